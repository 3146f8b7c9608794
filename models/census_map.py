"""Which steady outputs exist where: the census over a grid of (k, delta), and the borders of one cycle by repeated division."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.census import rows_of
from models.census_native import words_of
from models.census_pieces import DECIDED, Words, smallest_rotation
from models.checked import Array, ModelError, as_finite, as_scalar, frozen
from models.drawing import new_figure
from models.modulators import DiscretePWPF

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Bools = NDArray[np.bool_]
_PARTS = 64  # of an interval in one round of a search
_LEGEND = 9  # kinds of output that get a colour of their own


@dataclass(frozen=True, slots=True, eq=False)
class CensusMap:
    """Steady outputs over a grid of the feedback gain and the offset of the dead zone.

    Attributes
    ----------
    modulator : DiscretePWPF
        The other parameters.
    r : float
        Constant demand.
    k, delta : ndarray, shape (K,), (D,)
    words : tuple of words
        All that exist somewhere, sorted by period, then by word.
    exists : ndarray of bool, shape (W, K, D)
        Where each of them exists.
    decided : ndarray of bool, shape (K, D)
        Where it is proven that there are no others.
    """

    modulator: DiscretePWPF
    r: float
    k: Array
    delta: Array
    words: tuple[tuple[int, ...], ...]
    exists: Bools
    decided: Bools

    def of(self, word: Iterable[int]) -> Bools:
        """Where a word exists, shape (K, D); any rotation of it."""
        wanted = smallest_rotation(list(word))
        if wanted not in self.words:
            return np.zeros(self.decided.shape, dtype=bool)
        return np.asarray(self.exists[self.words.index(wanted)])

    @property
    def quiet(self) -> Bools:
        """Where the jets end up off from every state, proven, shape (K, D)."""
        others = [i for i, word in enumerate(self.words) if word != (0,)]
        return self.decided & self.of((0,)) & ~self.exists[others].any(axis=0)

    def plot(self) -> Figure:
        """Regions by the set of words that exist there; grey: undecided."""
        codes = np.packbits(self.exists, axis=0).reshape(-1, self.decided.size)
        kinds, which, sizes = np.unique(codes, axis=1, return_inverse=True, return_counts=True)
        order = np.argsort(-sizes, kind="stable")
        rank = np.empty(len(order), dtype=int)
        rank[order] = np.arange(len(order))
        shown = np.minimum(rank[which.ravel()], _LEGEND).reshape(self.decided.shape)
        figure = new_figure(7.0, 4.6)
        axes = figure.add_subplot()
        from matplotlib.colors import ListedColormap
        from matplotlib.patches import Patch

        colours = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#5c6570", "#999933", "#dddddd"]
        picture = np.where(self.decided, shown, -1).T
        colour_map = ListedColormap(["#22272e", *colours])
        extent = (self.k[0], self.k[-1], self.delta[0], self.delta[-1])
        axes.imshow(picture, origin="lower", aspect="auto", extent=extent, cmap=colour_map, vmin=-1.5, vmax=9.5, interpolation="nearest")
        handles = []
        for i, kind in enumerate(order[:_LEGEND]):
            here = np.unpackbits(kinds[:, kind])[: len(self.words)].astype(bool)
            names = [shown_word(w) for w, there in zip(self.words, here, strict=True) if there]
            handles.append(Patch(color=colours[i], label=" ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")))
        if len(order) > _LEGEND:
            handles.append(Patch(color=colours[9], label="others"))
        if not self.decided.all():
            handles.append(Patch(color="#22272e", label="undecided"))
        axes.legend(handles=handles, fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0)
        axes.set_xlabel("feedback gain k")
        axes.set_ylabel("offset delta")
        axes.set_title(f"Steady outputs for r = {self.r:g}")
        return figure


def shown_word(word: Iterable[int]) -> str:
    """A word as {+ 0 - 0}, 0 as {0}; long ones cut short."""
    signs = ["-0+"[y + 1] for y in word]
    return "{" + "".join(signs[:16]) + (f"… {len(signs)}" if len(signs) > 16 else "") + "}"


def census_map(modulator: DiscretePWPF, k: ArrayLike, delta: ArrayLike, *, r: float = 0.0) -> CensusMap:
    """The census at every point of a grid of k and delta.

    Parameters
    ----------
    modulator : DiscretePWPF
        The other parameters; its own k and delta are not used.
    k, delta : array_like, shape (K,), (D,)
        Increasing, >= 0.
    r : float
        Constant demand.

    Raises
    ------
    ModelError
        An axis that is not finite, not increasing or negative.

    Notes
    -----
    Compiled where the machine has a C compiler, by NumPy elsewhere; the answers are the same.
    """
    axes = [_axis(name, values) for name, values in (("k", k), ("delta", delta))]
    demand = as_scalar("census_map: r", r)
    gains, offsets = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    behind = modulator.f(demand) - modulator.delta
    slack = 2.0**-50 * (abs(demand) + offsets + modulator.delta)
    rows = rows_of(modulator, demand, k=gains, f=behind + offsets - slack, f_high=behind + offsets + slack)
    found = words_of(rows)
    shape = (len(axes[0]), len(axes[1]))
    words, which = distinct(found)
    exists = np.zeros((len(words), len(rows)), dtype=bool)
    exists[which, found.point] = True
    return CensusMap(
        modulator, demand, frozen(axes[0]), frozen(axes[1]), words, exists.reshape(-1, *shape), (found.outcome == DECIDED).reshape(shape)
    )


def distinct(found: Words) -> tuple[tuple[tuple[int, ...], ...], NDArray[np.int64]]:
    """All words once, sorted by period and then by word, and which of them each cycle is."""
    names: dict[bytes, tuple[int, ...]] = {}
    raw = found.symbols.astype(np.int8).tobytes()
    slices = [raw[a : a + n] for a, n in zip(found.first.tolist(), found.period.tolist(), strict=True)]
    for i, text in enumerate(slices):
        if text not in names:
            names[text] = found.word(i)
    words = tuple(sorted(set(names.values()), key=lambda w: (len(w), w)))
    place = {word: i for i, word in enumerate(words)}
    number = {text: place[word] for text, word in names.items()}
    return words, np.array([number[text] for text in slices], dtype=np.int64)


def cycle_border(
    modulator: DiscretePWPF, word: Iterable[int], parameter: Literal["k", "delta"], between: tuple[float, float], *, r: float = 0.0,
    tolerance: float = 1e-9,
) -> tuple[float, float]:  # fmt: skip
    """Where a cycle appears or disappears as k or delta changes.

    Parameters
    ----------
    modulator : DiscretePWPF
        The other parameters.
    word : iterable of int
        Outputs of the cycle, any rotation.
    parameter : {"k", "delta"}
    between : (float, float)
        The cycle must exist at exactly one of the two.
    r : float
        Constant demand.
    tolerance : float
        Width at which the search stops.

    Returns
    -------
    (float, float)
        The first such border from between[0] on: the cycle provably exists at exactly one of the two values, which are no further
        apart than `tolerance`, or than the undecided values between them.

    Raises
    ------
    ModelError
        The cycle exists at both ends or at none, or an end is undecided.
    """
    if parameter not in ("k", "delta"):
        raise ModelError(f"cycle_border: parameter must be 'k' or 'delta', got {parameter!r}")
    wanted = smallest_rotation([int(y) for y in word])
    ends = as_finite("cycle_border: between", between)
    if ends.shape != (2,) or ends[0] == ends[1]:
        raise ModelError(f"cycle_border: between: expected two different values, got {between}")
    first, last = float(ends[0]), float(ends[1])
    there = _has(modulator, wanted, parameter, np.array([first, last]), r)
    if there[0] < 0 or there[1] < 0 or there[0] == there[1]:
        says = {-1: "is undecided", 0: "does not exist", 1: "exists"}
        raise ModelError(
            f"cycle_border: {shown_word(wanted)} {says[int(there[0])]} at {parameter} = {first:.6g} and"
            f" {says[int(there[1])]} at {parameter} = {last:.6g};"
            " give two values of which exactly one has the cycle"
        )
    while abs(last - first) > tolerance:
        values = np.linspace(first, last, _PARTS + 1)
        state = _has(modulator, wanted, parameter, values, r)
        known = np.flatnonzero(state >= 0)
        change = int(np.flatnonzero(state[known] != there[0])[0])
        narrower = (float(values[known[change - 1]]), float(values[known[change]]))
        if narrower == (first, last):
            break  # all between is undecided
        first, last = narrower
    return first, last


def _has(modulator: DiscretePWPF, word: tuple[int, ...], parameter: str, values: Array, r: float) -> NDArray[np.int64]:
    """1 where a word exists, 0 where it does not, -1 where that is not decided; shape of `values`."""
    if parameter == "k":
        rows = rows_of(modulator, r, k=values)
    else:
        rows = rows_of(modulator, r, f=modulator.f(r) - modulator.delta + values, f_high=None)
    found = words_of(rows)
    state = np.where(found.outcome == DECIDED, 0, -1)
    words, which = distinct(found)
    if word in words:
        state[found.point[which == words.index(word)]] = 1
    return state


def _axis(name: str, values: ArrayLike) -> Array:
    axis = as_finite(f"census_map: {name}", values)
    if axis.ndim != 1 or axis.size == 0 or (np.diff(axis) <= 0).any() or axis[0] < 0:
        raise ModelError(f"census_map: {name}: expected increasing values >= 0, got shape {axis.shape}; give one axis of the grid")
    return axis
