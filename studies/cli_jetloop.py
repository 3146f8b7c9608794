"""Commands ``reentry jetloop``: closed forms (the default), df, exact, simulate, design.  Only typer and the standard library here."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from studies import console
from studies.cli_options import AsJson, out_folder
from studies.console import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from models.flexible_loop import LinearLoop, Mode
    from models.modulators import SchmittTrigger


class _ClosedByDefault(TyperGroup):
    """``reentry jetloop --a ...`` means ``reentry jetloop closed --a ...``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in (*self.commands, "--help"):
            args = ["closed", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    name="jetloop", cls=_ClosedByDefault,
    help="Limit cycle of a Schmitt-trigger jet loop: exact beside the describing function; the numbers of paper 001 unless given.",
)  # fmt: skip

Acceleration = Annotated[float, typer.Option("--a", help="Angular acceleration of the jets, rad/s2 (or threshold units per s2).")]
UOn = Annotated[float, typer.Option("--u-on", help="Threshold at which a jet turns on.")]
UOff = Annotated[float, typer.Option("--u-off", help="Threshold at which it turns off, 0 to u_on.")]
Tau = Annotated[float, typer.Option("--tau", help="Lead of the controller, s.")]
Flexible = Annotated[bool, typer.Option("--flexible/--rigid", help="With the appendage of paper 001, or the rigid body alone.")]
Modes = Annotated[
    list[str] | None,
    typer.Option("--mode", metavar="GAIN,REAL,IMAG", show_default=False, help="A flexible mode and its pole, rad/s; repeatable."),
]
Delay = Annotated[int, typer.Option("--delay", min=0, help="Delay of the jets in whole samples.")]
Sample = Annotated[float, typer.Option("--ts", help="Sampling period, s.")]
Bias = Annotated[float, typer.Option("--bias", help="Constant disturbance as a fraction of the jets' torque, above -1 and below 1.")]
Out = Annotated[Path | None, out_folder("Write a figure into this folder.")]


@app.command()
def closed(a: Acceleration = 0.15, u_on: UOn = 0.7, u_off: UOff = 0.3, tau: Tau = 0.7, as_json: AsJson = False) -> None:
    """Closed forms of the rigid loop: exact cycle, describing function, bounds on their difference, sensitivities."""
    from studies.jetloop import closed_forms

    data = closed_forms(_trigger(u_on, u_off), a=a, tau=tau)
    if as_json:
        console.print_text(console.to_json(data))
        return
    rows: list[tuple[Any, ...]] = [
        (name, _shown(data.get(key)), unit)
        for name, key, unit in (
            ("exact frequency", "w_exact", "rad/s"), ("exact attitude amplitude", "A_exact", ""), ("period", "period", "s"),
            ("coasting rate", "rate", "1/s"), ("one firing", "pulse", "s"), ("firing duty", "duty", ""),
            ("Floquet multiplier", "multiplier", ""),
            ("describing-function frequency", "w_df", "rad/s"), ("its amplitude at the trigger", "A_df_trigger", ""),
            ("its attitude amplitude", "A_df_attitude", ""),
        )
    ]  # fmt: skip
    if data.get("theorem_2"):
        rows += [(f"w_exact - w_df, {name}", _shown(data["theorem_2"][name]), "rad/s") for name in ("difference", "lower", "upper")]
    for name, value in (data.get("sensitivities") or {}).get("w_exact", {}).items():
        rows.append((f"d w_exact/d {name}", _shown(value), ""))
    console.print_table("Schmitt-trigger jet loop", ("quantity", "value", "unit"), rows)
    for key in ("w_exact_reason", "w_df_reason"):
        if data.get(key):
            console.say(f"note: {data[key]}")


