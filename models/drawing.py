"""What shows itself in a notebook: tables, and figures; matplotlib is loaded when the first figure is drawn, never for a computation."""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def html_table(head: Sequence[str], rows: Sequence[Sequence[str | float]]) -> str:
    """An HTML table: text escaped and to the left, numbers with five digits and to the right, as is the head of their column."""
    numeric = [any(not isinstance(row[i], str) for row in rows) for i in range(len(head))]

    def cell(tag: str, value: str | float, right: bool) -> str:
        text = html.escape(value) if isinstance(value, str) else f"{value:.5g}"
        # in the element itself: a notebook's own style sheet would win over one of ours
        return f'<{tag} style="padding:2px 10px;text-align:{"right" if right else "left"}">{text}</{tag}>'

    top = "".join(cell("th", name, right) for name, right in zip(head, numeric, strict=True))
    body = "".join("<tr>" + "".join(cell("td", value, not isinstance(value, str)) for value in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches, outside pyplot's global state; Jupyter shows it without any magic command."""
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        def _repr_png_(self) -> bytes:
            buffer = io.BytesIO()
            self.savefig(buffer, format="png", dpi=110)
            return buffer.getvalue()

    return ShownFigure(figsize=(width, height), layout="constrained")
