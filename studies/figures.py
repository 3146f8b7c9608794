"""One style for all figures, and figures without global state: made, drawn and written without pyplot."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, TypeVar

import matplotlib.style
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from models.checked import ModelError
from studies.result import FigureItem

Study = TypeVar("Study")
Maker = tuple[str, str, str, Callable[[Study], Any]]  # name, title, caption, function that draws the figure of a study

# Okabe and Ito, "Color Universal Design", 2008: distinct for the common kinds of colour blindness.
# Yellow is left out: a thin yellow line cannot be seen on white paper.
COLORS = MappingProxyType(
    {
        "blue": "#0072B2",
        "vermillion": "#D55E00",
        "green": "#009E73",
        "purple": "#CC79A7",
        "orange": "#E69F00",
        "sky": "#56B4E9",
        "black": "#000000",
    }
)
INK, MUTED, GRID = "#22272e", "#5c6570", "#e2e6ea"
_MM_PER_INCH = 25.4

_STYLE: dict[str, Any] = {
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.05,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "savefig.bbox": None,
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans"],  # ships with matplotlib: the same letters on every machine
    "mathtext.fontset": "dejavusans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "figure.titlesize": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.02,
    "axes.ymargin": 0.06,
    "axes.prop_cycle": cycler(color=list(COLORS.values())),
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-3, 5),
    "axes.formatter.useoffset": False,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 3.5,
    "lines.solid_capstyle": "round",
    "patch.linewidth": 0.6,
    "hatch.linewidth": 0.6,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "legend.borderaxespad": 0.4,
    "image.cmap": "cividis",
    "svg.fonttype": "path",  # letters as outlines: no font of the reader's machine is needed
    "svg.hashsalt": "reentry",  # otherwise the ids of a drawing change from run to run
}


@contextmanager
def style() -> Iterator[None]:
    """Publication style for everything that is made or drawn inside; the user's own matplotlib settings come back after."""
    with matplotlib.style.context(_STYLE, after_reset=True):
        yield


def new_figure(
    rows: int = 1, cols: int = 1, *, width_mm: float = 170.0, height_mm: float | None = None, sharex: bool = False, sharey: bool = False
) -> tuple[Figure, Any]:
    """Figure and its axes in the publication style, without pyplot.

    Parameters
    ----------
    rows, cols : int
    width_mm, height_mm : float
        Size on paper; 170 mm fills an A4 column, 84 mm half of it (two such figures share a row of the report).
        Height: 58 mm a row unless given.
    sharex, sharey : bool
        Panels of a column share their x axis, panels of a row their y axis.

    Returns
    -------
    figure : matplotlib Figure
    axes : ndarray of Axes, shape (rows, cols)
        Always two-dimensional.
    """
    height = 58.0 * rows + 6.0 if height_mm is None else height_mm
    if rows < 1 or cols < 1 or not (0 < width_mm < 2000 and 0 < height < 2000):
        raise ModelError(f"new_figure: expected rows, cols >= 1 and a size in mm, got {rows} x {cols}, {width_mm} mm x {height} mm")
    with style():
        figure = Figure(figsize=(width_mm / _MM_PER_INCH, height / _MM_PER_INCH), layout="constrained")
        axes = figure.subplots(rows, cols, squeeze=False, sharex="col" if sharex else False, sharey="row" if sharey else False)
    return figure, axes


