"""What turns a demand into jet pulses: Schmitt trigger, pulse-width pulse-frequency modulators, PWM, pseudo-rate, dead-band relay.

Every element is a frozen value with pure ``init`` and ``step``, vectorized over NumPy arrays and as one ``casadi.Function``, both written
once (``advance``), so that they cannot differ.  Long sequences: :func:`models.modulators_runs.run`; static characteristics and advice:
:mod:`models.modulators_static`.
Sources: Lu & Zhang 2012 (paper 000), sections 1-2; Deng et al. 2016 (paper 001), eq 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite
from models.modulators_base import (
    NUMPY,
    DigitalFilter,
    Filtered,
    Modulator,
    Ops,
    Values,
    checked_fields,
    dead_zone,
    require_positive,
    require_thresholds,
    schmitt,
)


@dataclass(frozen=True, slots=True, eq=False)
class SchmittTrigger(Modulator):
    """Relay with dead zone and hysteresis; output -1, 0 or 1.

    Attributes
    ----------
    u_on, u_off : float
        Thresholds of the input, 0 <= u_off <= u_on, u_on > 0.  On at x >= u_on, off at x <= u_off.
    """

    NAME: ClassVar[str] = "schmitt"
    STATES: ClassVar[tuple[str, ...]] = ("y",)
    PARAMETERS: ClassVar[tuple[str, ...]] = ("u_on", "u_off")

    u_on: float
    u_off: float

    def __post_init__(self) -> None:
        checked_fields(self)
        require_thresholds(self.NAME, self.u_on, self.u_off)

    @property
    def h(self) -> float:
        """Hysteresis u_on - u_off."""
        return self.u_on - self.u_off

    @staticmethod
    def advance(ops: Ops, z: Values, r: Any, p: Values) -> tuple[Values, Any]:
        """See :class:`Modulator`."""
        y = schmitt(ops, r, z[0], p[0], p[1])
        return (y,), y


def dead_band_relay(u_on: float) -> SchmittTrigger:
    """Plain relay with a dead band: 1 at r >= u_on, -1 at r <= -u_on, 0 between; no memory."""
    return SchmittTrigger(u_on, u_on)


@dataclass(frozen=True, slots=True, eq=False)
class DiscretePWPF(DigitalFilter):
    """Sampled PWPF modulator with feedback gain and asymmetric dead zone.

    x_k = n x_{k-1} + m (e_k + e_{k-1}),  e_k = f(r_k) - k y_{k-1},  y_k = Schmitt(x_k; y_{k-1}).

    Attributes
    ----------
    km, tau_m : float
        Gain and time constant (s) of the filter, > 0.
    u_on, h : float
        On threshold > 0 and hysteresis 0 <= h <= u_on.
    k : float
        Feedback gain, >= 0.
    delta : float
        f(0), >= 0.
    Ts : float
        Sample time, s, > 0.  From 2 tau_m on, n <= 0 and the filter alternates: allowed, but :func:`models.modulators_static.advice` warns.
    dead_low, dead_high : float
        Width of the flat part of f below and above r = 0, >= 0.

    Source: Lu & Zhang 2012 (paper 000), Figs 2 and 7, eq 3.  The figure of f is not legible; its equations use f = r + delta, the default.
    """

    NAME: ClassVar[str] = "pwpf"
    STATES: ClassVar[tuple[str, ...]] = ("x", "e", "y")
    PARAMETERS: ClassVar[tuple[str, ...]] = ("m", "n", "u_on", "u_off", "k", "delta", "dead_low", "dead_high")

    km: float = 4.0
    tau_m: float = 0.2
    u_on: float = 0.45
    h: float = 0.0
    k: float = 0.8
    delta: float = 0.0
    Ts: float = 0.06
    dead_low: float = 0.0
    dead_high: float = 0.0

    def __post_init__(self) -> None:
        checked_fields(self, h=0.0, k=0.0, delta=0.0, dead_low=0.0, dead_high=0.0)
        require_positive(self, ("km", "tau_m", "Ts"))
        require_thresholds(self.NAME, self.u_on, self.u_off)

    def f(self, r: ArrayLike) -> Array:
        """Asymmetric dead zone f(r) = delta + r - min(max(r, -dead_low), dead_high), f(0) = delta; shape of r."""
        return np.asarray(dead_zone(NUMPY, as_finite("pwpf: r", r), self.delta, self.dead_low, self.dead_high))

    @staticmethod
    def advance(ops: Ops, z: Values, r: Any, p: Values) -> tuple[Values, Any]:
        """See :class:`Modulator`."""
        (x, e, y), (m, n, u_on, u_off, k, delta, low, high) = z, p
        e_next = dead_zone(ops, r, delta, low, high) - k * y
        x_next = n * x + m * (e_next + e)
        y_next = schmitt(ops, x_next, y, u_on, u_off)
        return (x_next, e_next, y_next), y_next


@dataclass(frozen=True, slots=True, eq=False)
class ContinuousPWPF(Filtered):
    """PWPF modulator with a continuous filter; exact between switches for a demand held over Ts.

    tau_m dx/dt = -x + km (r - y),  y = Schmitt(x).  Under a constant demand the orbit leaves its first state by at most two switches and
    is periodic from then on, so a step of any length has a closed form; y of a step is the mean of the output over it.

    Attributes
    ----------
    km, tau_m : float
        Gain and time constant (s), > 0.
    u_on, h : float
        On threshold > 0, hysteresis 0 < h <= u_on (h = 0 switches infinitely often).
    Ts : float
        Time for which a sample of the demand is held, s, > 0; any length.

    Source: Lu & Zhang 2012 (paper 000), Fig. 1.
    """

    NAME: ClassVar[str] = "cpwpf"
    STATES: ClassVar[tuple[str, ...]] = ("x", "y")
    PARAMETERS: ClassVar[tuple[str, ...]] = ("km", "tau_m", "u_on", "u_off", "Ts")
    ELEMENTARY: ClassVar[bool] = True
    MEAN: ClassVar[bool] = True

    km: float = 4.0
    tau_m: float = 0.2
    u_on: float = 0.45
    h: float = 0.2
    Ts: float = 0.06

    def __post_init__(self) -> None:
        checked_fields(self)
        require_positive(self, ("km", "tau_m", "Ts"))
        if self.h <= 0:
            raise ModelError(f"cpwpf: h = {self.h:.6g}; expected > 0: without hysteresis the output switches infinitely often")
        require_thresholds(self.NAME, self.u_on, self.u_off)

    @staticmethod
    def advance(ops: Ops, z: Values, r: Any, p: Values) -> tuple[Values, Any]:
        """See :class:`Modulator`.  Phases in their order: firing against the demand, off, firing, then whole periods of off and on."""
        km, tau, u_on, u_off, held = p
        side = ops.where(r < 0, -1.0, 1.0)
        demand, x = side * r, side * z[0]
        y = schmitt(ops, x, side * z[1], u_on, u_off)
        against, off, on = km * (demand + 1.0), km * demand, km * (demand - 1.0)

        def until(start: Any, level: Any, target: Any) -> Any:
            """Time from `start` to `level` on the way to `target`; endless if it is not on the way."""
            passed, left = start - target, level - target
            reached = ops.both(passed * left >= left * left, left * left > 0)
            ratio = ops.where(reached, passed / ops.where(reached, left, 1.0), 1.0)
            return ops.where(reached, tau * ops.log(ratio), ENDLESS)

        t_against = ops.where(y < 0, until(x, -u_off, against), 0.0)
        t_off = ops.where(y > 0, 0.0, until(ops.where(y < 0, -u_off, x), u_on, off))
        t_on = until(ops.where(y > 0, x, u_on), u_off, on)
        again_off, again_on = until(u_off, u_on, off), until(u_on, u_off, on)

        first = ops.least(t_against, held)
        second = ops.least(t_off, held - first)
        third = ops.least(t_on, held - first - second)
        rest = held - first - second - third
        whole = ops.floor(rest / (again_off + again_on))
        part = rest - whole * (again_off + again_on)
        fourth = ops.least(again_off, part)
        fifth = part - fourth
        fired = third + whole * again_on + fifth

        phase = ops.where(held < t_against, 0.0, ops.where(held < t_against + t_off, 1.0, ops.where(rest > 0, 3.0, 2.0)))
        phase = ops.where(ops.both(phase > 2.5, fifth > 0), 4.0, phase)
        early = ops.where(y > 0, x, ops.where(phase > 1.5, u_on, ops.where(ops.both(phase > 0.5, y < 0), -u_off, x)))
        start = ops.where(phase > 3.5, u_on, ops.where(phase > 2.5, u_off, early))
        elapsed = ops.where(phase > 1.5, third, ops.where(phase > 0.5, second, first))
        elapsed = ops.where(phase > 3.5, fifth, ops.where(phase > 2.5, fourth, elapsed))
        firing = ops.either(ops.both(phase > 1.5, phase < 2.5), phase > 3.5)
        target = ops.where(firing, on, ops.where(phase < 0.5, against, off))
        x_next = target + (start - target) * ops.exp(-elapsed / tau)
        y_next = ops.where(firing, 1.0, ops.where(phase < 0.5, -1.0, 0.0))
        return (side * x_next, side * y_next), side * (fired - first) / held


ENDLESS = 1e300  # a time that no sample reaches; infinity would give NaN in branches that are not taken


@dataclass(frozen=True, slots=True, eq=False)
class PseudoRate(DigitalFilter):
    """Sampled pseudo-rate modulator: Schmitt trigger with a first-order lag in its feedback.

    x_k = n x_{k-1} + m (y_{k-1} + y_{k-2}),  y_k = Schmitt(r_k - x_k; y_{k-1}); m, n as in :class:`DiscretePWPF`.

    Attributes
    ----------
    km, tau_m : float
        Gain and time constant (s) of the lag, > 0.
    u_on, h : float
        On threshold > 0 and hysteresis 0 <= h <= u_on.
    Ts : float
        Sample time, s, > 0.

    Source: Deng et al. 2016 (paper 001), introduction (PRM); lag discretized as in paper 000, eq 3.
    """

    NAME: ClassVar[str] = "pseudorate"
    STATES: ClassVar[tuple[str, ...]] = ("x", "y", "before")
    PARAMETERS: ClassVar[tuple[str, ...]] = ("m", "n", "u_on", "u_off")

    km: float = 1.0
    tau_m: float = 0.5
    u_on: float = 0.1
    h: float = 0.05
    Ts: float = 0.01

    def __post_init__(self) -> None:
        checked_fields(self, h=0.0)
        require_positive(self, ("km", "tau_m", "Ts"))
        require_thresholds(self.NAME, self.u_on, self.u_off)

    @staticmethod
    def advance(ops: Ops, z: Values, r: Any, p: Values) -> tuple[Values, Any]:
        """See :class:`Modulator`."""
        (x, y, before), (m, n, u_on, u_off) = z, p
        x_next = n * x + m * (y + before)
        y_next = schmitt(ops, r - x_next, y, u_on, u_off)
        return (x_next, y_next, y), y_next


@dataclass(frozen=True, slots=True, eq=False)
class PWM(Modulator):
    """Pulse-width modulator: the demand is read once in `slots` samples and answered by one pulse of that fraction of them.

    Attributes
    ----------
    slots : int
        Samples in one period, >= 1.
    minimum : int
        Shortest pulse in samples, 0 <= minimum <= slots; what would be shorter is left out.
    Ts : float
        Sample time, s, > 0; the period is slots Ts.
    """

    NAME: ClassVar[str] = "pwm"
    STATES: ClassVar[tuple[str, ...]] = ("slot", "width")
    PARAMETERS: ClassVar[tuple[str, ...]] = ("slots", "minimum")

    slots: float = 20
    minimum: float = 1
    Ts: float = 0.01

    def __post_init__(self) -> None:
        checked_fields(self, slots=1.0, minimum=0.0)
        require_positive(self, ("Ts",))
        for name in ("slots", "minimum"):
            if getattr(self, name) != int(getattr(self, name)):
                raise ModelError(f"pwm: {name} = {getattr(self, name)}; expected a whole number of samples")
        if self.minimum > self.slots:
            raise ModelError(f"pwm: minimum = {self.minimum:g} is longer than the period of {self.slots:g} samples; use a shorter pulse")

    @staticmethod
    def advance(ops: Ops, z: Values, r: Any, p: Values) -> tuple[Values, Any]:
        """See :class:`Modulator`.  ``width`` has the sign of the demand."""
        (slot, width), (slots, minimum) = z, p
        wanted = ops.floor(ops.least(ops.absolute(r), 1.0) * slots + 0.5)
        wanted = ops.where(wanted < minimum, 0.0, wanted)
        width = ops.where(slot < 0.5, ops.where(r < 0, -wanted, wanted), width)
        y = ops.where(slot < ops.absolute(width), ops.where(width < 0, -1.0, 1.0), 0.0)
        return (ops.where(slot + 1.5 > slots, 0.0, slot + 1.0), width), y
