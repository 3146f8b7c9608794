"""Command ``reentry allocate compare``: allocation methods side by side.  Only typer and the standard library are imported here."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from studies import console
from studies.cli_options import AnswerFolder, AsJson
from studies.console import InputError

if TYPE_CHECKING:
    from allocation.demand_history import History
    from studies.allocation import AllocationStudy

app = typer.Typer(
    name="allocate", no_args_is_help=True, help="Share a demanded force and moment out to jets and surfaces: methods compared.",
)  # fmt: skip

File = Path | None
_FACTOR = "NAME=FACTOR such as M=10"


@app.callback()
def group() -> None:
    """Share a demanded force and moment out to jets and surfaces: methods compared."""


@app.command()
def compare(
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="[SCENARIO]", show_default=False, help="blend (recorded pitch demand of the STS-1 case) or three-axis."),
    ] = None,
    effectiveness: Annotated[
        File, typer.Option("--effectiveness", metavar="B.csv", show_default=False, help="Own data: heading axis, then the effectors.")
    ] = None,
    limits: Annotated[
        File,
        typer.Option(
            "--limits", metavar="L.csv", show_default=False, help="Own data: effector, lower, upper and, optionally, rate and flow."
        ),
    ] = None,
    demand: Annotated[
        File,
        typer.Option("--demand", metavar="D.csv", show_default=False, help="Own data: t (optional) and the axes, one row for each sample."),
    ] = None,
    dt: Annotated[float | None, typer.Option("--dt", metavar="S", show_default=False, help="Sample time, if the demand has no t.")] = None,
    methods: Annotated[
        str | None,
        typer.Option("--methods", metavar="A,B", show_default=False, help="Such as qp,osqp,redistributed,bound; all unless given."),
    ] = None,
    fail: Annotated[
        list[str] | None,
        typer.Option(
            "--fail",
            metavar="NAME[=VALUE]",
            show_default=False,
            help="Effector that is off, or jammed at VALUE (surface: rad; jet: duty, 0 to 1); repeatable.",
        ),
    ] = None,
    priority: Annotated[
        list[str] | None, typer.Option("--priority", metavar="AXIS=FACTOR", show_default=False, help="Weight of an axis; repeatable.")
    ] = None,
    cost: Annotated[
        list[str] | None, typer.Option("--cost", metavar="EFFECTOR=FACTOR", show_default=False, help="Cost of an effector; repeatable.")
    ] = None,
    slow: Annotated[int, typer.Option("--slow", min=1, max=100_000, help="Samples for each back end and the predictive method.")] = 200,
    bound: Annotated[int, typer.Option("--bound", min=0, max=100_000, help="Samples for the mixed-integer bound; 0: without.")] = 100,
    as_json: AsJson = False,
    out: AnswerFolder = None,
) -> None:
    """Compare allocation methods on one demand history: tracking, propellant, pulses, travel, optimality, time."""
    failed = _failures(fail)
    factors = [console.numbers(option, texts, expected=_FACTOR) for option, texts in (("--priority", priority), ("--cost", cost))]
    chosen = None if methods is None else _chosen(methods, bound)
    console.check_out(out)
    with console.work():
        from studies import allocation

        history = _history(scenario, effectiveness, limits, demand, dt)
        study = allocation.run(history, chosen=chosen, failed=failed, priority=factors[0], cost=factors[1], slow=slow, bound_samples=bound)
        data = study.to_dict()
    console.write_answer(out, "allocation", data, figures=study.figures)
    if as_json:
        console.print_text(console.to_json(data))
    else:
        _print(study)


def _history(scenario: str | None, effectiveness: File, limits: File, demand: File, dt: float | None) -> History:
    files = {"--effectiveness": effectiveness, "--limits": limits, "--demand": demand}
    given = [name for name, path in files.items() if path is not None]
    if dt is not None and (not math.isfinite(dt) or dt <= 0):
        raise InputError(f"--dt: found {dt}, expected a sample time > 0 s")
    from studies import allocation

    if scenario is not None:
        if given or dt is not None:
            raise InputError(f"SCENARIO {scenario} and {(given or ['--dt'])[0]}: give a scenario or your own data, not both")
        if scenario not in allocation.HISTORIES:
            from models.checked import unknown_name

            raise InputError(unknown_name("SCENARIO", scenario, allocation.HISTORIES))
        return allocation.HISTORIES[scenario]()
    missing = [name for name in files if name not in given]
    if len(missing) == 3:
        raise InputError(
            f"nothing to compare: give a SCENARIO ({', '.join(allocation.HISTORIES)}), or --effectiveness, --limits and --demand"
        )
    if effectiveness is None or limits is None or demand is None:
        raise InputError(f"{missing[0]}: not given, expected together with {' and '.join(given)}")
    from studies.allocation_files import read_history

    return read_history(effectiveness, limits, demand, dt=dt)


def _chosen(text: str, bound: int) -> list[str]:
    """Names of ``--methods``."""
    names = [part.strip() for part in text.split(",") if part.strip()]
    if not names:
        raise InputError(f"--methods: found {text!r}, expected names such as qp,osqp,redistributed; leave the option out for all of them")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"--methods: {name} is given twice; give it once")
    if "bound" in names and bound == 0:
        raise InputError("--methods names bound, and --bound 0 leaves it out; give it samples, such as --bound 100, or do not name it")
    return names


def _failures(texts: list[str] | None) -> dict[str, float | None]:
    named = console.named_values("--fail", texts, expected="NAME or NAME=VALUE", bare=True)
    return {name: None if value is None else console.number("--fail", name, value) for name, value in named.items()}


def _print(study: AllocationStudy) -> None:
    found, history = study.comparison, study.comparison.history
    columns = ("method", "rms", "worst", "kg", "pulses", "deg", "KKT", "bad", "us", "n")
    rows = [tuple(_cell(value) for value in row) for row in found.rows()]
    console.print_table(f"{history.name}: {len(history)} samples, {len(history.effectors.names)} effectors", columns, rows)
    console.print_text(
        "rms, worst: error in parts of the largest demand on the axis; kg: propellant; deg: travel of the surfaces;\n"
        "KKT: largest residual; bad: answers without a proof; us: time per solve; n: samples."
    )
    if study.remark:
        console.print_text(study.remark)
    if found.same != found.outcomes:
        n = len(found.same[0].samples)
        fewer = [tuple(_cell(value) for value in (*row[:4], *row[6:8])) for row in found.rows(same=True)]
        console.print_table(f"All methods on the same {n} samples", ("method", "rms", "worst", "kg", "KKT", "bad"), fewer)


def _cell(value: Any) -> Any:
    return f"{value:.3g}" if isinstance(value, float) else value
