"""Tables and *paper | computed* rows of the blending study; no drawing library is loaded here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from models.checked import Array
from models.units import DEG
from studies.blend_design import tail_wind
from studies.result import Comparison, Table

if TYPE_CHECKING:
    from studies.blend import BlendStudy, Figures
    from studies.blend_loop import Flight

_COLUMNS = (
    ("rms_deg", "error rms [deg]"), ("max_deg", "error max [deg]"), ("steady_deg", "steady [deg]"), ("pulses_below_q1", "pulses < q1"),
    ("pulses_between", "q1 to q2"), ("pulses_above_q2", "> q2"), ("propellant_kg", "propellant [kg]"),
    ("travel_deg", "elevon travel [deg]"), ("peak_g", "peak [g0]"),
)  # fmt: skip


def headline_table(study: BlendStudy) -> Table:
    """The recorded flight in numbers."""
    return Table(f"Hand-over, method {study.method}, {study.jets} + {study.jets} jets", ("quantity", "value", "unit"), study.summary())


def singles_table(study: BlendStudy) -> Table:
    """Stress cases and single dispersions, one row each."""
    rows = [[name, *_row(found), _remark(found)] for name, found in study.singles.items()]
    return Table(
        "Stress cases and single dispersions", ("case", *(label for _, label in _COLUMNS), "remark"), rows,
        "The controller flies with its nominal model in every case. Out of authority: the trim stood at its stop of −33 deg. "
        "Below Mach 2 a flight goes on with the coefficients of Mach 2.",
    )  # fmt: skip


def _remark(found: Figures) -> str:
    said = ["out of authority"] if found.out_of_authority else []
    if found.outside_tables:
        said.append(f"alpha outside the tables for {found.outside_tables_s:.0f} s")
    if found.below_tables_s > 0:
        said.append(f"below Mach 2 for {found.below_tables_s:.0f} s")
    return "; ".join(said)


def _row(found: Figures) -> list[Any]:
    values = [(name, float(getattr(found, name))) for name, _ in _COLUMNS]
    return [round(value) if name.startswith("pulses") else value for name, value in values]


def ensemble_table(study: BlendStudy) -> Table | None:
    """Median, 95th percentile and largest value over the random dispersions; None if none was flown or no flight is left for statistics."""
    from studies.blend import STATISTICS, ensemble_statistics, slow_flights

    data = {} if study.ensemble is None else ensemble_statistics(study.ensemble, study.failed)
    rows = [[name.replace("_", " "), *(data[name][kind] for kind in ("median", "p95", "max"))] for name in STATISTICS if name in data]
    if not rows:
        return None
    caption = (
        f"{data['cases']} flights, all dispersions uniform and at once; {data['out_of_authority']} out of authority and "
        f"{data['outside_tables']} with an angle of attack outside the aerodynamic tables are left out of the statistics. "
        f"Not left out: {slow_flights(data)}."
    )
    return Table("Random dispersions", ("quantity", "median", "95 %", "largest"), rows, caption)


def pulses(flight: Flight) -> Array:
    """Contiguous firings (n, 4): start s, length s, sign, dynamic pressure at the start Pa."""
    jets, t = flight["jets"], flight["t"]
    edges = np.flatnonzero(np.diff(np.concatenate([[0.0], jets])) != 0)
    starts = edges[jets[edges] != 0]
    after = np.append(edges, len(jets))
    ends = after[np.searchsorted(after, starts, side="right")]
    step = flight.loop.settings.control_s
    return np.column_stack([t[starts], (ends - starts) * step, jets[starts], flight["qbar"][starts]])


def comparisons(study: BlendStudy) -> list[Comparison]:
    """What paper 000 says of figures 10 and 11, in numbers where it gives any."""
    n, wind, flight, s = study.numbers, tail_wind(), study.flight, study.loop.settings
    h = np.linspace(40e3, 80e3, 4001)
    east = wind.at(h)[:, 0]
    fired = pulses(flight)
    per_10_s = [float(np.sum((fired[:, 0] >= t) & (fired[:, 0] < t + 10))) for t in (0.0, 50.0, 66.0)]
    lost = "the curves of figure 11 are not legible; the command is ours"
    quiet = flight["t"] > n.q2_s if n.q2_s > 0 else flight["t"] > 1e9
    level = flight["qbar"][(flight["t"] >= 66) & (flight["t"] < 76)]
    pressure = f"dynamic pressure {level.min():.0f} to {level.max():.0f} Pa; " if len(level) else ""
    rate = np.abs(np.diff(flight["delta_e"])) / flight.loop.settings.control_s / DEG
    return [
        Comparison("largest wind", 60.0, float(east.max()), "m/s", "CIRA-86 profile scaled to the printed maximum", 0.01),
        Comparison("altitude of the largest wind", "near 60", float(h[east.argmax()]) / 1e3, "km", "figure 10 is not legible"),
        Comparison("mean error over the last 60 s", "small", n.steady_deg, "deg", lost),
        Comparison("largest error after the first 10 s", "smooth transient", n.max_deg, "deg", lost),
        Comparison("pulses in the first 10 s", "frequent", per_10_s[0], "1", "alpha is being brought to its command"),
        Comparison("pulses from 50 to 60 s", "frequent", per_10_s[1], "1", "the jets hold what the trim has not taken over yet"),
        Comparison(
            "pulses from 66 to 76 s", "fewer", per_10_s[2], "1",
            f"{pressure}the elevon takes part above {s.q1:g} Pa",
        ),
        Comparison(f"pulses above {s.q2:g} Pa", "none", n.pulses_above_q2, "1", "full authority of the elevon"),
        Comparison("pulses of alternating sign from 42 s to q1", "no limit cycle", n.alternations, "1", "the command is steady there"),
        Comparison(
            "elevon rate while the jets fire, rms", "low", float(np.sqrt(np.mean(rate[flight["jets"][:-1] != 0] ** 2))), "deg/s",
            f"rms over the time above q2: {float(np.sqrt(np.mean(rate[quiet[:-1]] ** 2))) if quiet.any() else 0.0:.2f} deg/s",
        ),
    ]  # fmt: skip
