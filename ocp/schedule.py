"""Gain schedules simple enough to fly: constants and piecewise constants, from K(t) or from the commands that it flew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, ModelError, as_finite, frozen, unknown_name


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Piecewise-constant gains of one input over one scheduling variable (time, speed, energy).

    Attributes
    ----------
    names : tuple of str, length n
        The quantities that the gains multiply.
    breakpoints : ndarray, shape (m,)
        Increasing values of the scheduling variable; a breakpoint belongs to the piece that it opens.
    K : ndarray, shape (m + 1, n)
        Gains before, between and after the breakpoints.
    residual : float
        Root mean square of what is left: of K - K(t), each gain relative to its own rms, or of the command (unweighted).
    """

    names: tuple[str, ...]
    breakpoints: Array
    K: Array
    residual: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "breakpoints", frozen(as_finite("Schedule: breakpoints", self.breakpoints)))
        object.__setattr__(self, "K", frozen(as_finite("Schedule: K", self.K)))
        if self.breakpoints.ndim != 1:
            raise ModelError(f"Schedule: breakpoints: expected shape (m,), got {self.breakpoints.shape}; give a flat list")
        if self.K.shape != (len(self.breakpoints) + 1, len(self.names)):
            wanted = (len(self.breakpoints) + 1, len(self.names))
            raise ModelError(f"Schedule: K: expected shape {wanted}, one row for each piece, got {self.K.shape}")
        if (np.diff(self.breakpoints) <= 0).any():
            raise ModelError(f"Schedule: breakpoints must increase, got {self.breakpoints.tolist()}")

    def __call__(self, variable: ArrayLike) -> Array:
        """Gains (M, n) at values (M,) of the scheduling variable."""
        values = np.atleast_1d(as_finite("schedule", variable))
        if values.ndim != 1:
            raise ModelError(f"schedule: expected values of shape (M,), got {values.shape}; flatten them")
        return self.K[np.searchsorted(self.breakpoints, values, side="right")]


Breakpoints = Mapping[str, Sequence[float]]


def time_means(t: ArrayLike, K: ArrayLike, *, names: Sequence[str], breakpoints: Breakpoints | None = None) -> Schedule:
    """Means of K(t) over the pieces of each gain: the best constants in the sense of the integral of (K - K(t))^2.

    Parameters
    ----------
    t : array_like, shape (N,)
        Nodes, not decreasing, s (or any other scheduling variable).
    K : array_like, shape (N, n)
    names : sequence of str, length n
    breakpoints : mapping, optional
        Name -> breakpoints of that gain, such as ``{"s": [400.0]}``; a gain that is not named stays one constant.
    """
    nodes, values, cuts = _checked(t, K, names, breakpoints)
    total = np.concatenate([[0.0], cuts.union, [0.0]])
    total[0], total[-1] = nodes[0], nodes[-1]
    means = np.empty((len(total) - 1, len(names)))
    for column, own in enumerate(cuts.own):
        edges = np.concatenate([[nodes[0]], own, [nodes[-1]]])
        integral = _primitive(nodes, values[:, column], edges)
        pieces = np.diff(integral) / np.diff(edges)
        means[:, column] = pieces[np.searchsorted(own, total[:-1], side="right")]
    left = values - means[np.searchsorted(cuts.union, nodes, side="right")]
    span = nodes[-1] - nodes[0]
    scale = np.sqrt(np.trapezoid(values**2, nodes, axis=0) / span)
    relative = np.trapezoid(left**2, nodes, axis=0) / span / np.where(scale > 0, scale, 1.0) ** 2
    return Schedule(tuple(names), cuts.union, means, float(np.sqrt(relative.mean())))


def best_breakpoints(t: ArrayLike, K: ArrayLike, *, pieces: int) -> Array:
    """Breakpoints (pieces - 1,) that leave the least integral of (K - piece mean)^2, by dynamic programming.

    Parameters
    ----------
    t : array_like, shape (N,)
    K : array_like, shape (N,) or (N, n)
        Several gains share the breakpoints, each weighted by its own mean square.
    pieces : int
        2 to 100; the answer is the global optimum over a uniform grid of as many points as nodes, at most 400.
    """
    if isinstance(pieces, bool) or not isinstance(pieces, int) or not 2 <= pieces <= 100:
        raise ModelError(f"best_breakpoints: pieces must be a whole number from 2 to 100, got {pieces!r}")
    nodes, values = as_finite("t", t), as_finite("K", K)
    values = values[:, None] if values.ndim == 1 else values
    if nodes.ndim != 1 or len(nodes) < 2 or values.shape[:1] != nodes.shape or values.ndim != 2:
        raise ModelError(f"best_breakpoints: expected t (N,) with N >= 2 and K (N,) or (N, n), got {nodes.shape} and {values.shape}")
    if (np.diff(nodes) < 0).any() or nodes[-1] == nodes[0]:
        raise ModelError("best_breakpoints: t must not decrease and must span an interval; sort the nodes")
    grid = np.linspace(nodes[0], nodes[-1], min(400, max(len(nodes), 2 * pieces + 1)))
    sampled = np.column_stack([np.interp(grid, nodes, column) for column in values.T])
    sampled = sampled / np.sqrt(np.maximum((sampled**2).mean(axis=0), np.finfo(float).tiny))
    middle = 0.5 * (sampled[1:] + sampled[:-1])  # one value for each cell of equal width
    first = np.vstack([np.zeros(middle.shape[1]), np.cumsum(middle, axis=0)])
    second = np.concatenate([[0.0], np.cumsum((middle**2).sum(axis=1))])
    count = np.arange(len(grid))[None, :] - np.arange(len(grid))[:, None]
    spread = ((first[None, :, :] - first[:, None, :]) ** 2).sum(axis=2) / np.where(count > 0, count, 1)
    cost = np.where(count > 0, second[None, :] - second[:, None] - spread, np.inf)  # of one piece from node i to node j
    best, choice = cost[0], []
    for _ in range(pieces - 1):
        through = best[:, None] + cost
        choice.append(through.argmin(axis=0))
        best = through.min(axis=0)
    at, found = len(grid) - 1, []
    for row in reversed(choice):
        at = int(row[at])
        found.append(grid[at])
    return frozen(np.array(found[::-1]))


