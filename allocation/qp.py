"""Allocation as a quadratic program: bounded weighted least squares with rate limits and priorities, every answer with its KKT residuals.

    minimize  sum_k W_k^2 (B u - v)_k^2 + sum_j b_j^2 (u_j - p_j)^2   over  lower <= u <= upper

The own solver is :mod:`allocation.active_set`; OSQP and the other back ends stand in :mod:`allocation.backends`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from allocation import active_set, backends, blending, qp_native
from allocation.core import Allocation, Effectors, allocation
from models.checked import Array, ModelError, Status, as_finite, as_scalar, frozen, unknown_name

OWN = "active_set"
RATIO = 3e-4  # b/W: what is left of a demand that can be met is this squared
SURFACE_COST = 0.01  # of a moment made by a surface, beside 1 of the same moment made by a jet


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Weights of the quadratic program, all > 0.

    Attributes
    ----------
    axis : ndarray, shape (m,)
        W, per unit of wrench.
    effector : ndarray, shape (n,)
        b, per unit of command.
    preferred : ndarray, shape (n,)
        Commands p that cost nothing.
    """

    axis: Array
    effector: Array
    preferred: Array

    def __post_init__(self) -> None:
        for name in ("axis", "effector", "preferred"):
            values = as_finite(f"weights: {name}", getattr(self, name))
            if values.ndim != 1 or (name != "preferred" and (values <= 0).any()):
                raise ModelError(f"weights: {name}: expected a list of numbers > 0, got {values}; give small weights instead of zero")
            object.__setattr__(self, name, frozen(values))


def weights_for(
    effectors: Effectors,
    *,
    priority: Mapping[str, float] | None = None,
    cost: Mapping[str, float] | None = None,
    preferred: Mapping[str, float] | None = None,
    ratio: float = RATIO,
) -> Weights:
    """Weights in units that make axes and effectors comparable.

    An axis counts in parts of what all effectors together could deliver on it; an effector pays for the wrench that it makes, in
    these parts, wherever it comes from: weights on radians and duties instead would compare a degree of elevon with a jet.

    Parameters
    ----------
    effectors : Effectors
    priority : mapping of axis -> factor > 0, optional
        1 unless given: an axis with 10 gives up a hundredth of what an axis with 1 gives up.
    cost : mapping of effector -> factor > 0, optional
        1 for jets and 0.01 for surfaces unless given: surfaces first.
    preferred : mapping of effector -> command, optional
        0 unless given.
    ratio : float
        Cost against tracking, b/W; relative error of a demand that can be met: about ratio squared.
    """
    part = as_scalar("weights: ratio", ratio)
    if part <= 0:
        raise ModelError(f"weights: ratio must be > 0, got {ratio}")
    reach = np.maximum(np.abs(effectors.lower), np.abs(effectors.upper))
    scale = np.abs(effectors.B) @ reach
    axis = _named("priority", effectors.axes, priority, 1.0) / np.where(scale > 0, scale, 1.0)
    made = np.linalg.norm(axis[:, None] * effectors.B, axis=0)
    idle = float(np.max(made, initial=0.0)) or 1.0  # an effector without effect pays as the strongest does
    usual = np.where(effectors.jets, 1.0, SURFACE_COST)
    factor = _named("cost", effectors.names, cost, usual)
    return Weights(
        axis, part * factor * np.where(made > 0, made, idle), _named("preferred", effectors.names, preferred, 0.0, positive=False)
    )


def _named(what: str, names: tuple[str, ...], given: Mapping[str, float] | None, usual: ArrayLike, *, positive: bool = True) -> Array:
    values = np.broadcast_to(np.asarray(usual, dtype=float), (len(names),)).copy()
    for name, value in (given or {}).items():
        if name not in names:
            raise ModelError(unknown_name(f"weights: {what}", name, names))
        values[names.index(name)] = as_scalar(f"weights: {what}: {name}", value)
    if positive and (values <= 0).any():
        raise ModelError(f"weights: {what}: {names[int(np.argmin(values))]} has {values.min():.6g}, expected a factor > 0")
    return values


