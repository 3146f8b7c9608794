"""Gain schedules of the guidance study, and the dispersed flights under each of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from models.core import Array, ModelError, evaluate
from ocp.laws import Law
from ocp.methods import RK4
from ocp.schedule import Schedule, fit_commands, time_means
from ocp.simulate import simulate_ensemble
from ocp.stops import falls_below
from ocp.trajectory import Trajectory
from studies import guidance
from studies.guidance import MEASURED, GainsAt, Miss

if TYPE_CHECKING:
    from studies.scenario import Scenario
    from studies.scenario_sections import DispersionSet
    from studies.synthesis import Synthesis

NAMES = ("open_loop", "time_varying", "least_squares", "time_mean", "paper", "paper_unsplit")
TRAINING_CASES = 60
TRAINING_STREAM = 1000  # of the seed: the cases that constants are fitted to are not those that judge them
Progress = Callable[[str, float], None]


def split_of(scenario: Scenario, end: float) -> dict[str, list[float]]:
    """Breakpoints of the downrange gain: the scenario's split, if it lies inside the flight."""
    split = scenario.guidance.split_s
    return {"s": [split]} if 0 < split < end else {}


def means(scenario: Scenario, synthesis: Synthesis) -> Schedule:
    """Time means of K(t), the downrange gain split."""
    t = synthesis.reference.t
    return time_means(t, synthesis.K, names=MEASURED, breakpoints=split_of(scenario, float(t[-1])))


def plans(scenario: Scenario, synthesis: Synthesis, onward: Trajectory) -> tuple[dict[str, GainsAt], list[str]]:
    """The gain schedules that are flown, by name, and remarks; `onward` is the reference continued below its end."""
    printed, split = scenario.guidance.paper_gains, np.array([scenario.guidance.split_s])
    early = np.array([printed.K1, printed.K2, printed.K3a, printed.K4])
    late = np.array([printed.K1, printed.K2, printed.K3b, printed.K4])
    none, two = np.zeros(0), np.array([early, late])
    schedules: dict[str, GainsAt] = {
        "open_loop": Schedule(MEASURED, none, np.zeros((1, 4)), 0.0),
        "time_varying": guidance.interpolated(synthesis.reference.t, synthesis.K),
        "time_mean": means(scenario, synthesis),
        "paper": Schedule(MEASURED, split, two, 0.0) if split[0] > 0 else Schedule(MEASURED, none, late[None], 0.0),
        "paper_unsplit": Schedule(MEASURED, none, early[None], 0.0),
    }
    try:
        schedules["least_squares"] = fitted(scenario, synthesis, onward)
    except ModelError as error:
        return schedules, [f"no constants are fitted to flown commands: {error}"]
    return schedules, []


def fitted(scenario: Scenario, synthesis: Synthesis, onward: Trajectory) -> Schedule:
    """Constants, the downrange gain split, fitted to the commands of K(t) in flights of the set `large`.

    Least squares over every command given above the gate before the reference ends.  It weighs each gain where
    deviations occur, and about halves the range error of time means.
    """
    reference, g = synthesis.reference, scenario.guidance
    end = float(reference.t[-1])
    varying = guidance.interpolated(reference.t, synthesis.K)
    x0, p = guidance.dispersed_cases(
        reference.model, reference.x[0], half_widths(scenario.dispersions.sets.large),
        cases=TRAINING_CASES, seed=(scenario.dispersions.seed, TRAINING_STREAM),
    )  # fmt: skip
    flown = simulate_ensemble(
        reference.model, law_of(scenario, onward, varying, "training"), x0=x0, p=p, samples=True,
        until=falls_below("h", scenario.reference.stop_altitude_m), t_max=end, method=RK4(step=flight_step(scenario)),
    )  # fmt: skip
    taken = flown.samples
    if taken is None:
        raise ModelError("none of the training flights could be flown")
    measured = measurements(reference, taken.x, p[taken.case])
    deviation = measured - guidance.measured_reference(onward)(taken.t)
    command = (varying(taken.t) * deviation).sum(axis=1)
    used = np.abs(measured[:, 0]) >= g.gate_load_g
    if np.count_nonzero(used) < 2:
        raise ModelError(f"the training flights hardly reach {g.gate_load_g:g} g0 (guidance.gate_load_g)")
    return fit_commands(taken.t[used], deviation[used], command[used], names=MEASURED, breakpoints=split_of(scenario, end))


def measurements(reference: Trajectory, x: Array, p: Array) -> Array:
    """Measured quantities (M, 4) at states x (M, nx) with parameters p (M, np) or (np,)."""
    model = reference.model
    y = evaluate(model.out, x, np.zeros((len(x), len(model.inputs))), p)[0]
    outputs = [v.name for v in model.outputs]
    return np.column_stack([y[:, outputs.index(n)] if n in outputs else x[:, model.index(n)] for n in MEASURED])


def flight_step(scenario: Scenario) -> float:
    """Integration step of the dispersed flights, s."""
    return min(scenario.numerics.step_s, scenario.guidance.sample_s)


def law_of(scenario: Scenario, onward: Trajectory, plan: GainsAt, name: str) -> Law:
    """The scenario's guidance law with one schedule of gains."""
    g = scenario.guidance
    return guidance.guidance_law(onward, plan, sample=g.sample_s, limit=scenario.vehicle.lift_to_drag, gate=g.gate_load_g, name=name)


def half_widths(half: DispersionSet) -> dict[str, float]:
    """A dispersion set in SI units and radians."""
    return {
        "gamma": math.radians(half.path_angle_deg), "V": half.speed_m_s, "density": half.density, "drag": half.drag,
        "lift": half.lift, "wave_amplitude": half.wave_amplitude, "wave_length": half.wave_length_m,
    }  # fmt: skip


def fly_dispersed(
    scenario: Scenario, synthesis: Synthesis, cases: int, progress: Progress | None
) -> tuple[dict[str, dict[str, Miss]], list[str]]:
    """All sets under all schedules, the same cases for every schedule; and remarks."""
    reference = synthesis.reference
    onward = guidance.continued(reference, flight_step(scenario))
    flown: dict[str, dict[str, Miss]] = {}
    schedules, remarks = plans(scenario, synthesis, onward)
    sets = list(scenario.dispersions.sets.items())
    for number, (name, half) in enumerate(sets):
        drawn = guidance.dispersed_cases(
            reference.model, reference.x[0], half_widths(half), cases=cases, seed=(scenario.dispersions.seed, number)
        )  # fmt: skip
        flown[name] = {}
        for k, (schedule, plan) in enumerate(schedules.items()):

            def report(part: float, label: str = f"{cases} flights, {name}, {schedule}", done: int = number * len(schedules) + k) -> None:
                if progress is not None:
                    progress(label, (done + part) / (len(sets) * len(schedules)))

            flown[name][schedule] = guidance.fly(
                law_of(scenario, onward, plan, schedule), reference, drawn, stop_altitude=scenario.reference.stop_altitude_m,
                t_max=float(onward.t[-1]), step=flight_step(scenario), progress=report,
            )  # fmt: skip
    return flown, remarks
