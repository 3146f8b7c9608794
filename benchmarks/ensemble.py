"""500 dispersed closed loops of entry guidance: the workbench, all cases at once, beside scipy, one case after the other.

The law is the study's own: K(t) in the measured quantities [n_x hdot s sdot], sampled every second, gated and limited
(Tang & Zhao 2000, paper 003, eq. 1), over the dispersions of the set ``large``.  Scipy flies the same cases with the same law
written in plain floats: solve_ivp restarted at every command, and the same Runge-Kutta method of order 4 in a Python loop.  It flies
a few cases; its time for all is extrapolated, and said so.

Run: python -m benchmarks.ensemble [--quick] [--json]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import ocp
from benchmarks import _bench
from benchmarks._entry import Array
from models.units import G0
from ocp.methods import RK4
from studies import guidance
from studies.scenario import Scenario
from studies.synthesis import build_reference, synthesize

CASES, SET = 500, "large"
Rate = Callable[[float, Any], list[float]]


class Task:
    """Scenario, reference, law and drawn cases, built once."""

    def __init__(self, cases: int) -> None:
        self.scenario = s = Scenario.default()
        self.reference = build_reference(s)
        self.schedule = guidance.interpolated(self.reference.t, synthesize(s, self.reference).K)
        self.step = min(s.numerics.step_s, s.guidance.sample_s)
        self.onward = guidance.continued(self.reference, self.step)
        self.law = guidance.guidance_law(
            self.onward, self.schedule, sample=s.guidance.sample_s, limit=s.vehicle.lift_to_drag, gate=s.guidance.gate_load_g, name="K(t)"
        )  # fmt: skip
        half = dict(s.dispersions.sets.items())[SET]
        widths = {
            "gamma": math.radians(half.path_angle_deg), "V": half.speed_m_s, "density": half.density, "drag": half.drag,
            "lift": half.lift, "wave_amplitude": half.wave_amplitude, "wave_length": half.wave_length_m,
        }  # fmt: skip
        self.x0, self.p = guidance.dispersed_cases(self.reference.model, self.reference.x[0], widths, cases=cases, seed=(1, 1))
        self.t_max = float(self.reference.t[-1]) + guidance.AFTERWARDS

    def workbench(self) -> Array:
        """Downrange at the stop of all cases, m."""
        flown = ocp.simulate_ensemble(
            self.reference.model, self.law, x0=self.x0, p=self.p, until=ocp.falls_below("h", self.scenario.reference.stop_altitude_m),
            t_max=self.t_max, method=RK4(step=self.step),
        )  # fmt: skip
        if not flown.ok.all():
            raise RuntimeError(f"cases failed: {flown.failures()[:3]}")
        return np.asarray(flown["s"])


def equations(task: Task, case: int) -> tuple[Callable[[float], Rate], Callable[[Any], tuple[float, ...]]]:
    """(input -> rate of [V gamma h s], state -> measured quantities) of one case, written by hand."""
    s, model, p = task.scenario, task.reference.model, task.p[case]
    value = {v.name: float(p[k]) for k, v in enumerate(model.params)}
    rho0, height, mu, radius = (
        s.atmosphere.surface_density_kg_m3 * value["rho_factor"], s.atmosphere.scale_height_m,
        s.planet.gravitational_parameter_m3_s2, s.planet.radius_m,
    )  # fmt: skip
    per_mass, cd, cl = 0.5 / s.vehicle.ballistic_coefficient_kg_m2, value["CD_factor"], value["CL_factor"]
    amplitude, number, phase = value["wave_amplitude"], 2 * math.pi / value["wave_length"], value["wave_phase"]
    exp, sin, cos = math.exp, math.sin, math.cos

    def drag_of(V: float, h: float) -> float:
        return per_mass * rho0 * exp(-h / height) * (1 + amplitude * sin(number * h + phase)) * V * V

    def with_input(u: float) -> Rate:
        def rate(_t: float, x: Any) -> list[float]:
            V, gamma, h, _ = x
            r = radius + h
            g = mu / (r * r)
            drag, sine, cosine = drag_of(V, h), sin(gamma), cos(gamma)
            return [-cd * drag - g * sine, cl * u * drag / V + (V / r - g / V) * cosine, V * sine, radius * V * cosine / r]

        return rate

    def measured(x: Any) -> tuple[float, ...]:
        V, gamma, h, downrange = x
        return -cd * drag_of(V, h) / G0, V * sin(gamma), downrange, radius * V * cos(gamma) / (radius + h)

    return with_input, measured


def tables(task: Task) -> tuple[list[list[float]], list[list[float]], float]:
    """Reference quantities and gains at every command, and the reference input."""
    sample = task.scenario.guidance.sample_s
    times = sample * np.arange(int(task.t_max / sample) + 1)
    flown = task.onward.at(np.minimum(times, task.onward.t[-1]))
    wanted = np.column_stack([flown[name] for name in guidance.MEASURED])
    return wanted.tolist(), task.schedule(times).tolist(), float(task.reference.u[0, 0])


def by_loop(task: Task, case: int, method: str, data: tuple[list[list[float]], list[list[float]], float]) -> float:
    """Downrange at the stop of one case, m: by "RK4" in plain floats, or by solve_ivp's `method`, command by command."""
    with_input, measured = equations(task, case)
    wanted, K, u_ref = data
    s = task.scenario
    sample, limit, gate, stop = s.guidance.sample_s, s.vehicle.lift_to_drag, s.guidance.gate_load_g, s.reference.stop_altitude_m
    x = task.x0[case].tolist()
    for k in range(len(K)):
        y = measured(x)
        correction = sum(a * (b - c) for a, b, c in zip(K[k], y, wanted[k], strict=True)) if abs(y[0]) >= gate else 0.0
        rate = with_input(min(max(u_ref + correction, -limit), limit))
        before, x = x, advance(rate, x, sample, method, task.step)
        if x[2] <= stop:
            return arrival(rate, before, sample, method, task.step, stop)
    raise RuntimeError(f"case {case} did not arrive")


