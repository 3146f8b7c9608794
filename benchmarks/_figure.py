"""The scaling of the compiled loop with threads and lanes, drawn.

Run: python -m benchmarks.entry --json > entry.json; python -m benchmarks._figure entry.json scaling.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from models.drawing import new_figure


def scaling(result: dict[str, Any], path: Path) -> None:
    """Draw rate against lanes, a line for each number of threads, from the key ``scaling`` of the entry benchmark's result.

    Raises
    ------
    ValueError
        A result without scaling, such as that of a quick run.
    """
    rows = result["scaling"]
    if not rows:
        raise ValueError("the result has no scaling (a quick run measures none); run the benchmark without --quick")
    figure = new_figure(6.4, 4.0)
    axes = figure.subplots()
    lanes = sorted({row["lanes"] for row in rows})
    rates = {(row["lanes"], row["threads"]): row["rate"] for row in rows}
    one = rates.get((lanes[0], 1))
    counts = sorted({row["threads"] for row in rows})
    for threads, marker in zip(counts, "os^Dv*", strict=False):
        found = [(at, rates[at, threads]) for at in lanes if (at, threads) in rates]
        label = f"{threads} thread{'s' if threads > 1 else ''}"
        axes.plot([at for at, _ in found], [rate / 1e3 for _, rate in found], marker=marker, label=label)
        for at, rate in found:
            text = f"{rate / 1e3:.3g}" if one is None else f"{rate / 1e3:.3g} ({rate / one:.1f}x)"
            above = threads == counts[-1]
            axes.annotate(
                text, (at, rate / 1e3), textcoords="offset points", xytext=(0, 8 if above else -15), ha="right" if above else "left",
                fontsize="small",
            )  # fmt: skip
    if one is not None:
        axes.plot(lanes, [one / 1e3 * at / lanes[0] for at in lanes], ":", color="gray", label="1 thread, rate in proportion to lanes")
    axes.set_xscale("log", base=2)
    axes.set_yscale("log", base=2)
    axes.set_xticks(lanes, [str(at) for at in lanes])
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.margins(x=0.15, y=0.15)
    axes.set_xlabel("cases in a vector (lanes)")
    axes.set_ylabel("thousand entries a second")
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("result", type=Path, help="JSON of python -m benchmarks.entry --json")
    parser.add_argument("figure", type=Path, help="file to write (.png, .svg, .pdf)")
    options = parser.parse_args()
    scaling(json.loads(options.result.read_text(encoding="utf-8")), options.figure)
