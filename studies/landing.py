"""Fixed-point landing: both laws over the dispersion sets, what limits them, the footprint, and what any law could reach.

Source: Tian Yucheng 1998 (paper 004).  Its vehicle is not identified; reference N2 stands for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from models.core import Array
from models.entry_cartesian import to_spherical
from models.units import DEG, KM
from ocp.landing import Landings
from ocp.landing_footprint import boundary
from ocp.landing_optimal import best_profile
from ocp.trajectory import Trajectory
from studies import landing_flight as flights
from studies.landing_answer import reachability, statistics
from studies.landing_scenario import LandingScenario

if TYPE_CHECKING:
    from studies.result import StudyResult

Progress = Callable[[str, float], None]
LAWS = ("paper", "modern")
SETS = ("density", "small", "medium", "hard")
FROM = (0.0, 150.0, 250.0, 330.0)  # s: where the footprint is drawn
WORST = 5  # cases of the one-reversal law for which the best profile is found
# one change each to the hard set under the law of several reversals
CHANGES: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("as it stands", {}),
    ("servo 15 deg/s", {"actuator.rate_deg_s": 15.0}),
    ("navigation 100 m, 1 m/s", {"sensors.position_m": 100.0, "sensors.velocity_m_s": 1.0}),
    ("accelerometer bias 0.02, noise 0.05 m/s2", {"sensors.force_bias_m_s2": 0.02, "sensors.force_noise_m_s2": 0.05}),
    ("bank error 1 deg", {"sensors.bank_deg": 1.0}),
    ("bank error 2 deg", {"sensors.bank_deg": 2.0}),
    ("lift +10 % at low Mach number", {"truth.mach_lift": 0.10}),
    ("lift -10 % at low Mach number", {"truth.mach_lift": -0.10}),
    ("US Standard Atmosphere flown, exponential on board", {"truth.atmosphere": "us76_smooth"}),
    ("load limit 3.3 g", {"guidance.load_limit_g": 3.3}),
    ("all sensor errors, bank 1 deg, lift -10 %", {
        "sensors.position_m": 100.0, "sensors.velocity_m_s": 1.0, "sensors.force_bias_m_s2": 0.02, "sensors.force_noise_m_s2": 0.05,
        "sensors.bank_deg": 1.0, "truth.mach_lift": -0.10,
    }),
)  # fmt: skip
PAPER_CHANGES: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("one reversal, prediction in the central field as printed", {"guidance.law": "paper", "guidance.gravity": "central"}),
)
FAILURES: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("path angle -2.2 deg", {"reference.path_angle_deg": -2.2}),
    ("lift coefficient times 0.7", {"truth.lift_factor": 0.7}),
)


@dataclass(frozen=True, slots=True, eq=False)
class LandingStudy:
    """Result of :func:`run`.

    Attributes
    ----------
    scenario : LandingScenario
    reference : Trajectory
        Open loop.
    numbers, sensitivities : mapping
        Of the reference.
    flown : mapping of (law, set) to Landings
    changed : tuple of (text, statistics)
        The hard set with one thing changed.
    footprints : tuple of (time, polygon (M, 2) m, state (6,))
    nominal : mapping of law to Trajectory
        The nominal guided flights.
    failures : tuple of (text, answer)
        Targets outside the footprint.
    best : tuple of mapping
        Worst cases of the one-reversal law: its miss, that of the other law, and that of the best profile.
    gain_law : mapping of set to statistics
        Range errors of the gain law of paper 003 on dispersions of the same size.
    """

    scenario: LandingScenario
    set_up: flights.Setting
    reference: Trajectory
    numbers: Mapping[str, float]
    sensitivities: Mapping[str, float]
    flown: Mapping[tuple[str, str], Landings]
    changed: tuple[tuple[str, dict[str, Any]], ...]
    footprints: tuple[tuple[float, Array, Array], ...]
    nominal: Mapping[str, Trajectory]
    failures: tuple[tuple[str, dict[str, Any]], ...]
    best: tuple[dict[str, float], ...]
    gain_law: Mapping[str, dict[str, float]]

    @property
    def failed(self) -> list[tuple[str, int, str]]:
        """(law and set, case number, reason) of the flights that did not land."""
        return [
            (f"{law}, {name}", i, f"{status.name}: {status.value}")
            for (law, name), landed in self.flown.items()
            for i, status in enumerate(landed.status)
            if not status.ok
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        return {
            "flight": dict(self.numbers), "sensitivities": dict(self.sensitivities),
            "sets": {f"{law}_{name}": statistics(landed) for (law, name), landed in self.flown.items()},
            "changes": [{"change": text, **found} for text, found in self.changed],
            "footprints": [{"t_s": t, "miss_m": ring.tolist()} for t, ring, _ in self.footprints],
            "outside": [{"case": text, **answer} for text, answer in self.failures],
            "best_profiles": list(self.best), "gain_law": dict(self.gain_law), "scenario": self.scenario.to_dict(),
        }  # fmt: skip

    def result(self) -> StudyResult:
        """Figures, tables and numbers for the report."""
        from studies.landing_report import result

        return result(self)


def run(scenario: LandingScenario | None = None, *, cases: int = 300, progress: Progress | None = None) -> LandingStudy:
    """Fly both laws over all sets, the hard set with one change each, and ask what could be reached.

    Parameters
    ----------
    scenario : LandingScenario, optional
        Default: reference N2.  Its law and set are varied.
    cases : int
        Flights in each set; half of them with each change.
    progress : callable, optional
        Called with a stage and its finished fraction.
    """
    s = scenario or LandingScenario()
    tell = progress or (lambda stage, part: None)
    set_up = flights.setting(s)
    reference = flights.reference_flight(s, set_up)
    flown, nominal = _sets(s, cases, tell)
    changed = _changed(s, max(cases // 2, 1), tell)
    return LandingStudy(
        scenario=s, set_up=set_up, reference=reference, numbers=flights.told(set_up, reference, banks=reference["bank"]),
        sensitivities=flights.sensitivities(s, set_up), flown=flown, changed=changed, footprints=_footprints(set_up, reference),
        nominal=nominal, failures=tuple((text, _nominal(s.edit(change))[1]) for text, change in FAILURES),
        best=_best(s, set_up, flown, cases), gain_law=_gain_law(cases),
    )  # fmt: skip


def _sets(s: LandingScenario, cases: int, tell: Progress) -> tuple[dict[tuple[str, str], Landings], dict[str, Trajectory]]:
    flown, nominal = {}, {}
    for i, law in enumerate(LAWS):
        chosen = s.edit({"guidance.law": law})
        set_up = flights.setting(chosen)
        guided = flights.guidance(chosen, set_up)
        for j, name in enumerate(SETS):
            tell("landings", (i * len(SETS) + j) / (len(LAWS) * len(SETS)))
            flown[law, name] = flights.fly_cases(chosen, set_up, guided, flights.draw(chosen, set_up, cases, name=name))
        nominal[law] = _nominal(chosen)[0]
    tell("landings", 1.0)
    return flown, nominal


def _changed(s: LandingScenario, cases: int, tell: Progress) -> tuple[tuple[str, dict[str, Any]], ...]:
    """(change, statistics) of the hard set."""
    found, every = [], (*PAPER_CHANGES, *CHANGES)
    for k, (text, change) in enumerate(every):
        tell("one change each", k / len(every))
        one = s.edit({"guidance.law": "modern", "dispersions.set": "hard"} | dict(change))
        set_up = flights.setting(one)
        landed = flights.fly_cases(one, set_up, flights.guidance(one, set_up), flights.draw(one, set_up, cases))
        found.append((text, statistics(landed)))
    tell("one change each", 1.0)
    return tuple(found)


def _nominal(s: LandingScenario) -> tuple[Trajectory, dict[str, Any]]:
    """The flight without dispersions, and its numbers with the reachability of the target."""
    set_up = flights.setting(s)
    case = flights.draw(s, set_up, 1, name="none")
    trajectory = flights.guided_flight(s, set_up, flights.guidance(s, set_up), (case.x0[0], case.p[0]))
    numbers = flights.told(set_up, trajectory, banks=trajectory["bank"])
    return trajectory, {"flight": numbers, **reachability(set_up, case.x0[0], case.p[0], numbers)}


def _footprints(set_up: flights.Setting, reference: Trajectory) -> tuple[tuple[float, Array, Array], ...]:
    found = []
    for t in FROM:
        x = np.array([np.interp(t, reference.t, reference[name]) for name in "xyzuvw"])
        ring = boundary(set_up.reachable, set_up.target, x=x, radius=set_up.radius, t=t, t_f=float(reference.t[-1]))
        found.append((t, ring, to_spherical(x)))
    return tuple(found)


def _best(
    s: LandingScenario, set_up: flights.Setting, flown: Mapping[tuple[str, str], Landings], cases: int
) -> tuple[dict[str, float], ...]:
    """The worst hard cases of the one-reversal law, and what the best bank profile makes of them (without their wind)."""
    one, several = flown["paper", "hard"], flown["modern", "hard"]
    drawn = flights.draw(s, set_up, cases, name="hard")
    rows = []
    for i in np.argsort(-one.distance)[:WORST]:
        p = set_up.reachable.p0.copy()
        for k, var in enumerate(set_up.reachable.params):
            if var.name in [v.name for v in set_up.truth.params]:
                p[k] = drawn.p[i, set_up.truth.index(var.name)]
        best = best_profile(set_up.reachable, set_up.target, x=drawn.x0[i, :6], radius=set_up.radius, p=p)
        rows.append({
            "case": int(i), "paper_km": float(one.distance[i] / KM), "modern_km": float(several.distance[i] / KM),
            "best_km": float(np.hypot(*best.miss) / KM), "replay_error_m": best.replay_error,
        })  # fmt: skip
    return tuple(rows)


def _gain_law(cases: int) -> dict[str, dict[str, float]]:
    """Range errors, km, of the gain law K(t) of paper 003 over the speeds, angles, densities and coefficients of the landing sets.

    Planar, without rotation, wind or cross-range, along a reference of constant bank angle with the entry and vehicle of N2.
    """
    from studies.scenario import Scenario

    places = {"medium": "large", "hard": "large_wave"}  # one study of its own flies both
    changes: dict[str, Any] = {"vehicle.lift_to_drag": 0.30, "reference.path_angle_deg": -1.6, "reference.speed_m_s": 7650.0}
    for name, place in places.items():
        path, speed, _, bias, wave, coefficient, _ = flights.SETS[name]
        keys = {
            "path_angle_deg": path, "speed_m_s": speed, "density": bias, "drag": coefficient, "lift": coefficient, "wave_amplitude": wave,
            "wave_length_m": 30000.0,
        }  # fmt: skip
        changes |= {f"dispersions.sets.{place}.{key}": value for key, value in keys.items()}
    flown = Scenario.default().edit(changes).run(dispersions=cases).closed_loop
    table: dict[str, dict[str, float]] = {}
    for name, place in places.items():
        miss = flown[place]["time_varying"]
        size = np.abs(miss.km)
        table[name] = {
            "within_1km": float(100 * (size < 1).sum() / cases), "p50_km": float(np.median(size)), "p95_km": miss.p95, "max_km": miss.worst
        }  # fmt: skip
    return table


def degrees(ring: Array, set_up: flights.Setting) -> Array:
    """(longitude, latitude) in degrees of misses (M, 2)."""
    unit = set_up.target.point(ring)
    return np.column_stack([np.arctan2(unit[:, 1], unit[:, 0]), np.arcsin(unit[:, 2])]) / DEG
