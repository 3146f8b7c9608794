"""What any law could reach: the nearest reachable point to a target, and the boundary of the reachable landing set.

The bank angle is free at nodes over the flight; the landing point and its derivatives to every node come from the compiled
prediction, and all targets and starts are optimized at once by a quasi-Newton method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from models import native
from models.core import Array, Model, ModelError, Status, as_finite, as_vector, frozen
from ocp.landing import Target
from ocp.predictor import Path, prediction

Cost = Callable[[Array, np.ndarray], tuple[Array, Array, Array]]  # (bank angles (M, K), rows (M,)) -> (value, gradient, miss)
NODES = 8
STEPS = 128
REACHED = 1e3  # m: a target nearer than this to the reachable set counts as reachable
_STARTS = np.radians(  # sides and sizes in the first and in the second half of the flight
    np.repeat([[60, 60], [-60, -60], [60, -60], [-60, 60], [0, 0], [150, 150], [110, 0], [10, 120]], NODES // 2, axis=1).astype(float)
)


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Nearest reachable points to N targets.

    Attributes
    ----------
    miss : ndarray, shape (N, 2)
        Where they lie, m, as misses of the reference target.
    distance : ndarray, shape (N,)
        From the targets asked for, m.
    t : ndarray, shape (K,)
        Nodes, s.
    bank : ndarray, shape (N, K)
        Bank angles there, rad; straight lines between them.
    status : tuple of Status, length N
        OK, or OUTSIDE_FOOTPRINT where the distance exceeds a kilometre.
    """

    miss: Array
    distance: Array
    t: Array
    bank: Array
    status: tuple[Status, ...]


@lru_cache(maxsize=8)
def _compiled(model: Model, radius: float) -> native.Native:
    return native.compile(prediction(model, Path(NODES, STEPS), radius=radius, seeds=NODES), mode="fast")


def nearest(
    model: Model, target: Target, *, x: ArrayLike, radius: float, t: float = 0.0, t_f: float = 540.0, p: ArrayLike | None = None,
    wanted: ArrayLike = ((0.0, 0.0),), weights: tuple[float, float] = (1.0, 1.0), iterations: int = 80,
) -> Reach:  # fmt: skip
    """Nearest points to `wanted` that a free bank profile can reach.

    Parameters
    ----------
    model : Model
        As for :func:`ocp.predictor.prediction`; give it the parameters of the case to be judged.
    target : Target
        In whose axes misses are told.
    x : array_like, shape (6,)
        State at time t.
    radius : float
        Stop, m.
    t, t_f : float
        Present time and about the time of landing, s: the nodes are laid between them.
    p : array_like, shape (np,), optional
    wanted : array_like, shape (N, 2)
        Points to be reached, as misses of the target, m.
    weights : tuple of float
        Of downrange and cross-range in the distance that is minimized.
    iterations : int

    Raises
    ------
    ModelError
        A wrong shape, or a state from which no start lands.
    """
    goals = as_finite("nearest: wanted", wanted)
    if goals.ndim != 2 or goals.shape[1] != 2 or len(goals) == 0:
        raise ModelError(f"nearest: wanted: expected shape (N, 2), got {goals.shape}; give (downrange, cross-range) in m")
    state, params = as_vector("x", x, model.states), model.parameters(p)
    span = max(t_f - t, 20.0)
    times = t + span * np.linspace(0.12, 1.0, NODES)
    count, starts = len(goals), len(_STARTS)
    goal, u = np.repeat(goals, starts, axis=0), np.tile(_STARTS, (count, 1))
    flown = _compiled(model, radius)
    weight = np.asarray(weights, dtype=float)

    def cost(bank: Array, rows: np.ndarray) -> tuple[Array, Array, Array]:
        miss, J = _predicted(flown, target, state, params, (t, 1.6 * span, times), bank)
        rest = (miss - goal[rows]) * weight / 1e5
        value = np.where(np.isfinite(miss).all(axis=1), 0.5 * np.sum(rest**2, axis=1), np.inf)
        return value, np.einsum("ni,nij->nj", np.where(np.isfinite(rest), rest, 0.0) * weight / 1e5, J), miss

    value, u, miss = _minimized(cost, u, iterations)
    best = np.argmin(value.reshape(count, starts), axis=1) + starts * np.arange(count)
    if not np.isfinite(value[best]).all():
        raise ModelError("nearest: no bank profile lands from this state; it skips out or starts below the stop altitude")
    found = miss[best]
    distance = np.hypot(*(found - goals).T)
    status = tuple(Status.OK if d <= REACHED else Status.OUTSIDE_FOOTPRINT for d in distance)
    return Reach(frozen(found), frozen(distance), frozen(times), frozen(u[best]), status)


