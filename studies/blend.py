"""RCS/elevon blending of the orbiter on the STS-1 case: one flight in full, stress cases, dispersions, ensembles.

Source: Lu & Zhang 2012 (paper 000), section 3.  The angle-of-attack command of its figure 11 is lost and replaced by a documented one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from allocation.blending import Handover
from models.checked import as_scalar
from models.units import DEG
from studies.blend_cases import SINGLES as SINGLES
from studies.blend_cases import SPREAD as SPREAD
from studies.blend_cases import check_cases, dispersed, single_parameters, split
from studies.blend_design import sts1_loop
from studies.blend_loop import BlendLoop, Flight, LoopSettings, fly, fly_many

if TYPE_CHECKING:
    from studies.result import StudyResult

STATISTICS = ("rms_deg", "max_deg", "steady_deg", "pulses", "propellant_kg", "pulses_above_q2", "travel_deg", "peak_g")
AS_CHANGED = "as changed"  # the single without dispersion, if the vehicle or its start was changed
LIMIT_S = 1.0  # a trim that stands at its stop for longer is out of authority


@dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """Numbers of one flight or of N flights, scalars or arrays (N,): degrees and seconds, as reported."""

    rms_deg: Any
    max_deg: Any
    steady_deg: Any
    pulses: Any
    propellant_kg: Any
    pulses_below_q1: Any
    pulses_between: Any
    pulses_above_q2: Any
    alternations: Any
    highest_pulse_pa: Any
    travel_deg: Any
    max_rate_deg_s: Any
    peak_g: Any
    q1_s: Any
    q2_s: Any
    trim_at_limit_s: Any
    outside_tables_s: Any
    below_tables_s: Any

    @property
    def out_of_authority(self) -> Any:
        """True where the trim stood at its stop for more than a second: no elevon is left."""
        return self.trim_at_limit_s > LIMIT_S

    @property
    def outside_tables(self) -> Any:
        """True where the angle of attack left the aerodynamic tables, whose edge values then stood in for them."""
        return self.outside_tables_s > 0


def figures_of(end: Mapping[str, Any]) -> Figures:
    """Reported numbers from the counts at the end of one flight or of many."""
    parts = [end[f"pulses_{name}"] for name in ("below_q1", "between", "above_q2")]
    return Figures(
        rms_deg=np.sqrt(end["sum_square"] / end["n"]) / DEG, max_deg=end["max_error"] / DEG,
        steady_deg=abs(end["sum_last"] / end["n_last"]) / DEG, pulses=sum(parts), propellant_kg=end["propellant"],
        pulses_below_q1=parts[0], pulses_between=parts[1], pulses_above_q2=parts[2], alternations=end["alternations"],
        highest_pulse_pa=end["highest_pulse_qbar"], travel_deg=end["travel"] / DEG, max_rate_deg_s=end["max_rate"] / DEG,
        peak_g=end["peak_load"], q1_s=end["q1_s"], q2_s=end["q2_s"], trim_at_limit_s=end["trim_limit_s"],
        outside_tables_s=end["outside_s"], below_tables_s=end["slow_s"],
    )  # fmt: skip


def one(numbers: Figures, case: int) -> Figures:
    """Numbers of one case of many."""
    return Figures(*(float(getattr(numbers, name)[case]) for name in Figures.__dataclass_fields__))


def as_json(numbers: Figures) -> dict[str, Any]:
    """Numbers of one flight under the keys of ``reentry blend --json``; a dynamic pressure never passed upwards has time None."""
    whole = {name: round(float(getattr(numbers, name))) for name in ("pulses", "pulses_below_q1", "pulses_between", "pulses_above_q2")}
    times = {name: float(getattr(numbers, name)) for name in ("q1_s", "q2_s")}
    return {
        "tracking": {name: float(getattr(numbers, name)) for name in ("rms_deg", "max_deg", "steady_deg")},
        "rcs": {
            "pulses": whole["pulses"], "propellant_kg": float(numbers.propellant_kg),
            **{name: whole[name] for name in ("pulses_below_q1", "pulses_between", "pulses_above_q2")},
            "sign_alternations": round(float(numbers.alternations)), "highest_pulse_pa": float(numbers.highest_pulse_pa),
        },
        "elevon": {"travel_deg": float(numbers.travel_deg), "max_rate_deg_s": float(numbers.max_rate_deg_s)},
        "loads": {"peak_g": float(numbers.peak_g)},
        "events": {name: value if value >= 0 else None for name, value in times.items()},
        "authority": {
            "out_of_authority": bool(numbers.out_of_authority), "trim_at_limit_s": float(numbers.trim_at_limit_s),
        },
        "tables": {"alpha_outside_s": float(numbers.outside_tables_s), "mach_below_2_s": float(numbers.below_tables_s)},
    }  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class BlendStudy:
    """Result of :func:`run`.

    Attributes
    ----------
    method : str
    jets : int
    changes : mapping
        Parameters of the flight that are not nominal.
    flight : Flight
        The recorded flight.
    singles : mapping of str to Figures
        Stress cases and single dispersions on top of the changes; empty unless asked for.
    stress : mapping of str to Flight
        Recorded stress cases; with the singles.
    ensemble : Figures or None
        Of all random dispersions, on top of the changes; arrays (cases,), NaN in the failed ones.
    failed : tuple of int
        Cases of the ensemble that did not stay finite.
    seed : int
        Of the random dispersions.
    """

    method: str
    jets: int
    changes: Mapping[str, float]
    flight: Flight
    singles: Mapping[str, Figures] = field(default_factory=dict)
    stress: Mapping[str, Flight] = field(default_factory=dict)
    ensemble: Figures | None = None
    failed: tuple[int, ...] = ()
    seed: int = 2012

    @property
    def loop(self) -> BlendLoop:
        """The closed loop that flew."""
        return self.flight.loop

    @property
    def numbers(self) -> Figures:
        """Reported numbers of the recorded flight."""
        return figures_of(self.flight.end)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What must not be overlooked."""
        # the single without dispersion is this flight once more
        others = {name: flown for name, flown in self.singles.items() if name != AS_CHANGED and SINGLES.get(name) != {}}
        named = {"this flight": self.numbers, **others}
        found = [
            f"{name}: out of authority: the trim stood at its stop for {flown.trim_at_limit_s:.1f} s"
            for name, flown in named.items()
            if flown.out_of_authority
        ]
        found += [
            f"{name}: angle of attack outside the aerodynamic tables for {flown.outside_tables_s:.1f} s"
            for name, flown in named.items()
            if flown.outside_tables
        ]
        found += [
            f"{name}: slower than Mach 2 for {flown.below_tables_s:.1f} s, with the coefficients of Mach 2"
            for name, flown in named.items()
            if flown.below_tables_s > 0
        ]
        below = float(np.mean(self.flight["h"] < 0)) * self.loop.settings.duration_s
        if below > 0:
            found.append(f"this flight: below sea level for {below:.1f} s; the ground is not part of the model")
        if self.ensemble is not None:
            found += _ensemble_remarks(ensemble_statistics(self.ensemble, self.failed))
        return tuple(found)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able result."""
        gains = self.loop.gains
        data = as_json(self.numbers) | {
            "method": self.method, "jets": self.jets, "changes": dict(self.changes),
            "certificate": {"riccati_residual": gains.riccati_residual, "spectral_abscissa_max": gains.abscissa},
        }  # fmt: skip
        if self.singles:
            data["singles"] = {name: as_json(found) for name, found in self.singles.items()}
        if self.ensemble is not None:
            data["ensemble"] = ensemble_statistics(self.ensemble, self.failed) | {"failed": list(self.failed)}
        if self.remarks:
            data["remarks"] = list(self.remarks)
        return data

    def summary(self) -> list[tuple[str, float | str, str]]:
        """Headline numbers as (label, value, unit); a dynamic pressure that was not passed upwards was reached "never"."""
        n = self.numbers
        passed: list[tuple[str, float | str, str]] = [
            (f"{name} reached", time, "s") if time >= 0 else (f"{name} reached", "never", "")
            for name, time in (("q1", n.q1_s), ("q2", n.q2_s))
        ]
        return [
            ("tracking error, rms after 10 s", n.rms_deg, "deg"), ("largest error after 10 s", n.max_deg, "deg"),
            ("mean error of the last 60 s", n.steady_deg, "deg"), ("jet pulses", n.pulses, "1"), ("propellant", n.propellant_kg, "kg"),
            ("pulses below q1", n.pulses_below_q1, "1"), ("pulses between q1 and q2", n.pulses_between, "1"),
            ("pulses above q2", n.pulses_above_q2, "1"), ("elevon travel", n.travel_deg, "deg"),
            ("largest elevon rate", n.max_rate_deg_s, "deg/s"), ("peak load", n.peak_g, "g0"), *passed,
        ]  # fmt: skip

    def figures(self) -> dict[str, Any]:
        """Figures by name (matplotlib)."""
        from studies.blend_report import figures

        return {item.name: item.figure for item in figures(self)}

    def result(self) -> StudyResult:
        """Figures, tables and comparisons for the report."""
        from studies.blend_report import result

        return result(self)


def ensemble_statistics(found: Figures, failed: Sequence[int] = ()) -> dict[str, Any]:
    """Median, 95th percentile and largest value over the flights in authority and inside the tables; the others are counted.

    Parameters
    ----------
    found : Figures
        Arrays (cases,).
    failed : sequence of int
        Cases without numbers.

    Returns
    -------
    dict
        Counts; `lost`, the numbers of the flights out of authority or outside the tables; the statistics, unless no flight is left;
        and how long those of all flights that fall below Mach 2 stay there.
    """
    sound = ~np.isin(np.arange(np.size(found.rms_deg)), failed)
    lost = np.asarray(found.out_of_authority | found.outside_tables) & sound
    slow = np.asarray(found.below_tables_s)[(found.below_tables_s > 0) & sound]
    data: dict[str, Any] = {
        "cases": len(lost),
        "out_of_authority": int(np.sum(found.out_of_authority & sound)),
        "outside_tables": int(np.sum(found.outside_tables & sound)),
        "slower_than_mach_2": len(slow),
        "lost": np.flatnonzero(lost).tolist(),
    }
    if len(slow):
        data["mach_below_2_s"] = {"median": float(np.median(slow)), "max": float(slow.max())}
    kept = sound & ~lost
    if kept.any():
        values = {name: np.asarray(getattr(found, name))[kept] for name in STATISTICS}
        data |= {
            name: {"median": float(np.median(v)), "p95": float(np.percentile(v, 95)), "max": float(v.max())} for name, v in values.items()
        }
    return data


def _ensemble_remarks(data: Mapping[str, Any]) -> list[str]:
    found, left = [], STATISTICS[0] in data
    if data["lost"] or not left:
        found.append(
            f"dispersions: {data['out_of_authority']} of {data['cases']} flights out of authority, {data['outside_tables']} with an"
            " angle of attack outside the aerodynamic tables; "
            + ("the statistics are of the others" if left else "no flight is left, so there are no statistics")
        )
    if data["slower_than_mach_2"]:
        found.append(f"dispersions: {slow_flights(data)}")
    return found


def slow_flights(data: Mapping[str, Any]) -> str:
    """What :func:`ensemble_statistics` says of the flights slower than Mach 2, in words."""
    if not data["slower_than_mach_2"]:
        return f"none of {data['cases']} flights slower than Mach 2"
    times = data["mach_below_2_s"]
    return (
        f"{data['slower_than_mach_2']} of {data['cases']} flights slower than Mach 2, for {times['median']:.1f} s (median) and"
        f" {times['max']:.1f} s at most, with the coefficients of Mach 2"
    )


def run(
    *,
    method: str = "paper",
    jets: int = 6,
    changes: Mapping[str, float] | None = None,
    singles: bool = False,
    cases: int = 0,
    seed: int = 2012,
    handover: Handover | None = None,
    settings: LoopSettings | None = None,
) -> BlendStudy:
    """Fly the STS-1 case.

    Parameters
    ----------
    method : str
        "paper" (equation 20, no jets above q2), "literal" (as printed), "qp" (the quadratic program) or "pinv" (redistributed
        pseudo-inverse).
    jets : {2, 4, 6}
        Aft jets in each direction.
    changes : mapping, optional
        Of the flown vehicle by name: parameters such as ``{"Cm_factor": 1.2}``, ``stress`` in rad, and initial states such as ``h``.
        The controller is not told.
    singles : bool
        Also fly the stress cases and the single dispersions, on top of the changes.
    cases : int
        Random dispersions to fly, on top of the changes.
    seed : int
    handover, settings : optional
        See :func:`studies.blend_design.sts1_loop`.

    Raises
    ------
    ModelError
        An unknown method or parameter, a value outside its range.
    """
    check_cases(cases)
    asked = {name: as_scalar(f"blend: {name}", value) for name, value in (changes or {}).items()}
    loop = sts1_loop(method, jets=jets, handover=handover, settings=settings)
    x0, given = split(loop, asked)
    flight = fly(loop, x0, loop.parameters(given))
    found: dict[str, Figures] = {}
    stress: dict[str, Flight] = {}
    if singles:
        vehicles = single_parameters(loop, given)
        many = figures_of(fly_many(loop, x0, np.stack(list(vehicles.values()))))
        found = {AS_CHANGED if asked and not SINGLES[name] else name: one(many, i) for i, name in enumerate(SINGLES)}
        stress = {name: fly(loop, x0, p) for name, p in vehicles.items() if "stress" in SINGLES[name]}
    ensemble: Figures | None = None
    failed: tuple[int, ...] = ()
    if cases:
        ends = fly_many(loop, x0, dispersed(loop, cases, seed=seed, changes=given))
        sound = ends["finite"] > 0
        failed = tuple(int(i) for i in np.flatnonzero(~sound))
        # all cases stay, so that their numbers are those of the draws
        ensemble = figures_of({name: np.where(sound, value, np.nan) for name, value in ends.items()})
    return BlendStudy(method, jets, asked, flight, found, stress, ensemble, failed, seed)
