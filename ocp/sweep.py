"""Differential Riccati equation swept backward over nodes, with the defect of every interval and exact tangents.

S' = -S A - A^T S + S W S - Q,  W = L L^T = B R^-1 B^T.  A step spans four equal node intervals, whose five nodes are the abscissae
of Butcher's fifth-order Runge-Kutta method: nothing is interpolated unless a step must be halved.

Over a step the equation has the exact discrete form S <- Q_h + A_h^T S (I + G_h S)^-1 A_h, whose parts do not depend on S: they are
integrated for all steps at once, and are smooth where S is not (a heavy terminal weight falls by orders of magnitude within the
last step).  What remains to be done one step after another is a discrete Riccati recursion, one CasADi function.
The proof is a second program (:mod:`ocp.sweep_flow`), another form of the equation, restarted from every swept S at half the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from models.checked import Array, ModelError
from ocp.riccati import packed_places
from ocp.sweep_flow import ROWS, STAGE, WEIGHTS, Check, Flow, check, flow, interpolation_change, tangent_drive, unit_scale
from ocp.sweep_grid import NodeData, Steps, blocks, cut, placed, positions

TARGET = 1e-9  # a step whose defect is larger is halved
LOCAL = 1e-8  # the same for the defect relative to the step's own S
SLACK = 2.0  # no further pass while every defect is within this factor of its target
LEVELS = 24  # passes of halving; each costs one sweep
FINEST = 2.0**-20  # smallest step, as a part of the given one


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """The answer of a sweep.

    Attributes
    ----------
    S, dS : ndarray, shapes (N, n, n), (nw, N, n, n)
        On the nodes; tangents.
    defect, local : float
        Largest defect of a step, relative to S over all time and to S of that step; see :func:`riccati_sweep`.
    scale : ndarray, shape (n,)
        d: the maximum over time of (diag(d) S diag(d))_ii is one.
    steps : Steps
        Those that were taken, latest first.
    flow : Flow
        Of the check; gives S between the nodes.
    gap : ndarray, shape (nb, n, n)
        S of the sweep less S of the flow at the begin of each step.
    """

    S: Array
    dS: Array
    defect: float
    local: float
    scale: Array
    steps: Steps
    flow: Flow
    gap: Array


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # judged by what comes out
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
        ``defect`` is the largest difference, over all steps and elements, between the swept S and two half steps of
        the check program restarted from the sweep at the later end of that step; in the coordinates in which every
        S_ii has the maximum 1 over time, so that it is relative and free of units.  ``local`` is the same in the
        coordinates in which S at the begin of that step has unit diagonal.

    Raises
    ------
    ModelError
        A grid of another kind; S beyond the floating-point range.

    Notes
    -----
    Steps are halved until their defects are about 1e-9 and their local defects about 1e-8 (where rounding alone is larger, it
    takes the place of S in the scale), on coefficients interpolated within its segment by polynomials of degree five.  The
    difference to interpolation of degree three then counts as defect too.
    """
    start = blocks(data.t)[::-1, 0].astype(float)
    steps = placed(data, start, np.full(len(start), 4.0))
    most = 16 * len(start) + 4096  # more halving than that is no stretch of fast motion but a problem without an answer
    for attempt in range(LEVELS + 1):
        ends = _sweep(steps, final[0])
        sound = _sound(ends)
        scale = unit_scale(np.abs(np.diagonal(ends[: sound + 1], axis1=1, axis2=2)).max(axis=0))
        proof = check(steps, ends[:-1], np.finfo(float).eps / scale**2)
        scales = (scale, _own_scale(ends, proof, scale)[:sound])
        defects = [_largest((proof.S - ends[1:])[:sound], d) for d in scales]
        halvings = _halvings(steps, *defects)
        if not halvings.any() or len(steps.h) > most or attempt == LEVELS:
            break
        steps = placed(data, *cut(steps, halvings))
    if sound < len(steps.h):
        raise ModelError(_overflow(data.t, steps, sound))
    at = flow(proof)
    S, dS = _at_points(steps, at, ends, final[1:])
    where = positions(steps.begin, steps.length, 5).T
    hit = where == np.round(where)
    filled = np.empty((len(final), *data.values.A.shape))
    for out, values in zip(filled, (S, *dS), strict=True):
        out[where[hit].astype(int)] = values[hit]
    change = interpolation_change(data, steps, at)
    defect, local = (
        float(np.nan_to_num(np.maximum(v, _largest(change, d)), nan=np.inf).max()) for v, d in zip(defects, scales, strict=True)
    )
    return Sweep(filled[0], filled[1:], defect, local, scale, steps, at, ends[1:] - at.S[-1])


