"""What jets that are on or off could do at best within one jet cycle: a mixed-integer program, solved by HiGHS with its own proof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.optimize import Bounds, LinearConstraint, milp

from allocation.core import Allocation, Effectors, allocation
from allocation.qp import Weights, weights_for
from models.checked import Array, ModelError, Status, as_finite, as_scalar, frozen

PROPELLANT = 1e-3  # cost of all jets for a whole cycle, beside 1 for the axis of the highest priority missed by all that it can do
OPPOSED = -0.99  # cosine of the angle between the columns of two jets that fire against each other, 8 degrees from antiparallel


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """Answers of the mixed-integer program.

    Attributes
    ----------
    allocation : Allocation
        kkt = (primal, not a number, relative gap between cost and proof).
    cost, proof : ndarray, shape () or (N,)
        Weighted error and propellant of the answer (see :func:`on_off`), and what no command of that kind can go below.
    """

    allocation: Allocation
    cost: Array
    proof: Array


def on_off(
    effectors: Effectors,
    demand: ArrayLike,
    *,
    weights: Weights | None = None,
    shortest: float = 1.0,
    opposed: bool = True,
    gap: float = 1e-4,
    time_limit: float = 5.0,
) -> Bound:
    """Least weighted sum of absolute errors and propellant over jets that fire for at least a part of the cycle.

    The cost is sum_k p_k |B u - v|_k / s_k + PROPELLANT (flow u) / (flow of all jets).  Here s_k is what all effectors together could
    deliver on the axis (:func:`allocation.qp.weights_for`), and p_k is W_k s_k in parts of the largest one: only ratios of weights count.

    Parameters
    ----------
    effectors : Effectors
        Those with a flow are jets (u = 0, or shortest <= u <= 1); the others move freely between their limits.
    demand : array_like, shape (m,) or (N, m)
        Mean wrench over the cycle.
    weights : Weights, optional
        Only the ratios of `axis` are used.
    shortest : float
        Shortest pulse over the cycle, 0 to 1; 1: on or off for the whole cycle.
    opposed : bool
        May jets fire against each other?  Two of different strength can meet a demand below that of either with their
        difference, which is the least error and burns far more than that is worth.  False: of two movable jets whose columns are
        antiparallel (cosine below :data:`OPPOSED`, axes weighted as in the cost) at most one fires.
    gap : float
        Relative gap between cost and proof at which the search ends.
    time_limit : float
        s, for each demand; an answer whose proof did not get that far has Status.UNDECIDED, and its proof still holds.

    Returns
    -------
    Bound

    Raises
    ------
    ModelError
        A demand that does not fit or is not finite, `shortest` outside [0, 1].
    """
    values = effectors.demands(demand)
    least = as_scalar("on_off: shortest", shortest)
    if not 0 <= least <= 1:
        raise ModelError(f"on_off: shortest must lie in [0, 1], got {shortest}; it is a part of the cycle")
    chosen = weights or weights_for(effectors)
    program = _program(effectors, chosen, least, opposed)
    found = [_one(program, v, gap, time_limit) for v in np.atleast_2d(values)]
    u, cost, proof = (np.array(column) for column in zip(*(f[:3] for f in found), strict=True))
    relative = (cost - proof) / np.maximum(cost, 1e-12)
    states = [f[3] for f in found]
    none = np.full(len(u), np.nan)
    if values.ndim == 1:
        answer = allocation(effectors, values, u=u[0], status=states[0], kkt=(0.0, np.nan, relative[0]), method="on-off bound")
        return Bound(answer, frozen(cost[0]), frozen(proof[0]))
    answer = allocation(effectors, values, u=u, status=states, kkt=(np.zeros(len(u)), none, relative), method="on-off bound")
    return Bound(answer, frozen(cost), frozen(proof))


@dataclass(frozen=True, slots=True, eq=False)
class _Program:
    """What is the same for every demand: variables are u (n), over- and under-delivery (m, m), firing of each movable jet (j)."""

    effectors: Effectors
    jets: np.ndarray
    axis: Array
    fuel: Array
    least: float
    errors: sp.csr_matrix
    firing: list[LinearConstraint]


def _program(effectors: Effectors, weights: Weights, least: float, opposed: bool) -> _Program:
    B, flow = effectors.B, effectors.flow
    m, n = B.shape
    jets = np.flatnonzero(effectors.jets & (effectors.upper > effectors.lower))
    j = len(jets)
    able = np.abs(B) @ np.maximum(np.abs(effectors.lower), np.abs(effectors.upper))
    top_priority = float(np.max(weights.axis * able)) or 1.0  # nothing acts: any scale will do
    W = weights.axis / top_priority
    fuel = np.zeros(n)  # what jammed jets burn is no choice
    fuel[jets] = PROPELLANT * flow[jets] / float(flow.sum() or 1.0)
    errors = sp.hstack([sp.csr_matrix(W[:, None] * B), -sp.eye(m), sp.eye(m), sp.csr_matrix((m, j))]).tocsr()
    firing = []
    if j:
        pick = sp.csr_matrix((np.ones(j), (np.arange(j), jets)), shape=(j, n))
        none, top = sp.csr_matrix((j, 2 * m)), sp.diags(effectors.upper[jets])
        firing.append(LinearConstraint(sp.hstack([pick, none, -top]).tocsr(), -np.inf, 0.0))
        firing.append(LinearConstraint(sp.hstack([pick, none, -least * top]).tocsr(), 0.0, np.inf))
    pairs = np.zeros((0, 2), dtype=int) if opposed else _opposed(W[:, None] * B[:, jets], effectors.lower[jets] > 0)
    if k := len(pairs):
        one_of = sp.csr_matrix((np.ones(2 * k), (np.repeat(np.arange(k), 2), pairs.ravel())), shape=(k, j))
        firing.append(LinearConstraint(sp.hstack([sp.csr_matrix((k, n + 2 * m)), one_of]).tocsr(), -np.inf, 1.0))
    return _Program(effectors, jets, W, fuel, least, errors, firing)


def _opposed(columns: Array, always: np.ndarray) -> np.ndarray:
    """Pairs (k, 2) of columns that point against each other; jets that may not stop are in none."""
    size = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(size > 0, size, 1.0)
    against = (unit.T @ unit < OPPOSED) & ~always[:, None] & ~always[None, :]
    return np.argwhere(np.triu(against))


def _one(program: _Program, v: Array, gap: float, time_limit: float) -> tuple[Array, float, float, Status]:
    """Commands, cost, proof and status for one demand (m,)."""
    effectors, jets, W, fuel = program.effectors, program.jets, program.axis, program.fuel
    m, n = effectors.B.shape
    j = len(jets)
    lower = np.concatenate([effectors.lower, np.zeros(2 * m + j)])
    upper = np.concatenate([effectors.upper, np.full(2 * m, np.inf), np.ones(j)])
    found = milp(
        np.concatenate([fuel, np.ones(2 * m), np.zeros(j)]), bounds=Bounds(lower, upper),
        constraints=[LinearConstraint(program.errors, W * v, W * v), *program.firing],
        integrality=np.concatenate([np.zeros(n + 2 * m), np.ones(j)]),
        options={"mip_rel_gap": gap, "time_limit": time_limit, "presolve": True},
    )  # fmt: skip
    if found.x is None:  # nothing found in time: no jets and surfaces at rest are a command, and zero bounds every cost
        u = np.clip(0.0, effectors.lower, effectors.upper)
        return u, float(np.abs(W * (effectors.B @ u - v)).sum() + fuel @ u), 0.0, Status.UNDECIDED
    x = as_finite("on_off", found.x)
    u = x[:n].copy()
    firing = np.round(x[n + 2 * m :])
    u[jets] = np.clip(u[jets], program.least * firing * effectors.upper[jets], firing * effectors.upper[jets])
    u = np.clip(u, effectors.lower, effectors.upper)
    value = float(np.abs(W * (effectors.B @ u - v)).sum() + fuel @ u)
    proof = float(found.mip_dual_bound) if j and found.mip_dual_bound is not None else float(found.fun)
    status = Status.OK if found.status == 0 else Status.UNDECIDED
    return u, value, min(proof, value), status
