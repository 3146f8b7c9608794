"""Landing guidance: one prediction with its derivatives beside scipy, and a thousand closed-loop landings.

A guidance cycle of the one-reversal law (paper 004) needs the landing point and its derivatives to the amplitude and the time of the
reversal.  The workbench gives all three by one compiled function with exact tangents; scipy flies three trajectories with
solve_ivp at rtol 1e-8, equations in plain floats, restarted at the kinks of the bank profile, and takes differences.

Run: python -m benchmarks.landing [--quick] [--json]
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks import _bench, _landing_scipy
from models import native
from models.entry_cartesian import to_cartesian
from models.units import DEG
from ocp.predictor import Path, prediction
from studies import landing_flight as flights
from studies.landing_scenario import LandingScenario

LANDINGS, STEPS = 1000, 28
TRIAL = (1e-4, 0.01)  # steps of scipy's differences: of beta, and of the reversal time in s


class Cycle:
    """One guidance cycle at the entry of reference N2."""

    def __init__(self, steps: int = STEPS) -> None:
        self.set_up = flights.setting(LandingScenario())
        self.x = to_cartesian(self.set_up.entry)
        self.T, self.B = np.array([245.0, 275.0]), np.array([45.0, -45.0]) * DEG
        model = self.set_up.reference
        function = prediction(model, Path(2, steps, order=8), radius=self.set_up.radius, seeds=2)
        self.native = native.compile(function, lanes=1, threads=1)
        seeds = (np.zeros(12), np.array([0.0, 0.0, 1.0, 1.0]), np.concatenate([self.B, np.zeros(2)]), np.zeros(2 * len(model.params)))
        self.arguments = (self.x, np.zeros(1), np.array([600.0]), self.T, self.B, model.p0, *seeds)

    def workbench(self) -> tuple[np.ndarray, np.ndarray]:
        """Landing position (3,) and its derivatives (3, 2) to beta and to the time of the reversal."""
        out = self.native(*self.arguments)
        return out[0][:3], np.column_stack([out[4][:3], out[4][6:9]])

    def scipy(self, method: str, rtol: float) -> tuple[np.ndarray, np.ndarray]:
        """The same by three flights."""

        def land(beta: float, shift: float) -> np.ndarray:
            return _landing_scipy.fall(self.x, self.T + shift, self.B * (1 + beta), stop=1e4, method=method, rtol=rtol)[1][:3]

        base = land(0.0, 0.0)
        return base, np.column_stack([(land(TRIAL[0], 0.0) - base) / TRIAL[0], (land(0.0, TRIAL[1]) - base) / TRIAL[1]])


def cycles(*, quick: bool) -> list[dict[str, Any]]:
    """One row for each tool: time of a cycle, error of the point (m) and of the derivatives (relative)."""
    task, accurate = Cycle(), Cycle(steps=400)
    point, slope = accurate.workbench()
    size = np.linalg.norm(slope, axis=0)

    def row(tool: str, call: Any, repeat: int) -> dict[str, Any]:
        r, J = call()
        seconds = _bench.best(call, repeat=1 if quick else repeat, budget=5.0)
        errors = {
            "error_m": float(np.linalg.norm(r - point)),
            "error_of_derivatives": float((np.linalg.norm(J - slope, axis=0) / size).max()),
        }
        return {"tool": tool, "seconds": seconds, **errors}

    rows = [row(f"workbench, compiled ({task.native.backend}), exact derivatives", task.workbench, 2000)]
    for method in ("DOP853",) if quick else ("DOP853", "RK45", "LSODA"):
        _bench.announce(f"  scipy {method}")
        rows.append(row(f"scipy solve_ivp {method}, three flights", lambda method=method: task.scipy(method, 1e-8), 10))
    return rows


def landings(count: int, *, law: str) -> dict[str, Any]:
    """Closed-loop landings of the hard set under a law."""
    scenario = LandingScenario().edit({"guidance.law": law})
    set_up = flights.setting(scenario)
    guided = flights.guidance(scenario, set_up)
    cases = flights.draw(scenario, set_up, count)
    begin = time.perf_counter()
    landed = flights.fly_cases(scenario, set_up, guided, cases)
    first = time.perf_counter() - begin
    seconds = _bench.best(lambda: flights.fly_cases(scenario, set_up, guided, cases), repeat=2, budget=20.0)
    within = float(100 * (landed.distance < 1e3).mean())
    return {"law": law, "cases": count, "seconds": seconds, "first_call_s": first, "within_1km": within, "landed": int(landed.ok.sum())}


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Times of a cycle and of closed-loop landings."""
    rows = cycles(quick=quick)
    _bench.announce("  closed-loop landings")
    flown = [landings(16 if quick else LANDINGS, law=law) for law in ("paper", "modern")]
    return {"machine": _bench.machine(), "rows": rows, "landings": flown}


def show(result: dict[str, Any]) -> None:
    """The tables."""
    ours = result["rows"][0]["seconds"]
    lines = [
        (
            r["tool"],
            "",
            f"{1e3 * r['seconds']:.3g} ms",
            f"{r['seconds'] / ours:.3g}",
            f"{r['error_m']:.2g} m",
            f"{r['error_of_derivatives']:.1g}",
        )
        for r in result["rows"]
    ]
    _bench.table("One guidance cycle at entry", ("tool", "", "time", "ratio", "error", "of derivatives"), lines)
    lines = [
        (r["law"], f"{r['cases']} landings", f"{r['seconds']:.3g} s", f"{r['first_call_s']:.3g} s", f"{r['within_1km']:.4g} %")
        for r in result["landings"]
    ]
    _bench.table("Closed-loop landings, hard set", ("law", "", "time", "first call", "within 1 km"), lines)


if __name__ == "__main__":
    _bench.run(__doc__, measure, show)
