"""Predictive allocation: the next few jet cycles at once, trading propellant, surface travel and tracking.

    minimize  sum_k |W (B u_k - v_k)|^2 + impulse |W e_k|^2 + propellant flow'u_k / total flow + travel |S (u_k - u_{k-1})|^2 + |b u_k|^2

with e_k the wrench missed so far (in cycles), over the limits and the rates of the effectors.  Only the first cycle is commanded; then
the horizon moves on.  A sparse quadratic program for OSQP, set up once, warm started; its KKT residuals are computed here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from allocation.core import Allocation, Effectors, allocation
from allocation.qp import Weights, weights_for
from models.checked import Array, ModelError, Status, as_finite, as_scalar, frozen

ACCEPTED = 1e-6  # KKT residual, relative to the largest term, above which a plan is not called solved
SMALLEST = 1e-3  # term that residuals are measured by where all are smaller: a plan that has nothing to do is no failure
_SETTINGS = {
    "eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20000, "polishing": False, "verbose": False, "check_termination": 10,
    "adaptive_rho_interval": 50,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Tradeoff:
    """What a plan weighs, beside 1 for the square of a wrench missed by all that the effectors can do.

    Attributes
    ----------
    horizon : int
        Cycles looked ahead.
    impulse : float
        Of the square of the wrench missed so far: lets a later cycle make good what an earlier one missed.  Where demands stay out of
        reach for long, what is owed piles up and is paid back with errors and propellant; hence 0 unless given.
    propellant : float
        Of all jets firing for a whole cycle.
    travel : float
        Of the square of a surface's move, in parts of its range.
    """

    horizon: int = 8
    impulse: float = 0.0
    propellant: float = 1e-3
    travel: float = 1e-3

    def __post_init__(self) -> None:
        if isinstance(self.horizon, bool) or not isinstance(self.horizon, int) or not 1 <= self.horizon <= 200:
            raise ModelError(f"Tradeoff: horizon must be 1 to 200 cycles, got {self.horizon!r}")
        for name in ("impulse", "propellant", "travel"):
            if as_scalar(f"Tradeoff: {name}", getattr(self, name)) < 0:
                raise ModelError(f"Tradeoff: {name} must be >= 0, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Commands over the horizon.

    Attributes
    ----------
    u : ndarray, shape (H, n)
    status : Status
    kkt : tuple of float
        Primal, dual, gap of the quadratic program, relative.
    """

    u: Array
    status: Status
    kkt: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Planner:
    """One horizon problem, set up once; use :func:`planner`."""

    effectors: Effectors
    dt: float
    tradeoff: Tradeoff
    weights: Weights
    size: Array
    P: sp.csc_matrix
    A: sp.csc_matrix
    solver: Any

    def plan(self, demand: ArrayLike, previous: ArrayLike, missed: ArrayLike | None = None) -> Plan:
        """Plan for the next H cycles.

        Parameters
        ----------
        demand : array_like, shape (H, m)
            Wrench asked for in each of them.
        previous : array_like, shape (n,)
            Commands of the cycle before.
        missed : array_like, shape (m,), optional
            Sum of demand - wrench of the cycles before; zero unless given.
        """
        e, H = self.effectors, self.tradeoff.horizon
        m, n = e.B.shape
        v = e.demands(demand)
        if v.shape != (H, m):
            raise ModelError(f"plan: demand has shape {v.shape}, expected {(H, m)}: one row for each cycle of the horizon")
        before = as_finite("plan: previous", previous) * self.size
        owed = np.zeros(m) if missed is None else as_finite("plan: missed", missed)
        W = self.weights.axis
        q = self._linear(v, before)
        balance = W * v
        balance[0] += W * owed
        lower, upper = np.tile(e.lower * self.size, H), np.tile(e.upper * self.size, H)
        room = np.where(np.isinf(e.rate), 1e6, e.rate * self.dt) * self.size  # OSQP's own infinity is 1e20: far enough is enough
        low_rate, high_rate = np.tile(-room, H), np.tile(room, H)
        low_rate[:n] += before
        high_rate[:n] += before
        low, high = np.concatenate([balance.ravel(), lower, low_rate]), np.concatenate([balance.ravel(), upper, high_rate])
        self.solver.update(q=q, l=low, u=high)
        found = self.solver.solve(raise_error=False)
        x, y = np.asarray(found.x, dtype=float), np.asarray(found.y, dtype=float)
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            held = np.clip(before / self.size, e.lower, e.upper)
            return Plan(frozen(np.tile(held, (H, 1))), Status.INFEASIBLE, (np.inf, np.inf, np.inf))
        kkt = _kkt(self.P, q, self.A, low, high, x, y)
        u = np.clip((x[: n * H] / np.tile(self.size, H)).reshape(H, n), e.lower, e.upper)
        return Plan(frozen(u), Status.OK if max(kkt) <= ACCEPTED else Status.MAX_ITERATIONS, kkt)

    def _linear(self, v: Array, before: Array) -> Array:
        e, H, trade = self.effectors, self.tradeoff.horizon, self.tradeoff
        WB = self.weights.axis[:, None] * e.B / self.size
        total = max(float(e.flow.sum()), 1e-300)
        fuel = trade.propellant * e.flow / total / self.size
        first = -2 * _travel(e, trade, self.size) * before
        lead = np.stack([-2 * WB.T @ (self.weights.axis * row) + fuel - 2 * self._cost * self.weights.preferred * self.size for row in v])
        lead[0] += first
        return np.concatenate([lead.ravel(), np.zeros(H * len(e.axes))])

    @property
    def _cost(self) -> Array:
        return np.asarray((self.weights.effector / self.size) ** 2)


