"""Figures, tables and *paper | computed* rows of the gain study."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from studies import figures as fig
from studies.guidance import MEASURED
from studies.result import Comparison, FigureItem, Headline, StudyResult, Table

if TYPE_CHECKING:
    from studies.gains import GainsStudy

# name, symbol with scale, factor to that scale
PANELS = (
    ("K1", "$K_1$ [1/g$_0$]", 1.0),
    ("K2", "$K_2$ [10$^{-3}$ s/m]", 1e3),
    ("K3", "$K_3$ [10$^{-5}$ 1/m]", 1e5),
    ("K4", "$K_4$ [10$^{-3}$ s/m]", 1e3),
)
LABELS = {
    "open_loop": "open loop",
    "time_varying": "K(t)",
    "least_squares": "constants fitted to flown commands, K3 split",
    "time_mean": "time means of K(t), K3 split",
    "paper": "printed constants",
    "paper_unsplit": "printed constants, K3 unsplit",
}


def result(study: GainsStudy) -> StudyResult:
    """Everything the report shows of the study."""
    tables = [gain_table(study), certificate_table(study), sensitivity_table(study)]
    if study.closed_loop:
        tables.insert(1, miss_table(study))
    means = study.time_mean
    headlines = [
        Headline("mean K1", float(means["K1"] or 0.0), "1/g0", "printed -0.62"),
        Headline("Riccati defect", study.certificate()["riccati_residual"], "", "independent, half step", 2),
        Headline("routes differ by", study.synthesis.routes_difference, "", "guidance against state coordinates", 2),
    ]
    for name, flights in study.closed_loop.items():
        if name == "large" and len(flights["time_varying"].km):
            headlines.append(
                Headline("rms miss, K(t)", flights["time_varying"].rms, "km", f"open loop {flights['open_loop'].rms:.0f} km", 3)
            )
    return StudyResult(
        name="gains",
        title="Optimal feedback gains of longitudinal entry guidance",
        lead=(
            "Tang and Zhao (2000) derive the feedback gains of capsule entry guidance from a Riccati equation along the reference flight. "
            "Here the perturbation model comes from the symbolic Jacobians of the equations of motion, in measured coordinates "
            "(axial load, altitude rate, downrange, downrange rate) and, as a check, in state coordinates. The reference flight was found "
            "by a search so that the computed gains meet the printed ones: it does not identify the authors' vehicle."
        ),
        figures=figures(study), tables=tables, comparisons=comparisons(study),
        data=study.to_dict(), failed=study.failed, headlines=headlines,
    )  # fmt: skip


def figures(study: GainsStudy) -> list[FigureItem]:
    """All figures of the study."""
    makers: list[tuple[str, str, str, Callable[[GainsStudy], Any]]] = [
        (
            "gains", "Feedback gains along the reference",
            "Gains K(t) of the Riccati equation (paper's sign, ungated), their time means (K3 split) and the printed constants. "
            "The printed constants are the time means of K(t).", gain_figure,
        ),
        (
            "reference", "Reference flight",
            "Altitude against speed, aerodynamic load, flight-path angle and range of the reference flight.", reference_figure,
        ),
        (
            "sensitivity", "Sensitivity of the gains to the weights",
            "Time mean of |dK/d ln(weight)| over the time mean of |K|, exact, from the derivative of the Riccati solution. "
            "The downrange weight in Q acts about as strongly as R.", sensitivity_figure,
        ),
        (
            "coordinates", "Conditioning and agreement of the two routes",
            "Condition number of the scaled map from states to measured coordinates (left), and difference of the gains found in the "
            "two coordinates relative to the largest magnitude of each gain (right).", coordinates_figure,
        ),
    ]  # fmt: skip
    if study.closed_loop:
        makers.insert(1, (
            "misses", "Range errors of the dispersed flights",
            "Share of the cases with a range error below the abscissa; the same cases under every schedule.", miss_figure,
        ))  # fmt: skip
    items = []
    for name, title, caption, make in makers:
        with fig.style():
            items.append(FigureItem(name, title, caption, make(study)))
    return items


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
    figure, axes = fig.small_multiples(["corridor", "load", "path angle", "range"], cols=2, panel_height_mm=46)
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
    figure, axes = fig.small_multiples([name.replace("_", " + ") for name in study.closed_loop], cols=3, panel_height_mm=58, sharey=True)
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
    axis.set_xticks(range(len(table)), [_weight_label(name) for name in table])
    axis.set_ylabel("relative change of the gain")
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
    axes[1].set(xlabel="time [s]", ylabel="difference of the routes")
    axes[1].set_ylim(1e-15, None)
    axes[1].legend(ncols=4, loc="lower center")
    return figure


def gain_table(study: GainsStudy) -> Table:
    """Gains at a few times."""
    end = float(study.synthesis.reference.t[-1])
    times = [t for t in (0.0, 50.0, 100.0, 200.0, 300.0, 400.0, 450.0, 500.0) if t < end] + [end]
    values = study.synthesis.spline()(times)
    rows = [[t, *(float(v) for v in row)] for t, row in zip(times, values, strict=True)]
    return Table(
        "Feedback gains K(t)", ["time [s]", "K1 [1/g0]", "K2 [s/m]", "K3 [1/m]", "K4 [s/m]"], rows,
        "Sign of the paper: correction of CL/CD cos(bank) = K1 dn_x + K2 dhdot + K3 ds + K4 dsdot.",
    )  # fmt: skip


def miss_table(study: GainsStudy) -> Table:
    """rms, 95th percentile and maximum of the range error."""
    rows: list[list[Any]] = []
    for name, flights in study.closed_loop.items():
        for schedule, m in flights.items():
            numbers = [m.rms, m.p95, m.worst] if len(m.km) else [None, None, None]
            rows.append([name, LABELS[schedule], *numbers, len(m.km), len(m.failed)])
    seed = study.scenario.dispersions.seed
    return Table(
        "Range errors of the dispersed closed loops",
        ["set", "schedule", "rms [km]", "95 % [km]", "largest [km]", "arrived", "failed"], rows,
        f"Independent uniform dispersions, seed {seed}, command every {study.scenario.guidance.sample_s:g} s, feedback above "
        f"{study.scenario.guidance.gate_load_g:g} g0, perfect navigation. A few cases in which the lift saturates dominate the rms "
        "of the constants.",
    )  # fmt: skip


def certificate_table(study: GainsStudy) -> Table:
    """The proofs of the synthesis."""
    c = study.certificate()
    rows: list[list[Any]] = [
        [
            "Riccati defect, guidance coordinates",
            c["riccati_residual"],
            "per interval, against an independent integration at half the step",
        ],
        ["Riccati defect, state coordinates", c["riccati_residual_state_route"], "the same for the second route"],
        ["difference of the two routes", c["routes_difference"], "relative to the largest magnitude of each gain"],
        ["terminal gain against its closed form", c["terminal_gain_error"], "K(t_f) = -R⁻¹H'F"],
        ["smallest eigenvalue of scaled S", c["min_eig_S"], "must not be negative"],
        ["condition number of scaled S", c["cond_S"], "worst node"],
        ["condition number of scaled M", c["coordinate_condition_max"], "worst node; singular only where the load or the speed vanishes"],
    ]
    return Table("Certificate of the synthesis", ["proof", "value", "meaning"], rows)


def sensitivity_table(study: GainsStudy) -> Table:
    """Relative sensitivities."""
    rows: list[list[Any]] = []
    for name, row in study.to_dict()["sensitivity"].items():
        rows.append([name, *row.values()])
    return Table(
        "Relative sensitivity of the gains to the weights", ["weight", "K1", "K2", "K3", "K4"], rows,
        "Time mean of |dK/d ln(weight)| over the time mean of |K|. The paper finds K insensitive to F and Q; along this reference "
        f"the {MEASURED[2]} entries of Q and F are not negligible beside R.",
    )  # fmt: skip


def comparisons(study: GainsStudy) -> list[Comparison]:
    """Printed constants beside the computed time means."""
    printed, means = study.scenario.guidance.paper_gains, study.time_mean
    units = {"K1": "1/g0", "K2": "s/m", "K3a": "1/m", "K3b": "1/m", "K4": "s/m"}
    split = study.scenario.guidance.split_s
    words = {"K3a": f", t < {split:g} s", "K3b": f", t ≥ {split:g} s"}
    rows = []
    for key, unit in units.items():
        value = means[key]
        if value is not None:
            why = "time mean of K(t); printed to two digits, along the authors' own unpublished reference"
            rows.append(Comparison(f"{key[:2]}{words.get(key, '')}", float(getattr(printed, key)), value, unit, why, 0.03))
    sensitivity = study.to_dict()["sensitivity"]
    strongest = max((max(row.values()), name) for name, row in sensitivity.items() if name.startswith("Q["))
    rows.append(Comparison(
        "sensitivity to Q relative to R", "“not very sensitive”", strongest[0] / max(sensitivity["R[lift_ratio]"].values()), "1",
        f"largest relative sensitivity to an entry of Q ({strongest[1]}) over that to R: not small along this reference", None,
    ))  # fmt: skip
    return rows
