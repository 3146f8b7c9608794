"""Command line ``reentry``.

Only typer and the standard library are imported here: ``reentry --help`` must answer at once. Exit codes: 0 done, 2 the user's
input, 3 some cases failed, 4 the machine, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from studies import cli_allocate, cli_blend, cli_campaign, cli_jetloop, cli_landing, cli_modulator, console
from studies.cli_options import AsJson, ShowScenario, folder_of, out_folder, scenario_changes, scenario_file
from studies.console import Code, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from studies.scenario import Scenario

app = typer.Typer(
    name="reentry", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Atmospheric entry and jet control: certified gains, landing, jet modulators, allocation, dispersed flights, reports.",
    epilog="Exit codes: 0 done, 2 wrong input, 3 some cases failed, 4 machine (disk, permission, missing part), 130 interrupted.",
)  # fmt: skip
app.add_typer(cli_campaign.app)
app.add_typer(cli_jetloop.app)
app.add_typer(cli_modulator.app)
app.add_typer(cli_allocate.app)
app.command()(cli_blend.blend)
app.command()(cli_landing.land)

_EXAMPLE = "vehicle.lift_to_drag=0.3"

ScenarioFile = Annotated[Path | None, scenario_file("Scenario; keys left out keep their defaults (reference N1).")]
Changes = Annotated[list[str] | None, scenario_changes(_EXAMPLE)]
OutFolder = Annotated[Path | None, out_folder("Write the results into this folder.")]
Cases = Annotated[int, typer.Option("--cases", min=1, max=100_000, help="Dispersed closed-loop flights in each set.")]
Flights = Annotated[int, typer.Option("--dispersions", min=0, max=100_000, help="Dispersed closed-loop flights in each set.")]
Times = Annotated[
    str | None,
    typer.Option("--at", metavar="TIMES", show_default=False, help='Sample the gains at these times in s, such as "0,50,100".'),
]
ReportFolder = Annotated[
    Path, typer.Option("--out", metavar="DIR", parser=folder_of, help="Folder of the report; an older report there is replaced.")
]

_HEADLINES = (
    ("flight time", "t_f_s", "s"), ("range", "range_m", "m"), ("peak axial load", "peak_axial_g", "g0"),
    ("peak load", "peak_load_g", "g0"), ("time of peak load", "peak_time_s", "s"),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """What every command is asked: the checked scenario, the form of the answer, and where files go."""

    scenario: Scenario
    as_json: bool
    out: Path | None


def _version(wanted: bool) -> None:
    if wanted:
        from studies.doctor import version

        console.print_text(f"reentry {version()}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")] = False,
) -> None:
    pass


@app.command()
def gains(
    scenario: ScenarioFile = None,
    changes: Changes = None,
    dispersions: Flights = 0,
    at: Times = None,
    as_json: AsJson = False,
    out: OutFolder = None,
    show: ShowScenario = False,
) -> None:
    """Synthesize the feedback gains of a scenario, with their certificate."""
    request = _request(scenario, changes, as_json, out, show)
    times = _times(at)
    with console.work() as progress:
        study = request.scenario.run(dispersions=dispersions, at=times, progress=progress)
        data = study.to_dict()
    _write_gains(study, data, request)
    for remark in study.remarks:
        console.say(f"note: {remark}")
    if as_json:
        console.print_text(console.to_json(data))
    else:
        console.print_table(f"Gains of {request.scenario.vehicle.name}", ("quantity", "value", "unit"), study.summary())
        from studies.gains_tables import gain_table, miss_table

        tables = ([gain_table(study, times)] if times else []) + ([miss_table(study)] if study.closed_loop else [])
        for table in tables:
            console.print_table(table.title, table.columns, table.rows)
    _end(study.failed)


@app.command()
def study(
    scenario: ScenarioFile = None,
    changes: Changes = None,
    full: Annotated[bool, typer.Option("--full", help="Ten times the cases.")] = False,
    cases: Cases = 500,
    as_json: AsJson = False,
    out: ReportFolder = Path("out/report"),
    show: ShowScenario = False,
) -> None:
    """Run all studies and write the report (one HTML page with figures, and the data)."""
    request = _request(scenario, changes, as_json, out, show)
    chosen = request.scenario
    from studies.all_studies import run_all
    from studies.provenance import collect
    from studies.report import write_report

    with console.work() as progress:
        results = run_all(chosen, full=full, cases=cases, progress=progress)
        facts = collect(chosen, chosen.dispersions.seed)
        page = write_report(results, out, scenario_yaml=chosen.to_yaml(), provenance=facts)
    failed = [case for result in results for case in result.failed]
    if as_json:
        console.print_text(console.to_json({"report": str(page), "studies": {result.name: result.data for result in results}}))
    else:
        console.print_text(f"report: {page}")
    _end(failed)


@app.command()
def demo(
    scenario: ScenarioFile = None, changes: Changes = None, as_json: AsJson = False, out: OutFolder = None, show: ShowScenario = False
) -> None:
    """Shortest way to a first figure: synthesize gains and draw them into demo.png."""
    request = _request(scenario, changes, as_json, out, show)
    from studies.files import write_bytes

    with console.work() as progress:
        result = request.scenario.run(progress=progress)
        reference = result.to_dict()["reference"]
        figures = result.figures()
        figure = figures.get("gains") or next(iter(figures.values()))
        path = write_bytes((out or Path()) / "demo.png", _drawn(figure, "png"))
    if as_json:
        console.print_text(console.to_json({"figure": str(path), "reference": reference}))
    else:
        rows = [(label, reference[key], unit) for label, key, unit in _HEADLINES]
        console.print_table(f"Reference flight of {request.scenario.vehicle.name}", ("quantity", "value", "unit"), rows)
        console.print_text(f"figure: {path}")
    _end(result.failed)


@app.command()
def doctor(
    scenario: ScenarioFile = None, changes: Changes = None, as_json: AsJson = False, out: OutFolder = None, show: ShowScenario = False
) -> None:
    """Check the installation in seconds: versions, compiler, known numbers; and the scenario, if one is given."""
    request = _request(scenario, changes, as_json, out, show)
    from studies.doctor import Check, examine

    with console.work():
        checks = examine()
    if scenario is not None or changes:
        checks.append(Check("scenario", True, f"{scenario or '--set'}: all keys and values are accepted"))
    sound = all(check.ok for check in checks)
    data = {"ok": sound, "checks": [{"name": check.name, "ok": check.ok, "detail": check.detail} for check in checks]}
    _write(request, "doctor.json", console.to_json(data))
    if as_json:
        console.print_text(console.to_json(data))
    else:
        console.print_table("Installation", ("check", "", "meaning"), [(c.name, "OK" if c.ok else "FAIL", c.detail) for c in checks])
    if not sound:
        console.say("reentry: the installation is not sound: " + ", ".join(check.name for check in checks if not check.ok))
        raise typer.Exit(Code.MACHINE)


@app.command()
def schema(
    scenario: ScenarioFile = None, changes: Changes = None, as_json: AsJson = False, out: OutFolder = None, show: ShowScenario = False
) -> None:
    """Print the JSON schema of a scenario for editors; a scenario that is given is checked first. Always JSON."""
    request = _request(scenario, changes, as_json, out, show)
    text = console.to_json(request.scenario.json_schema())
    _write(request, "scenario.schema.json", text)
    console.print_text(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of the console script.

    Parameters
    ----------
    arguments : sequence of str, optional
        Instead of those of the process.

    Returns
    -------
    int
        Exit code.
    """
    os.environ.setdefault("MPLBACKEND", "Agg")  # figures go to files: no display is needed
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal without Unicode shows less, but does not fail
    given = None if arguments is None else list(arguments)
    with console.termination_as_interrupt():
        return int(console.guard(lambda: app(args=given, prog_name="reentry")))


