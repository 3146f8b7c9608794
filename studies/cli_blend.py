"""Command ``reentry blend``: the STS-1 case of RCS/elevon blending.  Only typer and the standard library are imported here."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from studies import console
from studies.cli_options import AnswerFolder, AsJson
from studies.console import Code, InputError

if TYPE_CHECKING:
    from studies.blend import BlendStudy
    from studies.result import Table

_LARGEST_STRESS_DEG = 20.0  # more takes the angle of attack out of the aerodynamic tables

Method = Annotated[str, typer.Option("--method", metavar="NAME", help="Allocation: paper, literal (equation 20 as printed), qp, or pinv.")]
Jets = Annotated[int, typer.Option("--jets", help="Aft pitch jets in each direction: 2, 4 or 6.")]
Stress = Annotated[
    float, typer.Option("--stress", metavar="DEG", help="Amplitude of the command added in the blending window, at most 20 deg.")
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", show_default=False,
        help="Change the flown vehicle or its start, SI and rad, such as Cm_factor=1.2, cg_aft=0.05, wind_factor=1.5, h=74000; repeatable.",
    ),
]  # fmt: skip
Low = Annotated[float, typer.Option("--q1", metavar="PA", help="Dynamic pressure at which the elevon begins to take part.")]
High = Annotated[float, typer.Option("--q2", metavar="PA", help="Dynamic pressure at which the elevon has its full authority.")]
Singles = Annotated[bool, typer.Option("--singles", help="Also fly the stress cases and the single dispersions.")]
Cases = Annotated[int, typer.Option("--dispersions", min=0, max=100_000, help="Random dispersed flights, in compiled code.")]
Compare = Annotated[bool, typer.Option("--compare", help="Fly the random dispersions under paper, qp, pinv and --method, and compare.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Of the random dispersions.")]


def blend(
    method: Method = "paper",
    jets: Jets = 6,
    stress: Stress = 0.0,
    changes: Changes = None,
    q1: Low = 1000.0,
    q2: High = 2500.0,
    singles: Singles = False,
    dispersions: Cases = 0,
    compare: Compare = False,
    seed: Seed = 2012,
    as_json: AsJson = False,
    out: AnswerFolder = None,
) -> None:
    """Fly the orbiter through the hand-over from reaction jets to the elevon (STS-1 case of paper 000)."""
    given = console.numbers("--set", changes, expected="name=number such as Cm_factor=1.2")
    if stress:
        if not abs(stress) <= _LARGEST_STRESS_DEG:
            raise InputError(f"--stress: found {stress:g} deg, expected an amplitude from -20 to 20 deg, such as 2")
        if "stress" in given:
            raise InputError("--stress and --set stress=... name the same amplitude; give one of them")
        given["stress"] = math.radians(stress)
    if compare and dispersions < 2:
        raise InputError(f"--compare: needs --dispersions of at least 2, found {dispersions}")
    console.check_out(out)
    with console.work():
        from allocation.blending import Handover
        from studies import blend as study_of

        settings: dict[str, Any] = {
            "jets": jets, "changes": given, "cases": dispersions, "seed": seed, "handover": Handover(q1=q1, q2=q2),
        }  # fmt: skip
        study = study_of.run(method=method, singles=singles, **settings)
        data = study.to_dict()
        methods = None
        if compare:
            from studies.blend_methods import of_studies

            names = dict.fromkeys(("paper", "qp", "pinv", method))
            methods = of_studies({name: study if name == method else study_of.run(method=name, **settings) for name in names})
            data["methods"] = methods.to_dict()
    console.write_answer(out, "blend", data, figures=study.figures)
    for remark in (*study.remarks, *([methods.remark] if methods is not None and methods.remark else [])):
        console.say(f"note: {remark}")
    if as_json:
        console.print_text(console.to_json(data))
    else:
        _print(study)
        if methods is not None:
            for table in methods.tables():
                _print_table(table)
    for number in study.failed[:20]:
        console.say(f"failed: case {number} of the dispersions: a number was not finite")
    if study.failed:
        raise typer.Exit(Code.CASES_FAILED)


def _print(study: BlendStudy) -> None:
    from studies.blend_tables import ensemble_table, singles_table

    console.print_table(
        f"Blending, method {study.method}, {study.jets} + {study.jets} jets", ("quantity", "value", "unit"), study.summary()
    )
    if study.singles:
        _print_table(singles_table(study))
    statistics = ensemble_table(study)
    if statistics is not None:
        _print_table(statistics)


def _print_table(table: Table) -> None:
    console.print_table(table.title, table.columns, table.rows)
