"""Effectors and what is asked of them: the values that every allocation method takes and returns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, Status, as_finite, as_scalar, frozen, unknown_name

WRITTEN = 1e-5  # of the range: a jammed command this far beyond a limit is the limit, written with few digits


@dataclass(frozen=True, slots=True, eq=False)
class Effectors:
    """Jets and surfaces as the columns of one linear map, wrench = B u, with their limits.

    Attributes
    ----------
    names : tuple of str, length n
    B : ndarray, shape (m, n)
        Wrench (N, N m, or whatever the axes are) of each effector at u = 1.
    lower, upper : ndarray, shape (n,)
        Limits of u, finite; a jet runs from 0 to 1 (its duty), a surface between its stops in rad.
    rate : ndarray, shape (n,)
        Largest |du/dt|, 1/s; infinite where nothing limits it (default).
    axes : tuple of str, length m
        Names of the rows.
    flow : ndarray, shape (n,)
        Propellant at u = 1, kg/s; 0 (default) for what burns none.  Effectors with a flow are jets: on or off, in pulses.
    unit : str
        Of the wrench, such as "N m", for the labels of figures; empty (default) where nobody knows it.

    Raises
    ------
    ModelError
        Shapes that do not agree, crossed limits, NaN, a name that stands twice.
    """

    names: tuple[str, ...]
    B: Array
    lower: Array
    upper: Array
    rate: Array = field(default_factory=lambda: np.array(np.inf))
    axes: tuple[str, ...] = ()
    flow: Array = field(default_factory=lambda: np.array(0.0))
    unit: str = ""

    def __post_init__(self) -> None:
        names = tuple(str(name) for name in self.names)
        B = as_finite("effectors: B", self.B)
        if B.ndim != 2 or B.shape[1] != len(names) or not B.size:
            raise ModelError(f"effectors: B has shape {B.shape}, expected (axes, {len(names)}): one column for each of the names given")
        axes = tuple(str(a) for a in self.axes) or tuple(f"axis{i + 1}" for i in range(B.shape[0]))
        if len(axes) != B.shape[0]:
            raise ModelError(f"effectors: {len(axes)} names of axes beside {B.shape[0]} rows of B; give one for each row")
        for what, given in (("effector", names), ("axis", axes)):
            twice = [name for name in given if given.count(name) > 1]
            if twice:
                raise ModelError(f"effectors: the {what} {twice[0]!r} stands twice; names must differ")
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "B", frozen(B))
        object.__setattr__(self, "lower", self._column("lower", self.lower))
        object.__setattr__(self, "upper", self._column("upper", self.upper))
        object.__setattr__(self, "rate", self._column("rate", self.rate, infinite=True))
        object.__setattr__(self, "flow", self._column("flow", self.flow))
        for name, low, high, rate, flow in zip(names, self.lower, self.upper, self.rate, self.flow, strict=True):
            if low > high:
                raise ModelError(f"effectors: {name}: lower {low:.6g} is above upper {high:.6g}; exchange or correct them")
            if rate < 0 or flow < 0:
                raise ModelError(f"effectors: {name}: rate {rate:.6g} and flow {flow:.6g} must be >= 0; give magnitudes")
            if flow > 0 and low < 0:
                raise ModelError(f"effectors: {name}: burns propellant and has lower {low:.6g}; a jet pushes one way, expected >= 0")

    def _column(self, what: str, values: ArrayLike, *, infinite: bool = False) -> Array:
        raw = np.asarray(values, dtype=float)
        checked = np.where(np.isposinf(raw), math.pi, raw) if infinite else raw  # infinity is allowed here, NaN is not
        as_finite(f"effectors: {what}", checked)
        n = len(self.names)
        if raw.ndim == 0:
            return frozen(np.full(n, float(raw)))
        if raw.shape != (n,):
            raise ModelError(f"effectors: {what} has shape {raw.shape}, expected ({n},): one value for each effector")
        return frozen(raw)

    def __repr__(self) -> str:
        first = ", ".join(self.names[:3]) + (", ..." if len(self.names) > 3 else "")
        axes = ", ".join(self.axes) + (f" in {self.unit}" if self.unit else "")
        return f"Effectors({len(self.names)}: {first}; {int(self.jets.sum())} jets; axes {axes})"

    def label(self, text: str) -> str:
        """Text of a figure's axis on which a wrench stands, with its unit if there is one."""
        return f"{text} [{self.unit}]" if self.unit else text

    def index(self, name: str) -> int:
        """Column of an effector."""
        if name not in self.names:
            raise ModelError(unknown_name("effectors", name, self.names))
        return self.names.index(name)

    @property
    def jets(self) -> np.ndarray:
        """True for effectors that burn propellant, shape (n,)."""
        return self.flow > 0

    def failed(self, names: Iterable[str] | Mapping[str, float | None]) -> Effectors:
        """The same effectors with some of them out of order.

        Parameters
        ----------
        names : names, or mapping name -> value
            Jammed where the mapping says (a surface stuck at 0.1 rad still acts); names alone (or None) stop at 0, or at the limit
            nearest to 0.

        Raises
        ------
        ModelError
            An unknown name; a value beyond the limits of its effector, where it cannot have stopped.
        """
        values: dict[str, float | None] = dict(names) if isinstance(names, Mapping) else dict.fromkeys(names)
        lower, upper = self.lower.copy(), self.upper.copy()
        for name, value in values.items():
            i = self.index(name)
            lower[i] = upper[i] = min(max(0.0, lower[i]), upper[i]) if value is None else self._jammed(i, value)
        return replace(self, lower=lower, upper=upper)

    def _jammed(self, i: int, value: float) -> float:
        name, low, high = self.names[i], float(self.lower[i]), float(self.upper[i])
        found = as_scalar(f"effectors: failed: {name}", value)
        slack = WRITTEN * (high - low)
        if not low - slack <= found <= high + slack:
            hint = "duty from 0 (off) to 1 (always on)" if self.jets[i] else "angles are in radians: did you give degrees?"
            raise ModelError(f"effectors: failed: {name}: found {found:.6g}, expected a value from {low:.6g} to {high:.6g}; {hint}")
        return min(max(found, low), high)

    def within_reach(self, previous: ArrayLike, dt: float) -> Effectors:
        """The same effectors with the limits that the rates leave for the next dt (s) after the commands `previous` (n,)."""
        before = as_finite("effectors: previous", previous)
        step = as_scalar("effectors: dt", dt)
        if before.shape != (len(self.names),) or step <= 0:
            raise ModelError(f"effectors: within_reach: got shape {before.shape} and dt {step}, expected ({len(self.names)},) and dt > 0")
        room = self.rate * step
        # a command beyond its limits comes back as fast as it may: then both limits stand at the nearest point that it can reach
        lower = np.minimum(np.maximum(self.lower, before - room), before + room)
        upper = np.maximum(np.minimum(self.upper, before + room), before - room)
        return replace(self, lower=lower, upper=upper)

    def demands(self, demand: ArrayLike) -> Array:
        """Checked demand, shape (m,) or (N, m)."""
        values = as_finite("demand", demand)
        if values.ndim not in (1, 2) or values.shape[-1] != len(self.axes) or not values.size:
            raise ModelError(
                f"demand: expected shape ({len(self.axes)},) or (N, {len(self.axes)}) for [{' '.join(self.axes)}], got {values.shape}"
            )
        return values


