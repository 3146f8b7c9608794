"""Commands ``reentry campaign``: run (the default), replay, show.  Only typer and the standard library are imported here."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from studies import console
from studies.cli_options import AsJson, folder_of, scenario_changes, scenario_file
from studies.console import Code, InputError

if TYPE_CHECKING:
    from studies.campaign import Campaign
    from studies.scenario import Scenario


class _RunByDefault(TyperGroup):
    """``reentry campaign SCENARIO.yaml ...`` means ``reentry campaign run SCENARIO.yaml ...``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    name="campaign", cls=_RunByDefault, no_args_is_help=True,
    help="Very many dispersed flights, stored as they come and resumed after any interruption: [SCENARIO.yaml] --out STORE.",
)  # fmt: skip

_EXAMPLE = "campaign.design=sobol"

Place = Annotated[Path, typer.Argument(metavar="STORE", show_default=False, help="Folder that `reentry campaign --out` wrote.")]
Report = Annotated[
    Path | None,
    typer.Option("--report", metavar="DIR", show_default=False, help="Folder of the report; STORE-report unless given."),
]


@app.command()
def run(
    scenario: Annotated[Path | None, scenario_file("Scenario; with --resume it may be left out.")] = None,
    changes: Annotated[list[str] | None, scenario_changes(_EXAMPLE)] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="STORE", show_default=False, parser=folder_of, help="New or empty folder of the zarr store."),
    ] = None,
    cases: Annotated[
        int | None, typer.Option("--cases", min=1, max=10**8, show_default=False, help="Number of flights; campaign.cases unless given.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted campaign; nothing complete is computed again.")] = False,
    workers: Annotated[int, typer.Option("--workers", min=0, max=1024, help="Worker processes of this machine; 0: this process.")] = 0,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="ADDRESS", show_default=False, help="Running dask scheduler, tcp://host:8786.")
    ] = None,
    report: Report = None,
    as_json: AsJson = False,
    show_scenario: Annotated[bool, typer.Option("--print-scenario", help="Print the scenario with all its keys, and stop.")] = False,
) -> None:
    """Fly the campaign of a scenario into a store, and report its statistics."""
    chosen = _scenario(scenario, changes, cases, out if resume else None)
    if show_scenario:
        console.print_scenario(chosen, as_json=as_json)
        raise typer.Exit
    if out is None:
        raise InputError("--out: not given, expected the folder of the store, such as --out out/campaign")
    if workers and scheduler:
        raise InputError(f"--workers {workers} and --scheduler {scheduler}: give one of them")
    from studies import campaign

    with _bar() as progress:
        try:
            done = campaign.run(chosen, out, resume=resume, workers=workers, scheduler=scheduler, progress=progress)
        except KeyboardInterrupt:
            console.say(f"{out}: partial; the complete chunks stand, continue with --resume")
            raise
    for note in done.notes:
        console.say(f"note: {note}")
    _tell(done, report, as_json)
    if done.lost:
        console.say(f"reentry: the workers were lost: {done.lost}; {out} is partial, continue with --resume")
        raise typer.Exit(Code.CASES_FAILED)
    failed = int((~done.arrived).sum())
    if failed:
        for name, number, reason in done.first_failures(20):
            console.say(f"failed: case {number} of {name}: {reason}")
        console.say(f"reentry: {failed} case(s) failed; the results of the others stand")
        raise typer.Exit(Code.CASES_FAILED)


@app.command()
def show(place: Place, report: Report = None, as_json: AsJson = False) -> None:
    """Statistics and report of a store, also of a partial one."""
    from studies import campaign

    _tell(campaign.load(place), report, as_json)


@app.command()
def replay(
    place: Place,
    case: Annotated[int, typer.Argument(metavar="CASE", show_default=False, help="Number of the case, from 0.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", parser=folder_of, help="Folder of the figure.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """Fly one case again, compare it with the store, and draw its flight."""
    from studies import campaign
    from studies.campaign_report import replay_figure
    from studies.figures import to_png
    from studies.files import write_bytes

    with console.work():
        again = campaign.replay(place, case)
        path = None if again.trajectory is None else write_bytes(out / f"case_{case}.png", to_png(replay_figure(again)))
    flown = {name: value for name, value in again.flown.items() if value == value}  # a failed case has no miss
    stored = {name: value for name, value in again.stored.items() if value == value}
    if as_json:
        data = {"case": case, "drawn": dict(again.drawn), "flown": flown, "stored": stored, "same": again.same,
                "changed": list(again.changed), "figure": path and str(path)}  # fmt: skip
        console.print_text(console.to_json(data))
    else:
        rows: list[tuple[Any, ...]] = [(name, value, "") for name, value in again.drawn.items()]
        rows += [(name, str(value) if name == "status" else value, stored.get(name, "–")) for name, value in flown.items()]
        console.print_table(f"Case {case}", ("quantity", "now", "in the store"), [tuple(map(_digits, row)) for row in rows])
        console.print_text(f"figure: {path}" if path else "not flown: it starts outside the valid range of a variable")
    for difference in again.changed:
        console.say(f"note: {difference}")
    if not again.same:
        why = "the store has no result of this case" if not again.stored else "the numbers are not those of the store"
        console.say(f"reentry: case {case}: {why}")
        raise typer.Exit(Code.CASES_FAILED)


def _scenario(path: Path | None, changes: list[str] | None, cases: int | None, store: Path | None) -> Scenario:
    """The scenario asked for; of a store that is continued, if none is given."""
    from studies import campaign_store
    from studies.scenario import Scenario

    if path is not None:
        chosen = Scenario.load(path)
    elif store is not None and campaign_store.holds_anything(store):
        chosen = campaign_store.scenario_of(campaign_store.open_store(store))
    else:
        chosen = Scenario.default()
    chosen = chosen.edit(console.changes(changes, example=_EXAMPLE), origin="--set")
    if cases is not None:
        chosen = chosen.edit({"campaign.cases": cases}, origin="--cases")
    for remark in chosen.remarks():
        console.say(f"note: {remark}")
    return chosen


def _tell(done: Campaign, report: Path | None, as_json: bool) -> None:
    """Report, statistics on stdout."""
    from studies.campaign_report import rows, summary
    from studies.provenance import collect
    from studies.report import write_report

    c = done.scenario.campaign
    place = report or done.path.with_name(f"{done.path.absolute().name}-report")
    title = f"Dispersion campaign of {done.scenario.vehicle.name}"
    with console.work():
        page = write_report(
            [done.result()], place, scenario_yaml=done.scenario.to_yaml(), provenance=collect(done.scenario, c.seed), title=title
        )  # fmt: skip
    if as_json:
        console.print_text(console.to_json({"store": str(done.path), "report": str(page), "campaign": summary(done)}))
        return
    state = "" if done.complete else " (partial)"
    console.print_table(f"{title}, {c.schedule}{state}", ("quantity", "value", "low", "high", "unit"), rows(done))
    console.print_text(f"store: {done.path}\nreport: {page}")


def _digits(value: Any) -> Any:
    return repr(value) if isinstance(value, float) else value


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[int, int], None] | None]:
    """Progress with rate and remaining time on stderr, if that is a terminal."""
    if not sys.stderr.isatty():
        with console.work():
            yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn())
    with console.libraries_to_stderr(), Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bars:
        task = bars.add_task("", total=None, rate="")

        def report(done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)
            speed = bars.tasks[0].speed
            bars.update(task, rate="" if not speed else f"{speed:.0f} cases/s")

        yield report
