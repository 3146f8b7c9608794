"""RCS/elevon blending of the orbiter on the STS-1 case: one flight in full, stress cases, dispersions, ensembles.

Source: Lu & Zhang 2012 (paper 000), section 3.  The angle-of-attack command of its figure 11 is lost and replaced by a documented one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from allocation.blending import Handover
from models.checked import Array, ModelError, as_scalar, as_vector
from models.units import DEG, INCH
from studies.blend_design import START, sts1_loop
from studies.blend_loop import BlendLoop, Flight, LoopSettings, fly, fly_many

if TYPE_CHECKING:
    from studies.result import StudyResult

STRESS = 2 * DEG
SINGLES: Mapping[str, Mapping[str, float]] = {
    "nominal": {},
    "stress +2 deg": {"stress": STRESS},
    "stress -2 deg": {"stress": -STRESS},
    "Cm +20 %": {"Cm_factor": 1.2},
    "Cm -20 %": {"Cm_factor": 0.8},
    "elevon +20 %": {"elevon_factor": 1.2},
    "elevon -20 %": {"elevon_factor": 0.8},
    "CL +20 %": {"CL_factor": 1.2},
    "CL -20 %": {"CL_factor": 0.8},
    "CD +20 %": {"CD_factor": 1.2},
    "CD -20 %": {"CD_factor": 0.8},
    "c.g. 2 in aft": {"cg_aft": 2 * INCH},
    "c.g. 2 in forward": {"cg_aft": -2 * INCH},
    "wind x 0.5": {"wind_factor": 0.5},
    "wind x 1.5": {"wind_factor": 1.5},
    "one of six nose-up jets lost": {"up_share": 5 / 6},
    "Cm +20 %, elevon -20 %": {"Cm_factor": 1.2, "elevon_factor": 0.8},
}
SPREAD: Mapping[str, tuple[float, float]] = {
    "Cm_factor": (0.8, 1.2), "elevon_factor": (0.8, 1.2), "CL_factor": (0.8, 1.2), "CD_factor": (0.8, 1.2),
    "cg_aft": (-2 * INCH, 2 * INCH), "wind_factor": (0.5, 1.5),
}  # fmt: skip
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
        Stress cases and single dispersions; empty unless asked for.
    stress : mapping of str to Flight
        Recorded stress cases; with the singles.
    ensemble : Figures or None
        Of `cases` random dispersions; arrays.
    failed : tuple of int
        Cases of the ensemble that did not stay finite.
    """

    method: str
    jets: int
    changes: Mapping[str, float]
    flight: Flight
    singles: Mapping[str, Figures] = field(default_factory=dict)
    stress: Mapping[str, Flight] = field(default_factory=dict)
    ensemble: Figures | None = None
    failed: tuple[int, ...] = ()

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
        named = {"this flight": self.numbers, **self.singles}
        found = [
            f"{name}: out of authority: the trim stood at its stop for {one.trim_at_limit_s:.1f} s"
            for name, one in named.items()
            if one.out_of_authority
        ]
        found += [
            f"{name}: angle of attack outside the aerodynamic tables for {one.outside_tables_s:.1f} s"
            for name, one in named.items()
            if one.outside_tables
        ]
        found += [
            f"{name}: slower than Mach 2 for {one.below_tables_s:.1f} s, with the coefficients of Mach 2"
            for name, one in named.items()
            if one.below_tables_s > 0
        ]
        below = float(np.mean(self.flight["h"] < 0)) * self.loop.settings.duration_s
        if below > 0:
            found.append(f"this flight: below sea level for {below:.1f} s; the ground is not part of the model")
        if self.ensemble is not None and np.any(self.ensemble.out_of_authority | self.ensemble.outside_tables):
            data = ensemble_statistics(self.ensemble)
            found.append(
                f"dispersions: {data['out_of_authority']} of {data['cases']} flights out of authority, {data['outside_tables']} with an"
                " angle of attack outside the aerodynamic tables; the statistics are of the others"
            )
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
            data["ensemble"] = ensemble_statistics(self.ensemble) | {"failed": list(self.failed)}
        if self.remarks:
            data["remarks"] = list(self.remarks)
        return data

    def summary(self) -> list[tuple[str, float, str]]:
        """Headline numbers as (label, value, unit)."""
        n = self.numbers
        return [
            ("tracking error, rms after 10 s", n.rms_deg, "deg"), ("largest error after 10 s", n.max_deg, "deg"),
            ("mean error of the last 60 s", n.steady_deg, "deg"), ("jet pulses", n.pulses, "1"), ("propellant", n.propellant_kg, "kg"),
            ("pulses below q1", n.pulses_below_q1, "1"), ("pulses between q1 and q2", n.pulses_between, "1"),
            ("pulses above q2", n.pulses_above_q2, "1"), ("elevon travel", n.travel_deg, "deg"),
            ("largest elevon rate", n.max_rate_deg_s, "deg/s"), ("peak load", n.peak_g, "g0"), ("q1 reached", n.q1_s, "s"),
            ("q2 reached", n.q2_s, "s"),
        ]  # fmt: skip

    def figures(self) -> dict[str, Any]:
        """Figures by name (matplotlib)."""
        from studies.blend_report import figures

        return {item.name: item.figure for item in figures(self)}

    def result(self) -> StudyResult:
        """Figures, tables and comparisons for the report."""
        from studies.blend_report import result

        return result(self)


