"""Control laws as values: constant, profile over time, feedback gains, and a user's own init/step law."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, as_finite, as_scalar, as_vector, evaluate, frozen, unknown_name

Signals = Callable[[Array, Array], Array]
Step = Callable[[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX], tuple[ca.SX, ca.SX]]


@dataclass(frozen=True, slots=True, eq=False)
class BoundLaw:
    """A law fitted to one model.

    Attributes
    ----------
    sample : float or None
        Period of a sampled law, s; None for an input that runs linearly from w[:nu] to w[nu:] over each group of steps, or, where
        n_signals is nu, is held at w over each.
    step : casadi.Function or None
        (t, x, y, z, w) -> (u, z) at each sample.
    z0 : ndarray, shape (nz,)
        Memory at the start.
    signals : callable
        (t_start (M,), t_end (M,)) -> (M, nw): what the law reads from tables over each period; the same for all cases.
    kinks : tuple of float
        Times at which the integration must restart, s.
    """

    sample: float | None
    step: ca.Function | None
    z0: Array
    signals: Signals
    n_signals: int
    kinks: tuple[float, ...] = ()

    def holds(self, n_inputs: int) -> bool:
        """True if the input stands still over each group."""
        return self.sample is not None or self.n_signals == n_inputs


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """A control law that can be fitted to a model: ``bind(model) -> BoundLaw``."""

    name: str
    bind: Callable[[Model], BoundLaw]


def constant(**inputs: float) -> Law:
    """Every input of the model held at the named value (SI, radians)."""

    def bind(model: Model) -> BoundLaw:
        u = _named_inputs(model, inputs)
        return BoundLaw(None, None, np.zeros(0), lambda start, end: np.tile(u, (len(start), 1)), len(u))

    return Law("constant", bind)


def profile(t: ArrayLike, *, kind: str = "linear", **columns: ArrayLike) -> Law:
    """Inputs given at times t (M,), held before the first and after the last.

    Parameters
    ----------
    t : array_like, shape (M,)
        Increasing times, s.  Each is a restart point of the integration.
    kind : {"linear", "previous"}
        Straight lines between the points, or each value held until the next time.
    **columns : array_like, shape (M,)
        One for every input of the model, by name.
    """
    times = frozen(np.atleast_1d(as_finite("profile: t", t)))
    if times.ndim != 1 or times.size == 0 or (np.diff(times) <= 0).any():
        raise ModelError("profile: t must be a non-empty list of increasing times; sort it and remove doubles")
    if kind not in ("linear", "previous"):
        raise ModelError(f"profile: kind: expected 'linear' or 'previous', got {kind!r}")
    values = {name: as_finite(f"profile: {name}", v) for name, v in columns.items()}
    for name, column in values.items():
        if column.shape != times.shape:
            raise ModelError(f"profile: {name}: expected shape {times.shape} as t, got {column.shape}")

    def bind(model: Model) -> BoundLaw:
        points = np.array([_named_inputs(model, {n: float(v[i]) for n, v in values.items()}) for i in range(len(times))])

        def signals(start: Array, end: Array) -> Array:
            if kind == "previous":
                return points[np.clip(np.searchsorted(times, 0.5 * (start + end), side="right") - 1, 0, None)]
            ends = [np.column_stack([np.interp(moment, times, column) for column in points.T]) for moment in (start, end)]
            return np.hstack(ends)

        return BoundLaw(None, None, np.zeros(0), signals, points.shape[1] * (1 if kind == "previous" else 2), tuple(times.tolist()))

    return Law(f"{kind} profile", bind)


def sampled(
    step: Step, *, sample: float, memory: Sequence[float] = (), signals: Signals | None = None, n_signals: int = 0, name: str = "sampled"
) -> Law:
    """A user's own law, called every `sample` seconds; its input is held in between.

    Parameters
    ----------
    step : callable
        ``step(t, x, y, z, w) -> (u (nu,), z_next (nz,))`` in ``casadi.SX``; y are the model's outputs with the input held
        so far (the law's first call sees a zero input).
    sample : float
        Period, s, > 0.
    memory : sequence of float, length nz
        Initial memory z.
    signals : callable, optional
        ``signals(t_start (M,), t_end (M,)) -> w (M, n_signals)`` in NumPy: table values, equal for all cases.
    """
    period = as_scalar("sampled: sample", sample)
    if period <= 0:
        raise ModelError(f"sampled: sample must be > 0 s, got {period}")
    z0 = frozen(np.atleast_1d(as_finite("sampled: memory", memory)) if len(memory) else np.zeros(0))

    @lru_cache(maxsize=8)  # one function per model, so that the compiled loop around it is reused
    def bind(model: Model) -> BoundLaw:
        sizes = (1, len(model.states), len(model.outputs), len(z0), n_signals)
        symbols = [ca.SX.sym(n, size) for n, size in zip(("t", "x", "y", "z", "w"), sizes, strict=True)]
        try:
            u, z = (ca.SX(v) for v in step(*symbols))
        except (TypeError, ValueError, NotImplementedError):
            raise ModelError(
                f"law {name}: step must return two casadi.SX columns (u, z_next); without memory return z as it came"
            ) from None
        if u.shape != (len(model.inputs), 1) or (z.shape != (len(z0), 1) and z.numel() + len(z0) > 0):
            raise ModelError(
                f"law {name}: step returned u of shape {u.shape} and z of shape {z.shape},"
                f" expected ({len(model.inputs)}, 1) and ({len(z0)}, 1)"
            )
        function = ca.Function(f"{model.name}_law", symbols, [ca.densify(u), ca.densify(z)], ["t", "x", "y", "z", "w"], ["u", "z_next"])
        read = signals or (lambda start, end: np.zeros((len(start), 0)))
        return BoundLaw(period, function, z0, read, n_signals)

    return Law(name, bind)


def call(law: Law, model: Model, *, t: float, x: ArrayLike, z: ArrayLike | None = None) -> tuple[Array, Array]:
    """One step of a sampled law outside a simulation: (u (nu,), z_next (nz,)) at time t and state x, with p0 and zero held input."""
    bound = law.bind(model)
    if bound.step is None:
        raise ModelError(f"law {law.name} is not sampled; it is a function of time only")
    xs = as_vector("x", x, model.states)
    y = evaluate(model.out, xs, np.zeros(len(model.inputs)), model.p0)[0]
    moment = np.array([as_scalar("t", t)])
    w = bound.signals(moment, moment + bound.sample)[0]
    u, z_next = evaluate(bound.step, moment, xs, y, bound.z0 if z is None else as_finite("z", z), w)
    return u, z_next


def _named_inputs(model: Model, values: Mapping[str, float]) -> Array:
    names = [v.name for v in model.inputs]
    for name in values:
        if name not in names:
            raise ModelError(unknown_name(f"{model.name}: input", name, names))
    missing = [n for n in names if n not in values]
    if missing:
        raise ModelError(f"{model.name}: input: missing {', '.join(missing)}; give every one of {' '.join(names)}")
    return as_vector("u", [values[n] for n in names], model.inputs)