@app.command()
def df(
    a: Acceleration = 0.15, u_on: UOn = 0.7, u_off: UOff = 0.3, tau: Tau = 0.7, flexible: Flexible = False, mode: Modes = None,
    delay: Delay = 0, ts: Sample = 0.0, as_json: AsJson = False,
) -> None:  # fmt: skip
    """All intersections of the linear part with -1/N of the describing function: predictions."""
    trigger, loop = _loop(a, u_on, u_off, tau, flexible, mode, delay, ts)
    from studies.jetloop import predictions

    found = [{"w": p.w, "A": p.A, "stability": p.stability, "residual": p.residual} for p in predictions(loop, trigger)]
    if as_json:
        console.print_text(console.to_json({"intersections": found}))
        return
    rows = [(p["w"], p["A"], p["stability"]) for p in found]
    console.print_table(f"Describing function, {loop.name}", ("w [rad/s]", "amplitude at the trigger", "predicted"), rows)
    if not found:
        console.say("note: the linear part does not meet -1/N; an exact limit cycle may exist all the same: reentry jetloop exact")


@app.command()
def exact(
    a: Acceleration = 0.15, u_on: UOn = 0.7, u_off: UOff = 0.3, tau: Tau = 0.7, flexible: Flexible = False, mode: Modes = None,
    delay: Delay = 0, ts: Sample = 0.0, bias: Bias = 0.0, as_json: AsJson = False,
) -> None:  # fmt: skip
    """Exact periodic orbits by event-exact shooting, each verified by a replay, with its Floquet multipliers."""
    trigger, loop = _loop(a, u_on, u_off, tau, flexible, mode, delay, ts)
    push = _bias(bias)
    from models.periodic_orbits import describe
    from studies.jetloop import orbits

    with console.work():
        found = describe(orbits(loop, trigger, a=a, tau=tau, bias=push))
    if as_json:
        console.print_text(console.to_json({"orbits": found}))
        return
    columns = ("w [rad/s]", "pulses", "attitude", "flexible", "duty", "largest |multiplier|", "stable", "replay residual")
    keys = ("w", "pulses", "attitude_amplitude", "flexible_amplitude", "duty", "largest_multiplier", "stable", "residual")
    console.print_table(f"Exact periodic orbits, {loop.name}", columns, [[orbit[key] for key in keys] for orbit in found])
    if not found:
        console.say("note: no periodic orbit was verified; the motion may be irregular or come to rest: reentry jetloop simulate")


@app.command()
def simulate(
    a: Acceleration = 0.15, u_on: UOn = 0.7, u_off: UOff = 0.3, tau: Tau = 0.7, flexible: Flexible = True, mode: Modes = None,
    delay: Delay = 0, ts: Sample = 0.0, bias: Bias = 0.0,
    x0: Annotated[str, typer.Option("--x0", help="Attitude, rate, then deflection and rate of each mode; 0 where left out.")] = "0.5,0.1",
    t_max: Annotated[float, typer.Option("--t-max", help="Duration, s.")] = 4000.0,
    as_json: AsJson = False, out: Out = None,
) -> None:  # fmt: skip
    """Event-exact simulation; figures of merit over its last half."""
    trigger, loop = _loop(a, u_on, u_off, tau, flexible, mode, delay, ts)
    push, start = _bias(bias), _start(x0, len(loop.A))
    from models.limit_cycles_events import simulate_loop

    with console.work():
        run = simulate_loop(loop, trigger, x0=start, t_max=t_max, bias=push)
    half = 0.5 * float(run.t[-1])
    data = {
        "status": run.status.name, "t_end": float(run.t[-1]), "switchings": len(run.events), "w": run.frequency(half),
        "max_flexible": run.peak_flexible(half), "max_attitude": run.peak_attitude(half), "firing_duty": run.firing(half),
        "x_end": run.x[-1].tolist(),
    }  # fmt: skip
    if not run.status.ok:
        console.say(
            f"note: given up at {data['t_end']:.6g} s of {t_max:.6g} s: too many steps; the switchings follow each other without end"
            " (chatter), or the time is too long for one run: give a shorter --t-max"
        )
    if out is not None:
        from studies.jetloop_report import run_picture

        data["figure"] = _save(out, "jetloop.png", run_picture(run))
    if as_json:
        console.print_text(console.to_json(data))
    else:
        console.print_table(
            f"Simulation, {loop.name}, last half", ("quantity", "value"), [(key, _shown(value)) for key, value in data.items()]
        )


