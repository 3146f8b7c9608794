"""What all modulators share: one text of each step for NumPy and CasADi, the Schmitt trigger, the dead zone, checks of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, as_scalar

Values = tuple[Any, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Ops:
    """The few operations in which NumPy and CasADi differ in name."""

    where: Callable[..., Any]
    both: Callable[..., Any]
    either: Callable[..., Any]
    least: Callable[..., Any]
    most: Callable[..., Any]
    exp: Callable[..., Any]
    log: Callable[..., Any]
    floor: Callable[..., Any]
    absolute: Callable[..., Any]


NUMPY = Ops(np.where, np.logical_and, np.logical_or, np.fmin, np.fmax, np.exp, np.log, np.floor, np.abs)
CASADI = Ops(ca.if_else, ca.logic_and, ca.logic_or, ca.fmin, ca.fmax, ca.exp, ca.log, ca.floor, ca.fabs)


class Modulator:
    """A sampled element with memory: z, y = step(z, r) once for each sample of the demand r."""

    __slots__ = ()
    NAME: ClassVar[str]
    STATES: ClassVar[tuple[str, ...]]
    PARAMETERS: ClassVar[tuple[str, ...]]
    ELEMENTARY: ClassVar[bool] = False  # its step has exponentials, which NumPy and the C library may round differently
    MEAN: ClassVar[bool] = False  # its output is a mean over the sample, not -1, 0 or 1

    @staticmethod
    def advance(ops: Ops, z: Values, r: Any, p: Values) -> tuple[Values, Any]:
        """(z_next, y) by the operations `ops`; z and p as tuples of numbers, arrays or symbols."""
        raise NotImplementedError

    def parameters(self) -> Array:
        """What ``advance`` reads, shape (np,), in the order of ``PARAMETERS``."""
        return np.array([getattr(self, name) for name in self.PARAMETERS], dtype=float)

    def init(self) -> Array:
        """State at rest, shape (nz,): everything zero, jets off."""
        return np.zeros(len(self.STATES))

    def step(self, z: ArrayLike, r: ArrayLike) -> tuple[Array, Array]:
        """One sample.

        Parameters
        ----------
        z : array_like, shape (nz,) or (runs, nz)
        r : array_like, scalar or shape (runs,)
            Demand as a fraction of what the jets deliver.

        Returns
        -------
        z_next : ndarray, shape (nz,) or (runs, nz)
        y : ndarray, shape () or (runs,)
            Output, -1, 0 or 1 (:class:`ContinuousPWPF`: its mean over the sample).

        Raises
        ------
        ModelError
            A wrong shape or a number that is not finite.
        """
        state, demand = as_finite(f"{self.NAME}: z", z), as_finite(f"{self.NAME}: r", r)
        if state.ndim not in (1, 2) or state.shape[-1] != len(self.STATES):
            n = len(self.STATES)
            raise ModelError(f"{self.NAME}: z: expected shape ({n},) or (runs, {n}) for [{' '.join(self.STATES)}], got {state.shape}")
        if demand.ndim > 1 or (state.ndim == 2 and demand.ndim == 1 and len(demand) != len(state)):
            raise ModelError(f"{self.NAME}: r: expected one number, or one for each of the {len(state)} runs, got shape {demand.shape}")
        shape = np.broadcast_shapes(state.shape[:-1], demand.shape)
        columns = tuple(np.broadcast_to(state[..., i], shape) for i in range(state.shape[-1]))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # in branches that are not taken
            after, y = self.advance(NUMPY, columns, np.broadcast_to(demand, shape), tuple(self.parameters()))
        return np.stack([np.broadcast_to(a, shape) for a in after], axis=-1).astype(float), np.asarray(y, dtype=float)

    def function(self) -> ca.Function:
        """The step as a casadi.Function (z (nz,), r (1,)) -> (z_next (nz,), y (1,)), parameters inside it."""
        z, r = ca.SX.sym("z", len(self.STATES)), ca.SX.sym("r")
        after, y = self.advance(CASADI, tuple(ca.vertsplit(z)), r, tuple(ca.SX(v) for v in self.parameters()))
        return ca.Function(f"{self.NAME}_step", [z, r], [ca.vertcat(*after), y], ["z", "r"], ["z_next", "y"])

    @classmethod
    @cache
    def kernel(cls) -> ca.Function:
        """The step with the parameters as an input: (z (nz,), r (1,), p (np,)) -> (z_next (nz,), y (1,))."""
        z, r, p = ca.SX.sym("z", len(cls.STATES)), ca.SX.sym("r"), ca.SX.sym("p", len(cls.PARAMETERS))
        after, y = cls.advance(CASADI, tuple(ca.vertsplit(z)), r, tuple(ca.vertsplit(p)))
        return ca.Function(f"{cls.NAME}_kernel", [z, r, p], [ca.vertcat(*after), y], ["z", "r", "p"], ["z_next", "y"])


class Filtered(Modulator):
    """A first-order filter and a Schmitt trigger with the hysteresis h."""

    __slots__ = ()
    km: float
    tau_m: float
    u_on: float
    h: float
    Ts: float

    @property
    def u_off(self) -> float:
        """Off threshold u_on - h."""
        return self.u_on - self.h


class DigitalFilter(Filtered):
    """The filter km/(tau_m s + 1) by the trapezoidal rule: x_k = n x_{k-1} + m (e_k + e_{k-1}).

    Source: Lu & Zhang 2012 (paper 000), eq 3.
    """

    __slots__ = ()

    @property
    def m(self) -> float:
        """Gain, km Ts/(2 tau_m + Ts) (12/23 for the values of paper 000, where its eq 11 prints 0.5237)."""
        return self.km * self.Ts / (2 * self.tau_m + self.Ts)

    @property
    def n(self) -> float:
        """Pole, (2 tau_m - Ts)/(2 tau_m + Ts), between -1 and 1."""
        return (2 * self.tau_m - self.Ts) / (2 * self.tau_m + self.Ts)


def schmitt(ops: Ops, x: Any, y: Any, u_on: Any, u_off: Any) -> Any:
    """Output of the Schmitt trigger for input x and the output y before it.

    On (+1) at x >= u_on; stays on while x > u_off; off at x <= u_off; the same mirrored.  With u_off = u_on the memory has no effect:
    a dead-band relay with 1 at x >= u_on, -1 at x <= -u_on and 0 between.

    Source: Deng et al. 2016 (paper 001), eq 2.
    """
    plus = ops.either(x >= u_on, ops.both(y > 0, x > u_off))
    minus = ops.either(x <= -u_on, ops.both(y < 0, x < -u_off))
    return ops.where(plus, 1.0, ops.where(minus, -1.0, 0.0))


def dead_zone(ops: Ops, r: Any, delta: Any, low: Any, high: Any) -> Any:
    """f(r) = delta + r - min(max(r, -low), high): flat at delta for -low <= r <= high, slope 1 outside."""
    return delta + (r - ops.least(ops.most(r, -low), high))


def require_thresholds(name: str, u_on: float, u_off: float) -> None:
    """Refuse thresholds that make no trigger, with the reason."""
    if u_on <= 0:
        raise ModelError(f"{name}: u_on = {u_on:.6g}; expected > 0: at 0 or below the jets would fire both ways without a demand")
    if u_off > u_on:
        raise ModelError(f"{name}: u_off = {u_off:.6g} is above u_on = {u_on:.6g}; a jet on at u_on must turn off at or below it")
    if u_off < 0:
        raise ModelError(
            f"{name}: u_off = {u_off:.6g} < 0 (h = {u_on - u_off:.6g} is more than u_on = {u_on:.6g}): the jet would stay on while its"
            " input asks for the other direction; use a hysteresis h <= u_on"
        )


def checked_fields(modulator: Any, **lowest: float) -> None:
    """Every field a finite number, those named not below their lowest value."""
    for field in fields(modulator):
        value = as_scalar(f"{modulator.NAME}: {field.name}", getattr(modulator, field.name))
        if field.name in lowest and not value >= lowest[field.name]:
            raise ModelError(f"{modulator.NAME}: {field.name} = {value:.6g}; expected >= {lowest[field.name]:g}")
        object.__setattr__(modulator, field.name, value)


def require_positive(modulator: Any, names: tuple[str, ...]) -> None:
    """Refuse fields that are not above zero."""
    for name in names:
        if getattr(modulator, name) <= 0:
            raise ModelError(f"{modulator.NAME}: {name} = {getattr(modulator, name):.6g}; expected > 0")
