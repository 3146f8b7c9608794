"""What jets that are on or off could do at best: a mixed-integer program for one jet cycle, solved by HiGHS with its own proof."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.optimize import Bounds, LinearConstraint, milp

from allocation.core import Allocation, Effectors, allocation
from allocation.qp import Weights, weights_for
from models.checked import Array, ModelError, Status, as_finite, as_scalar, frozen

PROPELLANT = 1e-3  # cost of all jets for a whole cycle, beside 1 for an axis missed by all that it can do


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """Answers of the mixed-integer program.

    Attributes
    ----------
    allocation : Allocation
        kkt = (primal, not a number, relative gap between cost and proof).
    cost, proof : ndarray, shape () or (N,)
        Weighted error and propellant of the answer, and what no command whatever can go below.
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
    gap: float = 1e-4,
    time_limit: float = 5.0,
) -> Bound:
    """Least weighted sum of absolute errors, W_k |B u - v|_k, and propellant over jets that fire for at least a part of the cycle.

    Parameters
    ----------
    effectors : Effectors
        Those with a flow are jets (u = 0, or shortest <= u <= 1); the others move freely between their limits.
    demand : array_like, shape (m,) or (N, m)
        Mean wrench over the cycle.
    weights : Weights, optional
        Only `axis` is used.
    shortest : float
        Shortest pulse over the cycle, 0 to 1; 1: on or off for the whole cycle.
    gap : float
        Relative gap between cost and proof at which the search ends.
    time_limit : float
        s, for each demand; an answer whose proof did not get that far has Status.UNDECIDED, and its proof still holds.
    """
    values = effectors.demands(demand)
    least = as_scalar("on_off: shortest", shortest)
    if not 0 <= least <= 1:
        raise ModelError(f"on_off: shortest must lie in [0, 1], got {shortest}; it is a part of the cycle")
    chosen = weights or weights_for(effectors)
    found = [_one(effectors, v, chosen, least, gap, time_limit) for v in np.atleast_2d(values)]
    u, cost, proof = (np.array(column) for column in zip(*(f[:3] for f in found), strict=True))
    relative = (cost - proof) / np.maximum(cost, 1e-12)
    states = [f[3] for f in found]
    none = np.full(len(u), np.nan)
    if values.ndim == 1:
        answer = allocation(effectors, values, u=u[0], status=states[0], kkt=(0.0, np.nan, relative[0]), method="on-off bound")
        return Bound(answer, frozen(cost[0]), frozen(proof[0]))
    answer = allocation(effectors, values, u=u, status=states, kkt=(np.zeros(len(u)), none, relative), method="on-off bound")
    return Bound(answer, frozen(cost), frozen(proof))


def _one(
    effectors: Effectors, v: Array, weights: Weights, least: float, gap: float, time_limit: float
) -> tuple[Array, float, float, Status]:
    """Variables: u (n), over- and under-delivery (m, m), firing of each jet (j)."""
    m, n = effectors.B.shape
    jets = np.flatnonzero(effectors.jets & (effectors.upper > effectors.lower))
    j = len(jets)
    W = weights.axis
    total = max(float(effectors.flow[jets].sum()), 1e-300)
    fuel = np.where(effectors.jets, PROPELLANT * effectors.flow / total, 0.0)
    cost = np.concatenate([fuel, np.ones(2 * m), np.zeros(j)])
    rows = sp.hstack([sp.csr_matrix(W[:, None] * effectors.B), -sp.eye(m), sp.eye(m), sp.csr_matrix((m, j))])
    pick = sp.csr_matrix((np.ones(j), (np.arange(j), jets)), shape=(j, n))
    none = sp.csr_matrix((j, 2 * m))
    constraints = [LinearConstraint(rows.tocsr(), W * v, W * v)]
    if j:
        top = sp.diags(effectors.upper[jets])
        constraints.append(LinearConstraint(sp.hstack([pick, none, -top]).tocsr(), -np.inf, 0.0))
        constraints.append(LinearConstraint(sp.hstack([pick, none, -least * top]).tocsr(), 0.0, np.inf))
    lower = np.concatenate([effectors.lower, np.zeros(2 * m + j)])
    upper = np.concatenate([effectors.upper, np.full(2 * m, np.inf), np.ones(j)])
    integral = np.concatenate([np.zeros(n + 2 * m), np.ones(j)])
    found = milp(
        cost, constraints=constraints, bounds=Bounds(lower, upper), integrality=integral,
        options={"mip_rel_gap": gap, "time_limit": time_limit, "presolve": True},
    )  # fmt: skip
    if found.x is None:  # nothing found in time: no jets and surfaces at rest are a command, and zero bounds every cost
        u = np.clip(0.0, effectors.lower, effectors.upper)
        return u, float(np.abs(W * (effectors.B @ u - v)).sum()), 0.0, Status.UNDECIDED
    x = as_finite("on_off", found.x)
    u = x[:n].copy()
    firing = np.round(x[n + 2 * m :])
    u[jets] = np.clip(u[jets], least * firing * effectors.upper[jets], firing * effectors.upper[jets])
    u = np.clip(u, effectors.lower, effectors.upper)
    value = float(np.abs(W * (effectors.B @ u - v)).sum() + fuel @ u)
    proof = float(found.mip_dual_bound) if j and found.mip_dual_bound is not None else float(found.fun)
    status = Status.OK if found.status == 0 else Status.UNDECIDED
    return u, value, min(proof, value), status
