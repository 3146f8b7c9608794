"""Describing functions: the relay family in closed form, any other element by quadrature, the sampled relay word by word.

A describing function says what an element does to the fundamental of a sine; everything built on it is a prediction, not a proof.
Exact answers beside it: :mod:`models.limit_cycles` and :mod:`models.census`.
Sources: Deng et al. 2016 (paper 001), eq 4; Lu & Zhang 2012 (paper 000), eqs 4-11, Table 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.checked import Array, ModelError, as_finite, as_scalar
from models.modulators import SchmittTrigger

Complex = NDArray[np.complex128]
_BISECTIONS = 60


def relay_df(A: ArrayLike, *, u_on: float, u_off: float, level: float = 1.0) -> Complex:
    """Describing function of a relay with dead zone and hysteresis; shape of A.

    N(A) = (2 level/(pi A)) [sqrt(1 - (u_on/A)^2) + sqrt(1 - (u_off/A)^2)] - j 2 level (u_on - u_off)/(pi A^2) for A >= u_on, 0 below.
    u_on = u_off = 0 is the ideal relay, u_off = u_on a dead zone alone, u_off = -u_on the two-position relay with hysteresis.

    Parameters
    ----------
    A : array_like
        Amplitude at the input, > 0.
    u_on, u_off : float
        Thresholds, -u_on <= u_off <= u_on.
    level : float
        Output when on.

    Raises
    ------
    ModelError
        An amplitude that is not positive, thresholds in the wrong order.

    Source: Deng et al. 2016 (paper 001), eq 4.
    """
    amplitude = _amplitudes(A)
    on, off, out = as_scalar("relay: u_on", u_on), as_scalar("relay: u_off", u_off), as_scalar("relay: level", level)
    if not -on <= off <= on:
        raise ModelError(f"relay: u_off = {off:.6g} must lie between -u_on and u_on = {on:.6g}")
    share = np.minimum(on / amplitude, 1.0), np.clip(off / amplitude, -1.0, 1.0)
    real = np.sqrt(1 - share[0] ** 2) + np.sqrt(1 - share[1] ** 2)
    value = 2 * out / (np.pi * amplitude) * (real - 1j * (on - off) / amplitude)
    return np.asarray(np.where(amplitude >= on, value, 0.0), dtype=complex)


def schmitt_df(trigger: SchmittTrigger, A: ArrayLike) -> Complex:
    """Describing function of a Schmitt trigger, see :func:`relay_df`."""
    return relay_df(A, u_on=trigger.u_on, u_off=trigger.u_off)


def numerical_df(
    element: Callable[..., Array] | SchmittTrigger, A: ArrayLike, *, hysteretic: bool = False, bias: float = 0.0, samples: int = 2048
) -> Complex:  # fmt: skip
    """Describing function of any element by quadrature over one period of bias + A sin(theta); shape of A.

    N(A) = (2/(A T)) int y exp(-j theta) j dt.  The output is taken as a straight line between samples, jumps are located by bisection
    and the products with sine and cosine are integrated exactly: relays come out to rounding, smooth elements with an error of order
    1/samples^2.

    Parameters
    ----------
    element : callable or SchmittTrigger
        ``element(x) -> y`` without memory; or with ``hysteretic=True`` ``element(x, before) -> y``, where `before` is its output before x
        moved monotonically to where it is (relays with hysteresis, backlash).  Arrays of any shape in and out.
    A : array_like
        Amplitude, > 0.
    hysteretic : bool
    bias : float
        Mean of the input.
    samples : int
        Points on each of the rising and falling halves, >= 16.

    Raises
    ------
    ModelError
        An amplitude that is not positive, an element that returns another shape or a number that is not finite.
    """
    amplitude, mean = _amplitudes(A), as_scalar("numerical_df: bias", bias)
    if not isinstance(samples, int) or samples < 16:
        raise ModelError(f"numerical_df: samples = {samples!r}; expected an integer >= 16")
    response = _response(element, hysteretic)
    flat = amplitude.reshape(-1, 1)
    trough, peak = _settled(response, mean - flat, mean + flat)
    half = np.linspace(-np.pi / 2, np.pi / 2, samples + 1)
    total = np.zeros(len(flat), dtype=complex)
    for start, before in ((0.0, trough), (np.pi, peak)):  # rising from the trough, falling from the peak
        total = total + _half_period(partial(_along_sine, response, mean, flat, before), start + half[None, :])
    return np.asarray((1j * total / (np.pi * flat[:, 0])).reshape(amplitude.shape))


def _along_sine(response: Callable[[Array, Array], Array], mean: float, amplitude: Array, before: Array, theta: Array) -> Array:
    return response(mean + amplitude * np.sin(theta), before)


def _amplitudes(A: ArrayLike) -> Array:
    amplitude = as_finite("A", A)
    if (amplitude <= 0).any():
        raise ModelError(f"A: expected amplitudes > 0, got {amplitude.min():.6g}")
    return amplitude


def _response(element: Callable[..., Array] | SchmittTrigger, hysteretic: bool) -> Callable[[Array, Array], Array]:
    def call(x: Array, before: Array) -> Array:
        if isinstance(element, SchmittTrigger):
            flat = np.broadcast_to(before, x.shape).reshape(-1, 1)
            y = element.step(flat, x.reshape(-1))[1].reshape(x.shape)
        else:
            y = as_finite("element(x)", element(x, np.broadcast_to(before, x.shape)) if hysteretic else element(x))
        if y.shape != x.shape:
            raise ModelError(f"element: returned shape {y.shape} for inputs of shape {x.shape}; return one output for each input")
        return y

    return call


def _settled(response: Callable[[Array, Array], Array], low: Array, high: Array) -> tuple[Array, Array]:
    """Outputs at the trough and the peak once the cycle repeats."""
    trough = np.zeros_like(low)
    for _ in range(50):
        peak = response(high, trough)
        again = response(low, peak)
        if np.array_equal(again, trough):
            return trough, peak
        trough = again
    raise ModelError("element: its output does not repeat from one period of the sine to the next; it must not depend on time")


def _half_period(y_of: Callable[[Array], Array], theta: Array) -> Complex:
    """Integral of y exp(-j theta) over one monotone half, rows are amplitudes."""
    theta = np.broadcast_to(theta, (len(y_of(theta[:, :1])), theta.shape[1]))
    y = y_of(theta)
    step = np.abs(np.diff(y, axis=1))
    typical = np.median(step, axis=1, keepdims=True) + 1e-12 * (1 + np.abs(y).max(axis=1, keepdims=True))
    rows, cells = np.nonzero(step > 20 * typical)
    total = _linear_pieces(theta[:, :-1], theta[:, 1:], y[:, :-1], y[:, 1:]).sum(axis=1)
    if rows.size:
        columns = np.zeros((len(theta), np.bincount(rows).max()), dtype=int)  # the jumps of each row side by side
        count = np.bincount(rows, minlength=len(theta))
        place = np.arange(rows.size) - np.repeat(np.cumsum(count) - count, count)
        columns[rows, place] = cells
        valid = np.arange(columns.shape[1])[None] < count[:, None]
        at = np.arange(len(theta))[:, None]
        left, right = theta[at, columns], theta[at, columns + 1]
        y_left, y_right = y[at, columns], y[at, columns + 1]
        total -= np.where(valid, _linear_pieces(left, right, y_left, y_right), 0).sum(axis=1)
        a, b, y_a, y_b = left.copy(), right.copy(), y_left.copy(), y_right.copy()
        for _ in range(_BISECTIONS):
            middle = 0.5 * (a + b)
            y_m = y_of(middle)
            lower = np.abs(y_m - y_a) <= np.abs(y_m - y_b)
            a, y_a = np.where(lower, middle, a), np.where(lower, y_m, y_a)
            b, y_b = np.where(lower, b, middle), np.where(lower, y_b, y_m)
        parts = _linear_pieces(left, a, y_left, y_a) + _linear_pieces(b, right, y_b, y_right)
        total += np.where(valid, parts, 0).sum(axis=1)
    return np.asarray(total)


def _linear_pieces(a: Array, b: Array, y_a: Array, y_b: Array) -> Complex:
    """Integral from a to b of the straight line from y_a to y_b times exp(-j theta), without cancellation for short pieces."""
    width, middle = b - a, 0.5 * (a + b)
    q = 0.5 * width
    small = q < 1e-3
    safe = np.where(small, 1.0, q)
    even = np.where(small, 1 - q**2 / 6 + q**4 / 120, np.sin(safe) / safe)
    odd = np.where(small, q / 3 - q**3 / 30, (np.sin(safe) - safe * np.cos(safe)) / safe**2)
    return np.asarray(width * np.exp(-1j * middle) * (0.5 * (y_a + y_b) * even - 0.5j * (y_b - y_a) * odd))


@dataclass(frozen=True, slots=True)
class SampledMode:
    """One output word of the sampled relay within a period: `plus` samples on, zeros, `minus` samples on the other side, zeros.

    Attributes
    ----------
    word : tuple of int
        Outputs of one period, the block of +1 first.
    """

    word: tuple[int, ...]

    @property
    def period(self) -> int:
        """Samples in a period."""
        return len(self.word)

    @property
    def mc(self) -> Fraction | int:
        """Mode in the notation of the paper: samples on for equal sides, otherwise their ratio (smaller over larger)."""
        plus, minus = self.word.count(1), self.word.count(-1)
        return plus if plus == minus else Fraction(min(plus, minus), max(plus, minus))

    @property
    def fundamental(self) -> complex:
        """sum y_k exp(-2 pi j k/period)."""
        return complex(np.dot(self.word, np.exp(-2j * np.pi * np.arange(self.period) / self.period)))


@dataclass(frozen=True, slots=True, eq=False)
class SineRegion:
    """Where a sine x_k = X cos(2 pi k/period + psi) makes the relay give a word: a convex set of the phasor C = X exp(j psi).

    Attributes
    ----------
    mode : SampledMode
    C : ndarray of complex, shape (N,)
        Corners in counter-clockwise order, cut off at the largest amplitude asked for; empty if no sine gives the word.
    minus_inverse : ndarray of complex, shape (N,)
        The same corners of -1/N.
    """

    mode: SampledMode
    C: Complex
    minus_inverse: Complex

    @property
    def empty(self) -> bool:
        """No sine gives the word."""
        return len(self.C) == 0


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """What the sampled describing function says of one word in one loop.

    Attributes
    ----------
    mode : SampledMode
    G : complex
        Linear part at z = exp(2 pi j/period).
    X, psi : float
        The sine that would balance the loop.
    margin : float
        Least distance of its samples inside the thresholds; negative: the relay would not give the word.
    """

    mode: SampledMode
    G: complex
    X: float
    psi: float
    margin: float

    @property
    def predicted(self) -> bool:
        """The linear part lies in the region of the word: a cycle is expected."""
        return self.margin >= 0


def sampled_modes(period: int) -> tuple[SampledMode, ...]:
    """Words with which the relay can answer a sine of `period` samples, with both sides fired, one for each rotation class.

    For periods 2 to 5 these are the modes of Table 2 in all their orders (both signs, and both places of an unequal gap).

    Source: Lu & Zhang 2012 (paper 000), Table 2.
    """
    if not isinstance(period, int) or isinstance(period, bool) or not 2 <= period <= 64:
        raise ModelError(f"sampled_modes: period = {period!r}; expected an integer from 2 to 64 samples")
    found = []
    for plus in range(1, period):
        for minus in range(1, period - plus + 1):
            for gap in range(period - plus - minus + 1):
                mode = SampledMode((1,) * plus + (0,) * gap + (-1,) * minus + (0,) * (period - plus - minus - gap))
                if not sampled_region(mode, SchmittTrigger(1.0, 1.0)).empty:
                    found.append(mode)
    return tuple(found)


def sampled_df(mode: SampledMode, X: ArrayLike, psi: ArrayLike) -> Complex:
    """Sampled describing function N = Y(z)/X(z) at z = exp(2 pi j/period) of a word for x_k = X cos(2 pi k/period + psi).

    Source: Lu & Zhang 2012 (paper 000), eqs 5-8.
    """
    return np.asarray(mode.fundamental / _phasor_gain(mode.period, as_finite("X", X) * np.exp(1j * as_finite("psi", psi))))


def _phasor_gain(period: int, C: Complex) -> Complex:
    """sum x_k exp(-2 pi j k/period) for x_k = Re(C exp(2 pi j k/period))."""
    return np.asarray(2 * C.real + 0j if period == 2 else 0.5 * period * C)


def _half_planes(mode: SampledMode, trigger: SchmittTrigger) -> tuple[Array, Array]:
    """Rows (normal . [Re C, Im C]) >= bound that say: sample k gives output k after output k - 1."""
    angle = 2 * np.pi * np.arange(mode.period) / mode.period
    axis = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    normals: list[Array] = []
    bounds: list[float] = []
    for k, y in enumerate(mode.word):
        before = mode.word[k - 1]
        upper = trigger.u_off if before > 0 else trigger.u_on
        lower = trigger.u_off if before < 0 else trigger.u_on
        if y > 0:
            normals, bounds = [*normals, axis[k]], [*bounds, upper]
        elif y < 0:
            normals, bounds = [*normals, -axis[k]], [*bounds, lower]
        else:
            normals, bounds = [*normals, -axis[k], axis[k]], [*bounds, -upper, -lower]
    return np.array(normals), np.array(bounds)


def sampled_region(mode: SampledMode, trigger: SchmittTrigger, *, largest: float | None = None) -> SineRegion:
    """Set of sines (X, psi) for which the trigger really gives the word, and its image -1/N.

    Parameters
    ----------
    mode : SampledMode
    trigger : SchmittTrigger
    largest : float, optional
        Amplitude at which a set without end is cut off (by a square); 20 u_on if not given.

    Source: Lu & Zhang 2012 (paper 000), eqs 9-10 (M_c = 1 of period 4: u_on/cos(psi) <= X <= u_on/|sin(psi)|).
    """
    size = 20 * trigger.u_on if largest is None else as_scalar("largest", largest)
    corners = size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for normal, bound in zip(*_half_planes(mode, trigger), strict=True):
        corners = _clipped(corners, normal, bound)
    C = corners[:, 0] + 1j * corners[:, 1]
    if mode.period > 2 and _area(corners) < 1e-12 * size**2:
        C = C[:0]
    return SineRegion(mode, C, np.asarray(-_phasor_gain(mode.period, C) / mode.fundamental))


def _clipped(corners: Array, normal: Array, bound: float) -> Array:
    """Part of a convex polygon where normal . x >= bound."""
    if len(corners) == 0:
        return corners
    value = corners @ normal - bound
    after, value_after = np.roll(corners, -1, axis=0), np.roll(value, -1)
    out = []
    for a, b, va, vb in zip(corners, after, value, value_after, strict=True):
        if va >= 0:
            out.append(a)
        if (va >= 0) != (vb >= 0):
            out.append(a + (b - a) * va / (va - vb))
    return np.array(out).reshape(-1, 2)


def _area(corners: Array) -> float:
    x, y = corners[:, 0], corners[:, 1]
    return float(0.5 * np.abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))) if len(corners) > 2 else 0.0


def predict(G: Callable[[complex], complex], trigger: SchmittTrigger, *, periods: Sequence[int] = (2, 3, 4, 5)) -> tuple[Prediction, ...]:
    """Ask the sampled describing function for every word of some periods whether the loop x = -G(z) y should hold it.

    Parameters
    ----------
    G : callable
        Linear part from the relay's output to minus its input, a function of z.
    trigger : SchmittTrigger
    periods : sequence of int

    Returns
    -------
    tuple of Prediction
        One for each word, also those that are not predicted.

    Source: Lu & Zhang 2012 (paper 000), section 2.1, Fig. 6.
    """
    answers = []
    for period in periods:
        value = complex(G(complex(np.exp(2j * math.pi / period))))
        for mode in sampled_modes(period):
            wanted = -value * mode.fundamental  # the input's sum x_k exp(-2 pi j k/period)
            C = np.asarray(wanted.real / 2 if period == 2 else 2 * wanted / period, dtype=complex)
            normals, bounds = _half_planes(mode, trigger)
            margin = float((normals @ np.array([C.real, C.imag]) - bounds).min())
            answers.append(Prediction(mode, value, float(abs(C)), float(np.angle(C)), margin))
    return tuple(answers)
