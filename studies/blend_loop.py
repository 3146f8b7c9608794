"""The sampled pitch loop of the orbiter as one CasADi function of a jet cycle: law, allocator, modulator, servo, plant, wind, bookkeeping.

A cycle of 60 ms has six steps of 10 ms.  At its start the law's demand goes through the allocator to the modulator, whose jets stay as they
are for the cycle; at every step law and allocator set the elevon and the plant advances by one step of RK4.
The allocator is any ``casadi.Function`` with the inputs and outputs of :func:`allocation.blending.paper`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from models import native
from models.checked import Array, ModelError, as_batch, as_vector, evaluate
from models.core import Model, unknown_name
from models.entry import SPHERE, Planet
from models.modulators import DiscretePWPF
from models.native_loop import NativeLoop, compile_loop
from models.pitch_jets import PitchJets
from models.shuttle import Orbiter
from models.shuttle_aero import OrbiterAero
from ocp.pitch_law import PitchGains, acceleration, rate_reference, trim_rate

MEMORY = ("t", "trim", "control", "alpha_cmd", "pwpf_x", "pwpf_e", "pwpf_y")
COUNTS = (
    "n", "sum_square", "max_error", "n_last", "sum_last", "pulses_below_q1", "pulses_between", "pulses_above_q2", "propellant", "last_sign",
    "alternations", "highest_pulse_qbar", "travel", "max_rate", "peak_load", "q1_s", "q2_s", "qbar_before", "trim_limit_s",
    "outside_s", "slow_s",
)  # fmt: skip
RECORD = (
    "t", "V", "gamma", "h", "s", "theta", "q", "delta_e", "delta_bf", "alpha", "alpha_cmd", "mach", "qbar", "load", "trim", "control",
    "delta_e_cmd", "demand", "slope", "duty", "k_blend", "jets", "pitch_moment", "K_alpha", "K_q", "K_integral",
)  # fmt: skip
LARGEST_STRESS = math.radians(20.0)  # rad, of the added command: more takes the angle of attack out of the aerodynamic tables
_LONGEST_PART = 125  # cycles recorded in one call: compiled code keeps them on the stack


@dataclass(frozen=True, slots=True, eq=False)
class LoopSettings:
    """Times, limits and thresholds of the loop.

    Attributes
    ----------
    control_s, steps : float, int
        Sample time of law and elevon; samples in one jet cycle.
    duration_s : float
        Length of a flight.
    transient_s, last_s : float
        Errors count after the first and, for the steady error, over the last so many seconds.
    quiet_from_s : float
        From here to q1 the command is steady: pulses of alternating sign are counted.
    q1, q2 : float
        Pa, as in the allocator.
    trim_above, trim_floor : float
        Dynamic pressure from which the trim integrates, and least one its gain is taken at, Pa.
    body_flap : float
        Command, rad.
    """

    control_s: float = 0.01
    steps: int = 6
    duration_s: float = 300.0
    transient_s: float = 10.0
    last_s: float = 60.0
    quiet_from_s: float = 42.0
    q1: float = 1000.0
    q2: float = 2500.0
    trim_above: float = 300.0
    trim_floor: float = 1000.0
    body_flap: float = math.radians(-11.7)

    def __post_init__(self) -> None:
        if not (self.control_s > 0 and self.steps >= 1 and self.duration_s > self.transient_s):
            raise ModelError(
                f"LoopSettings: control_s {self.control_s}, steps {self.steps}, duration_s {self.duration_s}: expected control_s > 0,"
                f" steps >= 1 and a flight longer than its transient of {self.transient_s} s"
            )
        if abs(self.duration_s / self.cycle_s - self.cycles) > 1e-6:
            raise ModelError(
                f"LoopSettings: duration_s {self.duration_s} is no whole number of jet cycles of {self.cycle_s:g} s; change one"
            )

    @property
    def cycle_s(self) -> float:
        """Length of a jet cycle, s."""
        return self.control_s * self.steps

    @property
    def cycles(self) -> int:
        """Number of jet cycles in a flight."""
        return round(self.duration_s / self.cycle_s)


@dataclass(frozen=True, eq=False)
class BlendLoop:
    """The closed loop: what flies, what commands it, what shares out its demand.

    Attributes
    ----------
    model : Model
        From :func:`models.orbiter_longitudinal`.
    vehicle, aero, jets : what the law knows of the vehicle (its nominal values, whatever is flown)
    gains : PitchGains
    command : casadi.Function
        (t, mach, stress) -> angle of attack, rad.
    allocator : casadi.Function
        As :func:`allocation.blending.paper`.
    modulator : DiscretePWPF
        Its sample time is that of a jet cycle.
    settings : LoopSettings
    """

    model: Model
    vehicle: Orbiter
    aero: OrbiterAero
    jets: PitchJets
    gains: PitchGains
    command: ca.Function
    allocator: ca.Function
    modulator: DiscretePWPF
    settings: LoopSettings = field(default_factory=LoopSettings)
    planet: Planet = SPHERE

    def __post_init__(self) -> None:
        s = self.settings
        if not math.isclose(self.modulator.Ts, s.cycle_s):
            raise ModelError(
                f"blend loop: the modulator samples every {self.modulator.Ts} s, a jet cycle lasts {s.cycle_s} s; make them equal"
            )
        wanted = ["demand", "qbar", "trim", "slope", "up", "down", "previous"]
        if self.allocator.name_in() != wanted or self.allocator.n_out() < 3:
            raise ModelError(f"blend loop: the allocator takes {self.allocator.name_in()}, expected {wanted} -> elevon, duty, k_blend")

    @property
    def carry(self) -> tuple[str, ...]:
        """Names of what goes from cycle to cycle: states, memory of the elements, running counts."""
        return tuple(v.name for v in self.model.states) + MEMORY + COUNTS

    @property
    def params(self) -> tuple[str, ...]:
        """Names of the parameters: those of the model, and `stress` (amplitude of the added command, rad)."""
        return (*(v.name for v in self.model.params), "stress")

    def parameters(self, changes: Mapping[str, float] | None = None) -> Array:
        """Parameter vector with some values changed by name."""
        p = np.append(self.model.p0, 0.0)
        for name, value in (changes or {}).items():
            if name not in self.params:
                raise ModelError(unknown_name("blend loop: parameters", name, self.params))
            p[self.params.index(name)] = value
        self.model.parameters(p[:-1])  # checks the ranges
        if not abs(p[-1]) <= LARGEST_STRESS:
            raise ModelError(
                f"blend loop: stress = {p[-1]:.6g} rad is beyond +-{LARGEST_STRESS:.6g} rad (20 deg);"
                " correct the value (angles are in radians: did you give degrees?)"
            )
        return p

    def start(self, x0: Array) -> Array:
        """Carry at t = 0 for a state (nx,), or carries for states (N, nx)."""
        x = as_batch("blend loop: x0", x0, self.model.states)
        mach = evaluate(self.model.out, x, np.zeros(4), self.model.p0)[0][..., self.model.index("mach")]
        first = np.zeros((*x.shape[:-1], len(self.carry)))
        first[..., : x.shape[-1]] = x
        first[..., self.carry.index("alpha_cmd")] = evaluate(self.command, np.zeros(1), mach[..., None], np.zeros(1))[0][..., 0]
        first[..., [self.carry.index(name) for name in ("q1_s", "q2_s")]] = -1.0
        return first

    @cached_property
    def cycle(self) -> ca.Function:
        """(carry, q (1,), p) -> (carry, record (len(RECORD), steps)); q is not read (compiled loops pass one number for each group)."""
        c, q, p = ca.SX.sym("c", len(self.carry)), ca.SX.sym("q"), ca.SX.sym("p", len(self.params))
        now, rows, held = c, [], ca.SX.zeros(4)
        for k in range(self.settings.steps):
            now, record = self._step(first=k == 0)(now, p, *((held,) if k else ()))
            held = record[[RECORD.index(n) for n in ("K_alpha", "K_q", "K_integral", "duty")]]
            rows.append(record)
        results = ca.cse([now, ca.horzcat(*rows)])  # measurement and first stage share their tables
        return ca.Function("blend_cycle", [c, q, p], results, ["c", "q", "p"], ["c_next", "record"])

    @cached_property
    def part(self) -> tuple[ca.Function, int]:
        """(carry, p) -> (carry, record (len(RECORD), samples)) over a part of a flight, and the number of parts."""
        count = next(n for n in range(_LONGEST_PART, 0, -1) if self.settings.cycles % n == 0)
        c, p = ca.MX.sym("c", len(self.carry)), ca.MX.sym("p", len(self.params))
        ends, record = self.cycle.mapaccum("blend_chain", count)(c, ca.MX.zeros(1, count), ca.repmat(p, 1, count))
        part = ca.Function("blend_record", [c, p], [ends[:, -1], record], ["c", "p"], ["c_end", "record"])
        return part, self.settings.cycles // count

    @cached_property
    def compiled_part(self) -> native.Native:
        """The function of :attr:`part`, compiled."""
        return native.compile(self.part[0], lanes=1, threads=1)

    def compiled(self, mode: native.Mode = "accurate", *, alone: bool = False) -> NativeLoop:
        """The loop over all cycles, compiled: for many cases in lanes, or for one alone."""
        c, p = ca.SX.sym("c", len(self.carry)), ca.SX.sym("p", len(self.params))
        endless = ca.Function("blend_margin", [c, p], [ca.SX(1.0)])
        return compile_loop(self.cycle, endless, lanes=1 if alone else "auto", mode=mode)

    def _step(self, *, first: bool) -> ca.Function:
        """(carry, p[, held]) -> (carry, record): one control sample; `held` is what the first sample of the cycle fixed."""
        key = f"blend_{'first' if first else 'next'}"
        c, p = ca.SX.sym("c", len(self.carry)), ca.SX.sym("p", len(self.params))
        held = ca.SX.sym("held", 4)
        old = SimpleNamespace(**dict(zip(self.carry, ca.vertsplit(c), strict=True)))
        new, record = self._sample(old, c, p, None if first else held)
        state = ca.vertcat(*(new[name] for name in self.carry))
        return ca.Function(key, [c, p] if first else [c, p, held], [state, ca.vertcat(*(record[n] for n in RECORD))])

    def _sample(self, old: Any, c: ca.SX, p: ca.SX, held: ca.SX | None) -> tuple[dict[str, Any], dict[str, Any]]:
        s, model, nx = self.settings, self.model, len(self.model.states)
        x, params = c[:nx], p[: len(model.params)]
        command = old.trim + old.control
        applied = ca.vertcat(command, s.body_flap, old.pwpf_y > 0, old.pwpf_y < 0)
        y = dict(zip((v.name for v in model.outputs), ca.vertsplit(model.out(x, applied, params)), strict=True))
        law = self._law(old, y, p, held)
        new: dict[str, Any] = dict(zip(("pwpf_x", "pwpf_e", "pwpf_y"), (old.pwpf_x, old.pwpf_e, old.pwpf_y), strict=True))
        if held is None:
            z, fired = self.modulator.function()(ca.vertcat(old.pwpf_x, old.pwpf_e, old.pwpf_y), ca.fmin(ca.fmax(law["duty"], -1.0), 1.0))
            new = {"pwpf_x": z[0], "pwpf_e": z[1], "pwpf_y": fired}
        jets = new["pwpf_y"]
        u = ca.vertcat(law["delta_e_cmd"], s.body_flap, jets > 0, jets < 0)
        x_next = _rk4(model.rhs, x, u, params, s.control_s)
        new |= dict(zip((v.name for v in model.states), ca.vertsplit(x_next), strict=True))
        new |= {"t": old.t + s.control_s, "trim": law["trim_next"], "control": law["control"], "alpha_cmd": law["alpha_cmd"]}
        new |= self._counts(old, new, y, law, p, cycle_start=held is None)
        states = dict(zip((v.name for v in model.states), ca.vertsplit(x), strict=True))
        return new, states | {n: y[n] for n in ("alpha", "mach", "qbar", "load", "pitch_moment")} | law | {"t": old.t, "jets": jets}

    def _law(self, old: Any, y: Mapping[str, Any], p: ca.SX, held: ca.SX | None) -> dict[str, Any]:
        """Demand and its sharing out, from what is measured; the vehicle's nominal values."""
        s, body, jets = self.settings, self.vehicle, self.jets
        gains = self.gains.at(y["mach"], y["qbar"]) if held is None else ca.vertsplit(held[:3])
        K_alpha, K_q, K_integral = gains
        alpha_cmd = self.command(old.t, y["mach"], p[-1])
        radius = self.planet.radius + old.h
        reference = rate_reference((alpha_cmd - old.alpha_cmd) / s.control_s, y["gamma_dot"], old.V, old.gamma, radius)
        error = y["alpha"] - alpha_cmd
        wanted = acceleration(error, old.q - reference, K_alpha, K_q)
        effect = self.aero.elevon_slope(y["mach"], y["alpha"], old.trim + old.control)
        slope = y["qbar"] * body.area * body.chord * ca.fmin(effect, -1e-3)
        up, down = (float(m) for m in jets.moments())
        demand = body.Iyy * wanted / slope
        control, duty, k_blend = self.allocator(demand, y["qbar"], old.trim, slope, up, down, old.control)[:3]
        if held is not None:
            duty = held[3]
        speed = trim_rate(error, K_integral, qbar=y["qbar"], slope=slope, inertia=body.Iyy, above=s.trim_above, floor=s.trim_floor)
        trim = body.elevon.held(old.trim + s.control_s * speed)
        return {
            "alpha_cmd": alpha_cmd, "demand": demand, "slope": slope, "control": control, "duty": duty, "k_blend": k_blend,
            "trim": old.trim, "trim_next": trim, "delta_e_cmd": old.trim + control,
            "K_alpha": K_alpha, "K_q": K_q, "K_integral": K_integral,
        }  # fmt: skip

    def _counts(
        self, old: Any, new: Mapping[str, Any], y: Mapping[str, Any], law: Mapping[str, Any], p: ca.SX, *, cycle_start: bool
    ) -> dict[str, Any]:
        """Running counts after this sample."""
        s, qbar = self.settings, y["qbar"]
        up, down = (p[self.params.index(n)] * f for n, f in (("up_share", self.jets.flow_up), ("down_share", self.jets.flow_down)))
        error = ca.fabs(y["alpha"] - law["alpha_cmd"])
        counts, late = old.t > s.transient_s - 1e-9, old.t > s.duration_s - s.last_s - 1e-9
        moved = ca.fabs(new["delta_e"] - old.delta_e)
        found = {
            "n": old.n + counts, "sum_square": old.sum_square + counts * error**2,
            "max_error": ca.fmax(old.max_error, counts * error), "n_last": old.n_last + late,
            "sum_last": old.sum_last + late * (y["alpha"] - law["alpha_cmd"]),
            "travel": old.travel + moved, "max_rate": ca.fmax(old.max_rate, moved / s.control_s),
            "peak_load": ca.fmax(old.peak_load, y["load"]),
            "q1_s": _crossing(old, qbar, s.q1, old.q1_s, s.control_s), "q2_s": _crossing(old, qbar, s.q2, old.q2_s, s.control_s),
            "qbar_before": qbar,
        }  # fmt: skip
        stop = ca.logic_or(law["trim"] <= self.vehicle.elevon.lower, law["trim"] >= self.vehicle.elevon.upper)
        found["trim_limit_s"] = old.trim_limit_s + s.control_s * stop
        domain = self.aero.domain
        low, high = domain["alpha"]
        found["outside_s"] = old.outside_s + s.control_s * ca.logic_or(y["alpha"] < low, y["alpha"] > high)
        found["slow_s"] = old.slow_s + s.control_s * (y["mach"] < domain["mach"][0])
        kept = ("pulses_below_q1", "pulses_between", "pulses_above_q2", "propellant", "last_sign", "alternations", "highest_pulse_qbar")
        found |= {name: getattr(old, name) for name in kept}
        if cycle_start:
            jets = new["pwpf_y"]
            pulse = ca.logic_and(jets != 0, jets != old.pwpf_y)
            quiet = ca.logic_and(old.t > s.quiet_from_s - 1e-9, found["q1_s"] < 0)
            found |= {
                "pulses_below_q1": old.pulses_below_q1 + pulse * (qbar < s.q1),
                "pulses_between": old.pulses_between + pulse * ca.logic_and(qbar >= s.q1, qbar <= s.q2),
                "pulses_above_q2": old.pulses_above_q2 + pulse * (qbar > s.q2),
                "propellant": old.propellant + s.cycle_s * ((jets > 0) * up + (jets < 0) * down),
                "alternations": old.alternations + ca.logic_and(pulse, quiet) * (jets * old.last_sign < 0),
                "last_sign": ca.if_else(quiet, ca.if_else(jets != 0, jets, old.last_sign), 0.0),
                "highest_pulse_qbar": ca.fmax(old.highest_pulse_qbar, pulse * qbar),
            }
        return found


