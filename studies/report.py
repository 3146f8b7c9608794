"""The report: one self-contained HTML page with its figures and data beside it, written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from models.checked import ModelError
from studies import figures
from studies.files import replace_folder, write_bytes, write_text
from studies.result import Cell, Comparison, FigureItem, StudyResult, Table, as_plain, number

TITLE = "Atmospheric entry and jet control: study report"
HALF_WIDTH_MM = 110.0  # figures up to this width stand two in a row
SHOWN_FAILURES = 20  # more are counted, and listed in the data file

_GENERATOR = "reentry-report"
_ENTRIES = frozenset({"index.html", "scenario.yaml", "provenance.json", "figures", "data"})
_LABELS = {
    "package": "This package",
    "commit": "Commit",
    "date_utc": "Date (UTC)",
    "python": "Python",
    "casadi": "CasADi",
    "numpy": "NumPy",
    "scipy": "SciPy",
    "osqp": "OSQP",
    "matplotlib": "Matplotlib",
    "platform": "Platform",
    "cpu_count": "Processors",
    "seed": "Seed of the dispersions",
    "scenario_sha256": "Scenario (SHA-256)",
}


@dataclass(frozen=True, slots=True)
class _Text:
    """A table cell ready to be set: its text, and whether it is a number."""

    text: str
    numeric: bool


@dataclass(frozen=True, slots=True)
class _Drawing:
    number: int
    item: FigureItem
    file: str
    svg: Markup
    half: bool
    max_width_mm: int


@dataclass(frozen=True, slots=True)
class _Grid:
    number: int
    table: Table
    rows: list[list[_Text]]


@dataclass(frozen=True, slots=True)
class _Row:
    comparison: Comparison
    paper: _Text
    computed: str
    difference: str
    tolerance: str


@dataclass(frozen=True, slots=True)
class _Section:
    number: int
    study: StudyResult
    drawings: list[_Drawing]
    grids: list[_Grid]
    rows: list[_Row]
    rows_number: int
    shown_failures: Sequence[tuple[str, int, str]]


def write_report(
    studies: Sequence[StudyResult], out: Path, *, scenario_yaml: str, provenance: Mapping[str, Any], title: str = TITLE
) -> Path:
    """Write ``index.html``, ``figures/*.svg|png``, ``data/<study>.json``, ``scenario.yaml`` and ``provenance.json`` into the folder `out`.

    The page needs no network and no other file. The folder is built beside `out` and swapped in at the end: after any failure an
    older report is as it was.

    Parameters
    ----------
    studies : sequence of StudyResult
        At least one; names unique.
    out : Path
        New or empty folder, or an older report, which is replaced.
    scenario_yaml : str
        The scenario as text; running it again gives the same report.
    provenance : mapping
        From :func:`studies.provenance.collect`; shown in its order.
    title : str
        Heading of the page.

    Returns
    -------
    Path
        ``out/index.html``.

    Raises
    ------
    ModelError
        No study, two studies of one name, a value that is not finite, or a folder that holds other files (they would be lost).
    OSError
        The machine refuses to write.
    """
    if not studies:
        raise ModelError("write_report: no study given; give at least one StudyResult")
    names = [study.name for study in studies]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ModelError(f"write_report: two studies are named {twice!r}; give each its own name")
    facts = as_plain(provenance, "provenance")
    target = Path(out)
    _refuse_foreign(target)
    with replace_folder(target) as folder:
        sections = _sections(studies, folder)
        write_text(folder / "scenario.yaml", scenario_yaml)
        write_text(folder / "provenance.json", _json(facts))
        for study in studies:
            write_text(folder / "data" / f"{study.name}.json", _json(_study_data(study)))
        write_text(folder / "index.html", _page(sections, title=title, scenario_yaml=scenario_yaml, facts=facts))
    return target / "index.html"


def _refuse_foreign(target: Path) -> None:
    """A folder is replaced only if all that it holds was written by an earlier report."""
    if not target.is_dir():
        return
    entries = {entry.name for entry in target.iterdir()}
    if not entries:
        return
    page = target / "index.html"
    own = page.is_file() and f'content="{_GENERATOR}"' in page.read_text(encoding="utf-8", errors="replace")[:1000]
    foreign = sorted(entries - _ENTRIES) or ([] if own else sorted(entries))
    if foreign:
        raise ModelError(
            f"{target}: the folder holds {foreign[0]!r}, which is not part of a report and would be lost; choose a new or empty folder"
        )


def _sections(studies: Sequence[StudyResult], folder: Path) -> list[_Section]:
    """Numbered figures and tables of all studies; figures are drawn once and written as they are drawn."""
    sections = []
    figure_count = table_count = 0
    for i, study in enumerate(studies, start=1):
        drawings = []
        for item in study.figures:
            figure_count += 1
            drawings.append(_draw(item, number=figure_count, file=f"{study.name}-{item.name}", folder=folder / "figures"))
        grids = []
        for table in study.tables:
            table_count += 1
            grids.append(_Grid(number=table_count, table=table, rows=[[_cell(cell) for cell in row] for row in table.rows]))
        table_count += bool(study.comparisons)
        sections.append(
            _Section(
                number=i,
                study=study,
                drawings=drawings,
                grids=grids,
                rows=[_row(comparison) for comparison in study.comparisons],
                rows_number=table_count,
                shown_failures=study.failed[:SHOWN_FAILURES],
            )
        )
    return sections


def _draw(item: FigureItem, *, number: int, file: str, folder: Path) -> _Drawing:
    svg = figures.to_svg(item.figure, prefix=f"f{number}-")
    write_text(folder / f"{file}.svg", svg)
    write_bytes(folder / f"{file}.png", figures.to_png(item.figure))
    width = figures.width_mm(item.figure)
    # On a screen a figure may grow by a third over its size on paper: its 8-point letters then match the text around it.
    return _Drawing(number=number, item=item, file=file, svg=Markup(svg), half=width <= HALF_WIDTH_MM, max_width_mm=round(1.35 * width))


def _cell(cell: Cell) -> _Text:
    if cell is None:
        return _Text("–", False)
    if isinstance(cell, bool):
        return _Text("yes" if cell else "no", False)
    if isinstance(cell, str):
        return _Text(cell, False)
    return _Text(number(cell), True)


def _row(comparison: Comparison) -> _Row:
    paper = comparison.paper
    digits = 4
    if paper is None or isinstance(paper, str):
        printed = _Text(paper or "not printed", False)
    else:
        # The paper's digits as printed, and one more in the computed value, so that the difference can be seen.
        own = _significant(paper)
        printed = _Text(number(paper, digits=own), True)
        digits = min(max(4, own + 1), 12)
    difference = comparison.difference
    tolerance = "" if comparison.tolerance is None else f"±{_percent(comparison.tolerance)}"
    if comparison.tolerance is not None and paper == 0:
        tolerance = f"±{number(comparison.tolerance, digits=2)}"
    return _Row(
        comparison=comparison,
        paper=printed,
        computed=number(comparison.computed, digits=digits),
        difference="–" if difference is None else _signed_percent(difference),
        tolerance=tolerance,
    )


def _signed_percent(fraction: float) -> str:
    if abs(fraction) < 1e-5:
        return "0" if fraction == 0 else "<\u202f0.001\u202f%"
    return ("+" if fraction > 0 else "") + _percent(fraction)


def _percent(fraction: float) -> str:
    return number(100.0 * fraction, digits=2) + "\u202f%"


def _significant(value: float) -> int:
    """Significant digits of the shortest decimal that is this number."""
    mantissa = repr(float(value)).lower().partition("e")[0].lstrip("-").removesuffix(".0")
    return max(1, min(len(mantissa.replace(".", "").lstrip("0")), 15))


def _study_data(study: StudyResult) -> dict[str, Any]:
    return {
        "study": study.name,
        "title": study.title,
        "headlines": [{"label": h.label, "value": h.value, "unit": h.unit, "note": h.note} for h in study.headlines],
        "comparisons": [
            {
                "quantity": c.quantity,
                "paper": c.paper,
                "computed": float(c.computed),
                "unit": c.unit,
                "why": c.why,
                "tolerance": c.tolerance,
                "met": c.met,
            }
            for c in study.comparisons
        ],
        "tables": [{"title": t.title, "columns": t.columns, "rows": t.rows, "caption": t.caption} for t in study.tables],
        "failed": [{"set": group, "case": case, "reason": reason} for group, case, reason in study.failed],
        "data": study.data,
    }


def _json(value: object) -> str:
    return json.dumps(as_plain(value, "report"), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _cards(sections: Sequence[_Section]) -> list[dict[str, str]]:
    """Headline numbers of all studies, then what was met and what failed."""
    cards = [
        {"label": h.label, "value": number(h.value, digits=h.digits), "unit": "" if h.unit == "1" else h.unit, "note": h.note, "kind": ""}
        for section in sections
        for h in section.study.headlines
    ]
    judged = [c.met for section in sections for c in section.study.comparisons if c.met is not None]
    if judged:
        met = sum(judged)
        note = "all within their tolerance" if met == len(judged) else f"{len(judged) - met} outside the tolerance: see the reasons"
        kind = "good" if met == len(judged) else "bad"
        cards.append({"label": "Printed values met", "value": f"{met} of {len(judged)}", "unit": "", "note": note, "kind": kind})
    failed = sum(len(section.study.failed) for section in sections)
    note = "every case gave a result" if failed == 0 else "listed with their reasons"
    cards.append({"label": "Failed cases", "value": number(failed), "unit": "", "note": note, "kind": "bad" if failed else "good"})
    return cards


def _facts(values: Mapping[str, Any], above: str = "") -> list[tuple[str, str]]:
    """Provenance as rows; nested mappings are flattened."""
    rows = []
    for key, value in values.items():
        label = above + _LABELS.get(key, key.replace("_", " "))
        if isinstance(value, dict):
            rows += _facts(value, label + ": ")
        else:
            rows.append((label, ", ".join(str(item) for item in value) if isinstance(value, list) else str(value)))
    return rows


def _page(sections: Sequence[_Section], *, title: str, scenario_yaml: str, facts: Mapping[str, Any]) -> str:
    def source(name: str) -> str:
        return resources.files("studies").joinpath("templates", name).read_text(encoding="utf-8")

    environment = Environment(
        loader=FunctionLoader(source), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html").render(
        generator=_GENERATOR,
        title=title,
        date=facts.get("date_utc"),
        package=facts.get("package"),
        cards=_cards(sections),
        sections=sections,
        facts=_facts(facts),
        scenario_yaml=scenario_yaml,
    )
