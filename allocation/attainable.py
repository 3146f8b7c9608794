"""The attainable set: every wrench that commands inside their limits can produce, as an exact polytope.

The image of a box under a linear map is a zonotope.  Each of its facets is spanned by the columns of r - 1 effectors (r the rank of B); its
normal is perpendicular to them, and its distance the sum of what each effector can contribute along that normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from allocation.core import Effectors
from models.checked import Array, ModelError, as_finite, frozen, unknown_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_FACETS = 2_000_000  # combinations of effectors to look at
INSIDE = 1e-9  # of the set's size: nearer to the surface counts as on it


@dataclass(frozen=True, slots=True, eq=False)
class AttainableSet:
    """{w : normals w <= offsets}, with unit normals in scaled axes.

    Attributes
    ----------
    effectors : Effectors
    scale : ndarray, shape (m,)
        Half the extent of the set along each axis (1 where it is flat); distances are measured in w / scale.
    normals : ndarray, shape (k, m)
        Of w / scale.
    offsets : ndarray, shape (k,)
    rank : int
        Dimension of the set; below m it is flat, and pairs of opposite normals with (almost) no room between them say so.
    """

    effectors: Effectors
    scale: Array
    normals: Array
    offsets: Array
    rank: int

    def __repr__(self) -> str:
        return f"AttainableSet(axes {self.effectors.axes}, {len(self.offsets)} facets, rank {self.rank})"

    def margin(self, wrench: ArrayLike) -> Array:
        """Least distance to a facet's plane in scaled axes, positive inside; shape () or (N,) for wrench (m,) or (N, m)."""
        values = self.effectors.demands(wrench) / self.scale
        return np.asarray((self.offsets - values @ self.normals.T).min(axis=-1))

    def contains(self, wrench: ArrayLike) -> np.ndarray:
        """True where a wrench (m,) or (N, m) can be produced."""
        return np.asarray(self.margin(wrench) >= -INSIDE)

    def reach(self, direction: ArrayLike) -> Array:
        """Largest factor for which factor * direction (m,) or (N, m) is attainable.

        Not a number where no multiple is, zero included.
        """
        along = self.effectors.demands(direction) / self.scale @ self.normals.T
        size = np.linalg.norm(along, axis=-1, keepdims=True) + 1e-300
        with np.errstate(divide="ignore"):
            most = np.where(along > 1e-12 * size, (self.offsets + INSIDE) / along, np.inf).min(axis=-1)
            least = np.where(along < -1e-12 * size, (self.offsets + INSIDE) / along, -np.inf).max(axis=-1)
        possible = (least <= most) & ((self.offsets >= -INSIDE) | (np.abs(along) > 1e-12 * size)).all(axis=-1)
        return np.where(possible, most, np.nan)

    def outline(self, axes: tuple[str, str]) -> Array:
        """Corners of the projection on two axes, counter-clockwise, shape (k, 2): exact, the zonotope of the two rows."""
        rows = [_row(self.effectors, a) for a in axes]
        return _polygon(self.effectors.B[rows], self.effectors.lower, self.effectors.upper)

    def plot(self, demand: ArrayLike | None = None) -> Figure:
        """Projections on every pair of axes (one axis: the interval), with demands (N, m): those inside, those outside."""
        from models.drawing import new_figure

        names = self.effectors.axes
        pairs = list(combinations(names, 2)) or [(names[0], names[0])]
        columns = min(3, len(pairs))
        rows = -(-len(pairs) // columns)
        figure = new_figure(4.2 * columns, 3.8 * rows)
        points = None if demand is None else np.atleast_2d(self.effectors.demands(demand))
        inside = None if points is None else np.atleast_1d(self.contains(points))
        for i, (a, b) in enumerate(pairs):
            ax = figure.add_subplot(rows, columns, i + 1)
            corners = self.outline((a, b))
            ax.fill(corners[:, 0], corners[:, 1], facecolor="0.9", edgecolor="0.3", label="attainable")
            if points is not None and inside is not None:
                x, y = points[:, names.index(a)], points[:, names.index(b)]
                ax.plot(x[inside], y[inside], ".", ms=4, label="demand inside")
                ax.plot(x[~inside], y[~inside], "x", ms=5, label="demand outside")
            ax.set_xlabel(self.effectors.label(a))
            ax.set_ylabel(self.effectors.label(b))
            ax.locator_params(nbins=5)
            ax.ticklabel_format(scilimits=(-3, 4))
            if i == 0:
                ax.legend(fontsize="small")
        return figure


def attainable_set(effectors: Effectors) -> AttainableSet:
    """The attainable set of some effectors.

    Raises
    ------
    ModelError
        More combinations of effectors than can be looked at: take fewer axes or effectors.
    """
    B, low, high = effectors.B, effectors.lower, effectors.upper
    m = len(effectors.axes)
    extent = 0.5 * np.abs(B) @ (high - low)
    scale = np.where(extent > 0, extent, 1.0)
    columns = B / scale[:, None]
    moving = (high > low) & (np.abs(columns).max(axis=0) > 0)
    spread = columns[:, moving] * (high - low)[moving]
    if not moving.any():
        basis, rank = np.eye(m), 0
    else:
        basis, values, _ = np.linalg.svd(spread, full_matrices=True)
        rank = int((values > 1e-12 * values[0] * np.sqrt(spread.shape[1])).sum())
    count = comb(spread.shape[1], max(rank - 1, 0))
    if count > MOST_FACETS:
        raise ModelError(
            f"attainable: {len(effectors.names)} effectors on {m} axes make {count} candidates of facets, more than {MOST_FACETS};"
            " take fewer axes or effectors (allocation.allocate tells by its residual whether one demand can be met)"
        )
    normals = _normals(basis[:, :rank].T @ spread, rank) @ basis[:, :rank].T if rank else np.zeros((0, m))
    flat = basis[:, rank:].T
    normals = np.vstack([normals, -normals, flat, -flat])
    along = normals @ columns
    offsets = np.maximum(along * low, along * high).sum(axis=1)
    return AttainableSet(effectors, frozen(scale), frozen(normals), frozen(offsets), rank)


def _normals(columns: Array, rank: int) -> Array:
    """Unit normals of the planes through every r - 1 independent columns (r, n), one of each opposite pair, each once."""
    if rank == 1:
        return np.ones((1, 1))
    unit = columns / np.linalg.norm(columns, axis=0)
    unit = unit[:, np.unique((unit * np.sign(_leading(unit.T))[None, :]).round(12), axis=1, return_index=True)[1]]  # parallel ones once
    found = []
    for part in _chunks(unit.shape[1], rank - 1):
        sets = unit.T[part]  # (k, r - 1, r)
        _, values, rows = np.linalg.svd(sets, full_matrices=True)
        good = values[:, -1] > 1e-9
        found.append(rows[good, -1])
    normals = np.vstack(found)
    normals = normals * np.sign(_leading(normals))[:, None]
    return normals[np.unique(normals.round(11), axis=0, return_index=True)[1]]


def _leading(rows: Array) -> Array:
    """First element of each row that is not small: decides between a direction and its opposite."""
    first = np.argmax(np.abs(rows) > 1e-9, axis=1)
    return rows[np.arange(len(rows)), first]


def _chunks(n: int, size: int, limit: int = 50_000) -> list[Array]:
    every = np.array(list(combinations(range(n), size)), dtype=np.intp).reshape(-1, size)
    return np.array_split(every, max(1, -(-len(every) // limit)))


def _polygon(rows: Array, low: Array, high: Array) -> Array:
    """Corners of a zonotope in the plane: its edges in the order of their angles."""
    edges = (rows * (high - low)).T
    edges = edges[np.linalg.norm(edges, axis=1) > 0]
    edges = np.where((edges[:, 1] < 0) | ((edges[:, 1] == 0) & (edges[:, 0] < 0)), -1.0, 1.0)[:, None] * edges  # all upwards
    order = np.argsort(np.arctan2(edges[:, 1], edges[:, 0]), kind="stable")
    centre = rows @ (0.5 * (low + high))
    start = centre - 0.5 * edges.sum(axis=0)
    right = start + np.vstack([np.zeros((1, 2)), np.cumsum(edges[order], axis=0)])
    return np.vstack([right, (2 * centre - right)[1:]])


def _row(effectors: Effectors, name: str) -> int:
    if name not in effectors.axes:
        raise ModelError(unknown_name("attainable: axis", name, effectors.axes))
    return effectors.axes.index(name)


def attainable_part(effectors: Effectors, demand: ArrayLike) -> Array:
    """Each demand (m,) or (N, m), shortened along its own direction to what can be produced (unchanged inside)."""
    values = as_finite("demand", demand)
    factor = attainable_set(effectors).reach(values)
    return np.asarray(np.minimum(np.where(np.isnan(factor), 0.0, factor), 1.0)[..., None] * values)
