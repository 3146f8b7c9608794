"""Commands ``reentry modulator``: duty, track, census, map, design.  Only typer and the standard library are imported here."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from studies import console
from studies.cli_options import AsJson, out_folder
from studies.console import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from models.modulators import DiscretePWPF

app = typer.Typer(
    name="modulator", no_args_is_help=True,
    help="Sampled pulse modulator of a jet: duty cycle, tracking, all its steady outputs with proof, and its design.",
)  # fmt: skip

Gain = Annotated[float, typer.Option("--k", help="Feedback gain, >= 0.")]
Delta = Annotated[float, typer.Option("--delta", help="Offset f(0) of the asymmetric dead zone, >= 0.")]
FilterGain = Annotated[float, typer.Option("--km", help="Gain of the filter, > 0.")]
Tau = Annotated[float, typer.Option("--tau-m", help="Time constant of the filter, s, > 0.")]
On = Annotated[float, typer.Option("--u-on", help="On threshold, > 0.")]
Hysteresis = Annotated[float, typer.Option("--h", help="Hysteresis u_on - u_off, from 0 to u_on.")]
Sample = Annotated[float, typer.Option("--ts", help="Sample time, s, > 0; from 2 tau_m on the filter alternates.")]
Low = Annotated[float, typer.Option("--dead-low", help="Width of the dead zone below zero, >= 0.")]
High = Annotated[float, typer.Option("--dead-high", help="Width of the dead zone above zero, >= 0.")]
Demand = Annotated[float, typer.Option("--r", help="Constant demand as a fraction of full thrust.")]
OutFolder = Annotated[Path | None, out_folder("Write data and figure into this folder.")]

_LARGEST = 1e6  # amplitude of a demand
_UNKNOWN = 1e-6  # share of the states that may be in no basin without a word about it


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two numbers of an option such as "0,6"."""

    low: float
    high: float


@app.command()
def census(
    k: Gain = 0.8, delta: Delta = 0.0, km: FilterGain = 4.0, tau_m: Tau = 0.2, u_on: On = 0.45, h: Hysteresis = 0.0, ts: Sample = 0.06,
    dead_low: Low = 0.0, dead_high: High = 0.0, r: Demand = 0.0, as_json: AsJson = False, out: OutFolder = None,
) -> None:  # fmt: skip
    """All steady outputs for a constant demand, from every state, with proof, and the states that lead to each."""
    modulator = _modulator(k, delta, km, tau_m, u_on, h, ts, dead_low, dead_high)
    from models.census import census as taken

    with console.work():
        found = taken(modulator, r)
    data = found.to_dict()
    _write(out, "census", data, None)
    if not found.decided:
        where = ", ".join(f"{b.threshold:+.6g} from y = {b.y1}, {b.y2}" for b in found.borders[:3])
        console.say(f"note: undecided, those listed exist, there may be others: {found.reason} (threshold {where})")
    elif data["unknown_fraction"] > _UNKNOWN:
        console.say(f"note: {data['unknown_fraction']:.3g} of the states were not followed to their end; they are in no basin shown")
    if as_json:
        console.print_text(console.to_json(data))
        return
    rows = [(str(list(c.word)), c.period, c.mean, c.margin, 100 * c.basin.fraction) for c in found.cycles]
    title = f"Steady outputs for r = {r:g}: " + ("all there are" if found.decided else "UNDECIDED, those that are certain")
    console.print_table(title, ("word", "period", "mean", "margin", "basin, %"), rows)
    for cycle in found.cycles:
        console.print_text(f"{list(cycle.word)}: x = " + ", ".join(f"{x:.6g}" for x in cycle.x))


@app.command()
def duty(
    k: Gain = 0.8, delta: Delta = 0.0, km: FilterGain = 4.0, tau_m: Tau = 0.2, u_on: On = 0.45, h: Hysteresis = 0.0, ts: Sample = 0.06,
    dead_low: Low = 0.0, dead_high: High = 0.0,
    r: Annotated[list[float] | None, typer.Option("--r", show_default=False, help="One demand; repeatable, instead of --points.")] = None,
    points: Annotated[int, typer.Option("--points", min=2, max=100_001, help="Demands between 0 and 1.")] = 21,
    h_continuous: Annotated[
        float | None, typer.Option("--h-continuous", show_default=False, help="Of the continuous one; --h, or where 0 at most 0.2.")
    ] = None,
    as_json: AsJson = False, out: OutFolder = None,
) -> None:  # fmt: skip
    """Duty cycle against a constant demand, from rest: continuous modulator (closed form) and sampled modulator (exact fraction)."""
    modulator = _modulator(k, delta, km, tau_m, u_on, h, ts, dead_low, dead_high)
    from studies.modulator_results import duty_figure, duty_of

    width = h_continuous if h_continuous is not None else h or min(0.2, u_on)
    with console.work():
        data = duty_of(modulator, r if r else [i / (points - 1) for i in range(points)], width)
    _write(out, "duty", data, lambda: duty_figure(data))
    if as_json:
        console.print_text(console.to_json(data))
        return
    columns = (data["r"], data["continuous"], data["sampled"], data["fraction"])
    rows = [(a, b, c, d or "undecided") for a, b, c, d in zip(*columns, strict=True)]
    console.print_table("Duty cycle", ("r", "continuous", "sampled", "exact"), rows)


