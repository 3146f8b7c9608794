"""Command ``reentry land``: fixed-point landing.  Only typer and the standard library are imported here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from studies import console
from studies.cli_options import AnswerFolder, AsJson, ShowScenario, scenario_changes, scenario_file
from studies.console import Code, InputError

if TYPE_CHECKING:
    from studies.landing_scenario import LandingScenario

_EXAMPLE = "guidance.law=paper"
_UNITS = {"_s": "s", "_m": "m", "_km": "km", "_g": "g0", "_deg": "deg", "_1km": "%", "_dbeta": "m", "_dtn": "m/s"}


def land(
    scenario: Annotated[Path | None, scenario_file("Landing scenario; keys left out keep those of reference N2.")] = None,
    changes: Annotated[list[str] | None, scenario_changes(_EXAMPLE)] = None,
    reference: Annotated[bool, typer.Option("--reference", help="Fly the reference open loop instead of under guidance.")] = False,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="With --reference: exact derivatives of the landing point at entry.")
    ] = False,
    cases: Annotated[
        int, typer.Option("--cases", min=0, max=1_000_000, help="Dispersed landings of dispersions.set; 0: one nominal flight.")
    ] = 0,
    seed: Annotated[int | None, typer.Option("--seed", min=0, show_default=False, help="Seed; dispersions.seed unless given.")] = None,
    as_json: AsJson = False,
    out: AnswerFolder = None,
    show: ShowScenario = False,
) -> None:
    """Land at a fixed point by prediction and correction: one flight, or many dispersed ones."""
    chosen = _scenario(scenario, changes, seed)
    if show:
        console.print_scenario(chosen, as_json=as_json)
        raise typer.Exit
    if reference and cases:
        raise InputError(f"--cases {cases}: the reference is one flight; leave --cases or --reference out")
    if sensitivities and not reference:
        raise InputError("--sensitivities: belongs to the reference flight, expected --reference beside it")
    from studies import landing_answer

    console.check_out(out)
    with console.work() as progress:
        if reference:
            answer = landing_answer.reference(chosen, with_sensitivities=sensitivities)
        elif cases == 0:
            answer = landing_answer.single(chosen)
        else:
            answer = landing_answer.dispersed(chosen, cases, progress=progress)
    data = answer.data
    console.write_answer(out, "land", data, figures=answer.figures)
    if as_json:
        console.print_text(console.to_json(data))
    else:
        console.print_table(f"Landing of {chosen.vehicle.name}, {data['law']}", ("quantity", "value", "unit"), _rows(data))
    if data.get("status") == "OUTSIDE_FOOTPRINT":
        nearest = data["footprint"]["nearest_m"]
        console.say(f"note: the target lies outside the footprint; the nearest reachable point is {nearest / 1e3:.1f} km from it")
    lost = answer.lost
    for number, reason in lost[:20]:
        console.say(f"failed: case {number}: {reason}")
    if lost:
        console.say(f"reentry: {len(lost)} case(s) did not land; the results of the others stand")
        raise typer.Exit(Code.CASES_FAILED)


def _scenario(path: Path | None, changes: list[str] | None, seed: int | None) -> LandingScenario:
    from studies.landing_scenario import LandingScenario

    chosen = LandingScenario.load(path) if path is not None else LandingScenario()
    chosen = chosen.edit(console.changes(changes, example=_EXAMPLE), origin="--set")
    return chosen if seed is None else chosen.edit({"dispersions.seed": seed}, origin="--seed")


def _rows(data: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any, str]]:
    rows: list[tuple[str, Any, str]] = []
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            rows += _rows(value, f"{name}.")
        elif not isinstance(value, list):
            unit = next((u for part in reversed(name.split(".")) for end, u in _UNITS.items() if part.endswith(end)), "")
            rows.append((name, value, unit))
    return rows
