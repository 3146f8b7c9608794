"""Statistics, figures and tables of a campaign, and the picture of one replayed case."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from models.core import Array, ModelError
from studies import campaign_statistics as statistics
from studies import figures as fig
from studies.campaign_design import DRAWN
from studies.campaign_flight import MEANINGS
from studies.campaign_statistics import CONFIDENCE, QUANTILES, Estimate
from studies.result import FigureItem, Headline, StudyResult, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from studies.campaign import Campaign, Replay

WORST = 20
NAMED_FAILURES = 1000  # in the report's list; all are counted
DOTS = 4000  # of a scatter plot
_AXES = {
    "V": ("speed at entry [m/s]", 1.0), "gamma": ("path angle at entry [deg]", 180 / math.pi), "density": ("density [%]", 100.0),
    "drag": ("drag [%]", 100.0), "lift": ("lift [%]", 100.0), "wave_phase": ("phase of the density wave [deg]", 180 / math.pi),
}  # fmt: skip
_LABELS = {
    "V": "dV [m/s]",
    "gamma": "dgamma [deg]",
    "density": "density [%]",
    "drag": "drag [%]",
    "lift": "lift [%]",
    "wave_phase": "phase [deg]",
}


def summary(campaign: Campaign) -> dict[str, Any]:
    """Statistics as plain values; estimates as {value, low, high}, an end that the cases cannot give as None."""
    miss = campaign.data["miss_km"][campaign.arrived]
    codes, counts = np.unique(campaign.data["status"], return_counts=True)
    out: dict[str, Any] = {
        "cases": campaign.scenario.campaign.cases, "computed": len(campaign.cases), "arrived": len(miss),
        "failed": len(campaign.cases) - len(miss), "complete": campaign.complete, "confidence": CONFIDENCE,
        "status": {MEANINGS.get(int(code), str(code)): int(count) for code, count in zip(codes, counts, strict=True)},
    }  # fmt: skip
    if len(campaign.cases):
        out["failure_probability"] = _plain(statistics.proportion(out["failed"], out["computed"]))
    if len(miss):
        ordered = np.sort(np.abs(miss))
        out["mean_km"], out["rms_km"] = _plain(statistics.mean(miss)), _plain(statistics.rms(miss))
        out["quantiles_km"] = {f"{share:g}": _plain(statistics.quantile(ordered, share)) for share in QUANTILES}
        out["max_km"] = float(ordered[-1])
        out["worst"] = [_worst(campaign, int(i)) for i in worst(campaign)]
    return out


def _plain(estimate: Estimate) -> dict[str, float | None]:
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def worst(campaign: Campaign) -> np.ndarray:
    """Indices of the arrived cases with the largest misses, largest first, at most `WORST`; equal misses in the order of their numbers."""
    arrived = np.flatnonzero(campaign.arrived)
    return np.asarray(arrived[np.argsort(-np.abs(campaign.data["miss_km"][arrived]), kind="stable")[:WORST]])


def _worst(campaign: Campaign, index: int) -> dict[str, Any]:
    drawn = {name: float(campaign.data[f"draw_{name}"][index]) for name, _ in DRAWN}
    return {"case": int(campaign.cases[index]), "miss_km": float(campaign.data["miss_km"][index]), **drawn}


def rows(campaign: Campaign) -> list[tuple[str, float | str, float | str, float | str, str]]:
    """(quantity, value, low, high, unit) for people."""
    data = summary(campaign)

    def row(label: str, e: dict[str, float | None], unit: str) -> tuple[str, float | str, float | str, float | str, str]:
        value, low, high = ("–" if x is None else x for x in (e["value"], e["low"], e["high"]))
        return label, value, low, high, unit

    out = [("cases computed", str(data["computed"]), "", "", f"of {data['cases']}"), ("cases failed", str(data["failed"]), "", "", "")]
    lines: list[tuple[str, float | str, float | str, float | str, str]] = [*out]
    if "failure_probability" in data:
        lines.append(row("probability of failure", data["failure_probability"], "1"))
    if "rms_km" in data:
        lines += [row("mean miss", data["mean_km"], "km"), row("rms miss", data["rms_km"], "km")]
        lines += [row(f"{100 * float(share):g} % of |miss| below", e, "km") for share, e in data["quantiles_km"].items()]
        lines.append(("largest |miss|", data["max_km"], "", "", "km"))
    return lines


def result(campaign: Campaign) -> StudyResult:
    """Everything the report shows of a campaign."""
    data, c = summary(campaign), campaign.scenario.campaign
    headlines = [Headline("cases computed", data["computed"], "", f"of {c.cases}")]
    if "rms_km" in data:
        rms = data["rms_km"]
        note = f"{rms['low']:.4g} to {rms['high']:.4g} km" if rms["low"] is not None else ""
        headlines.append(Headline("rms miss", rms["value"], "km", note))
        headlines.append(Headline("99.7 % of |miss| below", data["quantiles_km"]["0.997"]["value"], "km"))
    kinds = {"independent": "independent draws", "latin_hypercube": "a Latin hypercube", "sobol": "scrambled Sobol points"}
    state = "" if campaign.complete else f" This campaign is partial: {data['computed']} of {c.cases} cases were computed."
    caution = "" if c.design == "independent" else " The intervals are those of independent draws; means of this design scatter less."
    return StudyResult(
        name="campaign",
        title=f"Dispersion campaign, schedule {c.schedule}",
        lead=(
            f"{c.cases} dispersed closed-loop flights by {kinds[c.design]}, seed {c.seed}. Intervals hold with {100 * CONFIDENCE:g} % "
            f"confidence; those of quantiles hold for any law of the miss.{caution}{state}"
        ),
        figures=figures(campaign) if data["arrived"] > 1 else (), tables=tables(campaign), data=data,
        failed=campaign.first_failures(NAMED_FAILURES), headlines=headlines,
    )  # fmt: skip


def tables(campaign: Campaign) -> list[Table]:
    """Estimates, and the worst cases with the deviations that made them."""
    estimates = Table(
        "Range error at the stop", ["quantity", "value", "low", "high", "unit"], [list(row) for row in rows(campaign)],
        caption=f"low, high: ends of the {100 * CONFIDENCE:g} % confidence interval; – where the cases are too few to give one.",
    )  # fmt: skip
    lines = []
    for i in worst(campaign):
        found = _worst(campaign, int(i))
        lines.append([str(found["case"]), found["miss_km"], *(found[name] * _AXES[name][1] for name, _ in DRAWN)])
    names = [_LABELS[name] for name, _ in DRAWN]
    caption = f"Each can be flown again: {campaign.replay_command(int(lines[0][0]))}" if lines else "No case arrived."
    return [estimates, Table("Worst cases", ["case", "miss [km]", *names], lines, caption=caption)]


def figures(campaign: Campaign) -> list[FigureItem]:
    """Histogram and distribution, convergence, and miss against each dispersed quantity."""
    makers: tuple[fig.Maker[Campaign], ...] = (
        (
            "distribution", "Range errors",
            "Left: number of cases by range error. Right: share of the cases with a smaller magnitude, with a band that holds the whole "
            "curve of the true distribution with 95 % confidence.", _distribution,
        ),
        (
            "convergence", "Convergence of the rms miss",
            "Rms of the first n cases with its 95 % interval; the last value is dashed.", _convergence,
        ),
        (
            "scatter", "Miss against each dispersed quantity",
            f"At most {DOTS} cases, evenly taken by number; the line joins the medians of twenty equal groups of all cases.", _scatter,
        ),
    )  # fmt: skip
    return fig.items(makers, campaign)


def _distribution(campaign: Campaign) -> Figure:
    figure, axes = fig.new_figure(1, 2)
    miss = campaign.data["miss_km"][campaign.arrived]
    left, right = axes[0]
    left.hist(miss, bins=int(min(80, max(10, math.sqrt(len(miss))))), color=fig.COLORS["blue"])
    left.set(xlabel="miss [km]", ylabel="cases", yscale="log")
    ordered = np.sort(np.abs(miss))
    keep = np.unique(np.linspace(0, len(ordered) - 1, 2000).astype(int))
    share, half = (keep + 1) / len(ordered), statistics.band(len(ordered))
    x = np.maximum(ordered[keep], 1e-6)
    right.fill_between(x, np.maximum(share - half, 0), np.minimum(share + half, 1), color=fig.COLORS["sky"], alpha=0.35, linewidth=0)
    right.plot(x, share, color=fig.COLORS["blue"])
    right.set(xscale="log", xlabel="|miss| [km]", ylabel="share of the cases below")
    for letter, panel in zip("ab", (left, right), strict=True):
        fig.panel_label(panel, letter)
    return figure


def _convergence(campaign: Campaign) -> Figure:
    figure, axes = fig.new_figure(1, 1, width_mm=110.0)
    n, value, low, high = statistics.running_rms(campaign.data["miss_km"][campaign.arrived])
    panel = axes[0, 0]
    panel.fill_between(n, low, high, color=fig.COLORS["sky"], alpha=0.35, linewidth=0)
    panel.plot(n, value, color=fig.COLORS["blue"])
    panel.axhline(value[-1], color=fig.MUTED, linestyle="--", linewidth=0.8)
    panel.set(xscale="log", xlabel="cases", ylabel="rms miss [km]")
    return figure


def _scatter(campaign: Campaign) -> Figure:
    names = [name for name, _ in DRAWN if name != "wave_phase" or campaign.scenario.campaign.distributions.wave_amplitude > 0]
    figure, panels = fig.small_multiples([_AXES[name][0].partition(" [")[0] for name in names], cols=3)
    arrived = campaign.arrived
    miss = campaign.data["miss_km"][arrived]
    dots = np.unique(np.linspace(0, len(miss) - 1, min(DOTS, len(miss))).astype(int))
    for name, panel in zip(names, panels, strict=True):
        x = campaign.data[f"draw_{name}"][arrived] * _AXES[name][1]
        panel.plot(x[dots], miss[dots], ".", markersize=1.2, color=fig.COLORS["blue"], alpha=0.5, rasterized=True)
        panel.plot(*_medians(x, miss), color=fig.COLORS["vermillion"])
        panel.set(xlabel=_AXES[name][0], ylabel="miss [km]")
    return figure


def _medians(x: Array, y: Array) -> tuple[list[float], list[float]]:
    groups = [g for g in np.array_split(np.argsort(x, kind="stable"), 20) if g.size]
    return [float(np.median(x[g])) for g in groups], [float(np.median(y[g])) for g in groups]


def replay_figure(replay: Replay) -> Figure:
    """Altitude, load, command and path angle of one case, with its deviations above.

    Raises
    ------
    ModelError
        The case could not start, so there is no flight.
    """
    flown = replay.trajectory
    if flown is None:
        raise ModelError(f"case {replay.case}: was not flown, because it starts outside the valid range of a variable; nothing to draw")
    panels = (
        ("altitude [km]", flown["h"] / 1e3), ("load [g$_0$]", flown["load"]), ("vertical lift over drag", flown.u[:, 0]),
        ("path angle [deg]", np.degrees(flown["gamma"])),
    )  # fmt: skip
    with fig.style():
        figure, axes = fig.small_multiples([label.partition(" [")[0] for label, _ in panels], cols=2, sharex=True)
        for panel, (label, values) in zip(axes, panels, strict=True):
            panel.plot(flown.t, values, color=fig.COLORS["blue"])
            panel.set(xlabel="t [s]", ylabel=label)
        signed = {name: replay.drawn[f"draw_{name}"] * _AXES[name][1] for name, _ in DRAWN}
        drawn = ", ".join(f"{_LABELS[name].replace(' [', f' {value:+.4g} [')}" for name, value in signed.items() if name != "wave_phase")
        figure.suptitle(f"case {replay.case}: {drawn}")
    return figure