def allocate(
    effectors: Effectors,
    demand: ArrayLike,
    *,
    weights: Weights | None = None,
    method: str = OWN,
    previous: ArrayLike | None = None,
    dt: float | None = None,
) -> Allocation:
    """Commands for one demand, or for N of them at once.

    Parameters
    ----------
    effectors : Effectors
    demand : array_like, shape (m,) or (N, m)
        Wrench asked for.  What cannot be met is not an error: the answer is the nearest one in the weights, with its residual.
    weights : Weights, optional
        ``weights_for(effectors)`` unless given.
    method : str
        "active_set" (own), "osqp" (its own interface, warm started), or one of :func:`allocation.backends.available`.
    previous : array_like, shape (n,), optional
        Commands one sample ago; with `dt` (s) the effectors' rates limit the answer.  For a history see :func:`history`.

    Raises
    ------
    ModelError
        NaN or a wrong shape; an unknown method or one that is not installed; rate limits on N demands.
    """
    values = effectors.demands(demand)
    chosen = _fitting(effectors, weights)
    limited = _limited(effectors, values, previous, dt)
    many = np.atleast_2d(values)
    if method == OWN:
        found = qp_native.solve_many(
            effectors.B, many, lower=limited.lower, upper=limited.upper, axis_weight=chosen.axis, effector_weight=chosen.effector,
            preferred=chosen.preferred,
        )  # fmt: skip
        u, kkt, solved = np.asarray(found.u), np.asarray(found.kkt), np.asarray(found.solved)
    else:
        solver = backends.Backend.of(method, effectors.B, axis=chosen.axis, effector=chosen.effector, preferred=chosen.preferred)
        answers = [solver.solve(v, lower=limited.lower, upper=limited.upper) for v in many]
        u, kkt = np.array([a[0] for a in answers]), np.array([a[1] for a in answers])
        solved = np.asarray((kkt <= backends.ACCEPTED).all(axis=1))
    states = tuple(Status.OK if ok else Status.MAX_ITERATIONS for ok in solved)
    limits = (limited.lower, limited.upper)
    if values.ndim == 1:
        return allocation(effectors, values, u=u[0], status=states[0], kkt=(kkt[0, 0], kkt[0, 1], kkt[0, 2]), method=method, limits=limits)
    return allocation(effectors, values, u=u, status=states, kkt=(kkt[:, 0], kkt[:, 1], kkt[:, 2]), method=method, limits=limits)


def _fitting(effectors: Effectors, weights: Weights | None) -> Weights:
    chosen = weights or weights_for(effectors)
    m, n = effectors.B.shape
    sizes = (len(chosen.axis), len(chosen.effector), len(chosen.preferred))
    if sizes != (m, n, n):
        raise ModelError(
            f"allocate: weights have {sizes} entries (axis, effector, preferred), expected {(m, n, n)}; make them for these effectors"
        )
    return chosen


def _limited(effectors: Effectors, demand: Array, previous: ArrayLike | None, dt: float | None) -> Effectors:
    if previous is None and dt is None:
        return effectors
    if previous is None or dt is None:
        raise ModelError("allocate: previous and dt belong together; give both or none")
    if demand.ndim == 2:
        raise ModelError("allocate: rate limits tie each demand to the one before; use history for a sequence of demands")
    return effectors.within_reach(previous, dt)