def fit_commands(
    variable: ArrayLike, X: ArrayLike, u: ArrayLike, *, names: Sequence[str], breakpoints: Breakpoints | None = None,
    weight: ArrayLike | None = None,
) -> Schedule:  # fmt: skip
    """Constants whose commands K X come nearest to given commands, in the weighted least-squares sense.

    Fed with flights under K(t), it weighs each gain where deviations occur, which a time mean does not.

    Parameters
    ----------
    variable : array_like, shape (S,)
        Scheduling variable of each sample.
    X : array_like, shape (S, n)
        Deviations that the gains multiply.
    u : array_like, shape (S,)
        Corrections to be reproduced.
    names : sequence of str, length n
    breakpoints : mapping, optional
        As in :func:`time_means`.
    weight : array_like, shape (S,), optional
        Weight of each sample, >= 0.

    Raises
    ------
    ModelError
        Wrong shapes, or samples that do not determine every constant (SINGULAR).
    """
    moments, deviations, cuts = _checked(variable, X, names, breakpoints, ordered=False)
    commands = as_finite("u", u)
    if commands.shape != moments.shape:
        raise ModelError(f"fit_commands: u: expected shape {moments.shape}, got {commands.shape}")
    weights = np.ones(len(moments)) if weight is None else as_finite("weight", weight)
    if weights.shape != moments.shape or (weights < 0).any():
        raise ModelError(f"fit_commands: weight: expected shape {moments.shape} and no negative value, got {weights.shape}")
    root = np.sqrt(weights)
    blocks, owner = [], []
    for column, own in enumerate(cuts.own):
        piece = np.searchsorted(own, moments, side="right")
        for k in range(len(own) + 1):
            blocks.append(np.where(piece == k, deviations[:, column], 0.0))
            owner.append((column, k))
    design = np.column_stack(blocks) * root[:, None]
    scale = np.sqrt((design**2).sum(axis=0))
    if (scale == 0).any():
        column, k = owner[int(np.argmin(scale))]
        raise ModelError(f"fit_commands: SINGULAR: no sample moves {names[column]} in its piece {k + 1}; add flights, or merge pieces")
    solution, _, rank, _ = np.linalg.lstsq(design / scale, commands * root, rcond=1e-12)
    if rank < len(owner):
        raise ModelError(f"fit_commands: SINGULAR: the samples determine {rank} of {len(owner)} constants; add flights, or merge pieces")
    constants = solution / scale
    edges = np.concatenate([[-np.inf], cuts.union])
    K = np.empty((len(edges), len(names)))
    for value, (column, k) in zip(constants, owner, strict=True):
        K[np.searchsorted(cuts.own[column], edges, side="right") == k, column] = value
    left = (K[np.searchsorted(cuts.union, moments, side="right")] * deviations).sum(axis=1) - commands
    return Schedule(tuple(names), cuts.union, K, float(np.sqrt(np.mean(left**2))))


@dataclass(frozen=True, slots=True, eq=False)
class _Cuts:
    own: tuple[Array, ...]
    union: Array


def _checked(
    t: ArrayLike, K: ArrayLike, names: Sequence[str], breakpoints: Breakpoints | None, *, ordered: bool = True
) -> tuple[Array, Array, _Cuts]:
    nodes, values = as_finite("t", t), as_finite("K", K)
    if nodes.ndim != 1 or len(nodes) < 2 or values.shape != (len(nodes), len(names)):
        raise ModelError(
            f"schedule: expected t (N,) with N >= 2 and values (N, {len(names)}) for {tuple(names)}, got {nodes.shape} and {values.shape}"
        )
    if ordered and ((np.diff(nodes) < 0).any() or nodes[-1] == nodes[0]):
        raise ModelError("schedule: t must not decrease and must span an interval; sort the nodes")
    given = dict(breakpoints or {})
    for name in given:
        if name not in names:
            raise ModelError(unknown_name("schedule: breakpoints", name, names))
    own = []
    for name in names:
        cut = np.atleast_1d(as_finite(f"breakpoints of {name}", list(given.get(name, ())))).astype(np.float64)
        if (np.diff(cut) <= 0).any() or (cut.size and (cut.min() <= nodes.min() or cut.max() >= nodes.max())):
            inside = f"({nodes.min():.6g}, {nodes.max():.6g})"
            raise ModelError(f"schedule: breakpoints of {name}: expected increasing values inside {inside}, got {cut.tolist()}")
        own.append(cut)
    return nodes, values, _Cuts(tuple(own), np.unique(np.concatenate(own)) if own else np.zeros(0))


def _primitive(nodes: Array, values: Array, at: Array) -> Array:
    """Integral of the piecewise-linear interpolant from the first node to each of `at`."""
    steps = np.diff(nodes)
    whole = np.concatenate([[0.0], np.cumsum(0.5 * steps * (values[1:] + values[:-1]))])
    k = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    part = at - nodes[k]
    slope = (values[k + 1] - values[k]) / np.where(steps[k] > 0, steps[k], 1.0)
    result: Array = whole[k] + part * (values[k] + 0.5 * slope * part)
    return result