def _halvings(steps: Steps, defects: Array, local: Array) -> np.ndarray:
    """How often to halve each step; nothing where all are within SLACK of the targets."""
    count, sound = np.zeros(len(steps.h), dtype=int), len(defects)
    excess = np.nan_to_num(np.maximum(defects / TARGET, local / LOCAL), nan=np.inf)
    if sound == len(count) and excess.max() <= SLACK:
        return count
    # A defect falls with the sixth power of the length; aim below the target, since another pass costs more than a few short steps.
    wanted = np.log2(np.clip(4.0 * np.minimum(excess, 2.0**16), 1.0, None)) / 6
    count[:sound] = np.where(excess > 1.0, np.ceil(wanted), 0)
    count[sound : sound + 1] = 3
    return np.minimum(count, np.maximum(np.log2(steps.length / (4 * FINEST)), 0).astype(int))


def _largest(change: Array, d: Array) -> Array:
    """Largest element of each change (nb, n, n) in coordinates scaled by d (n,) or (nb, n)."""
    return np.asarray(np.abs(change * d[..., :, None] * d[..., None, :]).max(axis=(1, 2), initial=0.0))


def _sound(ends: Array) -> int:
    """Number of steps before the first that leaves the numbers; those after it say nothing."""
    wrong = np.flatnonzero(~np.isfinite(ends[1:]).all(axis=(1, 2)))
    return int(wrong[0]) if wrong.size else len(ends) - 1


def _own_scale(ends: Array, proof: Check, scale: Array) -> Array:
    """Scales (nb, n) that give S at the begin of each step unit diagonal, where its rounding is below LOCAL of it."""
    n, S = len(scale), np.abs(ends[1:])
    rounding = np.finfo(float).eps * S @ np.abs(proof.known[2, :, :n]) @ np.abs(proof.inverse)
    floor = np.maximum(np.diagonal(rounding, axis1=1, axis2=2), np.finfo(float).eps ** 2 / scale**2)
    return unit_scale(np.diagonal(S, axis1=1, axis2=2), floor / LOCAL)


def _overflow(t: Array, steps: Steps, sound: int) -> str:
    c, h = steps.values, float(steps.h[sound])
    A, W, Q = (v[sound, -1] for v in (c.A, c.W, c.Q))
    rate = float(np.abs(np.linalg.eigvals(np.block([[A, -W], [-Q, -A.T]]))).max())
    where = f"near t = {np.interp(steps.begin[sound], np.arange(len(t)), t):.6g} s"
    if h * rate > 1.0:
        return (
            f"riccati_sweep: the rates of the problem {where} reach {rate:.3g} 1/s, too fast for these nodes (the smallest step tried is"
            f" {h:.3g} s): use finer nodes, or lower Q, or raise R"
        )
    return (
        f"riccati_sweep: S exceeds the largest number {where}: over this horizon a mode grows beyond it that the input cannot reach,"
        " or the weights do: shorten the horizon, give the mode an input, or lower Qf and Q"
    )


def _elements(steps: Steps) -> tuple[Array, Array, Array]:
    """A_h, L_h and Q_h (nb, n, ...) with G_h = L_h L_h^T, by one Runge-Kutta step each from I, 0, 0.

    Q_h solves the Riccati equation from zero, A_h is its closed loop, G_h the integral of A_h W A_h^T: all weights of the method
    are positive, so that G_h is a sum of squares and L_h needs no square root.
    """
    c, h = steps.values, steps.h[:, None, None]
    n = c.A.shape[-1]
    rates: list[tuple[Array, Array]] = []
    columns = []
    for row, weight, j in zip(ROWS, WEIGHTS, STAGE, strict=True):
        A, L, Q = c.A[:, 2 * j], c.L[:, 2 * j], c.Q[:, 2 * j]
        Qh, Ah = _combined(np.zeros_like(A), np.broadcast_to(np.eye(n), A.shape), row, rates, h)
        V = np.swapaxes(L, 1, 2) @ Qh
        product = Qh @ A
        rates.append((product + np.swapaxes(product, 1, 2) - np.swapaxes(V, 1, 2) @ V + Q, Ah @ (A - L @ V)))
        if weight:
            columns.append(np.sqrt(h * weight) * (Ah @ L))
    Qh, Ah = _combined(np.zeros_like(c.A[:, 0]), np.broadcast_to(np.eye(n), c.A[:, 0].shape), WEIGHTS, rates, h)
    Lh = np.concatenate(columns, axis=-1)
    if Lh.shape[-1] > n:
        Lh = np.swapaxes(np.linalg.qr(np.swapaxes(Lh, 1, 2), mode="r"), 1, 2)
    return Ah, Lh, Qh