def _crossing(old: Any, qbar: Any, level: float, found: Any, step: float) -> Any:
    """Time of the first upward crossing of a level, linear between samples; -1 before it."""
    passed = ca.logic_and(found < 0, ca.logic_and(old.qbar_before < level, qbar >= level))
    rise = ca.if_else(passed, qbar - old.qbar_before, 1.0)
    return ca.if_else(ca.logic_and(passed, old.t > 0), old.t - step * (qbar - level) / rise, found)


def _rk4(rhs: ca.Function, x: ca.SX, u: ca.SX, p: ca.SX, step: float) -> ca.SX:
    k1 = rhs(x, u, p)
    k2 = rhs(x + 0.5 * step * k1, u, p)
    k3 = rhs(x + 0.5 * step * k2, u, p)
    k4 = rhs(x + step * k3, u, p)
    return x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One recorded flight: `record` (N, len(RECORD)) at every control sample, `end` the carry at the end by name, `p` (np,) as flown."""

    record: Array
    end: Mapping[str, float]
    loop: BlendLoop
    p: Array

    @property
    def t(self) -> Array:
        """Times of the samples, s."""
        return self["t"]

    def __getitem__(self, name: str) -> Array:
        """Column of the record, shape (N,)."""
        if name not in RECORD:
            raise ModelError(unknown_name("flight", name, RECORD))
        return self.record[:, RECORD.index(name)]


def fly(loop: BlendLoop, x0: Array, p: Array | None = None, *, compiled: bool = False) -> Flight:
    """Fly one case and keep every sample.

    Parameters
    ----------
    loop : BlendLoop
    x0 : ndarray, shape (nx,)
    p : ndarray, shape (np,), optional
        From ``loop.parameters``.
    compiled : bool
        The same numbers several times faster, once the compiler has taken its seconds.

    Raises
    ------
    ModelError
        A start of a wrong shape or outside its range, a number that is not finite.
    """
    end = loop.start(as_vector("blend loop: x0", x0, loop.model.states))
    params = loop.parameters() if p is None else p
    function, count = loop.part
    native_part, records = loop.compiled_part if compiled else None, []
    for _ in range(count):
        end, record = native_part(end, params) if native_part is not None else evaluate(function, end, params)
        records.append(record.T)
    return Flight(np.concatenate(records), dict(zip(loop.carry, end.tolist(), strict=True)), loop, params)


def fly_many(loop: BlendLoop, x0: Array, p: Array, *, mode: native.Mode = "accurate") -> dict[str, Array]:
    """Fly N cases in the lanes of compiled code and keep what :data:`COUNTS` and the states are at the end.

    Parameters
    ----------
    loop : BlendLoop
    x0 : ndarray, shape (nx,) or (N, nx)
    p : ndarray, shape (N, np)
        From ``loop.parameters``.
    mode : {"accurate", "fast"}

    Returns
    -------
    dict of str to ndarray (N,)
        By name, and `finite`: 1.0 where the flight stayed finite to its end.
    """
    starts = np.atleast_2d(loop.start(x0))
    if len(starts) == 1:
        starts = np.tile(starts, (len(p), 1))
    ends = loop.compiled(mode, alone=len(p) == 1).run(starts, np.zeros((loop.settings.cycles, 1)), p)
    found = {name: ends.after[:, i] for i, name in enumerate(loop.carry)}
    return found | {"finite": (ends.outcome == 0).astype(float)}
