"""One damped Gauss-Newton step on a predicted miss: two unknowns, bounds, a line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

DAMPING = 1e-3  # of the squared sizes of the columns
NOT_LANDED = 1e12  # m2: worse than any miss

Predicted = tuple[ca.SX, ca.SX, ca.SX]  # miss (2,) m, landing time s, landed (0 or 1)


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Limits of two unknowns: bounds (2,), largest change in one step, and scales."""

    low: ca.SX
    high: ca.SX
    trust: tuple[float, float]
    scale: tuple[float, float]


def corrected(
    u: ca.SX, base: Predicted, J: ca.SX, predict: Callable[[ca.SX], Predicted], bounds: Bounds, *, free: ca.SX, fractions: tuple[float, ...]
) -> Predicted:
    """Unknowns after one step, with the miss and the landing time predicted for them.

    Parameters
    ----------
    u : casadi.SX, shape (2,)
    base : tuple
        Prediction at u.
    J : casadi.SX, shape (2, 2)
        Its derivative, m per unit.
    predict : callable
        u -> prediction; called once for each of `fractions`.
    bounds : Bounds
    free : casadi.SX
        False where the second unknown has no effect any more.
    fractions : tuple of float
        Parts of the step tried; the best of them is taken, or none if none is better than the base.
    """
    step = _bounded(u, base[0], J, bounds, free)
    best, cost, miss, t_f = u, _cost(base), base[0], base[1]
    for fraction in fractions:
        trial = u + fraction * step
        found = predict(trial)
        better = _cost(found) < cost
        best, cost = ca.if_else(better, trial, best), ca.if_else(better, _cost(found), cost)
        miss, t_f = ca.if_else(better, found[0], miss), ca.if_else(better, found[1], t_f)
    return best, miss, t_f


def _cost(found: Predicted) -> ca.SX:
    return ca.dot(found[0], found[0]) + NOT_LANDED * (1 - found[2])


def _bounded(u: ca.SX, miss: ca.SX, J: ca.SX, bounds: Bounds, free: ca.SX) -> ca.SX:
    """Damped Gauss-Newton step; where an unknown meets its bound it stays there and the other is solved again."""
    scale = bounds.scale
    a, b = J[:, 0] * scale[0], J[:, 1] * scale[1] * free
    damping = DAMPING * (ca.dot(a, a) + ca.dot(b, b)) + 1.0
    A, B, C = ca.dot(a, a) + damping, ca.dot(a, b), ca.dot(b, b) + damping
    g, h = -ca.dot(a, miss), -ca.dot(b, miss)
    det = A * C - B * B
    full = [(C * g - B * h) / det, (A * h - B * g) / det]
    low = [ca.fmax(bounds.low[i] - u[i], -bounds.trust[i]) / scale[i] for i in range(2)]
    high = [ca.fmin(bounds.high[i] - u[i], bounds.trust[i]) / scale[i] for i in range(2)]

    def clipped(value: ca.SX, i: int) -> ca.SX:
        return ca.fmax(low[i], ca.fmin(high[i], value))

    first = clipped(full[0], 0)
    first_fixed = [first, clipped((h - B * first) / C, 1)]
    second = clipped(full[1], 1)
    second_fixed = [clipped((g - B * second) / A, 0), second]

    def left_over(step: list[ca.SX]) -> ca.SX:
        rest = miss + a * step[0] + b * step[1]
        return ca.dot(rest, rest)

    inside = ca.logic_and(full[0] == first, full[1] == second)
    better = left_over(first_fixed) <= left_over(second_fixed)
    chosen = [ca.if_else(inside, full[i], ca.if_else(better, first_fixed[i], second_fixed[i])) for i in range(2)]
    return ca.vertcat(chosen[0] * scale[0], chosen[1] * scale[1] * free)
