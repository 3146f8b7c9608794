"""The Schmitt-trigger jet loop of Deng et al. 2016 (paper 001): describing function beside the exact answers, resonance, and its cure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from models.checked import Array, ModelError
from models.describing import schmitt_df
from models.flexible_loop import FLEXIBLE_001, LinearLoop, Mode, jet_plant
from models.limit_cycles import closed_form_table, describing_cycle, frequency_bounds, sensitivities, symmetric_cycle
from models.limit_cycles_events import LoopRun, simulate_loop
from models.modulators import SchmittTrigger
from models.nyquist import Intersection, intersections
from models.periodic_orbits import Orbit, OrbitGuess, describe, find_orbits, from_harmonic, from_rigid, from_run
from ocp.jet_design import JetDesign, JetLimits, bands_around, design_trigger

if TYPE_CHECKING:
    from studies.result import StudyResult

PAPER = {"a": 0.15, "u_on": 0.7, "u_off": 0.3, "tau": 0.7}
DURATION = 4000.0
LOOPS = 10_000
SEED = 1
Progress = Callable[[str, float], None]


def starts(loop: LinearLoop, trigger: SchmittTrigger) -> Array:
    """Four starts, shape (4, n): attitude and rate of the body, the first mode at rest or deflected; in proportion to the thresholds."""
    x = np.zeros((4, len(loop.A)))
    size = trigger.u_on / PAPER["u_on"]
    rate = np.sqrt(loop.B[1] / PAPER["a"] * size)
    x[:, 0], x[:, 1] = size * np.array([0.5, 1.0, -0.2, 0.7]), rate * np.array([0.1, 0.0, 0.05, 0.02])
    if len(loop.A) > 2:
        x[2, 2] = 0.1 * size
    return x


def closed_forms(trigger: SchmittTrigger, *, a: float, tau: float) -> dict[str, Any]:
    """Everything that is known in closed form of the rigid loop, as JSON-able numbers; null with a reason where there is none."""
    predicted = describing_cycle(trigger, a=a, tau=tau)
    data: dict[str, Any] = {"parameters": {"a": float(a), "u_on": trigger.u_on, "u_off": trigger.u_off, "tau": float(tau)}}
    if trigger.h == 0:
        reason = "without hysteresis the coasting rate is zero: no limit cycle but chatter at the threshold"
        data |= {"w_exact": None, "w_exact_reason": reason, "w_df": None, "w_df_reason": predicted.reason, "A_df_trigger": None,
                 "A_df_attitude": None, "A_exact": None}  # fmt: skip
        return data
    exact, bounds = symmetric_cycle(trigger, a=a, tau=tau), frequency_bounds(trigger, a=a, tau=tau)
    data |= {
        "w_exact": exact.w, "w_df": predicted.w, "w_df_reason": predicted.reason or None,
        "A_df_trigger": predicted.trigger_amplitude, "A_df_attitude": predicted.attitude_amplitude, "A_exact": exact.amplitude,
        "period": exact.period, "rate": exact.rate, "switching_attitude": exact.switching, "pulse": exact.pulse, "duty": exact.duty,
        "multiplier": exact.multiplier,
        "theorem_2": None if bounds is None or predicted.w is None else {
            "difference": exact.w - predicted.w, "lower": bounds.lower, "upper": bounds.upper, "lower_abs": bounds.lower_abs,
        },
        "sensitivities": sensitivities(trigger, a=a, tau=tau),
    }  # fmt: skip
    return data


def predictions(loop: LinearLoop, trigger: SchmittTrigger) -> tuple[Intersection, ...]:
    """All intersections of the loop's linear part with -1/N, from four decades of frequencies around its modes and its cycle."""
    scale = [mode.frequency for mode in loop.modes] + [float(np.sqrt(np.abs(loop.B).max() / trigger.u_on))]
    span = 1e-2 * min(scale), 1e2 * max(scale)
    return intersections(
        loop.linear_part(), partial(schmitt_df, trigger), frequencies=span, amplitudes=(0.999 * trigger.u_on, 1e4 * trigger.u_on)
    )  # fmt: skip


def guesses_for(loop: LinearLoop, trigger: SchmittTrigger, predicted: Sequence[Intersection], *, a: float, tau: float) -> list[OrbitGuess]:
    """Guesses for the exact orbits: the rigid cycle, and each prediction, also at other amplitudes and frequencies."""
    low = 1.02 * trigger.u_on
    found = [
        from_harmonic(loop, trigger, amplitude=max(part * i.A, low), w=factor * i.w)
        for i in predicted for part in (1.0, 0.8, 0.6) for factor in (1.0, 0.75, 1.15)
    ]  # fmt: skip
    return found + ([from_rigid(loop, trigger, a=a, tau=tau)] if trigger.h > 0 else [])