def small_multiples(
    titles: Sequence[str],
    *,
    cols: int = 2,
    width_mm: float = 170.0,
    panel_height_mm: float = 48.0,
    sharex: bool = False,
    sharey: bool = False,
) -> tuple[Figure, list[Axes]]:
    """One lettered panel for each title, filled row by row; places that are left over stay blank.

    Returns
    -------
    figure : matplotlib Figure
    panels : list of Axes, one for each title
    """
    if not titles or cols < 1:
        raise ModelError(f"small_multiples: expected at least one title and one column, got {len(titles)} titles, cols = {cols}")
    count = min(cols, len(titles))
    rows = -(-len(titles) // count)
    figure, axes = new_figure(rows, count, width_mm=width_mm, height_mm=panel_height_mm * rows + 4.0, sharex=sharex, sharey=sharey)
    panels = list(axes.ravel())
    for spare in panels[len(titles) :]:
        spare.set_visible(False)
        above = axes[-2, panels.index(spare) % count] if rows > 1 else None
        if above is not None:  # with a shared axis only the lowest row is labelled, and here it is blank
            above.tick_params(axis="x", labelbottom=True)
    panels = panels[: len(titles)]
    for i, (panel, title) in enumerate(zip(panels, titles, strict=True)):
        panel_label(panel, _letters(i), title=title)
    return figure, panels


def panel_label(ax: Axes, label: str, *, title: str | None = None) -> None:
    """Put a bold letter before the (left) title of a panel; `title` replaces the title that is there."""
    if not (label.isascii() and label.isalnum()):
        raise ModelError(f"panel_label: expected letters or digits such as 'a', got {label!r}")
    text = ax.get_title(loc="left") if title is None else title
    with style():
        ax.set_title(rf"$\mathbf{{{label}}}$" + (f"   {text}" if text else ""), loc="left")


def _letters(index: int) -> str:
    alphabet = "abcdefghijklmnopqrstuvwxyz"
    return alphabet[index] if index < 26 else alphabet[index // 26 - 1] + alphabet[index % 26]


def to_svg(figure: Figure, *, prefix: str | None = None) -> str:
    """SVG text that can stand alone as a file or inside an HTML page beside others.

    Letters are outlines, nothing refers to another file, and the same drawing gives the same bytes.

    Parameters
    ----------
    figure : matplotlib Figure
    prefix : str, optional
        Put before every id, so that several drawings in one page do not mix their parts; unless given, a digest of the drawing.

    Raises
    ------
    ModelError
        A prefix that cannot start an id.
    """
    if prefix is not None and not re.fullmatch(r"[A-Za-z][\w-]*", prefix, flags=re.ASCII):
        raise ModelError(f"to_svg: prefix {prefix!r} must start with a letter and hold letters, digits, '-' and '_' only")
    buffer = io.StringIO()
    with style():
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    text = buffer.getvalue()
    text = re.sub(r"<!--.*?-->\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    # A style sheet inside a drawing would apply to the whole page; as attributes of the root it reaches this drawing only.
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>\s*", "", text, count=1, flags=re.DOTALL)
    text = text.replace("<svg ", '<svg stroke-linejoin="round" stroke-linecap="butt" ', 1)
    if prefix is None:
        prefix = "s" + hashlib.sha256(text.encode()).hexdigest()[:10] + "-"
    return re.sub(r'(\sid="|href="#|url\(#)', lambda found: found.group(1) + prefix, text)


def to_png(figure: Figure, *, dpi: float = 200.0) -> bytes:
    """PNG bytes at `dpi` dots per inch, without date or program name."""
    if not 10 <= dpi <= 1200:
        raise ModelError(f"to_png: dpi must lie in 10 to 1200, got {dpi}")
    buffer = io.BytesIO()
    with style():
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def items(makers: Iterable[Maker[Study]], study: Study) -> list[FigureItem]:
    """Draw the figures of a study in the publication style.

    Parameters
    ----------
    makers : iterable of (name, title, caption, function)
        The function takes the study and returns a matplotlib Figure.
    study
        Handed to each function.
    """
    drawn = []
    for name, title, caption, make in makers:
        with style():
            drawn.append(FigureItem(name, title, caption, make(study)))
    return drawn


def width_mm(figure: Figure) -> float:
    """Width of a figure on paper, mm."""
    return float(np.asarray(figure.get_size_inches())[0]) * _MM_PER_INCH
