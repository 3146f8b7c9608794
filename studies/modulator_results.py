"""What ``reentry modulator`` computes and draws: duty cycle, harmonic tracking, the map of cycles, a design."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from models.census import census
from models.census_map import CensusMap, census_map
from models.checked import Array, as_finite
from models.modulator_design import QuietDesign, design_quiet
from models.modulators import ContinuousPWPF, DiscretePWPF
from models.modulators_runs import run
from models.modulators_static import duty, sampled_duty
from studies.figures import new_figure

_SETTLE = (1, 500, 50_000)  # samples without a demand after which it is asked, each time, which cycle has been reached


def duty_of(modulator: DiscretePWPF, r: Sequence[float], h_continuous: float) -> dict[str, Any]:
    """Duty cycle of the continuous and of the sampled modulator for constant demands, from rest."""
    demand = np.atleast_1d(as_finite("duty: r", list(r)))
    continuous = ContinuousPWPF(km=modulator.km, tau_m=modulator.tau_m, u_on=modulator.u_on, h=h_continuous, Ts=modulator.Ts)
    sampled = sampled_duty(modulator, demand)
    fractions = [str(sampled.fraction(i)) if sampled.decided[i] else None for i in range(len(demand))]
    return {
        "r": demand.tolist(), "continuous": duty(continuous, demand).tolist(), "sampled": sampled.duty.tolist(), "fraction": fractions,
        "period": sampled.period.tolist(), "decided": sampled.decided.tolist(), "h_continuous": h_continuous,
    }  # fmt: skip


def duty_figure(data: dict[str, Any]) -> Figure:
    """Duty cycle against the demand."""
    figure, axes = new_figure(width_mm=120)
    ax = axes[0, 0]
    order = np.argsort(data["r"])
    r = np.array(data["r"])[order]
    ax.plot(r, r, color="0.7", label="demand")
    ax.plot(r, np.array(data["continuous"])[order], label="continuous")
    ax.plot(r, np.array(data["sampled"])[order], label="sampled", drawstyle="steps-mid")
    ax.set_xlabel("demand r")
    ax.set_ylabel("duty cycle")
    ax.legend()
    return figure


def tracking_of(modulator: DiscretePWPF, *, amplitude: float, frequency: float, time: float, until: float | None) -> dict[str, Any]:
    """Answer to amplitude sin(frequency t), zero from `until` on, and impulses of demand and jets (integrals over time, s)."""
    as_finite("track", [amplitude, frequency, time, 0.0 if until is None else until])
    Ts = modulator.Ts
    t = Ts * np.arange(int(np.floor(time / Ts * (1 + 1e-12))) + 1)
    withdrawn = t >= (np.inf if until is None else until)
    demand = np.where(withdrawn, 0.0, amplitude * np.sin(frequency * t))
    pulses = run(modulator, demand)
    # the demand itself, not its samples; the jets hold an output for one sample
    end = np.minimum(t, np.inf if until is None else until)
    wanted = amplitude / frequency * (1 - np.cos(frequency * end))
    given = Ts * (np.cumsum(pulses.y) - pulses.y)
    error = given - wanted
    return {
        "samples": len(t), "amplitude": amplitude, "frequency": frequency, "until": until,
        "rms_impulse_error": float(np.sqrt(np.mean(error**2))), "max_impulse_error": float(np.abs(error).max()),
        "pulses": int(pulses.pulses), "firing_time_s": float(Ts * np.abs(pulses.y).sum()),
        "ends_in": None if until is None or until >= time else _ending(modulator, pulses.y, pulses.z),
        "t": t.tolist(), "r": demand.tolist(), "y": pulses.y.astype(int).tolist(), "impulse_demand": wanted.tolist(),
        "impulse_output": given.tolist(),
    }  # fmt: skip


def _ending(modulator: DiscretePWPF, y: Array, z: Array) -> list[int] | None:
    """Steady output that the state z (3,) after the outputs y (N,) leads to without a demand; None where that is not decided."""
    cycles, before = census(modulator).cycles, y[-1]
    for samples in _SETTLE:
        answer = run(modulator, np.zeros(samples), z0=z)
        z, newest, before = answer.z, answer.y[-1], answer.y[-2] if samples > 1 else before
        for cycle in cycles:
            word = np.array(cycle.word)
            # a state with the outputs of the cycle and nearer to it than the nearest threshold gives the word for ever: |n| < 1
            if ((word == newest) & (np.roll(word, 1) == before) & (np.abs(cycle.x - z[0]) < cycle.margin)).any():
                return list(cycle.word)
        before = newest
    return None


def tracking_figure(data: dict[str, Any]) -> Figure:
    """Demand and output, and their impulses."""
    figure, axes = new_figure(2, 1, sharex=True)
    above, below = axes[:, 0]
    above.plot(data["t"], data["y"], drawstyle="steps-post", linewidth=0.7, label="jets y")
    above.plot(data["t"], data["r"], label="demand r")
    below.plot(data["t"], data["impulse_output"], label="jets")
    below.plot(data["t"], data["impulse_demand"], label="demand")
    above.set_ylabel("fraction of full thrust")
    below.set_ylabel("impulse [s]")
    below.set_xlabel("time [s]")
    for ax in (above, below):
        ax.legend()
    return figure


def map_of(
    modulator: DiscretePWPF, k: tuple[float, float, int], delta: tuple[float, float, int], r: float
) -> tuple[CensusMap, dict[str, Any]]:
    """Census over a grid, and its plain values: `kinds` are the sets of words, `map[i][j]` the kind at k[i], delta[j] (-1: undecided)."""
    found = census_map(modulator, np.linspace(*k), np.linspace(*delta), r=r)
    words = []
    for word, there in zip(found.words, found.exists, strict=True):
        i, j = np.nonzero(there)
        ends = [[float(axis[place.min()]), float(axis[place.max()])] for axis, place in ((found.k, i), (found.delta, j))]
        words.append({"word": list(word), "points": int(there.sum()), "k": ends[0], "delta": ends[1]})
    flat = found.exists.reshape(len(found.words), -1)
    sets, which = np.unique(flat, axis=1, return_inverse=True)
    number = np.where(found.decided, which.reshape(found.decided.shape), -1)
    data = {
        "k": found.k.tolist(), "delta": found.delta.tolist(), "words": words, "quiet": int(found.quiet.sum()),
        "undecided": int((~found.decided).sum()), "kinds": [np.flatnonzero(kind).tolist() for kind in sets.T], "map": number.tolist(),
    }  # fmt: skip
    return found, data


def design_of(modulator: DiscretePWPF, **options: Any) -> tuple[QuietDesign, dict[str, Any]]:
    """A design and its plain values; options of :func:`models.modulator_design.design_quiet`."""
    chosen = design_quiet(modulator, **options)
    data = {
        "k": chosen.modulator.k, "delta": chosen.modulator.delta, "margin": chosen.margin.to_dict(),
        "margin_steps": {"k": options["margin_k"], "delta": options["margin_delta"]}, "error": chosen.linearity.error,
        "slope": chosen.linearity.slope, "bend": chosen.linearity.bend, "candidates": len(chosen.k), "proven": int(chosen.proven.sum()),
    }  # fmt: skip
    return chosen, data


def design_figure(chosen: QuietDesign) -> Figure:
    """Error of the candidates with a proven margin, and the one that was taken."""
    figure, axes = new_figure(width_mm=130)
    ax = axes[0, 0]
    ax.scatter(chosen.k[~chosen.proven], chosen.delta[~chosen.proven], s=4, color="0.85", label="no proven margin")
    shown = ax.scatter(chosen.k[chosen.proven], chosen.delta[chosen.proven], s=9, c=chosen.error[chosen.proven])
    ax.plot(chosen.modulator.k, chosen.modulator.delta, marker="*", markersize=11, color="#D55E00", linestyle="none", label="chosen")
    figure.colorbar(shown, ax=ax, label="static tracking error, rms")
    ax.set_xlabel("feedback gain k")
    ax.set_ylabel("offset delta")
    ax.legend()
    return figure