def orbits(loop: LinearLoop, trigger: SchmittTrigger, *, a: float, tau: float, bias: float = 0.0) -> tuple[Orbit, ...]:
    """Verified periodic orbits of a jet plant: from the rigid cycle, from every prediction, and from where four simulations end."""
    guesses = guesses_for(loop, trigger, predictions(loop, trigger), a=a, tau=tau)
    if trigger.h == 0:
        return find_orbits(loop, trigger, guesses=guesses, bias=bias)  # a simulation may chatter for ever
    duration = max(DURATION, 60 * symmetric_cycle(trigger, a=a, tau=tau).period)
    return find_orbits(loop, trigger, guesses=guesses, starts=starts(loop, trigger), t_max=duration, bias=bias)


@dataclass(frozen=True, slots=True, eq=False)
class LoopState:
    """A flexible loop as it moves: predictions, exact orbits, and a simulation from each of the four starts."""

    trigger: SchmittTrigger
    tau: float
    loop: LinearLoop
    predicted: tuple[Intersection, ...]
    orbits: tuple[Orbit, ...]
    runs: tuple[LoopRun, ...]

    @property
    def peaks(self) -> list[float]:
        """Largest |flexible part| over the last half of each simulation."""
        return [run.peak_flexible(0.5 * run.t[-1]) for run in self.runs]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able numbers."""
        half = 0.5 * self.runs[0].t[-1]
        return {
            "u_on": self.trigger.u_on, "u_off": self.trigger.u_off, "tau": self.tau,
            "describing_function": [{"w": i.w, "A": i.A, "stability": i.stability} for i in self.predicted],
            "orbits": describe(self.orbits),
            "simulations": [
                {"x0": run.x[0].tolist(), "max_flexible_last_half": peak, "max_attitude_last_half": run.peak_attitude(half),
                 "w": run.frequency(half), "firing_duty": run.firing(half), "switchings": len(run.events)}
                for run, peak in zip(self.runs, self.peaks, strict=True)
            ],
        }  # fmt: skip


def loop_state(trigger: SchmittTrigger, *, a: float, tau: float, modes: Sequence[Mode], duration: float = DURATION) -> LoopState:
    """Simulate a loop from the four starts and find its orbits."""
    loop = jet_plant(a, tau=tau, modes=modes)
    runs = tuple(simulate_loop(loop, trigger, x0=x0, t_max=duration) for x0 in starts(loop, trigger))
    predicted = predictions(loop, trigger)
    guesses = guesses_for(loop, trigger, predicted, a=a, tau=tau)
    ends = [guess for guess in map(from_run, runs) if guess is not None]
    return LoopState(trigger, tau, loop, predicted, find_orbits(loop, trigger, guesses=[*guesses, *ends]), runs)


@dataclass(frozen=True, slots=True, eq=False)
class BoundsCheck:
    """Theorem 2 over random loops: difference of the frequencies and its bounds, each (N,), relative to w_df."""

    kappa: Array
    difference: Array
    lower: Array
    upper: Array
    lower_abs: Array

    @property
    def broken(self) -> int:
        """Loops for which a bound does not hold."""
        d = self.difference
        return int(((d > self.upper) | (d < self.lower) | (np.abs(d) < self.lower_abs)).sum())

    def to_dict(self) -> dict[str, Any]:
        """How tight the bounds are: quantiles over the loops."""
        size = np.abs(self.difference)
        over, under = (self.upper - self.difference) / size, self.lower_abs / size
        return {
            "loops": len(size), "broken": self.broken,
            "largest_difference_over_w_df": float(self.difference.max()), "smallest_difference_over_w_df": float(self.difference.min()),
            "excess_of_upper_over_difference": {
                "median": float(np.median(over)), "p99": float(np.quantile(over, 0.99)), "max": float(over.max()),
            },
            "excess_of_upper_over_w_df": float((self.upper - self.difference).max()),
            "lower_over_absolute_difference": {
                "min": float(under.min()), "p01": float(np.quantile(under, 0.01)), "median": float(np.median(under)),
            },
        }  # fmt: skip


def check_bounds(count: int = LOOPS, *, seed: int = SEED) -> BoundsCheck:
    """Draw `count` loops in which the describing function has an intersection, log-uniform over decades, and compare.

    Raises
    ------
    ModelError
    """
    if not isinstance(count, int) or count < 1:
        raise ModelError(f"check_bounds: count = {count!r}; expected a whole number >= 1")
    rng = np.random.default_rng(seed)
    rows = np.empty((0, 4))
    while len(rows) < count:
        u_on, a, tau = (10 ** rng.uniform(low, high, 4 * count) for low, high in ((-2.0, 1.0), (-4.0, 1.0), (-1.5, 1.5)))
        drawn = np.column_stack([a, u_on, u_on * rng.uniform(0, 1, 4 * count), tau])
        rows = np.vstack([rows, drawn[closed_form_table(drawn)["margin"] > 0]])
    rows = rows[:count]
    table = closed_form_table(rows)
    h, s = rows[:, 1] - rows[:, 2], rows[:, 1] + rows[:, 2]
    number = 8 * rows[:, 0] * s * rows[:, 3] ** 2 / (np.pi * h**2)
    scaled = {name: table[name] / table["w_df"] for name in ("lower", "upper", "lower_abs")}
    return BoundsCheck(number, (table["w_exact"] - table["w_df"]) / table["w_df"], **scaled)


@dataclass(frozen=True, slots=True, eq=False)
class JetLoopStudy:
    """Result of :func:`run`."""

    trigger: SchmittTrigger
    a: float
    tau: float
    modes: tuple[Mode, ...]
    closed: dict[str, Any]
    rigid: Orbit | None
    bounds: BoundsCheck
    design: JetDesign
    before: LoopState
    after: LoopState

    @property
    def quieter(self) -> float:
        """Least flexible motion of the given loop over the largest of the tuned one."""
        return min(self.before.peaks) / max(max(self.after.peaks), 1e-300)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able result."""
        return {**self.closed, "theorem_2_random_loops": self.bounds.to_dict(), "design": design_dict(self.design, self.before, self.after)}

    def result(self) -> StudyResult:
        """Figures, tables and comparisons for the report."""
        from studies.jetloop_report import result

        return result(self)