def _request(path: Path | None, changes: Sequence[str] | None, as_json: bool, out: Path | None, show: bool) -> Request:
    from studies.scenario import Scenario

    scenario = Scenario.load(path) if path is not None else Scenario.default()
    scenario = scenario.edit(console.changes(changes, example=_EXAMPLE), origin="--set")
    for remark in scenario.remarks():
        console.say(f"note: {remark}")
    console.check_out(out)
    request = Request(scenario=scenario, as_json=as_json, out=out)
    if show:
        console.print_scenario(scenario, as_json=as_json)
        raise typer.Exit
    return request


def _times(text: str | None) -> list[float] | None:
    """Times of ``--at``; that they lie in the flight is checked by the study, which knows its end."""
    if text is None:
        return None
    times = []
    for part in text.split(","):
        value = math.nan
        with contextlib.suppress(ValueError):
            value = float(part)
        if not math.isfinite(value) or value < 0:
            raise InputError(f'--at: found {part.strip()!r}, expected times >= 0 in s separated by commas, such as --at "0,50,100"')
        times.append(value)
    return times


def _write(request: Request, name: str, text: str) -> None:
    if request.out is not None:
        from studies.files import write_text

        console.say(f"wrote {write_text(request.out / name, text)}")


def _write_gains(study: Any, data: dict[str, Any], request: Request) -> None:
    if request.out is None:
        return
    from studies.files import folder

    with console.work(), folder(request.out) as place:
        (place / "gains.json").write_text(console.to_json(data), encoding="utf-8")
        (place / "scenario.yaml").write_text(request.scenario.to_yaml(), encoding="utf-8")
        for name, figure in study.figures().items():
            (place / f"{name}.svg").write_bytes(_drawn(figure, "svg"))
    console.say(f"wrote gains.json, scenario.yaml and figures into {request.out}")


def _drawn(figure: Figure, form: str) -> bytes:
    from studies.figures import style

    stream = io.BytesIO()
    with style():  # colours are looked up when a figure is drawn
        figure.savefig(stream, format=form, dpi=150, bbox_inches="tight")
    return stream.getvalue()


def _end(failed: Iterable[tuple[str, int, str]]) -> None:
    """Name the cases that failed; the others' results stand."""
    cases = list(failed)
    for name, number, reason in cases[:20]:
        console.say(f"failed: case {number} of {name}: {reason}")
    if cases:
        more = f" (the first 20 are named; {len(cases) - 20} more)" if len(cases) > 20 else ""
        console.say(f"reentry: {len(cases)} case(s) failed{more}; the results of the others stand")
        raise typer.Exit(Code.CASES_FAILED)


if __name__ == "__main__":
    sys.exit(main())