def history(
    effectors: Effectors, demand: ArrayLike, *, dt: float, weights: Weights | None = None, start: ArrayLike | None = None
) -> Allocation:
    """Commands for demands that follow each other every dt (s), each within reach of the one before; own solver.

    Parameters
    ----------
    effectors : Effectors
    demand : array_like, shape (N, m)
    dt : float
        s, > 0.
    weights : Weights, optional
    start : array_like, shape (n,), optional
        Commands before the first sample; the ones that the first demand asks for unless given.
    """
    values = effectors.demands(demand)
    period = as_scalar("history: dt", dt)
    if values.ndim != 2 or period <= 0:
        raise ModelError(f"history: got demand of shape {values.shape} and dt {period}, expected (N, {len(effectors.axes)}) and dt > 0")
    chosen = _fitting(effectors, weights)
    first = allocate(effectors, values[0], weights=weights).u if start is None else as_finite("history: start", start)
    if first.shape != (len(effectors.names),):
        raise ModelError(f"history: start has shape {first.shape}, expected ({len(effectors.names)},)")
    found = qp_native.solve_history(
        effectors.B, values, lower=effectors.lower, upper=effectors.upper, axis_weight=chosen.axis, effector_weight=chosen.effector,
        preferred=chosen.preferred, room=effectors.rate * period, start=first,
    )  # fmt: skip
    states = tuple(Status.OK if ok else Status.MAX_ITERATIONS for ok in found.solved)
    before = np.vstack([first, found.u[:-1]])
    limits = qp_native.within(effectors.lower, effectors.upper, before, effectors.rate * period)
    kkt = (found.kkt[:, 0], found.kkt[:, 1], found.kkt[:, 2])
    return allocation(effectors, values, u=found.u, status=states, kkt=kkt, method=OWN, limits=limits)


def blend(
    handover: blending.Handover | None = None, *, a: float = 3e-8, b: float = 3e-4, rate: float | None = None, name: str = "blend_qp"
) -> ca.Function:
    """The pitch loop's allocator as a quadratic program: inputs and first outputs as :func:`allocation.blending.paper`.

    minimize (y_e + y_r - v)^2 + a^2 y_e^2 + b^2 y_r^2 with v the demanded moment, y_e that of the elevon's control term and y_r
    that of the jets (nose up and nose down their own columns), over the elevon limits of the hand-over and duties of at most 1.
    Wherever |demand| is at least the floor of the hand-over and no rate limit is active, it differs from equation 20 by at most
    max[(a/b)^2 + a^2, b^2] of the demand (W = 1).

    Parameters
    ----------
    handover : Handover
    a, b : float
        Costs of moments of the elevon and of the jets beside the unit weight of the error; 0 < a < b.
    rate : float, optional
        Largest change of the elevon's control term from one sample to the next, rad (rate times sample time).
    name : str

    Returns
    -------
    casadi.Function
        Two outputs more than those of the logic: kkt (3,) and solved (1: each at most 1e-9).
    """
    h = handover or blending.Handover()
    if not 0 < a < b or (rate is not None and rate < 0):
        raise ModelError(f"blend: a {a}, b {b}, rate {rate}: expected 0 < a < b, and rate >= 0 if given")
    inputs = [ca.SX.sym(n) for n in blending.INPUTS]
    demand, qbar, trim, slope, up, down, previous = inputs
    low, high = blending.limits(qbar, trim, handover=h)
    if rate is not None:  # a term beyond its limits comes back as fast as it may
        low, high = ca.fmin(ca.fmax(low, previous - rate), previous + rate), ca.fmax(ca.fmin(high, previous + rate), previous - rate)
    moment = slope * demand
    strength = ca.fmax(ca.fabs(slope), 1e-9 * up)
    unit = ca.fmax(ca.fabs(moment), 1e-9 * strength)  # everything in parts of the demand
    columns = ca.vertcat(slope, up, down) / unit
    sizes = ca.vertcat(strength, up, -down) / unit
    if h.rcs_inhibit_above_q2:
        most = ca.if_else(qbar > h.q2, 0.0, 1.0)
    else:
        most = ca.SX(1.0)
    solver = active_set.solver(1, 3, name=f"{name}_wls")
    u, _, kkt, solved = solver.call([
        columns, moment / unit, ca.vertcat(low, 0, 0), ca.vertcat(high, most, most), ca.SX(1.0),
        ca.vertcat(a, b, b) * sizes, ca.SX.zeros(3), ca.SX(0.0),
    ])  # fmt: skip
    rcs = u[1] * up + u[2] * down
    share = ca.fmin(ca.fmax(rcs * moment / unit**2, 0.0), 1.0)
    return ca.Function(
        name, inputs, [u[0], u[1] - u[2], share, kkt, solved], list(blending.INPUTS), [*blending.OUTPUTS, "kkt", "solved"]
    )  # fmt: skip