def advance(rate: Rate, x: list[float], h: float, method: str, step: float) -> list[float]:
    """State after a time h under one command: "RK4" in equal steps of at most `step`, or solve_ivp's `method`."""
    if method != "RK4":
        end: list[float] = solve_ivp(rate, (0.0, h), x, method=method, rtol=1e-8, atol=1e-8).y[:, -1].tolist()
        return end
    count = math.ceil(h / step * (1 - 1e-12))
    h /= count
    for _ in range(count):
        k1 = rate(0.0, x)
        k2 = rate(0.0, [a + 0.5 * h * b for a, b in zip(x, k1, strict=True)])
        k3 = rate(0.0, [a + 0.5 * h * b for a, b in zip(x, k2, strict=True)])
        k4 = rate(0.0, [a + h * b for a, b in zip(x, k3, strict=True)])
        x = [a + h / 6 * (b + 2 * (c + d) + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)]
    return x


def arrival(rate: Rate, x: list[float], h: float, method: str, step: float, stop: float) -> float:
    """Downrange where the altitude falls to `stop` within a step, by the secant method."""
    low, high, a, b = 0.0, h, x[2] - stop, advance(rate, x, h, method, step)[2] - stop
    end = x
    for _ in range(30):
        at = high - b * (high - low) / (b - a)
        end = advance(rate, x, at, method, step)
        low, high, a, b = high, at, b, end[2] - stop
        if abs(b) < 1e-8 or a == b:
            break
    return end[3]


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Times for all cases, and the largest difference of the landing points."""
    cases = 20 if quick else CASES
    task = Task(cases)
    begin = time.perf_counter()
    ours = task.workbench()
    first = time.perf_counter() - begin
    seconds = min(first, _bench.best(task.workbench, repeat=1 if quick else 5, budget=20.0))
    data = tables(task)
    rows = [{"tool": "workbench", "cases_flown": cases, "seconds": seconds, "first_call_s": first, "largest_difference_m": 0.0}]
    for method, flown in (("RK4", 4), ("DOP853", 2)) if quick else (("RK4", 20), ("RK45", 5), ("DOP853", 5)):
        _bench.announce(f"  {method}, one case after the other")
        begin = time.perf_counter()
        others = np.array([by_loop(task, case, method, data) for case in range(flown)])
        spent = (time.perf_counter() - begin) * cases / flown
        name = "RK4 in plain Python" if method == "RK4" else f"scipy solve_ivp {method}"
        rows.append({
            "tool": name, "cases_flown": flown, "seconds": spent, "first_call_s": None,
            "largest_difference_m": float(np.abs(others - ours[:flown]).max()),
        })  # fmt: skip
    return {"machine": _bench.machine(), "cases": cases, "set": SET, "rms_miss_km": task_rms(task, ours), "rows": rows}


def task_rms(task: Task, downrange: Array) -> float:
    return float(np.sqrt(np.mean((downrange - task.reference["s"][-1]) ** 2))) / 1e3


def show(result: dict[str, Any]) -> None:
    """The table."""
    lines = []
    ours = result["rows"][0]["seconds"]
    for row in result["rows"]:
        flown = f"{row['cases_flown']} flown" + ("" if row["cases_flown"] == result["cases"] else ", time extrapolated")
        seconds = row["seconds"]
        lines.append((row["tool"], flown, f"{seconds:.3g} s", f"{seconds / ours:.3g}", f"{row['largest_difference_m']:.2g} m"))
    title = f"{result['cases']} dispersed closed loops, set {result['set']}, rms miss {result['rms_miss_km']:.3g} km"
    _bench.table(
        title, ("tool", "cases", "time", "ratio", "difference"), lines, note="difference: of the landing point, largest of the cases flown"
    )


if __name__ == "__main__":
    _bench.run(__doc__, measure, show)
