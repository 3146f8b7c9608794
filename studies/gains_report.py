"""Figures of the gain study, and all that the report shows of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from studies import figures as fig
from studies.gains_tables import LABELS, certificate_table, comparisons, gain_table, is_n1, miss_table, reference_table, sensitivity_table
from studies.result import FigureItem, Headline, StudyResult

if TYPE_CHECKING:
    from studies.gains import GainsStudy

# name, symbol with scale, factor to that scale
PANELS = (
    ("K1", "$K_1$ [1/g$_0$]", 1.0),
    ("K2", "$K_2$ [10$^{-3}$ s/m]", 1e3),
    ("K3", "$K_3$ [10$^{-5}$ 1/m]", 1e5),
    ("K4", "$K_4$ [10$^{-3}$ s/m]", 1e3),
)

SEARCHED = (
    "The reference flight was found by a search so that the computed gains meet the printed ones: it does not identify"
    " the authors' vehicle."
)
OTHER = (
    "This scenario is not reference N1, for which the computed gains meet the printed ones: the printed constants belong to another flight."
)


def result(study: GainsStudy) -> StudyResult:
    """Everything the report shows of the study."""
    tables = [reference_table(study), gain_table(study), certificate_table(study), sensitivity_table(study)]
    if study.closed_loop:
        tables.insert(2, miss_table(study))
    return StudyResult(
        name="gains",
        title="Optimal feedback gains of longitudinal entry guidance",
        lead=(
            "Tang and Zhao (2000) derive the feedback gains of capsule entry guidance from a Riccati equation along the reference flight. "
            "Here the perturbation model comes from the symbolic Jacobians of the equations of motion, in measured coordinates "
            "(axial load, altitude rate, downrange, downrange rate: X = M dx, with M the Jacobian of the measured quantities) and, "
            "as a check, in state coordinates: the two routes must give the same gains. S is the solution of the Riccati equation; "
            "a quantity is called scaled when its rows and columns are divided by typical magnitudes. "
            + (SEARCHED if is_n1(study) else OTHER)
        ),
        figures=figures(study), tables=tables, comparisons=comparisons(study),
        data=study.to_dict(), failed=study.failed, headlines=headlines(study),
    )  # fmt: skip


def headlines(study: GainsStudy) -> list[Headline]:
    """The cards of the study."""
    printed, proof = study.scenario.guidance.paper_gains, study.certificate()
    cards = [
        Headline("Flight time", float(study.synthesis.reference.t[-1]), "s", "of the reference"),
        Headline("Mean K1", float(study.time_mean["K1"] or 0.0), "1/g0", f"printed {printed.K1:g}".replace("-", "−")),
        Headline("Riccati defect", proof["riccati_residual"] or 0.0, "", "against an integration at half the step", 2),
        Headline("Routes differ by", proof["routes_difference"] or 0.0, "", "measured against state coordinates", 2),
    ]
    large = study.closed_loop.get("large")
    if large is not None and len(large["time_varying"].km) and len(large["open_loop"].km):
        note = f"set large, {len(large['time_varying'].km)} cases; open loop {large['open_loop'].rms:.0f} km"
        cards.append(Headline("Rms range error, K(t)", large["time_varying"].rms, "km", note, 3))
    return cards


def figures(study: GainsStudy) -> list[FigureItem]:
    """All figures of the study."""
    makers: list[fig.Maker[GainsStudy]] = [
        (
            "gains", "Feedback gains along the reference",
            "Gains K(t) of the Riccati equation (paper's sign, ungated), their time means (K3 split) and the printed constants."
            + ("" if any(row.met is False for row in comparisons(study)) else " The printed constants lie within 3 % of the time means."),
            gain_figure,
        ),
        (
            "reference", "Reference flight",
            "Altitude against speed, aerodynamic load, flight-path angle and range of the reference flight.", reference_figure,
        ),
        (
            "sensitivity", "Sensitivity of the gains to the weights",
            "Time mean of |dK/d ln(weight)| over the time mean of |K|, exact, from the derivative of the Riccati solution. "
            "Entries that show no bar are below 0.001 to 0.01.", sensitivity_figure,
        ),
        (
            "coordinates", "Conditioning and agreement of the two routes",
            "Condition number of the scaled map from states to measured coordinates (a), and difference of the gains found in the "
            "two coordinates relative to the largest magnitude of each gain (b).", coordinates_figure,
        ),
    ]  # fmt: skip
    if study.closed_loop:
        makers.insert(1, (
            "misses", "Range errors of the dispersed flights",
            "Share of the cases with a range error below the abscissa; the same cases under every schedule. "
            "Printed constants and time means lie on one another for reference N1.", miss_figure,
        ))  # fmt: skip
    return fig.items(makers, study)


def gain_figure(study: GainsStudy) -> Any:
    """K1 to K4 against time with time means and printed constants."""
    titles = ["axial load", "altitude rate", "downrange", "downrange rate"]
    figure, axes = fig.small_multiples(titles, cols=2, panel_height_mm=50)
    reference, printed = study.synthesis.reference, study.scenario.guidance.paper_gains
    end, split = float(reference.t[-1]), study.scenario.guidance.split_s
    means = study.time_mean
    for i, (axis, (name, label, factor)) in enumerate(zip(axes, PANELS, strict=True)):
        axis.plot(reference.t, factor * study.synthesis.K[:, i], color="C0", label="K(t)", zorder=3)
        pieces = [(0.0, end, name)] if name != "K3" else [(0.0, min(split, end), "K3a"), (min(split, end), end, "K3b")]
        for start, stop, key in pieces:
            mean = means[key]
            first = start == 0.0
            if mean is not None:
                axis.plot([start, stop], [factor * mean] * 2, color="C1", label="time mean" if first else None)
            value = factor * getattr(printed, key)
            axis.plot([start, stop], [value] * 2, color="0.15", linestyle=(0, (2, 2)), label="printed" if first else None, zorder=4)
        axis.set_ylabel(label)
        axis.set_xlim(0, end)
        axis.set_xlabel("time [s]")
    axes[0].legend(loc="lower right")
    return figure


def reference_figure(study: GainsStudy) -> Any:
    """Reference flight in four panels."""
    figure, axes = fig.small_multiples(["altitude and speed", "load", "path angle", "range"], cols=2, panel_height_mm=46)
    r = study.synthesis.reference
    axes[0].plot(r["V"] / 1e3, r["h"] / 1e3)
    axes[0].set(xlabel="speed [km/s]", ylabel="altitude [km]")
    axes[1].plot(r.t, -r["n_x"], label="axial")
    axes[1].plot(r.t, r["load"], label="total", linestyle="--")
    axes[1].set(xlabel="time [s]", ylabel="load [g$_0$]")
    axes[1].legend(loc="upper left")
    axes[2].plot(r.t, np.degrees(r["gamma"]))
    axes[2].set(xlabel="time [s]", ylabel="flight-path angle [deg]")
    axes[3].plot(r.t, r["s"] / 1e3)
    axes[3].set(xlabel="time [s]", ylabel="downrange [km]")
    return figure


def miss_figure(study: GainsStudy) -> Any:
    """Distribution of |range error| for each set and schedule."""
    figure, axes = fig.small_multiples(list(study.closed_loop), cols=3, panel_height_mm=58, sharey=True)
    for axis, flights in zip(axes, study.closed_loop.values(), strict=False):
        for i, (schedule, miss) in enumerate(flights.items()):
            if len(miss.km) == 0:
                continue
            ordered = np.sort(np.abs(miss.km))
            share = np.arange(1, len(ordered) + 1) / len(ordered)
            style = "--" if schedule == "paper" else "-"  # lies on the curve of the time means
            axis.step(np.maximum(ordered, 1e-4), 100 * share, style, where="post", color=f"C{i}", label=LABELS[schedule])
        axis.set_xscale("log")
        axis.set_xlim(1e-2, 1e3)
        axis.set_xticks([1e-2, 1e-1, 1e0, 1e1, 1e2, 1e3])
        axis.set_xlabel("range error [km]")
    axes[0].set_ylabel("share of the cases [%]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def sensitivity_figure(study: GainsStudy) -> Any:
    """Bars of the relative sensitivity of each gain to each weight."""
    table = study.to_dict()["sensitivity"]
    figure, axes = fig.new_figure(1, 1, height_mm=70)
    axis, width = axes[0, 0], 0.2
    for j, (gain, _, _) in enumerate(PANELS):
        heights = [row[gain] for row in table.values()]
        axis.bar(np.arange(len(table)) + (j - 1.5) * width, heights, width, label=f"$K_{gain[1]}$", color=f"C{j}")
    axis.set_xticks(range(len(table)), [_weight_label(name) for name in table], va="baseline")
    axis.tick_params(axis="x", pad=11)
    axis.set_ylabel("relative sensitivity of the gain [1]")
    axis.grid(visible=False, axis="x")
    axis.legend(ncols=4, loc="upper right")
    return figure


def _weight_label(name: str) -> str:
    matrix, key = name[:-1].split("[")
    symbols = {"n_x": "$n_x$", "hdot": r"$\dot h$", "s": "$s$", "sdot": r"$\dot s$", "lift_ratio": "$u$"}
    return f"{'F' if matrix == 'Qf' else matrix}({symbols[key]})"


def coordinates_figure(study: GainsStudy) -> Any:
    """Condition number of the map and difference of the routes."""
    figure, axes = fig.small_multiples(["map to measured coordinates", "guidance against state coordinates"], cols=2, panel_height_mm=52)
    s = study.synthesis
    axes[0].semilogy(s.to.t, s.to.condition)
    axes[0].set(xlabel="time [s]", ylabel="condition number of scaled M")
    difference = np.abs(s.K - s.K_state_route) / np.abs(s.K).max(axis=0)
    for i, (name, _, _) in enumerate(PANELS):
        shown = difference[:, i] > 1e-15  # both routes share the end point exactly
        axes[1].semilogy(s.to.t[shown], difference[shown, i], label=f"$K_{name[1]}$", color=f"C{i}")
    axes[1].set(xlabel="time [s]", ylabel="relative difference [1]")
    axes[1].set_ylim(1e-15, None)
    axes[1].legend(ncols=4, loc="lower center")
    return figure