@app.command()
def track(
    k: Gain = 0.8, delta: Delta = 0.0, km: FilterGain = 4.0, tau_m: Tau = 0.2, u_on: On = 0.45, h: Hysteresis = 0.0, ts: Sample = 0.06,
    dead_low: Low = 0.0, dead_high: High = 0.0,
    amplitude: Annotated[float, typer.Option("--amplitude", help="Of the demand, as a fraction of full thrust.")] = 0.5,
    frequency: Annotated[float, typer.Option("--frequency", help="Of the demand, rad/s, > 0.")] = 1.0,
    time: Annotated[float, typer.Option("--time", help="Length of the record, s, > 0.")] = 20.0,
    until: Annotated[
        float | None, typer.Option("--until", show_default=False, help="The demand is zero from this time on, s; says how it then ends.")
    ] = None,
    as_json: AsJson = False, out: OutFolder = None,
) -> None:  # fmt: skip
    """Answer to a demand amplitude sin(frequency t): output, and the impulse of the demand beside that of the jets."""
    modulator = _modulator(k, delta, km, tau_m, u_on, h, ts, dead_low, dead_high)
    for name, value in (("--frequency", frequency), ("--time", time)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: found {value}, expected a finite number > 0")
    if abs(amplitude) > _LARGEST:
        raise InputError(f"--amplitude: found {amplitude:g}, expected a fraction of full thrust, at most {_LARGEST:g}")
    if not (math.isfinite(time / ts) and time / ts <= 1e7):
        raise InputError(f"--time: {time:g} s are more than ten million samples of {ts:g} s; give a shorter time")
    from studies.modulator_results import tracking_figure, tracking_of

    with console.work():
        data = tracking_of(modulator, amplitude=amplitude, frequency=frequency, time=time, until=until)
    _write(out, "track", data, lambda: tracking_figure(data))
    if as_json:
        console.print_text(console.to_json(data))
        return
    rows = [(name, data[key], unit) for name, key, unit in (
        ("samples", "samples", ""), ("rms impulse error", "rms_impulse_error", "s"), ("largest impulse error", "max_impulse_error", "s"),
        ("times a jet is turned on", "pulses", ""), ("time that jets fire", "firing_time_s", "s"))]  # fmt: skip
    if data["ends_in"] is not None:
        rows.append(("ends in", str(data["ends_in"]), ""))
    console.print_table(f"Demand {amplitude:g} sin({frequency:g} t)", ("quantity", "value", "unit"), rows)


@app.command("map")
def map_(
    km: FilterGain = 4.0, tau_m: Tau = 0.2, u_on: On = 0.45, h: Hysteresis = 0.0, ts: Sample = 0.06, dead_low: Low = 0.0,
    dead_high: High = 0.0, r: Demand = 0.0,
    k_range: Annotated[str, typer.Option("--k-range", metavar="LOW,HIGH", help="Feedback gains.")] = "0,6",
    delta_range: Annotated[
        str | None, typer.Option("--delta-range", metavar="LOW,HIGH", show_default=False, help="Offsets; 0 to u_on/km unless given.")
    ] = None,
    points: Annotated[str, typer.Option("--points", metavar="NK,ND", help="Points of the grid.")] = "200,200",
    as_json: AsJson = False, out: OutFolder = None,
) -> None:  # fmt: skip
    """Which steady outputs exist where in the plane of k and delta."""
    modulator = _modulator(0.8, 0.0, km, tau_m, u_on, h, ts, dead_low, dead_high)
    gains = _pair("--k-range", k_range)
    offsets = _pair("--delta-range", delta_range) if delta_range is not None else _Pair(0.0, u_on / km)
    numbers = _pair("--points", points)
    for value in (numbers.low, numbers.high):
        if value != int(value) or not 2 <= value <= 5000:
            raise InputError(f"--points: found {points!r}, expected two whole numbers from 2 to 5000 such as 200,200")
    from studies.modulator_results import map_of

    with console.work():
        found, data = map_of(modulator, (gains.low, gains.high, int(numbers.low)), (offsets.low, offsets.high, int(numbers.high)), r)
    _write(out, "map", data, found.plot)
    if as_json:
        console.print_text(console.to_json(data))
        return
    from models.census_map import shown_word

    rows = [(shown_word(w["word"]), len(w["word"]), w["points"], _shown(w["k"]), _shown(w["delta"])) for w in data["words"]]
    total = found.decided.size
    title = f"Steady outputs over {total} points, {data['quiet']} of them quiet, {data['undecided']} undecided"
    console.print_table(title, ("word", "period", "points", "k", "delta"), rows)


@app.command()
def design(
    km: FilterGain = 4.0, tau_m: Tau = 0.2, u_on: On = 0.45, h: Hysteresis = 0.0, ts: Sample = 0.06, dead_low: Low = 0.0,
    dead_high: High = 0.0,
    k_range: Annotated[str, typer.Option("--k-range", metavar="LOW,HIGH", help="Feedback gains to choose from.")] = "0.3,1.5",
    delta_range: Annotated[
        str | None, typer.Option("--delta-range", metavar="LOW,HIGH", show_default=False, help="Offsets; 0 to u_on/(4 km) unless given.")
    ] = None,
    margin_k: Annotated[float, typer.Option("--margin-k", help="No cycle may exist at rest this near in k, >= 0.")] = 0.01,
    margin_delta: Annotated[float, typer.Option("--margin-delta", help="No cycle may exist at rest this near in delta, >= 0.")] = 0.001,
    as_json: AsJson = False, out: OutFolder = None,
) -> None:  # fmt: skip
    """The most linear (k, delta) with a proven margin from every cycle at rest."""
    modulator = _modulator(0.8, 0.0, km, tau_m, u_on, h, ts, dead_low, dead_high)
    gains = _pair("--k-range", k_range)
    offsets = None if delta_range is None else _pair("--delta-range", delta_range)
    from studies.modulator_results import design_figure, design_of

    with console.work():
        given = None if offsets is None else (offsets.low, offsets.high)
        chosen, data = design_of(modulator, k=(gains.low, gains.high), delta=given, margin_k=margin_k, margin_delta=margin_delta)
    _write(out, "design", data, lambda: design_figure(chosen))
    if as_json:
        console.print_text(console.to_json(data))
        return
    margin = data["margin"]
    rows = [("k", data["k"]), ("delta", data["delta"]), ("proven margin in k", margin["proven"] * margin_k),
            ("proven margin in delta", margin["proven"] * margin_delta), ("static tracking error, rms", data["error"]),
            ("slope of the duty cycle", data["slope"]), ("rms about that line", data["bend"])]  # fmt: skip
    console.print_table("Modulator without cycles at rest", ("quantity", "value"), rows)
    if margin["word"] is not None:
        console.print_text(f"nearest cycle found: {margin['word']} at k = {margin['at'][0]:.6g}, delta = {margin['at'][1]:.6g}")


def _modulator(
    k: float, delta: float, km: float, tau_m: float, u_on: float, h: float, ts: float, dead_low: float, dead_high: float
) -> DiscretePWPF:
    from models.modulators import DiscretePWPF
    from models.modulators_static import advice

    made = DiscretePWPF(km=km, tau_m=tau_m, u_on=u_on, h=h, k=k, delta=delta, Ts=ts, dead_low=dead_low, dead_high=dead_high)
    for remark in advice(made):
        console.say(f"note: {remark}")
    return made


def _pair(option: str, text: str) -> _Pair:
    values = []
    for part in text.split(","):
        with contextlib.suppress(ValueError):
            values.append(float(part))
    if len(values) != 2 or len(text.split(",")) != 2 or not all(math.isfinite(v) and v >= 0 for v in values):
        raise InputError(f"{option}: found {text!r}, expected two numbers >= 0 such as 0,6")
    if option != "--points" and values[0] >= values[1]:
        raise InputError(f"{option}: found {text!r}, expected the lower number first")
    return _Pair(values[0], values[1])


def _shown(ends: list[float]) -> str:
    return f"{ends[0]:.4g} to {ends[1]:.4g}"


def _write(out: Path | None, name: str, data: dict[str, Any], draw: Callable[[], Figure] | None) -> None:
    if out is None:
        return
    from studies.figures import style, to_png
    from studies.files import folder

    with console.work(), folder(out) as place:
        (place / f"{name}.json").write_text(console.to_json(data), encoding="utf-8")
        if draw is not None:
            with style():
                (place / f"{name}.png").write_bytes(to_png(draw()))
    console.say(f"wrote {name}.json{'' if draw is None else f' and {name}.png'} into {out}")
