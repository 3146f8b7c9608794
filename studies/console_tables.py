"""Tables on a terminal: one that is too wide becomes several, each with the first column, so that no number is broken.

A number is broken only where the terminal has no room for it beside one character of the first column.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

LONG = 24  # a cell beyond it is text that may be wrapped between words; numbers and names are shorter
LONG_FIRST = 32  # the same for the first column, which names the row and stands in every part
_FRAME = 3  # of a column: two blanks and a line


@dataclass(frozen=True, slots=True)
class _Column:
    heading: str
    cells: tuple[str, ...]
    numeric: bool
    widest: int  # with the whole heading on one line
    least: int  # with nothing broken inside a word
    content: int  # the same without the heading
    stiff: bool  # no cell is broken at all


def tables(columns: Sequence[str], rows: Sequence[Sequence[str]], *, numeric: Sequence[bool], width: int) -> list[Table]:
    """Tables that together show all cells.

    Parameters
    ----------
    columns : sequence of str
        Headings.
    rows : sequence of sequences of str
        Cells, as long as `columns`.
    numeric : sequence of bool
        Columns that are set to the right.
    width : int
        Of the terminal, characters.

    Returns
    -------
    list of rich Table
        One if all columns have room side by side.  Otherwise headings and long texts are wrapped between words, and what still has
        no room goes into further tables, without the rows that are blank there.
    """
    made = [_column(name, [row[i] for row in rows], numeric[i], first=i == 0) for i, name in enumerate(columns)]
    whole = _total([column.widest for column in made]) <= width
    parts = [made] if whole else _parts(made, width)
    return [_table(part, width, every_row=part is parts[0]) for part in parts]


def _column(heading: str, cells: Sequence[str], numeric: bool, *, first: bool) -> _Column:
    longest = max((cell_len(line) for cell in cells for line in cell.splitlines()), default=0)
    stiff = longest <= (LONG_FIRST if first else LONG)
    content = longest if stiff else max((cell_len(word) for cell in cells for word in cell.split()), default=0)
    least = max([min(content, LONG_FIRST), *(cell_len(word) for word in heading.split())])
    return _Column(heading, tuple(cells), numeric, max(longest, cell_len(heading)), least, content, stiff)


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + _FRAME * len(widths) + 1


def _parts(columns: Sequence[_Column], width: int) -> list[list[_Column]]:
    """Columns in groups that have room side by side, the first one in all of them."""
    parts = [[columns[0]]]
    for column in columns[1:]:
        if len(parts[-1]) > 1 and _total([c.least for c in (*parts[-1], column)]) > width:
            parts.append([columns[0]])
        parts[-1].append(column)
    return parts


def _table(columns: Sequence[_Column], width: int, *, every_row: bool) -> Table:
    roomy = _total([c.widest for c in columns]) <= width
    narrow = _total([c.least for c in columns]) > width  # words must be broken: better so than cut off
    table = Table(title_justify="left")
    for column in columns:
        stiff = column.stiff and not roomy and not narrow
        fixed = _held(columns, width) if narrow and column is not columns[0] else None
        lines = textwrap.wrap(column.heading, column.least, break_long_words=False) if stiff else [column.heading]
        justify: Literal["left", "right"] = "right" if column.numeric else "left"
        table.add_column(Text("\n".join(lines)), justify=justify, overflow="fold", no_wrap=stiff, width=fixed)
    for cells in zip(*(c.cells for c in columns), strict=True):
        if every_row or any(cells[1:]):
            table.add_row(*map(Text, cells))
    return table


def _held(columns: Sequence[_Column], width: int) -> int | None:
    """Width of the second of two columns that have no room side by side: its numbers come first, then the names of the rows.

    None where its cells have no room even so, or are long text: all is folded then.
    """
    if len(columns) != 2 or not columns[1].stiff:
        return None
    first, second = columns
    room = width - _total([0, 0])
    return max(second.content, min(second.least, room - first.least)) if second.content < room else None
