"""A user's own allocation problem from three CSV files; every complaint names file, row, column and value."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from allocation.core import Effectors
from allocation.demand_history import History
from models.checked import Array, ModelError

MAX_BYTES = 200_000_000
LIMIT_COLUMNS = ("effector", "lower", "upper", "rate", "flow")
STEADY = 1e-6  # relative spread of time steps that still counts as equal


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A CSV file: heading and rows of text, with the line of each row."""

    path: Path
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    def number(self, row: int, column: int, *, infinite: bool = False) -> float:
        """One cell as a number.

        Raises
        ------
        ModelError
            Text that is not a finite number (infinity only where it makes sense).
        """
        text = self.rows[row][column].strip()
        try:
            value = math.nan if "_" in text else float(text)  # 1_000 is a number to Python alone
        except ValueError:
            value = math.nan
        if not math.isfinite(value) and not (infinite and value == math.inf):
            raise self.error(row, column, "expected a finite number" + (" or inf" if infinite else ""))
        return value

    def error(self, row: int, column: int, expected: str) -> ModelError:
        """A complaint about one cell."""
        return ModelError(
            f"{self.path}: row {self.lines[row]}, column {self.heading[column]!r}: found {self.rows[row][column]!r}, {expected}"
        )


def read_grid(path: str | Path) -> Grid:
    """Heading and rows of a CSV file; empty lines and lines that begin with # are left out.

    Raises
    ------
    ModelError
        A missing file, a folder, text that is not UTF-8, no rows, a row of another length than the heading, a heading that stands twice.
    """
    place = Path(path)
    if not place.is_file():
        raise ModelError(f"{place}: {'is a folder' if place.is_dir() else 'no such file'}, expected a CSV file")
    if place.stat().st_size > MAX_BYTES:
        raise ModelError(f"{place}: has more than {MAX_BYTES // 1_000_000} MB; split the demand")
    try:
        text = place.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ModelError(f"{place}: is not UTF-8 text (byte {error.start}); save it as CSV in UTF-8") from None
    found, lines = [], []
    reader = csv.reader(io.StringIO(text))
    try:
        for row in reader:
            if row and any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#"):
                found.append(tuple(cell.strip() for cell in row))
                lines.append(reader.line_num)
    except csv.Error as error:
        raise ModelError(f"{place}: row {reader.line_num}: {error}; expected comma-separated values") from None
    if len(found) < 2:
        raise ModelError(f"{place}: has {len(found)} rows, expected a heading and at least one row of values")
    heading = found[0]
    twice = [name for name in heading if heading.count(name) > 1 or not name]
    if twice:
        raise ModelError(f"{place}: row {lines[0]}: the heading {twice[0]!r} is empty or stands twice; name every column once")
    for cells, line in zip(found[1:], lines[1:], strict=True):
        if len(cells) != len(heading):
            raise ModelError(f"{place}: row {line}: has {len(cells)} cells, the heading has {len(heading)}; give one cell for each column")
    return Grid(place, heading, tuple(found[1:]), tuple(lines[1:]))


def read_history(effectiveness: str | Path, limits: str | Path, demand: str | Path, *, dt: float | None = None) -> History:
    """The history of three files.

    Parameters
    ----------
    effectiveness : path
        Heading ``axis, <effector>, ...``; a row for each axis: its name and the wrench of each effector at a command of 1.
    limits : path
        Heading ``effector, lower, upper`` and, optionally, ``rate`` (1/s, inf: none) and ``flow`` (kg/s at a command of 1; 0: a surface).
    demand : path
        Heading ``t, <axis>, ...`` or ``<axis>, ...``; rows in the order of time.
    dt : float, optional
        Sample time, s, if the demand has no column t.

    Raises
    ------
    ModelError
        With file, row, column and value.
    """
    table = read_grid(effectiveness)
    if table.heading[0] != "axis" or len(table.heading) < 2:
        raise ModelError(f"{table.path}: row 1: found heading {table.heading[0]!r}, expected axis, followed by the names of the effectors")
    axes, names = tuple(row[0] for row in table.rows), table.heading[1:]
    for i, axis in enumerate(axes):
        if not axis or axes.index(axis) != i:
            raise table.error(i, 0, "expected the name of an axis, each once")
    B = np.array([[table.number(i, j + 1) for j in range(len(names))] for i in range(len(axes))])
    lower, upper, rate, flow = _limits(read_grid(limits), names, table.path)
    values, period = _demand(read_grid(demand), axes, table.path, dt)
    effectors = Effectors(names, B, lower, upper, rate=rate, axes=axes, flow=flow)
    return History(effectors=effectors, dt=period, demand=values, name=Path(demand).stem).weighted()


