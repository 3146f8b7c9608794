"""What the benchmarks share: timing, the machine, options, tables."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import casadi
import numpy
import scipy
from rich.console import Console
from rich.table import Table


def options(text: str | None) -> argparse.ArgumentParser:
    """Parser with the options of every benchmark."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("--quick", action="store_true", help="few settings, no repetition: for a look or a test, not for figures")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output and nothing else")
    return parser


def run(
    text: str | None, measure: Callable[..., dict[str, Any]], show: Callable[[dict[str, Any]], None], *,
    figure: Callable[[dict[str, Any], Path], None] | None = None,
) -> None:  # fmt: skip
    """Command line of a benchmark: ``measure(quick=...)``, and then its tables or JSON; with `figure` the option ``--figure FILE``."""
    parser = options(text)
    if figure is not None:
        parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw the figure into FILE (.png, .svg, .pdf)")
    chosen = parser.parse_args()
    drawn = figure is not None and chosen.figure is not None
    if drawn and chosen.quick:
        parser.error("--figure: a quick run measures too little to draw; leave --quick out")
    result = measure(quick=chosen.quick)
    if figure is not None and drawn:
        figure(result, chosen.figure)
    if chosen.json:
        write_json(result)
    else:
        show(result)


def best(call: Callable[[], Any], *, repeat: int = 20, budget: float = 2.0) -> float:
    """Least time of up to `repeat` calls, s, spending about `budget` s (at least one call)."""
    least, started = float("inf"), time.perf_counter()
    for _ in range(repeat):
        begin = time.perf_counter()
        call()
        end = time.perf_counter()
        least = min(least, end - begin)
        if end - started > budget:
            break
    return least


def machine() -> dict[str, Any]:
    """Class of machine and the versions that matter."""
    return {
        "processors": os.cpu_count(), "machine": platform.machine(), "python": platform.python_version(),
        "casadi": casadi.__version__, "numpy": numpy.__version__, "scipy": scipy.__version__,
    }  # fmt: skip


def announce(text: str) -> None:
    """What is going on, on standard error."""
    print(text, file=sys.stderr, flush=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, note: str = "") -> None:
    """Print a table; the first two columns are text, the others numbers."""
    drawn = Table(title=title, caption=note or None, title_justify="left", caption_justify="left")
    for i, column in enumerate(columns):
        drawn.add_column(column, justify="left" if i < 2 else "right")
    for row in rows:
        drawn.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 140).print(drawn)


def write_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, allow_nan=False))


def milliseconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.3g} ms"