def boundary(
    model: Model, target: Target, *, x: ArrayLike, radius: float, t: float = 0.0, t_f: float = 540.0, p: ArrayLike | None = None,
    points: int = 15,
) -> Array:  # fmt: skip
    """Boundary of the reachable landing set: closed polygon of misses (M, 2), m, of the greatest cross-range at each downrange.

    Parameters are those of :func:`nearest`; `points` is the number of downranges on each side.
    """
    far = 4e6
    given = {"x": x, "radius": radius, "t": t, "t_f": t_f, "p": p}
    ends = nearest(model, target, wanted=[[-far, 0.0], [far, 0.0]], **given).miss  # type: ignore[arg-type]
    part = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, points + 2)[1:-1])
    along = ends[0, 0] + part * (ends[1, 0] - ends[0, 0])
    wide = 3e5
    goals = np.concatenate([np.column_stack([along, np.full(points, side * wide)]) for side in (1.0, -1.0)])
    sides = nearest(model, target, wanted=goals, weights=(8.0, 1.0), **given).miss  # type: ignore[arg-type]
    ring = np.vstack([ends[:1], sides[:points], ends[1:], sides[points:][::-1], ends[:1]])
    return np.asarray(ring)


def _predicted(
    flown: native.Native, target: Target, x: Array, p: Array, when: tuple[float, float, Array], bank: Array
) -> tuple[Array, Array]:
    """Misses (M, 2), NaN where the flight does not land, and their derivatives (M, 2, K) to the bank angles."""
    t, horizon, times = when
    eye = np.eye(NODES).ravel()
    zeros = [np.zeros(NODES * n) for n in (6, NODES)]
    out, finite = flown.run(x, np.array([t]), np.array([horizon]), times, bank, p, zeros[0], zeros[1], eye, np.zeros(NODES * len(p)))
    r, slope = out[0][:, :3], out[4].reshape(len(bank), NODES, 6)[:, :, :3]
    size = np.linalg.norm(r, axis=1, keepdims=True)
    unit = r / size
    along, up = unit @ target.along, unit @ target.up
    level = along**2 + up**2
    rows = [(up[:, None] * target.along - along[:, None] * target.up) / level[:, None], target.right / np.sqrt(level)[:, None]]
    by_r = np.stack(rows, axis=1) * (target.radius / size)[:, :, None]
    good = finite & (out[2][:, 0] > 0)
    miss = np.where(good[:, None], target.miss(np.where(np.isfinite(r), r, 1.0)), np.nan)
    # of the unit vector only what is across it counts; the landing points lie at one radius, so that nothing is along it
    return miss, np.nan_to_num(np.einsum("nik,njk->nij", by_r, slope))


def _minimized(cost: Cost, u: Array, iterations: int) -> tuple[Array, Array, Array]:
    """BFGS with a backtracking line search for many cases at once: (value, u, miss)."""
    n, k = u.shape
    rows = np.arange(n)
    value, g, miss = cost(u, rows)
    H = np.tile(np.eye(k) * 0.05, (n, 1, 1))
    active = np.isfinite(value)
    for _ in range(iterations):
        if not active.any():
            break
        i = np.flatnonzero(active)
        d = -np.einsum("nij,nj->ni", H[i], g[i])
        slope = np.einsum("ni,ni->n", d, g[i])
        d *= np.minimum(1.0, 0.7 / np.maximum(np.abs(d).max(axis=1), 1e-300))[:, None]
        step, todo = np.ones(len(i)), np.ones(len(i), dtype=bool)
        new = (value[i].copy(), g[i].copy(), miss[i].copy(), u[i].copy())
        for _ in range(8):
            j = np.flatnonzero(todo)
            trial = u[i[j]] + step[j, None] * d[j]
            v, gradient, m = cost(trial, i[j])
            good = v < value[i[j]] + 1e-4 * step[j] * np.minimum(slope[j], 0)
            for into, what in zip(new, (v, gradient, m, trial), strict=True):
                into[j[good]] = what[good]
            todo[j[good]] = False
            step[j[~good]] *= 0.3
            if not todo.any():
                break
        s, y = new[3] - u[i], new[1] - g[i]
        H[i] = _updated(H[i], s, y)
        gain = value[i] - new[0]
        value[i], g[i], miss[i], u[i] = new
        active[i] = gain > 1e-9 * np.maximum(value[i], 1e-8)
    return value, u, miss


def _updated(H: Array, s: Array, y: Array) -> Array:
    """Inverse Hessians after a step s with a change y of the gradient; unchanged without positive curvature."""
    sy = np.einsum("ni,ni->n", s, y)
    good = sy > 1e-12 * np.linalg.norm(s, axis=1) * np.linalg.norm(y, axis=1)
    rho = np.where(good, 1 / np.where(good, sy, 1.0), 0.0)
    left = np.eye(s.shape[1]) - rho[:, None, None] * np.einsum("ni,nj->nij", s, y)
    return np.asarray(np.einsum("nij,njk,nlk->nil", left, H, left) + rho[:, None, None] * np.einsum("ni,nj->nij", s, s))