def _limits(grid: Grid, names: Sequence[str], effectiveness: Path) -> tuple[Array, Array, Array, Array]:
    unknown = [c for c in grid.heading if c not in LIMIT_COLUMNS]
    missing = [c for c in LIMIT_COLUMNS[:3] if c not in grid.heading]
    if unknown or missing:
        what = f"unknown column {unknown[0]!r}" if unknown else f"no column {missing[0]!r}"
        raise ModelError(f"{grid.path}: row 1: {what}; expected {', '.join(LIMIT_COLUMNS[:3])} and optionally rate and flow")
    at = {name: grid.heading.index(name) for name in grid.heading}
    order = {}
    for i, row in enumerate(grid.rows):
        name = row[at["effector"]]
        if name not in names:
            raise grid.error(i, at["effector"], f"which is no effector of {effectiveness}; it has {', '.join(names)}")
        if name in order:
            raise grid.error(i, at["effector"], "which stands twice; give each effector one row")
        order[name] = i
    for name in names:
        if name not in order:
            raise ModelError(f"{grid.path}: no row for the effector {name!r} of {effectiveness}; give each effector one row")
    columns = []
    for what, usual in (("lower", 0.0), ("upper", 0.0), ("rate", np.inf), ("flow", 0.0)):
        if what not in at:
            columns.append(np.full(len(names), usual))
            continue
        values = [grid.number(order[n], at[what], infinite=what == "rate") for n in names]
        if what in ("rate", "flow"):
            for name, value in zip(names, values, strict=True):
                if value < 0:
                    raise grid.error(order[name], at[what], "expected a number >= 0")
        columns.append(np.array(values))
    for name, low, high, flow in zip(names, columns[0], columns[1], columns[3], strict=True):
        if low > high:
            raise grid.error(order[name], at["lower"], f"above upper {high:g}; exchange or correct them")
        if flow > 0 and low < 0:
            raise grid.error(order[name], at["lower"], f"and a flow of {flow:g}: a jet pushes one way, expected >= 0")
    return columns[0], columns[1], columns[2], columns[3]


def _demand(grid: Grid, axes: Sequence[str], effectiveness: Path, dt: float | None) -> tuple[Array, float]:
    timed = "t" in grid.heading and "t" not in axes
    for name in grid.heading:
        if name not in axes and not (timed and name == "t"):
            raise ModelError(f"{grid.path}: row 1: unknown column {name!r}; expected t and the axes {', '.join(axes)} of {effectiveness}")
    for axis in axes:
        if axis not in grid.heading:
            raise ModelError(f"{grid.path}: row 1: no column {axis!r}; expected one for each axis of {effectiveness}")
    columns = [grid.heading.index(axis) for axis in axes]
    values = np.array([[grid.number(i, j) for j in columns] for i in range(len(grid.rows))])
    if not timed:
        if dt is None:
            raise ModelError(f"{grid.path}: has no column t; give the sample time with --dt, such as --dt 0.06")
        return values, dt
    if dt is not None:
        raise ModelError(f"{grid.path}: has a column t, and --dt {dt:g} is given as well; leave one out")
    at = grid.heading.index("t")
    times = np.array([grid.number(i, at) for i in range(len(grid.rows))])
    if len(times) < 2:
        raise ModelError(f"{grid.path}: one row has no time step; leave the column t out and give --dt")
    steps = np.diff(times)
    bad = np.flatnonzero((steps <= 0) | (np.abs(steps - steps[0]) > STEADY * np.abs(steps[0]) + 1e-9))
    if bad.size:
        row = int(bad[0]) + 1
        raise grid.error(row, at, f"{steps[row - 1]:g} s after the row before; expected equal steps of {steps[0]:g} s" if steps[0] > 0
                         else "expected increasing times")  # fmt: skip
    return values, float(f"{(times[-1] - times[0]) / (len(times) - 1):.12g}")  # the file says 0.1, not 0.09999999999999999
