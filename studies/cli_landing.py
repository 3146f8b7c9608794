"""Command ``reentry land``: fixed-point landing.  Only typer and the standard library are imported here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from studies import console
from studies.console import Code, InputError

if TYPE_CHECKING:
    from studies.landing_scenario import LandingScenario

LANDED = ("OK", "OUTSIDE_FOOTPRINT")  # states of a flight that came down to the stop altitude
_UNITS = {"_s": "s", "_m": "m", "_km": "km", "_g": "g0", "_deg": "deg", "_1km": "%", "_dbeta": "m", "_dtn": "m/s"}


def land(
    scenario: Annotated[
        Path | None,
        typer.Argument(metavar="SCENARIO.yaml", show_default=False, help="Landing scenario; keys left out keep those of reference N2."),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", show_default=False, help="Change one key, such as guidance.law=paper; repeatable."),
    ] = None,
    reference: Annotated[bool, typer.Option("--reference", help="Fly the reference open loop instead of under guidance.")] = False,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="With --reference: exact derivatives of the landing point at entry.")
    ] = False,
    cases: Annotated[
        int, typer.Option("--cases", min=0, max=1_000_000, help="Dispersed landings of dispersions.set; 0: one nominal flight.")
    ] = 0,
    seed: Annotated[int | None, typer.Option("--seed", min=0, show_default=False, help="Seed; dispersions.seed unless given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")] = False,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", show_default=False, help="Write land.json into this folder.")] = None,
    show: Annotated[bool, typer.Option("--print-scenario", help="Print the scenario with all its keys, ready to edit, and stop.")] = False,
) -> None:
    """Land at a fixed point by prediction and correction: one flight, or many dispersed ones."""
    chosen = _scenario(scenario, changes or [], seed)
    if show:
        console.print_text(console.to_json(chosen.to_dict()) if as_json else chosen.to_yaml().rstrip("\n"))
        raise typer.Exit
    if reference and cases:
        raise InputError(f"--cases {cases}: the reference is one flight; leave --cases or --reference out")
    if sensitivities and not reference:
        raise InputError("--sensitivities: belongs to the reference flight, expected --reference beside it")
    from studies import landing_answer
    from studies.files import check_folder, write_text

    if out is not None:
        check_folder(out)
    lost: list[tuple[int, str]] = []
    with console.work() as progress:
        if reference:
            data = landing_answer.reference(chosen, with_sensitivities=sensitivities)
        elif cases == 0:
            data = landing_answer.single(chosen)
            lost = [(0, f"{data['status']}: {data['meaning']}")] if data["status"] not in LANDED else []
        else:
            data, flown = landing_answer.dispersed(chosen, cases, progress=progress)
            lost = [(i, f"{status.name}: {status.value}") for i, status in enumerate(flown.status) if not status.ok]
    if out is not None:
        console.say(f"wrote {write_text(out / 'land.json', console.to_json(data))}")
    if as_json:
        console.print_text(console.to_json(data))
    else:
        console.print_table(f"Landing of {chosen.vehicle.name}, {data['law']}", ("quantity", "value", "unit"), _rows(data))
    if data.get("status") == "OUTSIDE_FOOTPRINT":
        nearest = data["footprint"]["nearest_m"]
        console.say(f"note: the target lies outside the footprint; the nearest reachable point is {nearest / 1e3:.1f} km from it")
    for number, reason in lost[:20]:
        console.say(f"failed: case {number}: {reason}")
    if lost:
        console.say(f"reentry: {len(lost)} case(s) did not land; the results of the others stand")
        raise typer.Exit(Code.CASES_FAILED)


def _scenario(path: Path | None, changes: list[str], seed: int | None) -> LandingScenario:
    from studies.landing_scenario import LandingScenario

    chosen = LandingScenario.load(path) if path is not None else LandingScenario()
    edits: dict[str, Any] = {}
    for text in changes:
        key, sign, value = text.partition("=")
        if not sign or not key.strip():
            raise InputError(f"--set: found {text!r}, expected key=value such as guidance.law=paper")
        edits[key.strip()] = value.strip()
    chosen = chosen.edit(edits, origin="--set")
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
