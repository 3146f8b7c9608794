"""Figures, tables and numbers of the landing study."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from models.units import DEG, KM
from studies import figures as fig
from studies.landing_answer import statistics
from studies.result import Comparison, FigureItem, Headline, StudyResult, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ocp.landing import Landings, Target
    from ocp.trajectory import Trajectory
    from studies.landing import LandingStudy

NAMES = {"paper": "one reversal", "modern": "several reversals"}
SHADES = {"paper": "C1", "modern": "C0", "reference": "C2"}

LEAD = (
    "Tian (1998) lands a capsule at a given point by predicting its landing point on board and correcting the bank angle: its amplitude"
    " and the time of its one reversal follow from a 2 by 2 system every 10 s. Here the prediction carries exact derivatives, and that law"
    " is flown beside one that keeps several reversals, a bank reserve and a line search in its plan. Truth: rotating, oblate Earth,"
    " dispersed density with waves, wind, coefficients, entry state, and a bank servo with limits of rate and acceleration."
    " The paper does not identify its vehicle: reference N2 stands for it."
)


def result(study: LandingStudy) -> StudyResult:
    """Everything the report shows of the study."""
    return StudyResult(
        name="landing", title="Fixed-point landing by prediction and correction", lead=LEAD, figures=figures(study), tables=tables(study),
        comparisons=comparisons(study), data=study.to_dict(), failed=study.failed, headlines=headlines(study),
    )  # fmt: skip


def headlines(study: LandingStudy) -> list[Headline]:
    """The cards of the study."""
    hard = {law: statistics(study.flown[law, "hard"])["miss"] for law in NAMES}
    ring = study.footprints[0][1]
    return [
        Headline("Hard set within 1 km", hard["modern"]["within_1km"], "%", f"one reversal: {hard['paper']['within_1km']:.0f} %"),
        Headline("95 % of the hard set within", hard["modern"]["p95_km"], "km", f"one reversal: {hard['paper']['p95_km']:.1f} km", 2),
        Headline("Greatest load, hard set", statistics(study.flown["modern", "hard"])["peak_load_g"]["max"], "g0", "", 3),
        Headline("Footprint at entry", float(np.ptp(ring[:, 0]) / KM), "km", f"long, {np.ptp(ring[:, 1]) / KM:.0f} km wide"),
    ]


def comparisons(study: LandingStudy) -> list[Comparison]:
    """Printed results beside ours."""
    small = statistics(study.flown["paper", "small"])["miss"]
    density = statistics(study.flown["paper", "density"])["miss"]
    why = "the paper prints three cases, of a vehicle and dispersions that it does not give"
    return [
        Comparison("landings within 1 km, density dispersed", "most, some a little beyond", density["within_1km"], "%", why),
        Comparison("median miss, small dispersions", "0.04 to 0.14 in three cases", small["p50_km"], "km", why),
        Comparison(
            "reversals needed", "not more than one", 1.0, "1", "met for density alone; wind, coefficients and entry errors need more"
        ),
    ]


def tables(study: LandingStudy) -> list[Table]:
    """Reference, sets, changes, reachability."""
    flight, slope = study.numbers, study.sensitivities
    sets = []
    for (law, name), landed in study.flown.items():
        s = statistics(landed)
        miss = s["miss"]
        load, travel = s["peak_load_g"], s["bank_travel_deg"]["p50"]
        sets.append(
            (name, NAMES[law], miss["within_1km"], miss["p50_km"], miss["p95_km"], miss["max_km"], load["p50"], load["max"], travel)
        )
    changed = [
        (text, s["miss"]["within_1km"], s["miss"]["p50_km"], s["miss"]["p95_km"], s["miss"]["max_km"], s["peak_load_g"]["max"])
        for text, s in study.changed
    ]
    miss_columns = ("within 1 km [%]", "median [km]", "95 % [km]", "largest [km]")
    outside = []
    for text, a in study.failures:
        flown = float(np.hypot(a["flight"]["miss_downrange_m"], a["flight"]["miss_crossrange_m"]) / KM)
        outside.append((text, a["status"], a["footprint"]["nearest_m"] / KM, flown))
    best = [tuple(row.values()) for row in study.best]
    gains = [(name, s["within_1km"], s["p50_km"], s["p95_km"], s["max_km"]) for name, s in study.gain_law.items()]
    return [
        Table("Reference N2, open loop", ("quantity", "value", "unit"), [
            ("flight time", flight["t_f_s"], "s"), ("range", flight["range_m"] / KM, "km"), ("peak load", flight["peak_load_g"], "g0"),
            ("d downrange/d beta", slope["dL_dbeta"] / KM, "km"), ("d cross-range/d beta", slope["dD_dbeta"] / KM, "km"),
            ("d downrange/d t_n", slope["dL_dtn"], "m/s"), ("d cross-range/d t_n", slope["dD_dtn"], "m/s"),
        ], "Central field, no dispersions, ideal bank response; derivatives at entry."),
        Table("Dispersed landings",
              ("set", "law", *miss_columns, "load, median [g0]", "load, largest [g0]", "bank travel, median [deg]"),
              sets, "Accuracy is paid for in bank travel and a little load."),
        Table("Hard set, one change at a time", ("change", *miss_columns, "load, largest [g0]"), changed,
              "Law of several reversals, but for the first row."),
        Table("Targets outside the footprint", ("case", "status", "nearest reachable [km]", "flown [km]"), outside,
              "Nominal flights under the law of several reversals."),
        Table("Worst hard cases of the one-reversal law",
              ("case", "one reversal [km]", "several reversals [km]", "best profile [km]", "replay error [m]"), best,
              "Best profile: IPOPT through the differentiable prediction, in the case's own air without wind; replayed by the simulator."),
        Table("Gain law of paper 003, range errors", ("dispersions of the set", *miss_columns), gains,
              "K(t) along a planar reference with the vehicle and entry of N2; no wind, no rotation, no cross-range."),
    ]  # fmt: skip


def figures(study: LandingStudy) -> list[FigureItem]:
    """All figures of the study."""
    makers = [
        ("landing_miss", "Where the hard set lands", "Misses of the hard set under both laws, the same cases; the circle has 1 km. "
         "With one reversal what is left is mostly cross-range.", miss_figure),
        ("landing_share", "Share of the landings", "Share of the cases with a miss below the abscissa, by set and law.", share_figure),
        ("landing_footprint", "Reachable landing points", "Boundary of what a free bank profile can reach, "
         "from entry and from three later points of the reference flight, each found by optimization; it shrinks onto the target.",
         footprint_figure),
        ("landing_bank", "Bank angle and flight", "Nominal flights under both laws: bank angle, load, altitude against speed, "
         "ground track across the great circle to the target.", flight_figure),
        ("landing_trade", "What accuracy costs", "Greatest load and bank travel of every case of the hard set.", trade_figure),
    ]  # fmt: skip
    return fig.items(makers, study)


def miss_figure(study: LandingStudy) -> Any:
    """Cross-range against downrange of the hard set."""
    figure, axes = fig.new_figure(1, 2, height_mm=80)
    for axis, law, limit in zip(np.ravel(axes), NAMES, (4.0, 1.2), strict=True):
        _misses(axis, law, study.flown[law, "hard"], limit=limit)
    return figure


def _misses(axis: Axes, law: str, landed: Landings, *, limit: float) -> None:
    """Misses around a circle of 1 km, in a frame of `limit` km to each side."""
    angle = np.linspace(0, 2 * np.pi, 200)
    km = landed.miss[landed.ok] / KM
    axis.plot(np.cos(angle), np.sin(angle), color="0.4", linewidth=0.8)
    axis.plot(km[:, 1], km[:, 0], ".", color=SHADES[law], markersize=3)
    beyond = int((np.abs(km) > limit).any(axis=1).sum())
    axis.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal", xlabel="cross-range [km]", ylabel="downrange [km]")
    axis.set_title(NAMES[law] + (f" ({beyond} beyond the frame)" if beyond else ""))


def share_figure(study: LandingStudy) -> Any:
    """Cumulative distributions of the miss."""
    figure, axes = fig.new_figure(1, 2, height_mm=66, sharey=True)
    lines = {"density": ":", "small": "-.", "medium": "--", "hard": "-"}
    for axis, (law, title) in zip(np.ravel(axes), NAMES.items(), strict=True):
        for name, line in lines.items():
            _share(axis, law, study.flown[law, name], line=line, label=name)
        axis.axvline(1.0, color="0.4", linewidth=0.8)
        axis.set(xlabel="miss [km]", xlim=(3e-3, 10), title=title)
    np.ravel(axes)[0].set_ylabel("cases [%]")
    np.ravel(axes)[0].legend(loc="upper left")
    return figure


def _share(axis: Axes, law: str, landed: Landings, *, line: str = "-", label: str | None = None) -> None:
    """Share of the cases, the lost ones among them, with a miss below the abscissa."""
    km = np.sort(landed.distance[landed.ok]) / KM
    axis.semilogx(km, 100 * np.arange(1, len(km) + 1) / len(landed.ok), line, color=SHADES[law], label=label)


def footprint_figure(study: LandingStudy) -> Any:
    """Footprints on a grid of longitude and latitude, with the ground track of the reference."""
    from studies.landing import degrees

    figure, axis = fig.new_figure(1, 1, width_mm=110, height_mm=170)
    axis = np.ravel(axis)[0]
    r = np.column_stack([study.reference[name] for name in "xyz"])
    unit = r / np.linalg.norm(r, axis=1, keepdims=True)
    axis.plot(np.arctan2(unit[:, 1], unit[:, 0]) / DEG, np.arcsin(unit[:, 2]) / DEG, color="0.4", linewidth=0.8, label="reference")
    for k, (t, ring, state) in enumerate(study.footprints):
        place = degrees(ring, study.set_up)
        axis.fill(place[:, 0], place[:, 1], facecolor=f"C{k}", alpha=0.12)
        axis.plot(place[:, 0], place[:, 1], color=f"C{k}", label=f"from {t:.0f} s, {state[0] / KM:.0f} km altitude")
        axis.plot(state[1] / DEG, state[2] / DEG, "o", color=f"C{k}")
    target = degrees(np.zeros((1, 2)), study.set_up)[0]
    axis.plot(*target, "+", color="black", markersize=9, label="target")
    axis.set(xlabel="longitude [deg]", ylabel="latitude [deg]", xlim=(target[0] - 8, target[0] + 8), aspect=1 / np.cos(target[1] * DEG))
    axis.legend(loc="lower right")
    return figure


def flight_figure(study: LandingStudy) -> Any:
    """Nominal flights under both laws."""
    return _flights(study.nominal, study.set_up.target)


def _flights(flown: Mapping[str, Trajectory], target: Target) -> Figure:
    """Bank angle, load, altitude against speed and ground track of flights, by the name of the law."""
    figure, axes = fig.small_multiples(["bank angle", "load", "altitude and speed", "ground track"], cols=2, panel_height_mm=50)
    for law, flight in flown.items():
        color = SHADES[law]
        r, v = np.column_stack([flight[n] for n in "xyz"]), np.column_stack([flight[n] for n in "uvw"])
        miss = target.miss(r) / KM
        axes[0].plot(flight.t, flight["bank"] / DEG, color=color, label=NAMES.get(law, law))
        axes[1].plot(flight.t, flight["load"], color=color)
        axes[2].plot(np.linalg.norm(v, axis=1) / KM, flight["h"] / KM, color=color)
        axes[3].plot(miss[:, 0], miss[:, 1], color=color)
    axes[0].set(xlabel="time [s]", ylabel="bank angle [deg]")
    axes[0].legend(loc="lower left")
    axes[1].set(xlabel="time [s]", ylabel="load [g$_0$]")
    axes[2].set(xlabel="speed [km/s]", ylabel="altitude [km]")
    axes[3].set(xlabel="downrange to the target [km]", ylabel="cross-range [km]")
    return figure


def trade_figure(study: LandingStudy) -> Any:
    """Greatest load against bank travel of the hard set."""
    figure, axis = fig.new_figure(1, 1, width_mm=100, height_mm=70)
    axis = np.ravel(axis)[0]
    for law in NAMES:
        _cost(axis, law, study.flown[law, "hard"])
    axis.legend(loc="upper left")
    return figure


def _cost(axis: Axes, law: str, landed: Landings) -> None:
    """Greatest load against bank travel of the cases that landed."""
    axis.plot(landed["travel"][landed.ok] / DEG, landed["peak"][landed.ok], ".", color=SHADES[law], label=NAMES[law])
    axis.set(xlabel="bank travel [deg]", ylabel="greatest load [g$_0$]")


def flown_figures(law: str, flown: Trajectory, *, target: Target) -> dict[str, Figure]:
    """Figure of one flight, under a law or of the open-loop reference."""
    with fig.style():
        return {"landing_bank": _flights({law: flown}, target)}


def landed_figures(law: str, landed: Landings) -> dict[str, Figure]:
    """Figures of one dispersed set under one law; none if no flight landed."""
    if not landed.ok.any():
        return {}
    with fig.style():
        figure, axes = fig.new_figure(1, 2, height_mm=80)
        frame = max(1.2, 1.05 * float(np.abs(landed.miss[landed.ok]).max()) / KM)
        _misses(axes[0, 0], law, landed, limit=frame)
        _share(axes[0, 1], law, landed)
        axes[0, 1].axvline(1.0, color="0.4", linewidth=0.8)
        axes[0, 1].set(xlabel="miss [km]", ylabel="cases [%]")
        trade, axes = fig.new_figure(1, 1, width_mm=100, height_mm=70)
        _cost(axes[0, 0], law, landed)
    return {"landing_miss": figure, "landing_trade": trade}
