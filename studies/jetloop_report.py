"""Figures of the jet-loop study, and all that the report shows of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from models.describing import schmitt_df
from models.flexible_loop import jet_plant
from models.limit_cycles import SIGN_CHANGE
from studies import figures as fig
from studies.result import Comparison, FigureItem, Headline, StudyResult, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from models.limit_cycles_events import LoopRun
    from studies.jetloop import JetLoopStudy, LoopState

TAIL = 300.0  # s of the end of a simulation that are drawn in detail
BLUE, RED, GREEN, ORANGE, PURPLE = (fig.COLORS[name] for name in ("blue", "vermillion", "green", "orange", "purple"))


def result(study: JetLoopStudy) -> StudyResult:
    """Everything the report shows of the study."""
    return StudyResult(
        name="jetloop",
        title="Limit cycle of a Schmitt-trigger jet loop",
        lead=(
            "Deng et al. (2016) predict the limit cycle of a jet loop by its describing function, give the exact one in closed form, and "
            "move it away from a flexible mode. Here every prediction stands beside exact answers: closed forms for the rigid body, and "
            "for the flexible vehicle periodic orbits found by event-exact shooting, replayed, with their Floquet multipliers."
        ),
        figures=figures(study), tables=[closed_table(study), orbit_table(study), design_table(study)], comparisons=comparisons(study),
        data=study.to_dict(), headlines=headlines(study),
    )  # fmt: skip


def headlines(study: JetLoopStudy) -> list[Headline]:
    """The cards of the study."""
    tight = study.bounds.to_dict()["lower_over_absolute_difference"]["median"]
    return [
        Headline("Exact limit cycle", study.closed["w_exact"], "rad/s", "printed 0.4298", 6),
        Headline("By describing function", study.closed["w_df"], "rad/s", "printed 0.4281", 6),
        Headline("Theorem 2", float(tight), "", f"of the difference is the median lower bound; {len(study.bounds.kappa)} loops", 4),
        Headline("Flexible motion", study.quieter, "times less", "after tuning, at the same closed-form accuracy", 3),
    ]


def comparisons(study: JetLoopStudy) -> list[Comparison]:
    """Every printed number of the paper."""
    c, s = study.closed, study.closed["sensitivities"]["w_exact"]
    mode = study.modes[0].frequency
    before = study.before.runs[0]
    return [
        Comparison("Exact limit-cycle frequency", 0.4298, c["w_exact"], "rad/s", "four printed digits", 1.2e-4),
        Comparison("Describing-function frequency", 0.4281, c["w_df"], "rad/s", "four printed digits", 1.2e-4),
        Comparison("Frequency of the mode", 0.45, mode, "rad/s", "given", 1e-12),
        Comparison("Exact amplitude A_T", None, c["A_exact"], why="not printed as a number"),
        Comparison("Describing-function amplitude at the trigger", None, c["A_df_trigger"], why="not printed; of the attitude it is less"),
        Comparison("Derivative of w_T by u_on", None, s["u_on"], why="the formula is printed as an image only"),
        Comparison("Derivative of w_T by u_off", None, s["u_off"], why="the formula is printed as an image only"),
        Comparison("Derivative of w_T by tau", None, s["tau"], why="the formula is printed as an image only"),
        Comparison(
            "Mean frequency of the flexible loop, given parameters", None, before.frequency(0.5 * before.t[-1]) or 0.0, "rad/s",
            why="the mode answers the jets as strongly as the rigid body: with it the motion is irregular and slower",
        ),
        Comparison(
            "Change of the closed-form amplitude by the tuning", "unchanged", study.design.amplitude_change,
            why="the tuned parameters are printed as an image only; these are the optimum of the stated problem",
        ),
    ]  # fmt: skip


def closed_table(study: JetLoopStudy) -> Table:
    """The rigid loop, exact beside the describing function."""
    c, rigid = study.closed, study.rigid
    rows: list[tuple[Any, ...]] = [
        ("frequency [rad/s]", c["w_exact"], None if rigid is None else rigid.w, c["w_df"]),
        ("attitude amplitude", c["A_exact"], None if rigid is None else rigid.peak(rigid.loop.attitude), c["A_df_attitude"]),
        ("trigger amplitude", None, None if rigid is None else rigid.peak(rigid.loop.C), c["A_df_trigger"]),
        ("firing duty", c["duty"], None if rigid is None else rigid.duty, None),
        ("Floquet multiplier", c["multiplier"], None if rigid is None else float(np.abs(rigid.multipliers).max()), None),
    ]
    return Table(
        "Limit cycle of the rigid loop", ("quantity", "closed form", "shooting", "describing function"), rows,
        caption="a = 0.15, u_on = 0.7, u_off = 0.3, tau = 0.7 s. The shooting knows neither of the formulas.",
    )  # fmt: skip


def orbit_table(study: JetLoopStudy) -> Table:
    """Predictions and exact orbits of the flexible loop before and after."""
    rows: list[tuple[Any, ...]] = []
    for name, state in (("given", study.before), ("tuned", study.after)):
        rows += [(name, "describing function", p.w, None, None, p.stability, None) for p in state.predicted]
        rows += [
            (name, f"exact, {o.pulses} pulses", o.w, o.peak(o.loop.attitude), o.peak(o.loop.flexible), "stable" if o.stable else "unstable",
             float(np.abs(o.multipliers).max()))
            for o in state.orbits
        ]  # fmt: skip
    columns = ("parameters", "answer", "w [rad/s]", "attitude amplitude", "flexible amplitude", "stability", "largest |multiplier|")
    return Table(
        "Limit cycles of the flexible loop", columns, rows,
        caption="Every exact orbit was replayed by a simulation that does not know its switching times. The describing function calls "
        "stable what is not.",
    )  # fmt: skip


def design_table(study: JetLoopStudy) -> Table:
    """Parameters and figures of merit before and after the tuning."""
    d, old = study.design, study.trigger
    rows = [
        ("u_on", old.u_on, d.trigger.u_on), ("u_off", old.u_off, d.trigger.u_off), ("tau [s]", study.tau, d.tau),
        ("closed-form w_T [rad/s]", d.before.w, d.cycle.w), ("closed-form A_T", d.before.amplitude, d.cycle.amplitude),
        ("closed-form firing duty", d.before.duty, d.cycle.duty), ("firing [s]", d.before.pulse, d.cycle.pulse),
        ("largest |flexible part|, last half", max(study.before.peaks), max(study.after.peaks)),
        ("firing duty, simulated", study.before.runs[0].firing(0.5 * study.before.runs[0].t[-1]),
         study.after.runs[0].firing(0.5 * study.after.runs[0].t[-1])),
    ]  # fmt: skip
    return Table("The tuned loop", ("quantity", "given", "tuned"), rows, caption="Four starts; the largest of them.")


def figures(study: JetLoopStudy) -> list[FigureItem]:
    """All figures of the study."""
    with fig.style():  # legends take their look when they are made
        return [
            FigureItem("jetloop_phase", "Exact limit cycle of the rigid loop",
                       "Figure 4 of the paper: parabolas while a jet fires, straight lines while coasting; switching lines dashed.",
                       phase_figure(study)),
            FigureItem("jetloop_resonance", "Given parameters, flexible vehicle",
                       "Figure 5 of the paper: attitude, flexible part and firings. The motion never settles.", run_figure(study.before)),
            FigureItem("jetloop_nyquist", "Nyquist plots before and after tuning",
                       "Figure 6 of the paper: linear part and -1/N(A), with their intersections; frequencies in rad/s.",
                       nyquist_figure(study)),
            FigureItem("jetloop_quiet", "Tuned parameters, flexible vehicle",
                       "Figure 7 of the paper, at the same scales as the resonant case.", run_figure(study.after, like=study.before)),
            FigureItem("jetloop_orbits", "Exact periodic orbits of the flexible loop",
                       "Solid: stable, dashed: unstable; dots: switchings. In grey the last 300 s of a simulation.", orbit_figure(study)),
            FigureItem("jetloop_bounds", "Theorem 2 over random loops",
                       "Both frequencies are functions of one number kappa; right: how much of the difference the bounds leave open.",
                       bounds_figure(study)),
        ]  # fmt: skip


def phase_figure(study: JetLoopStudy) -> Figure:
    """Phase plane of the rigid cycle with its switching lines."""
    figure, axes = fig.new_figure(1, 1, width_mm=110.0, height_mm=72.0)
    ax = axes[0, 0]
    if study.rigid is None:
        return figure
    x = study.rigid.path(64)[1]
    rate = np.array([-1.0, 1.0]) * 1.25 * np.abs(x[:, 1]).max()
    for level, color, text in ((study.trigger.u_on, RED, "on"), (study.trigger.u_off, GREEN, "off")):
        for sign in (1, -1):
            ax.plot(sign * level - study.tau * rate, rate, "--", color=color, lw=0.8, label=text if sign > 0 else None)
    ax.plot(*np.vstack([x, x[:1]]).T, color=BLUE, label="limit cycle")
    ax.plot(*study.rigid.run.x[study.rigid.run.events].T, "o", color=BLUE)
    ax.set(xlabel="attitude", ylabel="rate [1/s]", xlim=1.3 * np.array([-1, 1]) * study.closed["A_exact"])
    ax.set(ylim=(rate[0], 1.7 * rate[1]))
    ax.legend(loc="upper center", ncols=3)
    return figure


def run_figure(state: LoopState, *, like: LoopState | None = None) -> Figure:
    """Attitude, flexible part and jets of the first simulation, at the scale of another one."""
    return run_picture(state.runs[0], top=0.0 if like is None else like.runs[0].peak_attitude())


def run_picture(run: LoopRun, *, top: float = 0.0) -> Figure:
    """Attitude, flexible part and jets of a simulation; the whole of it and its end; the scale shows at least `top`."""
    with fig.style():
        figure, axes = fig.new_figure(2, 2, height_mm=96.0, sharex=True)
        t, x = run.dense(6)
        reach = 1.05 * max(top, float(np.abs(x @ run.loop.attitude).max()), 1e-12)
        end = float(t[-1])
        for column, (since, width) in enumerate(((0.0, 0.35), (max(end - TAIL, 0.0), 1.0))):
            inside = t >= since
            ax = axes[0, column]
            ax.plot(t[inside], x[inside] @ run.loop.attitude, color=BLUE, lw=width, label="attitude")
            ax.plot(t[inside], x[inside] @ run.loop.flexible, color=RED, lw=width, label="flexible part")
            ax.set(ylim=(-reach, 1.35 * reach))
            _firings(axes[1, column], run.t, run.u, since)
            axes[1, column].set(xlabel="time [s]", xlim=(since, end))
        axes[0, 1].legend(loc="upper right", ncols=2)
        axes[1, 0].set(ylabel="jets")
        for ax, letter, title in zip(axes.ravel(), "abcd", ("all of it", f"last {min(TAIL, end):.0f} s", "", ""), strict=True):
            fig.panel_label(ax, letter, title=title)
    return figure


def _firings(ax: Axes, t: np.ndarray, u: np.ndarray, since: float) -> None:
    changes = np.flatnonzero(np.diff(u, prepend=np.nan) != 0)
    used = changes[max(int(np.searchsorted(t[changes], since)) - 1, 0) :]
    ax.step(np.append(t[used], t[-1]), np.append(u[used], u[-1]), where="post", color=PURPLE, lw=0.5)
    ax.set(ylim=(-1.3, 1.3), yticks=(-1, 0, 1))


def nyquist_figure(study: JetLoopStudy) -> Figure:
    """Linear part, rigid and flexible, and -1/N with all intersections."""
    figure, axes = fig.new_figure(1, 2, height_mm=76.0)
    for ax, letter, state, name in zip(axes[0], "ab", (study.before, study.after), ("given parameters", "tuned parameters"), strict=True):
        trigger = state.trigger
        mode = study.modes[0].frequency
        w = np.sort(
            np.concatenate(
                [np.geomspace(0.05, 20, 1500), mode * (1 + np.concatenate([-np.geomspace(1e-5, 0.5, 500), np.geomspace(1e-5, 0.5, 500)]))]
            )
        )
        A = trigger.u_on * np.concatenate([1 + np.geomspace(1e-9, 1, 500), np.geomspace(2.001, 30, 300)])
        for curve, color, text in (
            (jet_plant(study.a, tau=state.tau).response(w), GREEN, "G, rigid"),
            (state.loop.response(w), BLUE, "G, flexible"),
            (-1 / schmitt_df(trigger, A), ORANGE, "-1/N"),
        ):
            ax.plot(curve.real, curve.imag, color=color, lw=0.9, label=text)
        points = [complex(state.loop.response(np.array([p.w]))[0]) for p in state.predicted]
        for k, (p, at) in enumerate(zip(state.predicted, points, strict=True)):
            ax.plot(at.real, at.imag, "o", color=RED)
            ax.annotate(f"{p.w:.3f}", (at.real, at.imag), textcoords="offset points", xytext=(-6, 8 - 22 * k), color=RED, ha="right")
        reach, depth = max((abs(at.real) for at in points), default=1.0), max((abs(at.imag) for at in points), default=1.0)
        ax.set(xlabel="real part", ylabel="imaginary part", xlim=(-2.2 * reach, 0.3 * reach), ylim=(-3.0 * depth, 1.0 * depth))
        fig.panel_label(ax, letter, title=name)
    axes[0, 0].legend(loc="lower right")
    return figure


def orbit_figure(study: JetLoopStudy) -> Figure:
    """Attitude and rate of the exact orbits over the end of a simulation."""
    figure, axes = fig.new_figure(1, 2, height_mm=72.0, sharey=True)
    for ax, letter, state, name in zip(axes[0], "ab", (study.before, study.after), ("given parameters", "tuned parameters"), strict=True):
        loop = state.loop
        rate = np.zeros(len(loop.A))
        rate[1::2] = 1.0
        t, x = state.runs[0].dense(6)
        last = x[t >= t[-1] - TAIL]
        ax.plot(last @ loop.attitude, last @ rate, color=fig.MUTED, lw=0.3)
        for orbit, color in zip(state.orbits, (BLUE, RED, GREEN, ORANGE, PURPLE), strict=False):
            path = orbit.path()[1]
            kind = "stable" if orbit.stable else "unstable"
            ax.plot(
                path @ loop.attitude, path @ rate, "-" if orbit.stable else "--", color=color, lw=1.0, label=f"{orbit.w:.4f} rad/s, {kind}"
            )
            nodes = orbit.run.x[orbit.run.events]
            ax.plot(nodes @ loop.attitude, nodes @ rate, "o", color=color, ms=2.5)
        ax.set(xlabel="attitude")
        fig.panel_label(ax, letter, title=name)
        ax.legend(loc="upper right", fontsize=6.5)
    axes[0, 0].set(ylabel="attitude rate [1/s]")
    low, high = axes[0, 0].get_ylim()
    axes[0, 0].set(ylim=(low, high + 0.35 * (high - low)))
    return figure


def bounds_figure(study: JetLoopStudy) -> Figure:
    """Relative difference of the frequencies over kappa, and the tightness of the bounds."""
    figure, axes = fig.new_figure(1, 2, height_mm=66.0)
    b = study.bounds
    left, right = axes[0]
    left.plot(b.kappa, b.difference, ".", color=BLUE, ms=1.0, rasterized=True)
    left.axhline(np.pi**2 / 8 - 1, color=RED, lw=0.8, ls="--")
    left.axvline(SIGN_CHANGE, color=GREEN, lw=0.8, ls="--")
    left.set(xscale="log", xlabel="kappa", ylabel="(w_T - w_DF)/w_DF")
    right.plot(b.kappa, np.maximum(b.upper - b.difference, 1e-16), ".", color=RED, ms=1.0, label="upper - difference", rasterized=True)
    right.plot(
        b.kappa,
        np.maximum(np.abs(b.difference) - b.lower_abs, 1e-16),
        ".",
        color=BLUE,
        ms=1.0,
        label="|difference| - lower",
        rasterized=True,
    )
    right.set(xscale="log", yscale="log", xlabel="kappa", ylabel="slack/w_DF")
    right.legend(loc="upper left", markerscale=6)
    for ax, letter in zip(axes[0], "ab", strict=True):
        fig.panel_label(ax, letter)
    return figure
