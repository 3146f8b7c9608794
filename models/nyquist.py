"""Where a linear part meets -1/N of a describing function: amplitude, frequency and stability of the predicted limit cycles.

Source: harmonic balance 1 + N(A) G(j w) = 0, Deng et al. 2016 (paper 001), eq 1; stability by the quasi-static perturbation of A and s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import root

from models.checked import Array, ModelError, as_finite, as_scalar
from models.describing import Complex

_POINTS = 1500  # on each curve
_RESIDUAL = 1e-9  # of 1 + N G at an intersection
_STEP = 1e-6  # relative, of the differences that decide stability


@dataclass(frozen=True, slots=True, eq=False)
class LinearPart:
    """One-input one-output linear part, continuous (dt None) or sampled with period dt.

    Attributes
    ----------
    transfer : callable
        G(s) or G(z): complex array in, complex array of the same shape out.
    dt : float or None
        Sample time, s.
    delay : float
        Dead time, s (of a sampled part: a whole number of samples).
    """

    transfer: Callable[[Complex], Complex]
    dt: float | None = None
    delay: float = 0.0

    def __post_init__(self) -> None:
        if self.dt is not None and as_scalar("linear part: dt", self.dt) <= 0:
            raise ModelError(f"linear part: dt = {self.dt:.6g}; expected > 0, or None for a continuous one")
        if as_scalar("linear part: delay", self.delay) < 0:
            raise ModelError(f"linear part: delay = {self.delay:.6g} s; expected >= 0")
        if self.dt is not None and abs(self.delay / self.dt - round(self.delay / self.dt)) > 1e-9:
            raise ModelError(f"linear part: delay = {self.delay:.6g} s is no whole number of samples of {self.dt:.6g} s")

    def __call__(self, w: ArrayLike) -> Complex:
        """Frequency response at w rad/s; shape of w.

        Raises
        ------
        ModelError
            A pole on the imaginary axis (on the unit circle) at one of the frequencies.
        """
        s = 1j * as_finite("w", w)
        point = s if self.dt is None else np.exp(s * self.dt)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.asarray(self.transfer(np.atleast_1d(point)), dtype=complex).reshape(np.shape(s))
        value = np.asarray(value * np.exp(-s * self.delay))
        if not np.isfinite(value).all():
            bad = np.atleast_1d(s.imag)[~np.isfinite(np.atleast_1d(value))][0]
            raise ModelError(f"linear part: no finite value at w = {bad:.6g} rad/s, a pole lies there; leave that frequency out")
        return value


def rational(num: Sequence[float], den: Sequence[float], *, dt: float | None = None, delay: float = 0.0) -> LinearPart:
    """Linear part from polynomials in s (or z), highest power first."""
    top, bottom = as_finite("num", num), as_finite("den", den)
    if top.ndim != 1 or bottom.ndim != 1 or not top.size or not np.any(bottom):
        raise ModelError(f"rational: expected two lists of coefficients, the second not all zero, got {num!r} and {den!r}")
    return LinearPart(lambda s: np.asarray(np.polyval(top, s) / np.polyval(bottom, s), dtype=complex), dt, delay)


def state_space(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike = 0.0, *, dt: float | None = None, delay: float = 0.0
) -> LinearPart:  # fmt: skip
    """Linear part C (s - A)^-1 B + D of a system with one input and one output."""
    a = np.atleast_2d(as_finite("A", A))
    n = len(a)
    b, c, d = as_finite("B", B).reshape(-1, 1), as_finite("C", C).reshape(1, -1), float(as_finite("D", D).reshape(-1)[0])
    if a.shape != (n, n) or b.shape != (n, 1) or c.shape != (1, n):
        raise ModelError(f"state_space: expected A (n, n), B (n,), C (n,), got {np.shape(A)}, {np.shape(B)}, {np.shape(C)}")

    def transfer(s: Complex) -> Complex:
        inside = np.linalg.solve(s[:, None, None] * np.eye(n) - a, np.broadcast_to(b.astype(complex), (len(s), n, 1)))
        return np.asarray(d + (c @ inside)[:, 0, 0], dtype=complex)

    return LinearPart(transfer, dt, delay)


def linear_part(system: Any, *, delay: float = 0.0) -> LinearPart:
    """Take over a linear part: a :class:`LinearPart`, a pair (num, den), or an object of python-control with one input and output.

    An object with ``dt`` that can be called with complex numbers will do; dt None or 0 means continuous, True a sample time of 1 s.

    Raises
    ------
    ModelError
        Anything else, or a system with several inputs or outputs.
    """
    if isinstance(system, LinearPart):
        return system
    if isinstance(system, tuple) and len(system) == 2:
        return rational(system[0], system[1], delay=delay)
    sizes = {getattr(system, "ninputs", 1), getattr(system, "noutputs", 1)}
    if not callable(system) or not hasattr(system, "dt"):
        raise ModelError(f"linear_part: expected a LinearPart, (num, den) or a system of python-control, got {type(system).__name__}")
    if sizes != {1}:
        raise ModelError(f"linear_part: {system.ninputs} inputs and {system.noutputs} outputs; choose one of each")
    dt = None if not system.dt else float(system.dt)
    return LinearPart(lambda s: np.asarray(system(s), dtype=complex), dt, delay)


@dataclass(frozen=True, slots=True)
class Intersection:
    """A predicted limit cycle.

    Attributes
    ----------
    A : float
        Amplitude at the input of the element.
    w : float
        Frequency, rad/s.
    stability : {"stable", "unstable", "neutral"}
        Whether a slightly larger amplitude decays; quasi-static, a prediction.
    growth : float
        d(Re s)/d(ln A), 1/s: its sign decides.
    residual : float
        |1 + N G| there.
    """

    A: float
    w: float
    stability: Literal["stable", "unstable", "neutral"]
    growth: float
    residual: float


def intersections(
    system: Any, df: Callable[[Array], Complex], *, frequencies: tuple[float, float], amplitudes: tuple[float, float],
    points: int = _POINTS,
) -> tuple[Intersection, ...]:  # fmt: skip
    """All (A, w) in a range with 1 + N(A) G(j w) = 0, by frequency.

    The two curves are drawn as polygons in the plane of log magnitude and phase, every crossing of two edges is refined by Newton's
    method and kept where the residual vanishes.

    Parameters
    ----------
    system : LinearPart, (num, den), or object of python-control
    df : callable
        Describing function N(A) of the element for an array of amplitudes.
    frequencies, amplitudes : tuple of float
        Ranges (lowest, highest), rad/s and units of the element's input, > 0.  Of a sampled part at most pi/dt.
    points : int
        Points on each curve.

    Raises
    ------
    ModelError
        A range that is empty or not positive, an unknown kind of system.
    """
    linear = linear_part(system)
    spans = []
    for name, (low, high) in (("frequencies", frequencies), ("amplitudes", amplitudes)):
        if not 0 < as_scalar(f"{name}: lowest", low) < as_scalar(f"{name}: highest", high):
            raise ModelError(f"intersections: {name} = ({low:.6g}, {high:.6g}); expected 0 < lowest < highest")
        spans.append(np.geomspace(low, high, points))
    w, A = spans[0], _with_edges(df, spans[1])
    n, g = np.asarray(df(A), dtype=complex), linear(w)
    used = n != 0
    if used.sum() < 2 or not np.all(g != 0):
        return ()
    A = A[used]
    first, second = _log_polar(g), _log_polar(-1 / n[used])
    found: list[tuple[float, float]] = []
    turns = range(int(np.floor((first[:, 1].min() - second[:, 1].max()) / (2 * np.pi))),
                  int(np.ceil((first[:, 1].max() - second[:, 1].min()) / (2 * np.pi))) + 1)  # fmt: skip
    for turn in turns:
        for i, j in _crossings(first, second + np.array([0.0, 2 * np.pi * turn])):
            answer = _refined(linear, df, float(np.sqrt(w[i] * w[i + 1])), float(np.sqrt(A[j] * A[j + 1])))
            if answer is None or not (0.999 * w[0] <= answer[1] <= 1.001 * w[-1] and 0.999 * A[0] <= answer[0] <= 1.001 * A[-1]):
                continue
            if not any(abs(answer[0] / a - 1) + abs(answer[1] / b - 1) < 1e-6 for a, b in found):
                found.append(answer)
    return tuple(_judged(linear, df, a, b) for a, b in sorted(found, key=lambda pair: pair[1]))


def _with_edges(df: Callable[[Array], Complex], A: Array) -> Array:
    """More amplitudes where the describing function begins or ends: -1/N comes from infinity within one step there."""
    silent = np.asarray(df(A)) == 0
    near = np.geomspace(1e-12, 1.0, 200)
    more = [A]
    for i in np.flatnonzero(silent[1:] != silent[:-1]):
        quiet, loud = (A[i], A[i + 1]) if silent[i] else (A[i + 1], A[i])
        for _ in range(60):
            middle = 0.5 * (quiet + loud)
            quiet, loud = (middle, loud) if complex(np.asarray(df(np.array([middle])))[0]) == 0 else (quiet, middle)
        more.append(loud + ((A[i + 1] if silent[i] else A[i]) - loud) * near)
    return np.unique(np.concatenate(more))


def _log_polar(value: Complex) -> Array:
    return np.stack([np.log(np.abs(value)), np.unwrap(np.angle(value))], axis=1)


def _crossings(a: Array, b: Array) -> NDArray[np.int64]:
    """Pairs of edges of two polygons that meet, shape (M, 2); touching and collinear ones included, a little widened."""
    p, r = a[:-1, None], np.diff(a, axis=0)[:, None]
    q, s = b[None, :-1], np.diff(b, axis=0)[None]
    slack = 1e-9
    near = np.ones((len(a) - 1, len(b) - 1), dtype=bool)
    for axis in (0, 1):
        low_a, high_a = np.minimum(a[:-1, axis], a[1:, axis])[:, None], np.maximum(a[:-1, axis], a[1:, axis])[:, None]
        low_b, high_b = np.minimum(b[:-1, axis], b[1:, axis])[None], np.maximum(b[:-1, axis], b[1:, axis])[None]
        near &= (low_a <= high_b + slack) & (low_b <= high_a + slack)
    i, j = np.nonzero(near)
    pi, ri, qj, sj = p[i, 0], r[i, 0], q[0, j], s[0, j]
    det = ri[:, 0] * sj[:, 1] - ri[:, 1] * sj[:, 0]
    gap = qj - pi
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (gap[:, 0] * sj[:, 1] - gap[:, 1] * sj[:, 0]) / det
        u = (gap[:, 0] * ri[:, 1] - gap[:, 1] * ri[:, 0]) / det
    meets = (np.abs(t - 0.5) <= 0.6) & (np.abs(u - 0.5) <= 0.6) | (det == 0)
    return np.stack([i[meets], j[meets]], axis=1)


def _refined(linear: LinearPart, df: Callable[[Array], Complex], w: float, A: float) -> tuple[float, float] | None:
    """(A, w) of the root next to a guess, or None."""

    def balance(logs: Array) -> Array:
        bounded = np.exp(np.clip(logs, -700, 700))
        value = 1 + complex(np.asarray(df(bounded[:1]))[0]) * complex(linear(bounded[1]))
        return np.array([value.real, value.imag])

    try:
        answer = root(balance, np.log([A, w]), tol=1e-13)
    except ModelError:  # the search left the domain
        return None
    if not np.isfinite(answer.x).all() or np.hypot(*balance(answer.x)) > _RESIDUAL:
        return None
    return float(np.exp(answer.x[0])), float(np.exp(answer.x[1]))


def _judged(linear: LinearPart, df: Callable[[Array], Complex], A: float, w: float) -> Intersection:
    """Stability: A -> A (1 + a) moves the root of 1 + N(A) G(s) by ds = -a A N'(A)/N(A) G/G'(s); it decays where Re ds/a < 0."""
    n_low, n, n_high = (complex(v) for v in np.asarray(df(A * np.array([1 - _STEP, 1.0, 1 + _STEP]))))
    g_low, g, g_high = (complex(v) for v in linear(w * np.array([1 - _STEP, 1.0, 1 + _STEP])))
    slope_n = (n_high - n_low) / (2 * _STEP * n)  # d ln N/d ln A
    slope_g = (g_high - g_low) / (2j * _STEP * w * g)  # d ln G/d s
    growth = float((-slope_n / slope_g).real) if slope_g else 0.0
    limit = 1e-6 * abs(slope_n / slope_g) if slope_g else 0.0
    verdict: Literal["stable", "unstable", "neutral"] = "neutral" if abs(growth) <= limit else "stable" if growth < 0 else "unstable"
    return Intersection(A, w, verdict, growth, abs(1 + n * g))