def ensemble_statistics(found: Figures) -> dict[str, Any]:
    """Median, 95th percentile and largest value over the flights in authority and inside the tables; the others are counted."""
    names = ("rms_deg", "max_deg", "steady_deg", "pulses", "propellant_kg", "pulses_above_q2", "travel_deg", "peak_g")
    lost = np.asarray(found.out_of_authority | found.outside_tables)
    counts = {
        "cases": len(lost),
        "out_of_authority": int(np.sum(found.out_of_authority)),
        "outside_tables": int(np.sum(found.outside_tables)),
        "slower_than_mach_2": int(np.sum(found.below_tables_s > 0)),
    }
    if lost.all():
        return counts | {"lost": np.flatnonzero(lost).tolist()}
    kept = {name: np.asarray(getattr(found, name))[~lost] for name in names}
    table = {
        name: {"median": float(np.median(v)), "p95": float(np.percentile(v, 95)), "max": float(v.max())} for name, v in kept.items()
    }  # fmt: skip
    return counts | {"lost": np.flatnonzero(lost).tolist(), **table}


def dispersed(loop: BlendLoop, cases: int, *, seed: int) -> Array:
    """Parameters (cases, np) with everything of ``SPREAD`` uniform and independent; case i is the same for any number of cases."""
    p = np.tile(loop.parameters(), (cases, 1))
    draws = np.random.Generator(np.random.Philox(seed)).random((cases, len(SPREAD)))
    for j, (name, (low, high)) in enumerate(SPREAD.items()):
        p[:, loop.params.index(name)] = low + (high - low) * draws[:, j]
    return p


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
        Also fly the stress cases and the single dispersions.
    cases : int
        Random dispersions to fly.
    seed : int
    handover, settings : optional
        See :func:`studies.blend_design.sts1_loop`.

    Raises
    ------
    ModelError
        An unknown method or parameter, a value outside its range.
    """
    if isinstance(cases, bool) or not isinstance(cases, int) or cases < 0:
        raise ModelError(f"blend: cases: expected a whole number, 0 or more, got {cases!r}")
    asked = {name: as_scalar(f"blend: {name}", value) for name, value in (changes or {}).items()}
    given = dict(asked)
    loop = sts1_loop(method, jets=jets, handover=handover, settings=settings)
    x0 = np.array([given.pop(name, value) for name, value in START.items()])
    as_vector("blend: start", x0, loop.model.states)
    flight = fly(loop, x0, loop.parameters(given))
    found: dict[str, Figures] = {}
    stress: dict[str, Flight] = {}
    if singles:
        many = figures_of(fly_many(loop, x0, np.stack([loop.parameters(c) for c in SINGLES.values()])))
        found = {name: one(many, i) for i, name in enumerate(SINGLES)}
        stress = {name: fly(loop, x0, loop.parameters(c)) for name, c in SINGLES.items() if "stress" in c}
    ensemble: Figures | None = None
    failed: tuple[int, ...] = ()
    if cases:
        ends = fly_many(loop, x0, dispersed(loop, cases, seed=seed))
        sound = ends["finite"] > 0
        failed = tuple(int(i) for i in np.flatnonzero(~sound))
        ensemble = figures_of({name: value[sound] for name, value in ends.items()}) if sound.any() else None
    return BlendStudy(method, jets, asked, flight, found, stress, ensemble, failed)
