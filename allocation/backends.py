"""Other people's solvers on the same quadratic program: OSQP through its own interface, the rest through qpsolvers.

Each gets the problem in the same normalized form, with refinement: variables in parts of the demand, and a ratio of at most 0.03
between the largest cost and the tracking weight.  At the wanted ratio of 3e-4 a first-order method calls an answer solved that gives
half of the demand to each of two effectors, since its own measure is dominated by W^2.  What the milder ratio leaves of the demand is
added to it, and the problem solved again (method of multipliers), until the KKT residuals of the *wanted* problem are small; they,
and not the solver's word, decide.  Some are asked for the wanted problem first (``AT_ONCE``); the best answer counts.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp

from models.checked import Array, ModelError, as_finite

MILD = 0.03
ACCEPTED = 1e-5  # KKT residual above which an answer of a back end is not called solved
REFINEMENTS = 8
FEWEST = 3  # before no gain means the end
ENOUGH = 1e-10  # KKT residual at which refinement ends
# These may well solve the wanted problem itself and are asked for it first; OSQP and proxqp stop short of it, and HiGHS can go round
# in circles on it.
AT_ONCE = ("clarabel", "daqp", "lsq_linear", "piqp", "quadprog")
_SPARSE = ("clarabel", "highs", "osqp")
_OPTIONS: dict[str, dict[str, Any]] = {
    "clarabel": {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11},
    "piqp": {
        "eps_abs": 1e-13, "eps_rel": 0.0, "eps_duality_gap_abs": 1e-14, "eps_duality_gap_rel": 0.0, "reg_lower_limit": 1e-13,
        "reg_finetune_lower_limit": 1e-14,
    },
    "proxqp": {"eps_abs": 1e-12, "eps_rel": 0.0},
    "highs": {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10, "qp_regularization_value": 0.0},
}  # fmt: skip
_OSQP = {
    "eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20000, "polishing": False, "verbose": False, "check_termination": 10,
    "adaptive_rho_interval": 50, "warm_starting": True,
}  # fmt: skip


@cache
def available() -> tuple[str, ...]:
    """Names of the back ends that are installed; "osqp" uses its own interface, "lsq_linear" is SciPy's."""
    import qpsolvers

    known = ("osqp", "clarabel", "daqp", "highs", "piqp", "proxqp", "quadprog")
    return (*(name for name in known if name == "osqp" or name in qpsolvers.available_solvers), "lsq_linear")


@dataclass(slots=True)
class Backend:
    """One solver with the constant data of a sequence of problems; use :meth:`of`.  It keeps its last answer as a warm start."""

    name: str
    B: Array
    axis: Array
    effector: Array
    preferred: Array
    osqp: Any = None

    @classmethod
    def of(cls, name: str, B: Array, *, axis: Array, effector: Array, preferred: Array) -> Backend:
        """A back end by name.

        Raises
        ------
        ModelError
            Unknown, or not installed.
        """
        if name not in available():
            raise ModelError(f"allocate: method {name!r} is not installed or unknown; known: active_set, {', '.join(available())}")
        return cls(name, as_finite("B", B), axis, effector, preferred)

    def solve(
        self, demand: Array, *, lower: Array, upper: Array, B: Array | None = None, axis: Array | None = None, effector: Array | None = None
    ) -> tuple[Array, Array]:
        """Commands u (n,) and KKT residuals (3,) of the wanted problem.

        Parameters
        ----------
        demand : ndarray, shape (m,)
        lower, upper : ndarray, shape (n,)
        B, axis, effector : ndarray, optional
            Instead of those given at the start.
        """
        v = as_finite("demand", demand)
        matrix = self.B if B is None else as_finite("B", B)
        W, b = (self.axis if axis is None else axis), (self.effector if effector is None else effector)
        scaled = _Scaled.of(matrix, v, W, b, self.preferred, lower, upper)

        def judged(z: Array, price: Array) -> tuple[Array, Array]:
            """Commands with the better of two proofs: that price, and W^2 times what is missed, sharper where much is missed."""
            u = np.clip(z / scaled.size, lower, upper)
            limits = {"lower": lower, "upper": upper, "axis": W, "effector": b, "preferred": self.preferred}
            proofs = [residuals(matrix, v, u, **limits, price=y) for y in (price * scaled.unit * W, None)]
            return u, min(proofs, key=lambda r: float(r.max()))

        best: tuple[Array, Array] = np.clip(self.preferred, lower, upper), np.full(3, np.inf)
        if self.name in AT_ONCE and scaled.mild < 1:
            z = self._once(replace(scaled, mild=1.0), scaled.v)
            best = best if z is None else judged(z, scaled.v - scaled.A @ z)
        price = np.zeros(len(v))  # of the scaled problem, W^2 (v - B u)
        for tries in range(1 + REFINEMENTS):
            if best[1].max() <= ENOUGH:
                break
            target = scaled.v + price * (1 / scaled.mild**2 - 1)
            z = self._once(scaled, target)
            if z is None:
                break
            price = scaled.mild**2 * (target - scaled.A @ z)
            found = judged(z, price)
            gained = found[1].max() < 0.5 * best[1].max()
            best = min(best, found, key=lambda one: float(one[1].max()))
            if not (gained or tries < FEWEST):
                break
        return best

    def _once(self, s: _Scaled, target: Array) -> Array | None:
        """Minimizer of |A z - target|^2 + |weight (z - preferred)/mild|^2 over the limits, all scaled; None if the solver gives up."""
        cost = s.weight / s.mild
        if self.name == "osqp":
            P = s.A.T @ s.A + np.diag(cost**2)
            return self._osqp(P, -(s.A.T @ target) - cost**2 * s.preferred, s)
        free = s.upper > s.lower  # fixed variables are no variables: interior-point methods have no interior there
        z = s.lower.copy()
        if not free.any():
            return z
        A, rest = s.A[:, free], target - s.A[:, ~free] @ z[~free]
        if self.name == "lsq_linear":
            from scipy.optimize import lsq_linear

            right = np.concatenate([rest, (cost * s.preferred)[free]])
            stacked = np.vstack([A, np.diag(cost[free])])
            z[free] = lsq_linear(stacked, right, (s.lower[free], s.upper[free]), method="bvls", tol=1e-15, max_iter=500).x
            return z
        found = self._qpsolvers(
            A.T @ A + np.diag(cost[free] ** 2), -(A.T @ rest) - (cost**2 * s.preferred)[free], s.lower[free], s.upper[free]
        )
        if found is None or not np.isfinite(found).all():
            return None
        z[free] = found
        return z

    def _qpsolvers(self, P: Array, q: Array, lower: Array, upper: Array) -> Array | None:
        import qpsolvers

        problem = qpsolvers.Problem(sp.csc_matrix(P) if self.name in _SPARSE else P, q, lb=lower, ub=upper)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of "almost solved": the residuals are judged here
                found = qpsolvers.solve_problem(problem, self.name, **_OPTIONS.get(self.name, {}))
        except (qpsolvers.QPError, ValueError):  # quadprog: a matrix that is not positive definite to its taste
            return None
        return None if found.x is None else np.asarray(found.x, dtype=float)

    def _osqp(self, P: Array, q: Array, s: _Scaled) -> Array | None:
        import osqp

        n = len(q)
        upper = sp.triu(sp.csc_matrix(np.where(P == 0, 1e-300, P)), format="csc")  # the same pattern in every solve
        if self.osqp is None:
            self.osqp = osqp.OSQP()
            self.osqp.setup(upper, q, sp.eye(n, format="csc"), s.lower, s.upper, **_OSQP)
        else:
            self.osqp.update(Px=np.ascontiguousarray(upper.data), q=q, l=s.lower, u=s.upper)
        found = self.osqp.solve(raise_error=False)
        x = np.asarray(found.x, dtype=float) if found.x is not None else None
        if x is None or not np.isfinite(x).all():
            self.osqp = None  # a fresh start: what it keeps may not be finite either
            return None
        return x