@dataclass(frozen=True, slots=True, eq=False)
class Allocation:
    """Commands for one demand (shapes as given) or for N of them (a leading axis N everywhere).

    Attributes
    ----------
    u : ndarray, shape (n,)
        Commands, always inside the limits; with rates, inside what these leave (from beyond a limit it takes time to come back).
    wrench : ndarray, shape (m,)
        B u: what the commands deliver.
    residual : ndarray, shape (m,)
        demand - wrench: what remains unmet.
    saturated : ndarray of bool, shape (n,)
        Commands that stand at a limit.
    status : Status or tuple of Status
        OK: the method's own problem is solved, which a large residual does not contradict.
    kkt : tuple of float or of ndarray
        (primal, dual, gap), relative, of the method's own problem; see :mod:`allocation.qp`.  Methods that solve no
        optimization problem give not-a-number for the last two.
    method : str
    """

    u: Array
    wrench: Array
    residual: Array
    saturated: np.ndarray
    status: Status | tuple[Status, ...]
    kkt: tuple[Array, Array, Array] | tuple[float, float, float]
    method: str = ""

    @property
    def ok(self) -> bool:
        """True if every status is OK."""
        return self.status.ok if isinstance(self.status, Status) else all(s.ok for s in self.status)

    @property
    def worst_kkt(self) -> float:
        """Largest finite one of the KKT residuals."""
        values = np.concatenate([np.ravel(k) for k in self.kkt])
        return float(np.max(values[np.isfinite(values)], initial=0.0))


AT_LIMIT = 1e-9  # of the range: nearer to a limit counts as at it


def allocation(
    effectors: Effectors,
    demand: Array,
    *,
    u: Array,
    status: Status | Sequence[Status] = Status.OK,
    kkt: tuple[ArrayLike, ArrayLike, ArrayLike] | None = None,
    method: str = "",
    limits: tuple[Array, Array] | None = None,
) -> Allocation:
    """Complete commands u (n,) or (N, n) to an :class:`Allocation`: wrench, residual, saturation, primal residual.

    Commands outside the limits are brought back to them, and by how much becomes the primal residual; commands that are not finite
    raise ModelError.  `limits` (lower, upper), shape (n,) or (N, n), stands for the effectors' own.
    """
    lower, upper = limits if limits is not None else (effectors.lower, effectors.upper)
    raw = as_finite(f"{method or 'allocation'}: u", u)
    if raw.shape != (*demand.shape[:-1], len(effectors.names)):
        raise ModelError(f"{method or 'allocation'}: u has shape {raw.shape}, expected {(*demand.shape[:-1], len(effectors.names))}")
    inside = np.clip(raw, lower, upper)
    span = np.where(upper > lower, upper - lower, 1.0)
    primal = np.max(np.abs(raw - inside) / span, axis=-1)
    wrench = inside @ effectors.B.T
    saturated = (inside - lower <= AT_LIMIT * span) | (upper - inside <= AT_LIMIT * span)
    single = demand.ndim == 1
    unknown = np.full(demand.shape[:-1], np.nan)
    own, dual, gap = kkt if kkt is not None else (0.0, unknown, unknown)
    residuals = (np.maximum(primal, own), np.asarray(dual, float), np.asarray(gap, float))
    states: Status | tuple[Status, ...] = status if isinstance(status, Status) else tuple(status)
    if not single and isinstance(states, Status):
        states = (states,) * len(demand)
    return Allocation(
        u=frozen(inside), wrench=frozen(wrench), residual=frozen(demand - wrench), saturated=saturated, status=states,
        kkt=tuple(float(r) for r in residuals) if single else tuple(frozen(r) for r in residuals),  # type: ignore[arg-type]
        method=method,
    )  # fmt: skip
