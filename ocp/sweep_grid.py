"""Node grids of the Riccati sweep: steps of four intervals, their halves, and coefficients at the points of each step."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import csr_array

from models.checked import Array, ModelError

POINTS = 9  # 0, 1/8, ..., 1 of each step, latest first: stages of a whole step and of two halves


@dataclass(frozen=True, slots=True, eq=False)
class Coefficients:
    """A, W, Q (..., n, n) and L (..., n, m) with L L^T = W; tangents dW, dQ (nw, ..., n, n), nw = 0 for none."""

    A: Array
    L: Array
    W: Array
    Q: Array
    dW: Array
    dQ: Array


@dataclass(frozen=True, slots=True, eq=False)
class NodeData:
    """Coefficients on nodes t (N,): every segment has 4 k equal intervals, a node at a jump is stored twice."""

    t: Array
    values: Coefficients


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Steps, latest first: node index at which each begins (nb,), its length in intervals (nb,), its duration (nb,) in s.

    The coefficients have the leading axes (nb, 9): the points 0, 1/8, ..., 1 of each step, latest point first.
    """

    begin: Array
    length: Array
    h: Array
    values: Coefficients


def blocks(t: Array) -> np.ndarray:
    """Node indices (nb, 5) of the steps in rising time; refuses a grid that is not made of 4 k equal intervals a segment."""
    if len(t) < 5:
        raise ModelError(f"t: a sweep needs at least 5 nodes (4 equal intervals), got {len(t)}; sample the reference more finely")
    first, last = segments(t)
    count = last - first
    wrong = np.flatnonzero((count % 4 != 0) | (count == 0))
    if wrong.size:
        i = wrong[0]
        raise ModelError(
            f"t: the segment from {t[first[i]]:.6g} s to {t[last[i]]:.6g} s has {count[i]} intervals, expected a multiple of 4;"
            " choose 4 k equal intervals between jumps, and store the node of a jump twice"
        )
    steps = np.diff(t)
    mean = np.zeros(len(steps))
    smooth = steps > 0
    mean[smooth] = np.repeat((t[last] - t[first]) / count, count)
    uneven = np.flatnonzero(np.abs(steps - mean) > 1e-6 * np.maximum(mean, 0.0))
    if uneven.size:
        i = uneven[0]
        raise ModelError(
            f"t: the interval after {t[i]:.9g} s is {steps[i]:.6g} s long, its segment's mean is {mean[i]:.6g} s; use equal intervals"
            " between jumps, and store the node at which the spacing changes twice"
        )
    starts = np.concatenate([np.arange(a, b, 4) for a, b in zip(first, last, strict=True)])
    return np.asarray(starts[:, None] + np.arange(5))


def segments(t: Array) -> tuple[np.ndarray, np.ndarray]:
    """First and last node of each stretch between nodes stored twice."""
    jump = np.flatnonzero(np.diff(t) == 0)
    return np.concatenate([[0], jump + 1]), np.concatenate([jump, [len(t) - 1]])


def lagrange(t: Array, position: Array, width: int) -> csr_array:
    """Matrix (M, N) of Lagrange interpolation, inside its segment, to `position` (M,) counted in node indices.

    On `width` nodes, or as many as the segment has; a position on a node takes its value to the last bit.
    """
    first, last = segments(t)
    segment = np.searchsorted(last, position)
    begin, count = first[segment], (last - first)[segment]
    local = position - begin
    size = np.minimum(width, count + 1)
    start = np.clip(np.floor(local).astype(int) - (size // 2 - 1), 0, count + 1 - size)
    x = local - start
    weights = np.zeros((len(position), width))
    for w in np.unique(size):
        rows = size == w
        for i in range(w):
            others = [k for k in range(w) if k != i]
            weights[rows, i] = np.prod([(x[rows] - k) / (i - k) for k in others], axis=0)
    columns = (begin + start)[:, None] + np.arange(width)
    used = weights != 0.0
    pointer = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    return csr_array((weights[used], columns[used], pointer), shape=(len(position), len(t)))


def interpolated(matrix: csr_array, values: Array) -> Array:
    """Values (N, ...) at the rows of the matrix, (M, ...); what does not vary is kept to the last bit."""
    flat = values.reshape(len(values), -1)
    if (flat == flat[:1]).all():
        out = np.broadcast_to(flat[0], (matrix.shape[0], flat.shape[1]))
    else:
        out = np.asarray(matrix @ flat)
    return out.reshape(matrix.shape[0], *values.shape[1:])


def positions(begin: Array, length: Array, points: int) -> Array:
    """Node positions (nb, points) from the end of each step back to its begin."""
    return np.asarray(begin[:, None] + length[:, None] * np.linspace(1.0, 0.0, points))


def placed(data: NodeData, begin: Array, length: Array, *, points: int = POINTS, width: int = 6) -> Steps:
    """Steps with their coefficients: node values, polynomials of degree `width` - 1 between them."""
    matrix = lagrange(data.t, positions(begin, length, points).ravel(), width)
    node = begin.astype(int)
    h = length * (data.t[node + 1] - data.t[node])
    out = {}
    for field in fields(Coefficients):
        value, shape = getattr(data.values, field.name), (len(begin), points)
        if field.name in ("dW", "dQ"):
            found = np.array([interpolated(matrix, v).reshape(*shape, *v.shape[1:]) for v in value])
            out[field.name] = found if len(value) else np.zeros((0, *shape, *value.shape[2:]))
        else:
            out[field.name] = interpolated(matrix, value).reshape(*shape, *value.shape[1:])
    return Steps(begin, length, h, Coefficients(**out))


def cut(steps: Steps, halvings: np.ndarray) -> tuple[Array, Array]:
    """Begin and length of all steps, latest first, each halved as often as told."""
    pieces = 2**halvings
    length = np.repeat(steps.length / pieces, pieces)
    place = np.arange(len(length)) - np.repeat(np.cumsum(pieces) - pieces, pieces)  # within its step, latest first
    return np.repeat(steps.begin, pieces) + (np.repeat(pieces, pieces) - 1 - place) * length, length
