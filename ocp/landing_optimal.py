"""The bank profile that lands nearest to a target, found by IPOPT through the differentiable prediction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, Status, as_vector, frozen
from ocp.landing import Target
from ocp.landing_footprint import REACHED
from ocp.laws import profile
from ocp.methods import RK8
from ocp.predictor import Path, prediction
from ocp.simulate import simulate
from ocp.stops import falls_below

STEPS = 60
SMOOTH = 1e-7  # weight of the squared changes between nodes, beside misses in 10 km: it only chooses among equal landings


@dataclass(frozen=True, slots=True, eq=False)
class BestProfile:
    """A bank profile and where it lands.

    Attributes
    ----------
    t, bank : ndarray, shape (K,)
        Nodes, s and rad; straight lines between them.
    miss : ndarray, shape (2,)
        Downrange and cross-range of the replay, m.
    replay_error : float
        Distance of the landing point of the optimization from that of the independent simulation, m.
    status : Status
        OK; OUTSIDE_FOOTPRINT if the miss exceeds a kilometre; MAX_ITERATIONS if IPOPT did not finish.
    """

    t: Array
    bank: Array
    miss: Array
    replay_error: float
    status: Status


def best_profile(
    model: Model, target: Target, *, x: ArrayLike, radius: float, p: ArrayLike | None = None, t_f: float = 540.0, nodes: int = 10
) -> BestProfile:
    """Minimize the squared miss over a free bank profile, abs(bank) <= pi.

    Parameters
    ----------
    model : Model
        As for :func:`ocp.predictor.prediction`, with an output `h`.
    target : Target
    x : array_like, shape (6,)
        State at time 0.
    radius : float
        Stop, m.
    p : mapping or array_like, optional
    t_f : float
        About the time of landing, s: the nodes are laid up to it.
    nodes : int
        Number K >= 2 of nodes.

    Raises
    ------
    ModelError
        Wrong shapes or too few nodes.
    """
    if isinstance(nodes, bool) or not isinstance(nodes, int) or nodes < 2:
        raise ModelError(f"best_profile: nodes must be an integer >= 2, got {nodes!r}")
    state, params = as_vector("x", x, model.states), as_vector("p", model.parameters(p), model.params)
    times = t_f * np.linspace(0.12, 1.0, nodes)
    solver, landing = _solver(model, target, radius, nodes, t_f)
    found: tuple[float, Array, bool] | None = None
    for start in (np.where(np.arange(nodes) < nodes // 2, 1.0, -1.0), np.where(np.arange(nodes) < nodes // 2, 0.4, -0.2)):
        result = solver(x0=start, p=np.concatenate([state, params]), lbx=-math.pi, ubx=math.pi)
        cost, bank = float(result["f"]), np.asarray(result["x"].full())[:, 0]
        if np.isfinite(cost) and (found is None or cost < found[0]):
            found = (cost, bank, bool(solver.stats()["success"]))
    if found is None:
        raise ModelError("best_profile: no start of the optimization lands; the state skips out or lies below the stop")
    bank = found[1]
    inside = np.asarray(landing(bank, np.concatenate([state, params])).full())[:, 0]
    surface = model.y(state, [bank[0]], params)[model.index("h")] - np.linalg.norm(state[:3])  # h - |r|
    flown = simulate(
        model, profile(times, bank=bank), x0=state, p=params, until=falls_below("h", radius + surface), method=RK8(step=0.5), t_max=3 * t_f
    )
    miss = target.miss(flown.x[-1, :3])
    status = Status.OUTSIDE_FOOTPRINT if np.hypot(*miss) > REACHED else (Status.OK if found[2] else Status.MAX_ITERATIONS)
    return BestProfile(frozen(times), frozen(bank), frozen(miss), float(np.hypot(*(inside - miss))), status)


@lru_cache(maxsize=8)
def _solver(model: Model, target: Target, radius: float, nodes: int, t_f: float) -> tuple[ca.Function, ca.Function]:
    """(IPOPT, (bank, [x; p]) -> miss)."""
    flight = prediction(model, Path(nodes, STEPS, order=8), radius=radius)
    bank, given = ca.MX.sym("bank", nodes), ca.MX.sym("given", 6 + len(model.params))
    empty = [ca.MX(0, 1)] * 4
    end = flight(given[:6], 0, 1.8 * t_f, t_f * np.linspace(0.12, 1.0, nodes), bank, given[6:], *empty)[0]
    r = ca.SX.sym("r", 3)
    miss = ca.Function("miss", [r], [target.expression(r)])(end[:3])
    changes = bank[1:] - bank[:-1]
    cost = ca.sumsqr(miss / 1e4) + SMOOTH * ca.sumsqr(changes)
    options: dict[str, Any] = {
        "ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.hessian_approximation": "limited-memory",
        "ipopt.max_iter": 150, "ipopt.tol": 1e-7, "error_on_fail": False,
    }  # fmt: skip
    problem: dict[str, Any] = {"x": bank, "p": given, "f": cost}
    solver = ca.nlpsol("best_profile", "ipopt", problem, options)
    return solver, ca.Function("landing", [bank, given], [miss])
