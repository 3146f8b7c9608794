"""Differential Riccati equation swept backward over nodes, with the defect of every interval and exact tangents.

S' = -S A - A^T S + S W S - Q,  W = B R^-1 B^T.  A step spans four equal node intervals, whose five nodes are the
abscissae of Butcher's fifth-order Runge-Kutta method: nothing is interpolated unless a step must be halved.  The steps
run as one CasADi function.
The proof is a second program, in NumPy with full matrices, that restarts from every swept S at half the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csr_array

from models.checked import Array, ModelError

TARGET = 1e-9  # a step whose defect is larger is halved
LEVELS = 24  # passes of halving; each costs one sweep
FINEST = 2.0**-20  # smallest step, as a part of the given one

# Butcher 1964 (J. Austral. Math. Soc. 4, 179): six stages, order five, abscissae 0 1/4 1/4 1/2 3/4 1.
STAGE = (0, 1, 1, 2, 3, 4)
ROWS = ((), (1 / 4,), (1 / 8, 1 / 8), (0, -1 / 2, 1), (3 / 16, 0, 0, 9 / 16), (-3 / 7, 2 / 7, 12 / 7, -12 / 7, 8 / 7))
WEIGHTS = (7 / 90, 0, 32 / 90, 12 / 90, 32 / 90, 7 / 90)


@dataclass(frozen=True, slots=True, eq=False)
class NodeData:
    """Coefficients on nodes: t (N,), A, W, Q (N, n, n), L (N, n, m) with L L^T = W; tangents dL, dW, dQ (nw, N, ...) or empty."""

    t: Array
    A: Array
    L: Array
    W: Array
    Q: Array
    dL: Array
    dW: Array
    dQ: Array


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """S (N, n, n), its tangents dS (nw, N, n, n), the largest scaled defect, and the scale d (n,): max over time of (d S d)_ii = 1."""

    S: Array
    dS: Array
    defect: float
    scale: Array


def blocks(t: Array) -> np.ndarray:
    """Node indices (nb, 5) of the steps in rising time; refuses a grid that is not made of 4 k equal intervals a segment."""
    if len(t) < 5:
        raise ModelError(f"t: a sweep needs at least 5 nodes (4 equal intervals), got {len(t)}; sample the reference more finely")
    jump = np.flatnonzero(np.diff(t) == 0)
    first, last = np.concatenate([[0], jump + 1]), np.concatenate([jump, [len(t) - 1]])
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


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Steps, latest first: node index at which each begins (nb,), its length in intervals (nb,), its duration (nb,) in s.

    Coefficients at the nine points 0, 1/8, ..., 1 of each step, latest point first: A, L, W, Q (nb, 9, ...) and
    tangents dL, dW, dQ (nw, nb, 9, ...).
    """

    begin: Array
    length: Array
    h: Array
    A: Array
    L: Array
    W: Array
    Q: Array
    dL: Array
    dW: Array
    dQ: Array


def _lagrange(t: Array, position: Array, width: int) -> csr_array:
    """Matrix (M, N) of Lagrange interpolation, inside its segment, to `position` (M,) counted in node indices.

    On `width` nodes, or as many as the segment has; a position on a node takes its value to the last bit.
    """
    jump = np.flatnonzero(np.diff(t) == 0)
    first, last = np.concatenate([[0], jump + 1]), np.concatenate([jump, [len(t) - 1]])
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


