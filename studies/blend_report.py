"""Figures of the blending study, and all that the report shows of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.interpolate import RegularGridInterpolator

from models.shuttle_trim import trim_elevon
from models.units import DEG
from studies import figures as fig
from studies.blend_tables import comparisons, ensemble_table, headline_table, pulses, singles_table
from studies.figures import INK
from studies.result import FigureItem, Headline, StudyResult

if TYPE_CHECKING:
    from studies.blend import BlendStudy
    from studies.blend_loop import Flight

_PALE, _HATCH = "0.6", "////"


def result(study: BlendStudy) -> StudyResult:
    """Everything the report shows of the study."""
    tables = [headline_table(study)]
    if study.singles:
        tables.append(singles_table(study))
    statistics = ensemble_table(study)
    if statistics is not None:
        tables.append(statistics)
    n, s = study.numbers, study.loop.settings
    return StudyResult(
        name="blend",
        title="Hand-over of pitch control from reaction jets to the elevon",
        lead=(
            "Lu and Zhang (2012) hand the pitch control of an orbiter over from jets to the elevon as the dynamic pressure rises from "
            f"q1 = {s.q1:g} to q2 = {s.q2:g} Pa (equation 20), the jets behind a discrete PWPF modulator. Here the case is flown with the "
            "aerodynamic tables of the STS-1 orbiter, gains from a scheduled LQI synthesis on the symbolic Jacobians, and everything "
            "sampled (10 ms, jets 60 ms) inside one function. The angle-of-attack command of the paper's figure 11 is lost; a documented "
            "one stands in for it."
        ),
        figures=figures(study), tables=tables, comparisons=comparisons(study), data=study.to_dict(),
        failed=[("dispersions", i, "a number was not finite") for i in study.failed],
        headlines=[
            Headline("Tracking error, rms", n.rms_deg, "deg", "after the first 10 s", 2),
            Headline("Propellant", n.propellant_kg, "kg", f"{n.pulses:.0f} pulses, {n.pulses_above_q2:.0f} above q2", 3),
            Headline("Elevon travel", n.travel_deg, "deg", "", 3),
        ],
    )  # fmt: skip


def figures(study: BlendStudy) -> list[FigureItem]:
    """All figures of the study."""
    flap = f"{study.loop.settings.body_flap / DEG:.1f}".replace("-", "−")
    makers: list[fig.Maker[BlendStudy]] = [
        (
            "blend_flight", "The flight, as in figure 11 of the paper",
            "(a) to (h) as in the paper's figure 11, then propellant and pulses. Broken lines: the command, and q1 and q2.", flight_figure,
        ),
        (
            "blend_window", "The blending window",
            "Demand and its sharing out while the dynamic pressure passes q1 and q2 (vertical lines).", window_figure,
        ),
        (
            "blend_trim", "Trim over the corridor",
            f"Body flap at {flap} deg; the flight in vermillion. Hatched: no trim within −33 to 18 deg, or beyond the tables.", trim_figure,
        ),
        (
            "blend_gains", "Gains along the flight",
            "Gains of the schedule in Mach number and dynamic pressure, as flown, and the pitch stiffness that they were found for "
            "(positive: unstable).", gain_figure,
        ),
    ]  # fmt: skip
    if study.stress:
        makers.insert(2, (
            "blend_stress", "Stress cases", "A manoeuvre of 2 deg up or down inside the blending window.", stress_figure,
        ))  # fmt: skip
    return fig.items(makers, study)


def flight_figure(study: BlendStudy) -> Any:
    """Ten panels: the eight of the paper, propellant, pulses."""
    titles = [
        "Mach number", "altitude", "angle of attack", "pitch rate", "dynamic pressure", "pitch angle", "elevon", "jets", "propellant",
        "length of the pulses",
    ]  # fmt: skip
    figure, axes = fig.small_multiples(titles, cols=2, panel_height_mm=38, sharex=True)
    flight, s = study.flight, study.loop.settings
    t, every = flight["t"], slice(None, None, 5)
    columns = (("mach", 1.0, "Ma [1]"), ("h", 1e3, "h [km]"), ("alpha", DEG, r"$\alpha$ [deg]"), ("q", DEG, "q [deg/s]"),
               ("qbar", 1e3, r"$\bar q$ [kPa]"), ("theta", DEG, r"$\theta$ [deg]"), ("delta_e", DEG, r"$\delta_e$ [deg]"))  # fmt: skip
    for axis, (name, scale, label) in zip(axes, columns, strict=False):
        axis.plot(t[every], flight[name][every] / scale, label="elevon" if name == "delta_e" else None)
        axis.set_ylabel(label)
    axes[2].plot(t[every], flight["alpha_cmd"][every] / DEG, "--", color="C1", label="command")
    axes[2].legend(loc="upper right")
    for name, level, side in (("$q_1$", s.q1, "top"), ("$q_2$", s.q2, "bottom")):  # apart, however near they are
        axes[4].axhline(level / 1e3, color=_PALE, linestyle="--", linewidth=0.8)
        axes[4].annotate(name, (1.0, level / 1e3), xycoords=("axes fraction", "data"), xytext=(2, 0), textcoords="offset points", va=side)
    axes[6].plot(t[every], flight["trim"][every] / DEG, color="C1", linewidth=0.9, label="trim")
    _legend_above(axes[6])
    _jets(axes[7], flight)
    axes[8].plot(t[every], used(flight)[every])
    axes[8].set_ylabel("used [kg]")
    fired = pulses(flight)
    for sign, label, color in ((1, "nose up", "C0"), (-1, "nose down", "C1")):
        chosen = fired[fired[:, 2] == sign]
        axes[9].plot(chosen[:, 0], 1e3 * chosen[:, 1], "o", color=color, label=label, markersize=2.5)
    axes[9].set(ylabel="length [ms]", ylim=(0, None))
    if len(fired):
        axes[9].legend(loc="upper right")
    for axis in axes[-2:]:
        axis.set_xlabel("time [s]")
    axes[0].set_xlim(0, t[-1])
    return figure


def _jets(axis: Any, flight: Flight) -> None:
    axis.step(flight["t"], flight["jets"], where="post", linewidth=0.6)
    axis.set(ylabel="command [1]", ylim=(-1.3, 1.3))
    axis.set_yticks([-1, 0, 1])


def _legend_above(axis: Any) -> None:
    """Legend on the line of the title, where no curve can be under it."""
    axis.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, ncols=4, columnspacing=0.8, handlelength=1.0, handletextpad=0.4
    )


def _mark_handover(column: Any, flight: Flight) -> None:
    """Vertical lines in the panels of a column where q1 and q2 are reached, named beside their tops in the first, outside the window."""
    for name, label, side, shift in (("q1_s", "$q_1$", "right", -2), ("q2_s", "$q_2$", "left", 2)):
        if flight.end[name] > 0:
            for axis in column:
                axis.axvline(flight.end[name], color=_PALE, linewidth=0.8)
            place = (flight.end[name], 1.0)
            column[0].annotate(
                label, place, xycoords=("data", "axes fraction"), xytext=(shift, 0), textcoords="offset points", ha=side, va="top"
            )


def _printed(name: str) -> str:
    return name.replace("-", "−")


def used(flight: Flight) -> Any:
    """Propellant used up to each sample, kg, by the jets that work."""
    jets, thrust = flight["jets"], flight.loop.jets
    up, down = (flight.p[flight.loop.params.index(name)] for name in ("up_share", "down_share"))
    rate = np.where(jets > 0, up * thrust.flow_up, 0.0) + np.where(jets < 0, down * thrust.flow_down, 0.0)
    return np.cumsum(rate) * flight.loop.settings.control_s


def _window(flight: Flight) -> Any:
    n, t = flight.end, flight["t"]
    middle = n["q1_s"] if n["q1_s"] > 0 else 66.0
    end = n["q2_s"] if n["q2_s"] > 0 else 79.0
    return (t > middle - 16) & (t < end + 10)


def window_figure(study: BlendStudy) -> Any:
    """Close-up of the hand-over."""
    names, flights = ["this flight" if study.changes else "nominal"], [study.flight]
    if study.stress:
        names.append(_printed("stress -2 deg"))
        flights.append(study.stress["stress -2 deg"])
    rows = ["error", "elevon", "jets' share of the demand", "jets"]
    titles = [f"{rows[0]}: {name}" for name in names] + [row for row in rows[1:] for _ in names]  # the case heads its column
    figure, axes = fig.small_multiples(titles, cols=len(names), panel_height_mm=36, sharex=True)
    panels = np.array(axes).reshape(len(rows), len(names))
    for column, one in zip(panels.T, flights, strict=True):
        part = _window(one)
        t = one["t"][part]
        column[0].plot(t, (one["alpha"] - one["alpha_cmd"])[part] / DEG)
        column[0].set_ylabel(r"$\alpha-\alpha_{cmd}$ [deg]")
        for name, label in (("delta_e", "elevon"), ("trim", "trim"), ("control", "control term")):
            column[1].plot(t, one[name][part] / DEG, label=label, linewidth=1.0)
        column[1].set_ylabel("[deg]")
        column[2].plot(t, one["k_blend"][part], linewidth=0.9)
        column[2].set(ylabel="$k_{blend}$ [1]", ylim=(-0.05, 1.05))
        column[3].plot(t, np.clip(one["duty"][part], -1, 1), color="C1", linewidth=0.9, label="demand")
        column[3].step(t, one["jets"][part], where="post", linewidth=0.7, label="jets", color="C0")
        column[3].set(ylabel="[1]", ylim=(-1.3, 1.3), xlabel="time [s]")
        _mark_handover(column, one)
    for row in (1, 3):
        _legend_above(panels[row, 0])
    return figure


def stress_figure(study: BlendStudy) -> Any:
    """Angle of attack and jets in the stress cases."""
    figure, axes = fig.small_multiples(
        [f"{kind}: {_printed(name)}" for kind in ("angle of attack", "jets") for name in study.stress], panel_height_mm=42
    )
    for i, flight in enumerate(study.stress.values()):
        part = _window(flight)
        t = flight["t"][part]
        axes[i].plot(t, flight["alpha"][part] / DEG, label="flown")
        axes[i].plot(t, flight["alpha_cmd"][part] / DEG, "--", label="command")
        axes[i].set_ylabel(r"$\alpha$ [deg]")
        axes[2 + i].step(t, flight["jets"][part], where="post", linewidth=0.7)
        axes[2 + i].set(ylabel="command [1]", xlabel="time [s]", ylim=(-1.3, 1.3))
        _mark_handover((axes[i], axes[2 + i]), flight)
    axes[0].legend(loc="lower left")
    return figure


def trim_figure(study: BlendStudy) -> Any:
    """Maps of trim elevon, static stability and control effectiveness, with the flight on them."""
    mach, alpha = np.linspace(2.0, 10.0, 81), np.linspace(5.0, 45.0, 81) * DEG
    M, A = np.meshgrid(mach, alpha)
    found = trim_elevon(M, A, delta_bf=study.loop.settings.body_flap)
    shown = found.trimmed & found.covered
    titles = ["trim elevon [deg]", r"static stability $C_{m\alpha}$ [1/rad]", r"effectiveness $C_{m\delta_e}$ [1/rad]"]
    figure, axes = fig.small_multiples(titles, cols=3, panel_height_mm=62, sharey=True)
    values = (found.elevon / DEG, found.Cm_alpha, found.Cm_delta_e)
    levels = (np.arange(-32, 19, 4.0), np.arange(-40, 21, 5) / 100, np.arange(-30, 1, 3) / 100)
    flight = study.flight
    for axis, value, steps in zip(axes, values, levels, strict=True):
        axis.grid(visible=False)
        axis.contourf(mach, alpha / DEG, ~shown, levels=[0.5, 1.5], colors="none", hatches=[_HATCH])
        lines = axis.contour(mach, alpha / DEG, np.ma.masked_where(~shown, value), levels=steps, cmap="cividis", linewidths=0.9)
        axis.clabel(lines, fontsize=6, fmt="%g")
        axis.plot(flight["mach"][::50], flight["alpha"][::50] / DEG, color="C1", linewidth=1.4)
        axis.set(xlabel="Mach number [1]", xlim=(2, 10), ylim=(5, 45))
    axes[0].set_ylabel(r"$\alpha$ [deg]")
    entries = [
        Line2D([], [], color="C1", linewidth=1.4, label="flight"),
        Patch(facecolor="none", edgecolor=INK, hatch=_HATCH, label="no trim, or beyond the tables"),
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=2)
    return figure


def gain_figure(study: BlendStudy) -> Any:
    """The gains that the flight used."""
    figure, axes = fig.small_multiples(["gains", "what they are for"], cols=2, panel_height_mm=46)
    flight, gains = study.flight, study.loop.gains
    every = slice(None, None, 30)
    t = flight["t"][every]
    for name, label in (("K_alpha", r"$K_\alpha$ [1/s$^2$]"), ("K_q", "$K_q$ [1/s]"), ("K_integral", "$K_I$ [1/s$^3$]")):
        axes[0].plot(t, flight[name][every], label=label)
    axes[0].legend(loc="lower center", ncols=3, bbox_to_anchor=(0.5, 0.22))
    axes[0].set(xlabel="time [s]", ylim=(0, None))
    low, high = gains.mach[0], gains.mach[-1]
    stiffness = RegularGridInterpolator((gains.mach, gains.log_qbar), gains.A[:, :, 1, 0])
    pressure = np.clip(np.log(np.maximum(flight["qbar"][every], 1e-6)), gains.log_qbar[0], gains.log_qbar[-1])
    axes[1].plot(t, stiffness(np.column_stack([np.clip(flight["mach"][every], low, high), pressure])))
    axes[1].axhline(0.0, color=_PALE, linewidth=0.8)
    axes[1].set(xlabel="time [s]", ylabel=r"$\partial\dot q/\partial\alpha$ [1/s$^2$]")
    return figure
