"""Prediction of the landing point with CVODES and its forward sensitivities: the reference for the compiled prediction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, as_finite, as_scalar, as_vector, frozen
from ocp.predictor import check_model

ROUNDS = 12  # of Newton's method for the time of arrival
CLOSE = 1e-9  # s


@dataclass(frozen=True, slots=True, eq=False)
class Fall:
    """A predicted landing with its exact derivatives.

    Attributes
    ----------
    t_f : float
        Time of arrival at the stop radius, s.
    x_f : ndarray, shape (6,)
        State there.
    by_x, by_T, by_B, by_p : ndarray, shapes (6, 6), (6, K), (6, K), (6, np)
        Derivatives of x_f at the stop to the initial state, the times and bank angles of the nodes, and the parameters.
    """

    t_f: float
    x_f: Array
    by_x: Array
    by_T: Array
    by_B: Array
    by_p: Array


def predict(
    model: Model, *, x: ArrayLike, T: ArrayLike, B: ArrayLike, radius: float, t: float = 0.0, p: ArrayLike | None = None,
    t_f: float = 540.0, rtol: float = 1e-10,
) -> Fall:  # fmt: skip
    """Fly along a bank profile of straight lines to a distance from the centre, restarting at every node.

    Each piece runs over a scaled time in [0, 1], and the time of arrival follows from Newton's method on the radius: no event of
    the integrator is used.  The derivatives are CVODES's forward sensitivities with the term dr = S - v (up . S)/(up . v).

    Parameters
    ----------
    model : Model
        As for :func:`ocp.predictor.prediction`.
    x : array_like, shape (6,)
    T, B : array_like, shape (K,)
        Nodes of the bank angle: times, s, increasing; angles, rad.
    radius : float
        Stop, m.
    t : float
        Time of `x`, s.
    p : mapping or array_like, optional
    t_f : float
        Guess of the time of arrival, s, after the last node.
    rtol : float
        Relative tolerance of CVODES, also for the sensitivities.

    Raises
    ------
    ModelError
        Wrong shapes, nodes out of order, or an arrival that is not found after the last node.
    """
    check_model(model, radius)
    state, params = as_vector("x", x, model.states), model.parameters(p)
    times, banks = as_finite("T", T), as_finite("B", B)
    if times.ndim != 1 or times.shape != banks.shape or len(times) == 0 or (np.diff(times) <= 0).any():
        raise ModelError(
            f"predict: T and B must be lists of equal length with increasing times, got shapes {times.shape} and {banks.shape}"
        )
    if not 0 < as_scalar("predict: rtol", rtol) < 1:
        raise ModelError(f"predict: rtol must lie in (0, 1), got {rtol}")
    ahead = times > t  # a node in the past is no restart point
    flow, slope = _flow(model, len(times), tuple(ahead.tolist()), float(rtol))
    start = max(t, float(times[-1]))
    tau = max(t_f - start, 1.0)
    argument = np.concatenate([state, [t], times, banks, params])
    for _ in range(ROUNDS):
        end = _numbers(flow(argument, tau))
        r, v = end[:3], end[3:]
        distance = float(np.linalg.norm(r))
        change = (distance - radius) / min(float(r @ v) / distance, -1.0)
        tau -= change
        if not np.isfinite(tau) or tau <= 0:
            raise ModelError(f"predict: no arrival at {radius:.6g} m after the last node at {start:.6g} s; give nodes before the landing")
        if abs(change) < CLOSE:
            break
    else:
        raise ModelError(
            f"predict: the time of arrival did not settle (last change {change:.3g} s); give a nearer guess t_f than {t_f:.6g} s"
        )
    end, S = _numbers(flow(argument, tau)), np.asarray(slope(argument, tau).full())
    S = _at_stop(model, end, S, float(banks[-1]), params)
    k = len(times)
    parts = np.split(S, [6, 7, 7 + k, 7 + 2 * k], axis=1)
    return Fall(start + tau, frozen(end), frozen(parts[0]), frozen(parts[2]), frozen(parts[3]), frozen(parts[4]))


def _at_stop(model: Model, end: Array, S: Array, bank: float, p: Array) -> Array:
    """Derivatives at the moved time of arrival; the duration of the last piece was held, and the nodes moved its beginning."""
    up = end[:3] / np.linalg.norm(end[:3])
    rate = model.xdot(end, [bank], p)
    return S - np.outer(rate, up @ S[:3]) / (up @ end[3:])


@lru_cache(maxsize=16)
def _flow(model: Model, nodes: int, ahead: tuple[bool, ...], rtol: float) -> tuple[ca.Function, ca.Function]:
    """(argument = [x; t; T; B; p], duration of the last piece) -> end state, and its derivative to the argument at that duration."""
    np_ = len(model.params)
    scale = ca.DM([v.nominal for v in model.states])
    z, q = ca.SX.sym("z", 6), ca.SX.sym("q", 3 + np_)  # duration, bank at both ends, parameters
    sigma = ca.SX.sym("sigma")
    rate = model.rhs(z * scale, q[1] + sigma * (q[2] - q[1]), q[3:])
    dae = {"x": z, "p": q, "t": sigma, "ode": q[0] * rate / scale}
    options = {"reltol": rtol, "abstol": rtol * 1e-2, "max_num_steps": 100000, "fsens_err_con": True}
    piece = ca.integrator(f"{model.name}_piece", "cvodes", dae, 0.0, 1.0, options)
    argument, tau = ca.MX.sym("argument", 7 + 2 * nodes + np_), ca.MX.sym("tau")
    x, t = argument[:6] / scale, argument[6]
    T, B, p = argument[7 : 7 + nodes], argument[7 + nodes : 7 + 2 * nodes], argument[7 + 2 * nodes :]
    first = ahead.index(True) if True in ahead else nodes
    bank = (
        B[0]
        if first == 0
        else (B[-1] if first == nodes else B[first - 1] + (t - T[first - 1]) / (T[first] - T[first - 1]) * (B[first] - B[first - 1]))
    )
    for k in range(first, nodes):
        x = piece(x0=x, p=ca.vertcat(T[k] - t, bank, B[k], p))["xf"]
        t, bank = T[k], B[k]
    x = piece(x0=x, p=ca.vertcat(tau, bank, bank, p))["xf"] * scale
    names = (["argument", "tau"], ["x_f"])
    return (
        ca.Function(f"{model.name}_flow", [argument, tau], [x], *names),
        ca.Function(f"{model.name}_slope", [argument, tau], [ca.jacobian(x, argument)], names[0], ["S"]),
    )


def _numbers(value: ca.DM) -> Array:
    return np.asarray(value.full())[:, 0]