def _apply(matrix: csr_array, values: Array, steps: int, axis: int = 0) -> Array:
    """Values (N, ...) at the points of all steps, (nb, points, ...)."""
    moved = np.moveaxis(values, axis, 0)
    flat = moved.reshape(len(moved), -1)
    # A coefficient that does not vary is kept to the last bit.
    out = np.repeat(flat[:1], matrix.shape[0], axis=0) if (flat == flat[:1]).all() else np.asarray(matrix @ flat)
    out = out.reshape(steps, matrix.shape[0] // steps, *moved.shape[1:])
    return np.moveaxis(out, (0, 1), (axis, axis + 1))


def _positions(begin: Array, length: Array, points: int) -> Array:
    return np.asarray(begin[:, None] + length[:, None] * np.linspace(1.0, 0.0, points))


def _placed(data: NodeData, begin: Array, length: Array) -> _Steps:
    matrix = _lagrange(data.t, _positions(begin, length, 9).ravel(), 6)
    node = begin.astype(int)
    interval = data.t[node + 1] - data.t[node]
    parts = [_apply(matrix, v, len(begin)) for v in (data.A, data.L, data.W, data.Q)]
    tangents = [_apply(matrix, v, len(begin), 1) for v in (data.dL, data.dW, data.dQ)]
    return _Steps(begin, length, length * interval, *parts, *tangents)


def _expressions(z: ca.SX, nodes: list[tuple[ca.SX, ca.SX, ca.SX]], h: ca.SX, n: int) -> ca.SX:
    """One backward step of S, stored as its upper triangle."""
    rows, columns = np.triu_indices(n)
    place = np.zeros((n, n), dtype=int)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    upper = [int(i) for i in rows + n * columns]

    def rate(values: ca.SX, node: tuple[ca.SX, ca.SX, ca.SX]) -> ca.SX:
        A, L, Q = node
        S = ca.reshape(values[[int(i) for i in place.ravel()]], n, n)
        product, factor = ca.mtimes(S, A), ca.mtimes(S, L)
        full = product + product.T - ca.mtimes(factor, factor.T) + Q
        return ca.densify(full)[upper]

    stages: list[ca.SX] = []
    for row, j in zip(ROWS, STAGE, strict=True):
        value = z
        for a, k in zip(row, stages, strict=True):
            value = value + (h * a) * k if a else value
        stages.append(rate(value, nodes[j]))
    return z + h * sum((w * k for w, k in zip(WEIGHTS, stages, strict=True) if w), ca.SX.zeros(z.shape[0]))


@lru_cache(maxsize=64)
def _steps(n: int, m: int, pattern: tuple[tuple[int, ...], ...], seeds: int, count: int) -> ca.Function:
    """(z, data, h) -> z over `count` steps; z = upper triangle of S, then of each tangent; data = 5 nodes of nonzeros."""
    size, per_node = n * (n + 1) // 2, sum(len(p) for p in pattern)
    z, d, h = ca.SX.sym("z", size), ca.SX.sym("d", 5 * per_node), ca.SX.sym("h")
    nodes = []
    for j in range(5):
        position, matrices = j * per_node, []
        for entries, columns in zip(pattern, (n, m, n), strict=True):
            matrix = ca.SX(n, columns)
            for entry in entries:
                matrix[entry // columns, entry % columns] = d[position]
                position += 1
            matrices.append(matrix)
        nodes.append((matrices[0], matrices[1], matrices[2]))
    after = _expressions(z, nodes, h, n)
    dz, dd = ca.SX.sym("dz", size, seeds), ca.SX.sym("dd", 5 * per_node, seeds)
    if seeds:
        after = ca.vertcat(after, ca.vec(ca.jtimes(after, ca.vertcat(z, d), ca.vertcat(dz, dd))))
    step = ca.Function("riccati_step", [ca.vertcat(z, ca.vec(dz)), ca.vertcat(d, ca.vec(dd)), h], [after], ["z", "data", "h"], ["after"])
    return step.mapaccum("riccati_sweep", count, {"base": -1})


def _pattern(*values: Array) -> np.ndarray:
    used = np.zeros(values[0].shape[-2:], dtype=bool)
    for value in values:
        used |= (value != 0).reshape(-1, *used.shape).any(axis=0)
    return used


def run(function: ca.Function, z0: Array, data: Array, h: Array) -> Array:
    """Call a mapped-accumulated function on (count, rows) arrays: the columns CasADi wants are these rows in memory."""
    data, h, z0 = (np.ascontiguousarray(v, dtype=np.float64) for v in (data, h[:, None], z0))
    for i, value in enumerate((z0, data, h)):
        if value.size != function.numel_in(i):
            raise ModelError(f"{function.name()}: {function.name_in(i)}: expected {function.numel_in(i)} numbers, got {value.size}")
    out = np.empty(function.size_out(0)[::-1])
    handle: Any = function  # CasADi's own stubs miss the Python form of the buffer calls
    buffer, evaluate = handle.buffer()
    for i, value in enumerate((z0, data, h)):
        buffer.set_arg(i, value.data)
    buffer.set_res(0, out.data)
    evaluate()
    return out


def _sweep(steps: _Steps, final: Array) -> Array:
    """S and tangents at the ends of the steps, (1 + nw, nb + 1, n, n), latest first; `final` is (1 + nw, n, n)."""
    n, m, nw, count = steps.A.shape[-1], steps.L.shape[-1], len(steps.dQ), len(steps.h)
    used = (_pattern(steps.A), _pattern(steps.L, steps.dL), np.triu(_pattern(steps.Q, steps.dQ)))
    pattern = tuple(tuple(int(i) for i in np.flatnonzero(u)) for u in used)
    rows, columns = np.triu_indices(n)
    function = _steps(n, m, pattern, nw, count)
    table = [np.concatenate([v[:, ::2, u] for v, u in zip((steps.A, steps.L, steps.Q), used, strict=True)], axis=-1)]
    for dL, dQ in zip(steps.dL, steps.dQ, strict=True):
        still = np.zeros((count, 5, int(used[0].sum())))
        table.append(np.concatenate([still, dL[:, ::2, used[1]], dQ[:, ::2, used[2]]], axis=-1))
    data = np.concatenate([v.reshape(count, -1) for v in table], axis=1)
    out = run(function, final[:, rows, columns].ravel(), data, steps.h)
    ends = np.empty((1 + nw, count + 1, n, n))
    ends[:, 0] = final
    upper = np.moveaxis(out.reshape(count, 1 + nw, len(rows)), 1, 0)
    ends[:, 1:, rows, columns] = upper
    ends[:, 1:, columns, rows] = upper
    return ends


def _rate(y: Array, A: Array, W: Array, Q: Array, dW: Array, dQ: Array) -> Array:
    """-d/dt of S and of its tangents, stacked (1 + nw, M, n, n), in full matrices."""
    S = y[0]
    closed = A - W @ S
    SA = S @ closed
    base = SA + np.swapaxes(SA, -1, -2) + S @ W @ S + Q
    if len(y) == 1:
        return base[None]
    product = y[1:] @ closed
    return np.concatenate([base[None], product + np.swapaxes(product, -1, -2) - S @ dW @ S + dQ])


def _runge_kutta(rate: Callable[[int, Array], Array], y: Array, h: Array) -> Array:
    stages: list[Array] = []
    width = h[:, None, None]
    for row, j in zip(ROWS, STAGE, strict=True):
        value = y
        if row:
            value = y + width * sum((a * k for a, k in zip(row, stages, strict=True) if a), np.zeros(1))
        stages.append(rate(j, value))
    return np.asarray(y + width * sum((w * k for w, k in zip(WEIGHTS, stages, strict=True) if w), np.zeros(1)))


@lru_cache(maxsize=1)
def _quintic() -> tuple[Array, Array]:
    """Weights (2, 3) of values and of slopes at 0, 1/2, 1 for the quintic Hermite interpolant at 1/4 and 3/4."""
    powers = np.arange(6)
    value = np.array([0.0, 0.5, 1.0])[:, None] ** powers
    slope = np.zeros((3, 6))
    slope[:, 1:] = powers[1:] * value[:, :-1]
    at = np.array([0.25, 0.75])[:, None] ** powers
    weights = np.linalg.solve(np.vstack([value, slope]).T, at.T).T
    return weights[:, :3], weights[:, 3:]


def _check(steps: _Steps, ends: Array) -> tuple[Array, Array]:
    """Values at the five points of each step (1 + nw, nb, 5, n, n), and the difference (nb, n, n) of two half steps from the sweep."""

    def rate_from(point: int) -> Callable[[int, Array], Array]:
        def rate(j: int, y: Array) -> Array:
            i = point + j
            return _rate(y, steps.A[:, i], steps.W[:, i], steps.Q[:, i], steps.dW[:, :, i], steps.dQ[:, :, i])

        return rate

    centre = _runge_kutta(rate_from(0), ends[:, :-1], 0.5 * steps.h)
    far = _runge_kutta(rate_from(4), centre, 0.5 * steps.h)
    known = (ends[:, :-1], centre, ends[:, 1:])
    slopes = [rate_from(i)(0, y) for i, y in zip((0, 4, 8), known, strict=True)]
    values, derivatives = _quintic()
    width = steps.h[:, None, None]
    quarters = [
        sum((a[i] * known[i] + width * b[i] * slopes[i] for i in range(3)), np.zeros(1))
        for a, b in zip(values, derivatives, strict=True)
    ]  # fmt: skip
    return np.stack([known[0], quarters[0], known[1], quarters[1], known[2]], axis=2), far[0] - ends[0, 1:]


def riccati_sweep(data: NodeData, final: Array) -> Sweep:
    """Backward solution of the differential Riccati equation on the nodes of `data`, and of its tangents.

    Parameters
    ----------
    data : NodeData
        Coefficients; every segment has 4 k equal intervals, a node at a jump is stored twice.
    final : ndarray, shape (1 + nw, n, n)
        S at the last node, then its tangents.

    Returns
    -------
    Sweep
        The defect is the largest difference, over all steps and elements, between the swept S and two half steps of
        the check program restarted from the sweep at the later end of that step; in the coordinates in which every
        S_ii has the maximum 1 over time, so that it is relative and free of units.

    Raises
    ------
    ModelError
        A grid of another kind; a sweep that stays infinite at the finest spacing.

    Notes
    -----
    A step whose defect exceeds 1e-9 is halved, on coefficients interpolated within its segment by polynomials of
    degree five: a heavy terminal weight makes the loop fast near the end and only there.  The difference to
    interpolation of degree three then counts as defect too.
    """
    start = blocks(data.t)[::-1, 0].astype(float)
    steps = _placed(data, start, np.full(len(start), 4.0))
    most = 16 * len(start) + 4096  # more halving than that is no stretch of fast motion but a problem without an answer
    for attempt in range(LEVELS + 1):
        with np.errstate(over="ignore", invalid="ignore"):
            ends = _sweep(steps, final)
            values, difference = _check(steps, ends)
            sound = _sound(ends[0], values[0], difference)
        scale = _scale(np.abs(np.diagonal(ends[0, : sound + 1], axis1=-2, axis2=-1)).max(axis=0))
        defects = np.abs(difference[:sound] * scale[:, None] * scale).max(axis=(1, 2))
        coarse = np.zeros(len(steps.h), dtype=bool)
        coarse[:sound] = defects > TARGET
        coarse[sound : sound + 1] = True
        coarse &= steps.length > 4 * FINEST
        if not coarse.any() or len(steps.h) > most:
            break
        if attempt < LEVELS:
            steps = _placed(data, *_halved(steps, coarse))
    if sound < len(steps.h):
        raise ModelError(
            f"riccati_sweep: the Riccati solution overflows near t = {np.interp(steps.begin[sound], np.arange(len(data.t)), data.t):.6g} s,"
            " however small the step; a mode grows out of reach of the input, or the weights are too far apart: lower Qf or Q, or raise R"
        )
    at = _positions(steps.begin, steps.length, 5)
    hit = at == np.round(at)
    filled = np.empty((len(final), *data.A.shape))
    filled[:, at[hit].astype(int)] = values[:, hit]
    return Sweep(filled[0], filled[1:], max(float(defects.max()), _interpolation_error(data, steps, values[0], scale)), scale)


def _sound(S: Array, values: Array, difference: Array) -> int:
    """Number of steps before the first that is no answer at all: not finite, or half as large as S itself off its two half steps.

    Such a step spoils all that follow it, whose defects then say nothing.
    """
    size = np.maximum.accumulate(np.abs(np.diagonal(S, axis1=-2, axis2=-1)), axis=0)[1:]
    d = _scale(size)
    wrong = ~(np.isfinite(values).all(axis=(1, 2, 3)) & (np.abs(difference * d[:, :, None] * d[:, None, :]).max(axis=(1, 2)) < 0.5))
    return int(np.argmax(wrong)) if wrong.any() else len(wrong)


def _scale(size: Array) -> Array:
    """1/sqrt of a diagonal, one where it is zero."""
    return np.asarray(1.0 / np.sqrt(np.where(size > np.finfo(float).tiny, size, 1.0)))


def _halved(steps: _Steps, coarse: np.ndarray) -> tuple[Array, Array]:
    """Begin and length of all steps with those marked cut in two, latest first."""
    pieces = np.where(coarse, 2, 1)
    length = np.repeat(steps.length / pieces, pieces)
    later = np.zeros(len(length), dtype=bool)
    later[np.cumsum(pieces)[coarse] - 2] = True
    return np.repeat(steps.begin, pieces) + np.where(later, length, 0.0), length


def _interpolation_error(data: NodeData, steps: _Steps, values: Array, scale: Array) -> float:
    """Change of S over a halved step when coefficients are interpolated by cubics in place of quintics."""
    cut = steps.length < 4.0
    if not cut.any():
        return 0.0
    points = _positions(steps.begin[cut], steps.length[cut], 5)
    matrix, count = _lagrange(data.t, points.ravel(), 4), int(cut.sum())
    none = np.zeros((0, 1, 1, 1, 1))
    S = values[cut][None]
    A, W, Q = (_apply(matrix, v, count) for v in (data.A, data.W, data.Q))
    coarse = _rate(S, A, W, Q, none, none)[0]
    A, W, Q = (v[cut][:, ::2] for v in (steps.A, steps.W, steps.Q))
    fine = _rate(S, A, W, Q, none, none)[0]
    change = (coarse - fine) * steps.h[cut][:, None, None, None]
    return float(np.abs(change * scale[:, None] * scale).max())