def _combined(Qh: Array, Ah: Array, row: tuple[float, ...], rates: list[tuple[Array, Array]], h: Array) -> tuple[Array, Array]:
    for a, (dQ, dA) in zip(row, rates, strict=True):
        if a:
            Qh, Ah = Qh + (h * a) * dQ, Ah + (h * a) * dA
    return Qh, Ah


@lru_cache(maxsize=32)
def _step(n: int, m: int) -> ca.Function:
    """(z, data, h) -> z; z = upper triangle of S, data = A_h, L_h (column by column) and upper triangle of Q_h."""
    size = n * (n + 1) // 2
    z, d, h = ca.SX.sym("z", size), ca.SX.sym("d", n * n + n * m + size), ca.SX.sym("h")
    place, upper = _indices(n)
    S, Q = (ca.reshape(v[place], n, n) for v in (z, d[n * n + n * m :]))
    A, L = ca.reshape(d[: n * n], n, n), ca.reshape(d[n * n : n * n + n * m], n, m)
    SL = ca.mtimes(S, L)
    # A sum of squares (Joseph's form): no difference of large numbers, whatever the size of S.
    lower = ca.chol(ca.SX.eye(m) + ca.mtimes(L.T, SL)).T
    gain = ca.solve(lower.T, ca.solve(lower, ca.mtimes(SL.T, A)))
    loop = A - ca.mtimes(L, gain)
    before = Q + ca.mtimes([loop.T, S, loop]) + ca.mtimes(gain.T, gain)
    return ca.Function("riccati_step", [z, d, h], [ca.densify(before)[upper]], ["z", "data", "h"], ["before"])


@lru_cache(maxsize=32)
def _tangent_step(n: int) -> ca.Function:
    """(z, data, h) -> z; z = upper triangle of a tangent, data = closed loop (column by column) and upper triangle of its drive."""
    size = n * (n + 1) // 2
    z, d, h = ca.SX.sym("z", size), ca.SX.sym("d", n * n + size), ca.SX.sym("h")
    place, upper = _indices(n)
    loop = ca.reshape(d[: n * n], n, n)
    before = ca.mtimes([loop.T, ca.reshape(z[place], n, n), loop]) + ca.reshape(d[n * n :][place], n, n)
    return ca.Function("tangent_step", [z, d, h], [ca.densify(before)[upper]], ["z", "data", "h"], ["before"])


def _indices(n: int) -> tuple[list[int], list[int]]:
    """Place of every element of a square matrix in its packed triangle, and of every packed element in the matrix by columns."""
    rows, columns = np.triu_indices(n)
    return [int(i) for i in packed_places(n).ravel()], [int(i) for i in rows + n * columns]


@lru_cache(maxsize=128)
def _repeated(step: ca.Function, count: int) -> ca.Function:
    return step.mapaccum(f"{step.name()}s", count, {"base": -1})


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


def _recursion(step: ca.Function, final: Array, matrices: tuple[Array, ...], symmetric: Array, h: Array) -> Array:
    """Values (nb + 1, n, n) at the ends of the steps, latest first."""
    count, n = len(h), final.shape[-1]
    rows, columns = np.triu_indices(n)
    data = [np.swapaxes(v, 1, 2).reshape(count, -1) for v in matrices]
    out = run(_repeated(step, count), final[rows, columns], np.hstack([*data, symmetric[:, rows, columns]]), h)
    return np.concatenate([final[None], out[:, packed_places(n)]])


def _sweep(steps: Steps, final: Array) -> Array:
    """S at the ends of the steps, (nb + 1, n, n), latest first."""
    Ah, Lh, Qh = _elements(steps)
    return _recursion(_step(*Lh.shape[1:]), final, (Ah, Lh), Qh, steps.h)


def _at_points(steps: Steps, at: Flow, ends: Array, tangents: Array) -> tuple[Array, Array]:
    """S (5, nb, n, n) and its tangents (nw, 5, nb, n, n) at the five points of each step."""
    S = at.S + np.linspace(0.0, 1.0, 5)[:, None, None, None] * (ends[1:] - at.S[-1])
    S[0], S[-1] = ends[:-1], ends[1:]
    if not len(tangents):
        return S, np.zeros((0, *S.shape))
    n, drive, turned = S.shape[-1], tangent_drive(steps, at), np.swapaxes(at.inverse, -1, -2)
    pushed = turned[-1] @ drive[:, -1] @ at.inverse[-1]
    step, loop = _tangent_step(n), at.loop
    start = np.array([_recursion(step, end, (loop,), push, steps.h)[:-1] for end, push in zip(tangents, pushed, strict=True)])
    carried = start * at.d[:, :, None] * at.d[:, None, :]
    return S, turned @ (carried[:, None] + drive) @ at.inverse