def design_dict(design: JetDesign, before: LoopState, after: LoopState) -> dict[str, Any]:
    """JSON-able numbers of a design and of the flexible loop before and after it."""
    return {
        "u_on": design.trigger.u_on, "u_off": design.trigger.u_off, "tau": design.tau, "w_exact": design.cycle.w,
        "w_df": describing_cycle(design.trigger, a=design.a, tau=design.tau).w, "A_exact": design.cycle.amplitude,
        "amplitude_change": design.amplitude_change, "pulse": design.cycle.pulse, "duty": design.cycle.duty,
        "duty_before": design.before.duty, "excluded": design.excluded.tolist(), "optimality": design.optimality,
        "max_flexible_before": min(before.peaks), "max_flexible_after": max(after.peaks),
        "quieter": min(before.peaks) / max(max(after.peaks), 1e-300),
        "before": before.to_dict(), "after": after.to_dict(),
    }  # fmt: skip


def designed(
    trigger: SchmittTrigger, *, a: float, tau: float, modes: Sequence[Mode], width: float, limits: JetLimits
) -> tuple[JetDesign, LoopState, LoopState]:
    """Tune a loop and look at it, flexible, before and after."""
    if not modes:
        raise ModelError("design: no flexible mode is given, so there is nothing to keep away from; give at least one")
    design = design_trigger(trigger, a=a, tau=tau, bands=bands_around(modes, width=width), limits=limits)
    before = loop_state(trigger, a=a, tau=tau, modes=modes)
    return design, before, loop_state(design.trigger, a=a, tau=design.tau, modes=modes)


def run(*, loops: int = LOOPS, width: float = 0.2, limits: JetLimits | None = None, progress: Progress | None = None) -> JetLoopStudy:
    """Reproduce paper 001: its numbers, its resonance (figure 5), Nyquist plots (6) and a quiet loop (7).

    Parameters
    ----------
    loops : int
        Random loops for Theorem 2.
    width : float
        Half width of the band around each mode, relative.
    limits : JetLimits, optional
    progress : callable, optional
        ``progress(label, fraction)``.
    """
    report = progress or (lambda stage, fraction: None)
    a, tau, trigger = PAPER["a"], PAPER["tau"], SchmittTrigger(PAPER["u_on"], PAPER["u_off"])
    closed = closed_forms(trigger, a=a, tau=tau)
    rigid = orbits(jet_plant(a, tau=tau), trigger, a=a, tau=tau)
    report("jet loop", 0.2)
    bounds = check_bounds(loops)
    report("jet loop", 0.4)
    design, before, after = designed(trigger, a=a, tau=tau, modes=FLEXIBLE_001, width=width, limits=limits or JetLimits())
    report("jet loop", 1.0)
    return JetLoopStudy(trigger, a, tau, FLEXIBLE_001, closed, rigid[0] if rigid else None, bounds, design, before, after)