def planner(effectors: Effectors, *, dt: float, tradeoff: Tradeoff | None = None, weights: Weights | None = None) -> Planner:
    """Set up the horizon problem of some effectors.

    Parameters
    ----------
    effectors : Effectors
        Their rates (1/s) limit the moves from cycle to cycle.
    dt : float
        Length of a cycle, s.
    tradeoff : Tradeoff, optional
    weights : Weights, optional
        ``weights_for(effectors)`` unless given.
    """
    import osqp

    period = as_scalar("planner: dt", dt)
    if period <= 0:
        raise ModelError(f"planner: dt must be > 0 s, got {dt}")
    trade, chosen = tradeoff or Tradeoff(), weights or weights_for(effectors)
    m, n = effectors.B.shape
    H = trade.horizon
    made = np.linalg.norm(chosen.axis[:, None] * effectors.B, axis=0)
    size = np.where(made > 0, made, 1.0)
    WB = sp.csc_matrix(chosen.axis[:, None] * effectors.B / size)
    step = sp.eye(H) - sp.eye(H, k=-1)
    travel = sp.diags(_travel(effectors, trade, size))
    tracking = sp.kron(sp.eye(H), WB.T @ WB + sp.diags((chosen.effector / size) ** 2))
    # e_k - e_{k-1} + W B u_k = W v_k: e is what is still owed
    P = 2 * sp.block_diag([tracking + sp.kron(step.T @ step, travel), trade.impulse * sp.eye(H * m)], format="csc")
    A = sp.vstack([
        sp.hstack([sp.kron(sp.eye(H), WB), sp.kron(step, sp.eye(m))]),
        sp.hstack([sp.eye(n * H), sp.csc_matrix((n * H, H * m))]),
        sp.hstack([sp.kron(step, sp.eye(n)), sp.csc_matrix((n * H, H * m))]),
    ], format="csc")  # fmt: skip
    solver = osqp.OSQP()
    wide = np.full(A.shape[0], 1e6)
    solver.setup(sp.triu(P, format="csc"), np.zeros(P.shape[0]), A, -wide, wide, **_SETTINGS)
    return Planner(effectors, period, trade, chosen, frozen(size), P, A, solver)


def receding_horizon(
    effectors: Effectors, demand: ArrayLike, *, dt: float, tradeoff: Tradeoff | None = None, weights: Weights | None = None
) -> Allocation:
    """Commands for demands (N, m) that follow each other every dt (s): the first cycle of a new plan in each of them.

    The demand of the cycles ahead is known, that after the last one held: what a preview of the law's demand would buy.
    """
    values = effectors.demands(demand)
    if values.ndim != 2:
        raise ModelError(f"predictive: demand has shape {values.shape}, expected (N, {len(effectors.axes)})")
    made = planner(effectors, dt=dt, tradeoff=tradeoff, weights=weights)
    H = made.tradeoff.horizon
    ahead = np.vstack([values, np.repeat(values[-1:], H, axis=0)])
    u, owed = np.clip(0.0, effectors.lower, effectors.upper), np.zeros(len(effectors.axes))
    commands, kkt, states = [], [], []
    for k, v in enumerate(values):
        found = made.plan(ahead[k : k + H], u, owed)
        u = found.u[0]
        owed = owed + v - effectors.B @ u
        commands.append(u)
        kkt.append(found.kkt)
        states.append(found.status)
    table = np.array(kkt).T
    return allocation(effectors, values, u=np.array(commands), status=states, kkt=(table[0], table[1], table[2]), method="predictive")


def _travel(effectors: Effectors, trade: Tradeoff, size: Array) -> Array:
    """Weight of the square of a scaled move; jets may switch freely."""
    span = np.where(effectors.upper > effectors.lower, effectors.upper - effectors.lower, 1.0)
    return np.asarray(np.where(effectors.jets, 0.0, trade.travel / (span * size) ** 2))


def _kkt(P: sp.csc_matrix, q: Array, A: sp.csc_matrix, low: Array, high: Array, x: Array, y: Array) -> tuple[float, float, float]:
    """Primal, dual and complementarity residuals, each relative to the largest term in it, at least to SMALLEST."""
    Ax, Px, Ay = A @ x, P @ x, A.T @ y
    primal = np.maximum(np.maximum(low - Ax, Ax - high), 0.0).max() / max(float(np.abs(Ax).max()), SMALLEST)
    scale = max(float(np.abs(v).max()) for v in (Px, q, Ay))
    dual = np.abs(Px + q + Ay).max() / max(scale, SMALLEST)
    slack = np.where(y > 0, high - Ax, Ax - low)
    gap = float(np.abs(y) @ np.abs(slack)) / max(abs(float(x @ Px)) + abs(float(q @ x)), SMALLEST)
    return float(primal), float(dual), gap