@dataclass(slots=True)
class _Scaled:
    """The problem in parts of the demand: columns of A of length 1, W = 1."""

    A: Array
    v: Array
    unit: float
    size: Array
    weight: Array
    preferred: Array
    lower: Array
    upper: Array
    mild: float

    @classmethod
    def of(cls, B: Array, v: Array, axis: Array, effector: Array, preferred: Array, lower: Array, upper: Array) -> _Scaled:
        WB = axis[:, None] * B
        reach = np.linalg.norm(WB, axis=0) * np.maximum(np.abs(lower), np.abs(upper))
        unit = float(np.linalg.norm(axis * v)) or float(reach.max(initial=0.0)) or 1.0
        length = np.linalg.norm(WB, axis=0) / unit
        size = np.where(length > 0, length, 1.0)
        weight = effector / (size * unit)
        mild = min(1.0, float(weight.max()) / MILD)  # tracking weight; the costs stay as they are
        return cls(WB / unit / size, axis * v / unit, unit, size, weight, preferred * size, lower * size, upper * size, mild)


def residuals(
    B: Array, demand: Array, u: Array, *, lower: Array, upper: Array, axis: Array, effector: Array, preferred: Array,
    price: Array | None = None,
) -> Array:  # fmt: skip
    """Primal, dual and gap of commands u for the wanted problem, (3,) or (N, 3); as :func:`allocation.active_set.kkt`, in NumPy.

    price (m,) or (N, m) is a multiplier that proves them, W^2 (v - B u) unless given.
    """
    y = axis**2 * (demand - u @ B.T) if price is None else price
    tiny = 1e-300
    delivered = np.abs(demand) + np.abs(u) @ np.abs(B).T + tiny
    span = np.where(upper > lower, upper - lower, 1.0)
    outside = np.maximum(np.maximum(lower - u, u - upper), 0.0) / span
    primal = np.maximum((np.abs(u @ B.T + y / axis**2 - demand) / delivered).max(axis=-1), outside.max(axis=-1))
    r = effector**2 * (u - preferred) - y @ B
    scale = effector**2 * np.abs(u - preferred) + np.abs(y) @ np.abs(B) + tiny
    room = np.maximum(np.where(r > 0, u - lower, upper - u), 0.0)
    dual = np.minimum(np.abs(r) / scale, room / span).max(axis=-1)
    gap = (np.abs(r) * room).sum(axis=-1) / (scale * span).sum(axis=-1)
    return np.stack([primal, dual, gap], axis=-1)
