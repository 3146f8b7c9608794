"""The classical baselines: weighted pseudo-inverse, redistributed pseudo-inverse, daisy chain; all demands of a batch at once.

They solve no bounded problem, so their KKT residuals are not numbers; their residuals tell what they missed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from allocation.core import Allocation, Effectors, allocation
from allocation.qp import Weights, weights_for
from models.checked import Array, ModelError

CUTOFF = 1e-12  # singular values below this part of the largest are zero


def weighted(effectors: Effectors, demand: ArrayLike, *, weights: Weights | None = None) -> Allocation:
    """Least-cost commands that meet the demand exactly, cut off at the limits: u = p + C B' (B C B')^+ (v - B p), C = diag(1/b^2).

    Parameters
    ----------
    effectors : Effectors
    demand : array_like, shape (m,) or (N, m)
    weights : Weights, optional
        Only `effector` and `preferred` are used.
    """
    values = effectors.demands(demand)
    chosen = weights or weights_for(effectors)
    start = np.broadcast_to(chosen.preferred, (*values.shape[:-1], len(effectors.names)))
    free = np.ones(start.shape, dtype=bool)
    u = _meet(effectors, values, start, free, chosen)
    limits = (effectors.lower, effectors.upper)
    return allocation(effectors, values, u=np.clip(u, *limits), method="pseudo-inverse")


def redistributed(effectors: Effectors, demand: ArrayLike, *, weights: Weights | None = None) -> Allocation:
    """As :func:`weighted`, and what saturated effectors leave is asked of the others, until none saturates any more (at most n times).

    A saturated effector stays at its limit, also where that turns out wrong: this is why the method misses demands that can be met.

    Source: D. Bordignon, Constrained control allocation for systems with redundant control effectors, Virginia Tech, 1996.
    """
    values = effectors.demands(demand)
    chosen = weights or weights_for(effectors)
    n = len(effectors.names)
    u = np.broadcast_to(np.clip(chosen.preferred, effectors.lower, effectors.upper), (*values.shape[:-1], n)).copy()
    free = np.broadcast_to(effectors.upper > effectors.lower, u.shape)
    return allocation(effectors, values, u=_redistribute(effectors, values, u, free, chosen), method="redistributed")


def _redistribute(effectors: Effectors, demand: Array, u: Array, free: np.ndarray, weights: Weights) -> Array:
    """Commands u with the free ones changed: by pseudo-inverse, those beyond a limit fixed there, again and again."""
    free, start = free.copy(), np.where(free, weights.preferred, u)
    for _ in range(len(effectors.names)):
        raw = _meet(effectors, demand, start, free, weights)
        u = np.where(free, np.clip(raw, effectors.lower, effectors.upper), u)
        beyond = free & ((raw > effectors.upper) | (raw < effectors.lower))
        if not beyond.any():
            break
        free &= ~beyond
        start = np.where(free, weights.preferred, u)
    return u


def daisy_chain(effectors: Effectors, demand: ArrayLike, *, groups: Sequence[Sequence[str]], weights: Weights | None = None) -> Allocation:
    """Groups in the order of preference: each gets what the groups before it left, by redistributed pseudo-inverse.

    Parameters
    ----------
    groups : sequence of sequences of names
        Every effector in at most one of them; those in none stay at the limit nearest to zero.

    Raises
    ------
    ModelError
        An unknown name, or one that stands twice.
    """
    values = effectors.demands(demand)
    chosen = weights or weights_for(effectors)
    n, taken = len(effectors.names), set[str]()
    u = np.broadcast_to(np.clip(0.0, effectors.lower, effectors.upper), (*values.shape[:-1], n)).copy()
    for group in groups:
        columns = np.zeros(n, dtype=bool)
        for name in group:
            columns[effectors.index(name)] = True
            if name in taken:
                raise ModelError(f"daisy_chain: {name} stands in two groups; name each effector once")
            taken.add(name)
        u = _redistribute(effectors, values, u, np.broadcast_to(columns & (effectors.upper > effectors.lower), u.shape), chosen)
    return allocation(effectors, values, u=u, method="daisy chain")


def _meet(effectors: Effectors, demand: Array, start: Array, free: np.ndarray, weights: Weights) -> Array:
    """Change the free commands at least cost so that the demand is met (in the least-squares sense where it cannot be)."""
    B = weights.axis[:, None] * effectors.B  # rows comparable, so that the cutoff means the same for each
    compliance = free / weights.effector**2
    scale = compliance.max(axis=-1, keepdims=True)
    compliance = compliance / np.where(scale > 0, scale, 1.0)
    matrix = np.einsum("in,...n,jn->...ij", B, compliance, B)
    missing = weights.axis * (demand - start @ effectors.B.T)
    prices = np.einsum("...ij,...j->...i", np.linalg.pinv(matrix, rcond=CUTOFF, hermitian=True), missing)
    return np.asarray(start + compliance * (prices @ B))
