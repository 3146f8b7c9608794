"""Answers of ``reentry land``: one flight, or a dispersed set, as plain data and figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from models.core import Array, Status
from models.units import DEG, KM
from ocp.landing import Landings, Target
from ocp.trajectory import Trajectory
from studies import landing_flight as flights
from studies.landing_scenario import LandingScenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LANDED = ("OK", "OUTSIDE_FOOTPRINT")  # states of a flight that came down to the stop altitude
DOUBTFUL = 2 * KM  # a miss beyond it is asked whether the target could be reached at all
MOST_ASKED = 50  # cases for which it is asked

Progress = Callable[..., None]


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What the command has found.

    Attributes
    ----------
    data : dict
        Plain data, ready for JSON.
    flown : Trajectory or Landings
        The one flight with all its nodes, or the ends of a dispersed set.
    target : Target
    """

    data: dict[str, Any]
    flown: Trajectory | Landings
    target: Target

    @property
    def lost(self) -> list[tuple[int, str]]:
        """(case number, reason) of the guided flights that did not come down to the stop altitude."""
        if isinstance(self.flown, Trajectory):
            status = self.data["status"]
            return [(0, f"{status}: {self.data['meaning']}")] if "meaning" in self.data and status not in LANDED else []
        return [(i, f"{status.name}: {status.value}") for i, status in enumerate(self.flown.status) if not status.ok]

    def figures(self) -> dict[str, Figure]:
        """Figures by name: the flight; or misses, their distribution and what they cost, of the flights that landed."""
        from studies.landing_report import flown_figures, landed_figures

        law = self.data["law"]
        if isinstance(self.flown, Trajectory):
            return flown_figures(law, self.flown, target=self.target)
        return landed_figures(law, self.flown)


def reference(scenario: LandingScenario, *, with_sensitivities: bool) -> Answer:
    """The open-loop reference flight; its target may be that of another scenario, which then shows as a miss."""
    set_up = flights.setting(scenario)
    flown = flights.reference_flight(scenario, set_up)
    data: dict[str, Any] = {"law": "reference", "status": flown.status.name, "flight": flights.told(set_up, flown, banks=flown["bank"])}
    if with_sensitivities:
        data["sensitivities"] = flights.sensitivities(scenario, set_up)
    return Answer(data, flown, set_up.target)


def single(scenario: LandingScenario) -> Answer:
    """The nominal flight under the guidance law, and whether its target can be reached."""
    set_up = flights.setting(scenario)
    law = flights.guidance(scenario, set_up)
    case = flights.draw(scenario, set_up, 1, name="none")
    flown = flights.guided_flight(scenario, set_up, law, (case.x0[0], case.p[0]))
    numbers = flights.told(set_up, flown, banks=flown["bank"])
    data: dict[str, Any] = {"law": scenario.guidance.law, "status": flown.status.name, "meaning": flown.status.value, "flight": numbers}
    if flown.status.ok:
        data |= reachability(set_up, case.x0[0], case.p[0], numbers)
    return Answer(data, flown, set_up.target)


def reachability(set_up: flights.Setting, x0: Array, p: Array, numbers: Mapping[str, float]) -> dict[str, Any]:
    """Status and nearest reachable miss of one case that landed with the numbers of :func:`studies.landing_flight.told`."""
    flown = np.array([numbers["miss_downrange_m"], numbers["miss_crossrange_m"]])
    distance, miss, status = flights.reach_of(set_up, x0, p, t_f=numbers["t_f_s"], flown=flown)
    nearest = {"nearest_m": distance, "downrange_m": float(miss[0]), "crossrange_m": float(miss[1])}
    return {"status": status.name, "meaning": status.value, "footprint": {"inside": status.ok, **nearest}}


def dispersed(scenario: LandingScenario, count: int, *, progress: Progress | None = None) -> Answer:
    """Statistics of a dispersed set, and the flights."""
    set_up = flights.setting(scenario)
    law = flights.guidance(scenario, set_up)
    cases = flights.draw(scenario, set_up, count)
    report = None if progress is None else (lambda part: progress("landings", part))
    landed = flights.fly_cases(scenario, set_up, law, cases, progress=report)
    data: dict[str, Any] = {
        "law": scenario.guidance.law, "set": scenario.dispersions.set, "seed": scenario.dispersions.seed, "cases": count,
        "landed": int(landed.ok.sum()),
    }  # fmt: skip
    if landed.ok.any():
        data |= statistics(landed)
    doubtful = np.flatnonzero(landed.ok & (landed.distance > DOUBTFUL))
    outside = []
    for i in doubtful[:MOST_ASKED]:
        distance, _, status = flights.reach_of(set_up, cases.x0[i], cases.p[i], t_f=float(landed.t[i]), flown=landed.miss[i])
        if status is Status.OUTSIDE_FOOTPRINT:
            outside.append({"case": int(i), "nearest_m": distance, "miss_m": float(landed.distance[i])})
    data["outside_footprint"] = {"asked": int(min(len(doubtful), MOST_ASKED)), "outside": len(outside), "cases": outside}
    return Answer(data, landed, set_up.target)


def statistics(landed: Landings) -> dict[str, Any]:
    """Misses, loads and bank travel of the flights that landed; percentages count the others as misses."""
    ok = landed.ok
    km = landed.distance[ok] / KM
    load, travel = landed["peak"][ok], landed["travel"][ok] / DEG
    return {
        "miss": {
            "within_1km": float(100.0 * (km < 1.0).sum() / len(ok)), "p50_km": float(np.percentile(km, 50)),
            "p95_km": float(np.percentile(km, 95)), "max_km": float(km.max()),
        },
        "peak_load_g": {"p50": float(np.median(load)), "max": float(load.max())},
        "bank_travel_deg": {"p50": float(np.median(travel)), "max": float(travel.max())},
        "reversals": {"p50": float(np.median(landed["reversals"][ok])), "max": float(landed["reversals"][ok].max())},
        "t_f_s": {"p50": float(np.median(landed.t[ok])), "max": float(landed.t[ok].max())},
    }  # fmt: skip
