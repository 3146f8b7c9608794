"""The (k, delta) map of steady outputs under sliders, for Jupyter or any other interactive matplotlib window."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from models.census_map import CensusMap, census_map
from models.checked import ModelError
from models.modulators import DiscretePWPF
from studies import figures as fig
from studies.modulators import K_MAX, PAPER
from studies.modulators_figures import KINDS, draw_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.widgets import Slider

# name, label, lowest, highest
SLIDERS = (("h", "h / u_on", 0.0, 1.0), ("Ts", "Ts [s]", 0.03, 0.6), ("r", "demand r", 0.0, 1.0))


def map_explorer(figure: Figure, *, modulator: DiscretePWPF = PAPER, points: int = 60) -> dict[str, Slider]:
    """Draw the map in a figure, with sliders for hysteresis, sample time and demand; every move computes the census anew.

    Parameters
    ----------
    figure : matplotlib Figure
        Empty; of ``pyplot.figure()`` for a window or a notebook with an interactive backend.
    modulator : DiscretePWPF
        Where the sliders begin, and the parameters that they leave alone.
    points : int
        Points on each axis of the map, 2 to 400.

    Returns
    -------
    dict of str to matplotlib Slider
        ``"h"`` (in units of u_on), ``"Ts"`` and ``"r"``; keep it, or the sliders stop.

    Raises
    ------
    ModelError
        A number of points out of range.
    """
    if not isinstance(points, int) or isinstance(points, bool) or not 2 <= points <= 400:
        raise ModelError(f"map_explorer: points = {points!r}; expected an integer from 2 to 400")
    from matplotlib.patches import Patch
    from matplotlib.widgets import Slider

    figure.set_layout_engine("none")
    axis = figure.add_axes((0.11, 0.34, 0.52, 0.6))
    handles = [Patch(facecolor=colour, edgecolor=fig.MUTED, label=text) for text, colour in KINDS]
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.645, 0.94), fontsize=7)
    start = {"h": modulator.h / modulator.u_on, "Ts": modulator.Ts, "r": 0.0}
    sliders = {}
    for i, (name, label, low, high) in enumerate(SLIDERS):
        place = figure.add_axes((0.2, 0.18 - 0.06 * i, 0.45, 0.04))
        sliders[name] = Slider(place, label, low, high, valinit=start[name])

    def redraw(_: float = 0.0) -> None:
        chosen = replace(modulator, h=sliders["h"].val * modulator.u_on, Ts=sliders["Ts"].val)
        found = explored(chosen, r=sliders["r"].val, points=points)
        axis.clear()
        draw_map(axis, found)
        axis.set(xlim=(0, K_MAX), ylim=(0, found.delta[-1]), ylabel="offset delta [1]")
        axis.set_title(f"proven quiet: {100 * found.quiet.mean():.1f} % of the map", fontsize=8)
        figure.canvas.draw_idle()

    for slider in sliders.values():
        slider.on_changed(redraw)
    redraw()
    return sliders


def explored(modulator: DiscretePWPF, *, r: float, points: int) -> CensusMap:
    """The map over 0 <= k <= 6 and 0 <= delta <= u_on/km."""
    return census_map(modulator, np.linspace(0.0, K_MAX, points), np.linspace(0.0, modulator.u_on / modulator.km, points), r=r)