@app.command()
def design(
    a: Acceleration = 0.15, u_on: UOn = 0.7, u_off: UOff = 0.3, tau: Tau = 0.7, mode: Modes = None,
    width: Annotated[float, typer.Option("--width", help="Half width of the band around each mode, relative.")] = 0.2,
    pulse_min: Annotated[float, typer.Option("--pulse-min", help="Shortest firing, s.")] = 0.5,
    contraction: Annotated[float, typer.Option("--contraction", help="Largest share of a rate error that survives a firing.")] = 0.5,
    as_json: AsJson = False, out: Out = None,
) -> None:  # fmt: skip
    """Move the limit cycle away from the modes at the least firing and the same closed-form amplitude."""
    trigger = _trigger(u_on, u_off)
    modes = _modes(mode, flexible=not mode)
    from ocp.jet_design import JetLimits
    from studies.jetloop import design_dict, designed

    with console.work():
        tuned, before, after = designed(
            trigger, a=a, tau=tau, modes=modes, width=width, limits=JetLimits(pulse_min=pulse_min, contraction=contraction)
        )
        data = design_dict(tuned, before, after)
    if out is not None:
        from studies.jetloop_report import run_figure

        data["figures"] = [_save(out, "before.png", run_figure(before)), _save(out, "after.png", run_figure(after, like=before))]
    if as_json:
        console.print_text(console.to_json(data))
        return
    rows = [
        ("u_on", u_on, data["u_on"]), ("u_off", u_off, data["u_off"]), ("tau [s]", tau, data["tau"]),
        ("closed-form frequency [rad/s]", tuned.before.w, tuned.cycle.w),
        ("closed-form amplitude", tuned.before.amplitude, data["A_exact"]),
        ("closed-form firing duty", tuned.before.duty, data["duty"]),
        ("max |flexible part|, last half of 4000 s", data["max_flexible_before"], data["max_flexible_after"]),
        ("stable exact orbits", sum(o.stable for o in before.orbits), sum(o.stable for o in after.orbits)),
    ]  # fmt: skip
    console.print_table(f"Design: {data['quieter']:.3g} times quieter", ("quantity", "given", "tuned"), rows)


def _trigger(u_on: float, u_off: float) -> SchmittTrigger:
    from models.modulators import SchmittTrigger

    return SchmittTrigger(u_on, u_off)


def _loop(
    a: float, u_on: float, u_off: float, tau: float, flexible: bool, mode: list[str] | None, delay: int, ts: float
) -> tuple[SchmittTrigger, LinearLoop]:  # fmt: skip
    trigger = _trigger(u_on, u_off)
    from models.flexible_loop import jet_plant
    from models.limit_cycles import describing_cycle

    describing_cycle(trigger, a=a, tau=tau)  # names an a or tau that is not positive
    return trigger, jet_plant(a, tau=tau, modes=_modes(mode, flexible=flexible and not mode), samples=delay, sample=ts)


def _modes(given: list[str] | None, *, flexible: bool) -> tuple[Mode, ...]:
    from models.flexible_loop import FLEXIBLE_001, Mode

    modes = []
    for text in given or ():
        numbers = _numbers("--mode", text, "GAIN,REAL,IMAG such as 1,-0.0023,0.45")
        if len(numbers) != 3:
            raise InputError(f"--mode: found {text!r}, expected three numbers GAIN,REAL,IMAG such as 1,-0.0023,0.45")
        modes.append(Mode(numbers[0], complex(numbers[1], numbers[2])))
    return tuple(modes) or (FLEXIBLE_001 if flexible else ())


def _start(text: str, size: int) -> list[float]:
    numbers = _numbers("--x0", text, "numbers separated by commas such as 0.5,0.1")
    if len(numbers) > size:
        raise InputError(f"--x0: found {len(numbers)} numbers, the plant has {size} states; leave some out")
    return numbers + [0.0] * (size - len(numbers))


def _numbers(option: str, text: str, wanted: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{option}: found {text!r}, expected {wanted}")
    return numbers


def _bias(value: float) -> float:
    if not -1 < value < 1:
        raise InputError(f"--bias: found {value}, expected above -1 and below 1: a stronger disturbance cannot be held by the jets")
    return value


def _shown(value: Any) -> Any:
    return "none" if value is None else value


def _save(place: Path, name: str, figure: Figure) -> str:
    from studies.figures import to_png
    from studies.files import write_bytes

    return str(write_bytes(place / name, to_png(figure)))
