"""Figures of the modulator study."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from models.describing import sampled_modes, sampled_region
from models.modulators import dead_band_relay
from models.sampled_cycles import region
from studies import figures as fig
from studies.modulators import K_MAX, M1, M2, NEAR, PAPER, SCHEMES, linear_part
from studies.result import FigureItem

if TYPE_CHECKING:
    from models.census_map import CensusMap
    from studies.modulators import ModulatorStudy, Track

KINDS = (  # of the map: what exists besides {0}, colour
    ("off only: quiet, proven", "#e8f1ec"),
    ("M$_c$ = 1", "#56B4E9"),
    ("M$_c$ = 2", "#E69F00"),
    ("M$_c$ = 1 and 2", "#0072B2"),
    ("others too (periods 3, 15, 19, ...)", "#CC79A7"),
    ("undecided", "#22272e"),
)


def figures(study: ModulatorStudy) -> list[FigureItem]:
    """All figures of the study, in the order of the paper."""
    makers: list[fig.Maker[ModulatorStudy]] = [
        (
            "modulator_duty", "Duty cycle against a constant demand (Fig. 3)",
            "Continuous modulator by its closed form; sampled ones exactly, from the word in which the orbit from rest ends.", duty_figure,
        ),
        (
            "modulator_tracking", "Impulse of a harmonic demand (Fig. 4)",
            "Integral of 0.5 sin(w t) and of the pulses that answer it, h = 0, k = 0.8.", tracking_figure,
        ),
        (
            "modulator_endings", "What a demand leaves behind (Fig. 5)",
            "k = 1; the demand sin(w t) ends after 5 s and the jets go on: w = 1 rad/s leaves M_c = 1, w = 0.5 rad/s leaves M_c = 2.",
            endings_figure,
        ),
        (
            "modulator_describing", "Discrete describing functions (Fig. 6)",
            "Sets of -1/N in which the relay really gives a word, and the linear part G at the frequency of that period: a cycle is "
            "predicted where the point lies in the set.", describing_figure,
        ),
        (
            "modulator_schemes", "The schemes compared (Fig. 8)",
            "Duty cycles (a) and the impulse error while tracking 0.8 sin(t) (b). The offset of scheme b fires a little more.",
            schemes_figure,
        ),
        (
            "modulator_map", "Which steady outputs exist where, without a demand",
            "Census at every point; lines: the paper's conditions for M_c = 1 (eqs 16 to 19) and their counterpart for M_c = 2; "
            "right: the part around the schemes of Table 4.", map_figure,
        ),
    ]  # fmt: skip
    return fig.items(makers, study)


def duty_figure(study: ModulatorStudy) -> Any:
    """Duty cycle of the continuous and of the sampled modulators."""
    figure, axes = fig.small_multiples(["hysteresis and sampling", "feedback gain k, h = 0"], cols=2, panel_height_mm=66, sharey=True)
    for axis, names in zip(axes, (("h = 0.2, k = 1", "h = 0, k = 1"), ("h = 0, k = 0.9", "h = 0, k = 0.8", "h = 0, k = 0.7")), strict=True):
        axis.plot([0, 1], [0, 1], color=fig.MUTED, linewidth=0.7, linestyle=":", label="duty = demand")
        axis.plot(study.r, study.continuous, color=fig.INK, label="continuous, h = 0.2, k = 1")
        for i, name in enumerate(names):
            axis.plot(study.r, study.sampled[name].duty, color=f"C{i}", linewidth=1.0, label=f"sampled, {name}")
        axis.set(xlabel="demand r [1]", xlim=(0, 1), ylim=(0, 1.02))
        axis.legend(loc="upper left")
    axes[0].set_ylabel("duty cycle [1]")
    return figure


def tracking_figure(study: ModulatorStudy) -> Any:
    """Impulses of demand and pulses for each frequency."""
    titles = [f"w = {w:g} rad/s" for w in study.tracks]
    figure, axes = fig.small_multiples(titles, cols=3, panel_height_mm=54)
    for axis, track in zip(axes, study.tracks.values(), strict=True):
        axis.plot(track.t, track.wanted, color=fig.MUTED, label="demand")
        axis.step(track.t, track.given, where="post", color="C0", linewidth=0.9, label="pulses")
        axis.set(xlabel="time [s]")
    axes[0].set_ylabel("impulse [s of full thrust]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def endings_figure(study: ModulatorStudy) -> Any:
    """Demand and output around the end of the demand."""
    figure, axes = fig.small_multiples([f"w = {w:g} rad/s" for w in study.endings], cols=1, panel_height_mm=42, sharex=True)
    for axis, track in zip(axes, study.endings.values(), strict=True):
        axis.step(track.t, track.y, where="post", color="C0", linewidth=0.9, label="output y")
        axis.step(track.t, track.r, where="post", color="C1", label="demand r")
        axis.set(xlim=(3.0, 8.0), ylim=(-1.15, 1.15), ylabel="demand, output [1]")
    axes[-1].set_xlabel("time [s]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def describing_figure(study: ModulatorStudy) -> Any:
    """Regions of the modes with the linear part of three gains."""
    figure, axes = fig.small_multiples(["4 samples", "2 and 3 samples", "5 samples"], cols=3, panel_height_mm=84)
    trigger = dead_band_relay(PAPER.u_on)
    for axis, periods in zip(axes, ((4,), (2, 3), (5,)), strict=True):
        colours: dict[str, str] = {}
        for mode in (m for p in periods for m in sampled_modes(p)):
            label = f"{mode.period} samples, M$_c$ = {mode.mc}"
            first = label not in colours
            colour = colours.setdefault(label, f"C{len(colours)}")
            edge = sampled_region(mode, trigger, largest=12.0).minus_inverse
            name = label if first else f"_{label}"
            if mode.period == 2:
                axis.plot([-12.0, float(edge.real.max())], [0, 0], color=colour, linewidth=1.8, label=name)
            else:
                axis.fill(edge.real, edge.imag, facecolor=colour, alpha=0.28, edgecolor=colour, linewidth=0.8, label=name)
        for k, marker in zip(study.predictions, "sDo", strict=True):
            g = linear_part(k)(2 * np.pi / (np.array(periods) * PAPER.Ts))
            axis.plot(g.real, g.imag, marker, color=fig.INK, markersize=4, markerfacecolor="white", label=f"G, k = {k:g}")
        axis.set(xlim=(-1.5, 0.1), ylim=(-0.8, 0.8), xlabel="real part")
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2, fontsize=6.5, handlelength=1.2, columnspacing=0.8)
    axes[0].set_ylabel("imaginary part")
    return figure


def schemes_figure(study: ModulatorStudy) -> Any:
    """Duty cycles of the three schemes and how far the impulse is off."""
    figure, axes = fig.small_multiples(["duty cycle", "impulse error while tracking 0.8 sin(t)"], cols=2, panel_height_mm=62)
    axes[0].plot([0, 1], [0, 1], color=fig.MUTED, linewidth=0.7, linestyle=":", label="duty = demand")
    for i, (name, m) in enumerate(SCHEMES.items()):
        label = f"{name}: k = {m.k:g}, delta = {m.delta:g}"
        track: Track = study.scheme_tracks[name]
        axes[0].plot(study.r, study.schemes[name].duty, color=f"C{i}", linewidth=1.0, linestyle=("-", "-", "--")[i], label=label)
        axes[1].plot(track.t, track.given - track.wanted, color=f"C{i}", linewidth=0.9, linestyle=("-", "-", "--")[i], label=label)
    axes[0].set(xlabel="demand r [1]", ylabel="duty cycle [1]", xlim=(0, 1), ylim=(0, 1.02))
    axes[0].legend(loc="upper left")
    axes[1].set(xlabel="time [s]", ylabel="impulse of pulses less demand [s]")
    return figure


def map_kinds(found: CensusMap) -> np.ndarray:
    """Number in ``KINDS`` of each point of a map, shape (K, D)."""
    one, two = found.of(M1), found.of(M2)
    turned = {w[i:] + w[:i] for w in ((0,), M1, M2) for i in range(len(w))}
    other = np.zeros_like(one)
    for word in found.words:
        if word not in turned:
            other |= found.of(word)
    kind = np.where(one & two, 3, np.where(one, 1, np.where(two, 2, 0)))
    return np.where(found.decided, np.where(other, 4, kind), 5)


def map_figure(study: ModulatorStudy) -> Any:
    """The census map with the closed conditions over it, whole and near the schemes."""
    from matplotlib.patches import Patch

    figure, axes = fig.small_multiples(["whole range", "around the schemes of Table 4"], cols=2, panel_height_mm=76)
    for axis, found in zip(axes, (study.map, study.near), strict=True):
        draw_map(axis, found)
    for name, m in SCHEMES.items():
        axes[1].plot(m.k, m.delta, "o", color="black", markerfacecolor="white", markersize=4.5, zorder=5, clip_on=False)
        axes[1].annotate(name, (m.k, m.delta), xytext=(5, 5), textcoords="offset points")
    axes[0].set(xlim=(0, K_MAX), ylim=(0, study.map.delta[-1]), ylabel="offset delta [1]")
    axes[1].set(xlim=NEAR[0], ylim=NEAR[1])
    handles, labels = axes[0].get_legend_handles_labels()
    present = np.unique(np.concatenate([map_kinds(study.map).ravel(), map_kinds(study.near).ravel()]))
    patches = [Patch(facecolor=c, edgecolor=fig.MUTED, label=text) for i, (text, c) in enumerate(KINDS) if i in present]
    figure.legend(handles=[*patches, *handles], labels=[*(p.get_label() for p in patches), *labels], loc="outside lower center", ncols=4)
    return figure


def draw_map(axis: Any, found: CensusMap) -> None:
    """A map on given axes, with the conditions of the two cycles of period 4 as lines."""
    from matplotlib.colors import ListedColormap

    dk, dd = np.diff(found.k)[0] / 2, np.diff(found.delta)[0] / 2
    extent = (found.k[0] - dk, found.k[-1] + dk, found.delta[0] - dd, found.delta[-1] + dd)
    axis.imshow(map_kinds(found).T, origin="lower", aspect="auto", extent=extent, cmap=ListedColormap([c for _, c in KINDS]),
                vmin=-0.5, vmax=5.5, interpolation="nearest")  # fmt: skip
    axis.grid(visible=False)
    for word, style, label in ((M1, "-", "M$_c$ = 1: eqs 16-19"), (M2, "--", "M$_c$ = 2: its counterpart")):
        limits = region(found.modulator, word, r=found.r)
        spans = [(k, limits.delta_range(k)) for k in np.linspace(0.0, found.k[-1], 1201)]
        ends = np.array([(k, span[1]) for k, span in spans if span is not None]).reshape(-1, 2)
        axis.plot(ends[:, 0], ends[:, 1], color="black", linestyle=style, linewidth=1.2, label=label)
    axis.set_xlabel("feedback gain k [1]")
