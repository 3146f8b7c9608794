"""Stop conditions: where a named state or output crosses a value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from models.core import Array, Model, ModelError, as_scalar, evaluate, unknown_name


@dataclass(frozen=True, slots=True)
class Stop:
    """The first crossing of any of `conditions`: (name, value, sign), sign +1 rising and -1 falling."""

    conditions: tuple[tuple[str, float, int], ...]

    def text(self) -> str:
        """Readable form, for messages."""
        return " or ".join(f"{n} {'rises above' if s > 0 else 'falls below'} {v:.9g}" for n, v, s in self.conditions)

    def expression(self, model: Model, x: ca.SX, u: ca.SX, p: ca.SX) -> ca.SX:
        """The least margin of the conditions as a symbolic expression, in units of each condition's scale."""
        least = ca.SX(ca.inf)
        for name, value, sign in self.conditions:
            group, index = _place(model, name)
            column = x[index] if group == "state" else model.out(x, u, p)[index]
            margin = sign * (value - column) / max(abs(value), _scale(model, name))
            least = margin if len(self.conditions) == 1 else ca.fmin(least, margin)
        return least

    def margins(self, model: Model, x: Array, u: Array, p: Array) -> Array:
        """(M, number of conditions): positive before a crossing, <= 0 after it, in units of the condition's scale.

        NaN where an output is not finite.
        """
        columns = []
        for name, value, sign in self.conditions:
            column, scale = _column(model, name, x, u, p)
            columns.append(sign * (value - column) / max(abs(value), scale))
        return np.column_stack(columns)


def falls_below(name: str, value: float) -> Stop:
    """Stop where a state or output falls through `value` (SI, radians)."""
    return Stop(((name, as_scalar(f"falls_below {name}", value), -1),))


def rises_above(name: str, value: float) -> Stop:
    """Stop where a state or output rises through `value` (SI, radians)."""
    return Stop(((name, as_scalar(f"rises_above {name}", value), 1),))


def first_of(first: Stop, second: Stop) -> Stop:
    """Stop at whichever comes first."""
    return Stop(first.conditions + second.conditions)


def _place(model: Model, name: str) -> tuple[str, int]:
    for group, variables in (("state", model.states), ("output", model.outputs)):
        for i, var in enumerate(variables):
            if var.name == name:
                return group, i
    raise ModelError(unknown_name("stop condition", name, [v.name for v in (*model.states, *model.outputs)]))


def _scale(model: Model, name: str) -> float:
    """Below this size of the value a margin is not relative to it any more."""
    group, i = _place(model, name)
    return 1e-3 * (model.states if group == "state" else model.outputs)[i].nominal


def _column(model: Model, name: str, x: Array, u: Array, p: Array) -> tuple[Array, float]:
    group, i = _place(model, name)
    column = x[:, i] if group == "state" else evaluate(model.out, x, u, p, finite=False)[0][:, i]
    return column, _scale(model, name)


def crossing_fraction(margin: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Zero of a decreasing scalar function in [0, 1], for many cases at once.

    Parameters
    ----------
    margin : callable
        fraction (M,) -> margin (M,).
    low, high : ndarray, shape (M,)
        Margins at fractions 0 (> 0) and 1 (<= 0).

    Returns
    -------
    ndarray, shape (M,)
        Fractions, to 1e-14 of the interval.

    Notes
    -----
    Source: Chandrupatla, A new hybrid quadratic/bisection algorithm for finding the zero of a nonlinear function without
    using derivatives, Advances in Engineering Software 28(3), 1997: inverse quadratic interpolation where it is safe, else
    bisection; about ten evaluations for a smooth margin.  A margin that is NaN counts as beyond the crossing.
    """
    a, fa = np.ones_like(low), np.where(np.isnan(high), -1.0, high)  # newest point
    b, fb = np.zeros_like(low), low.copy()  # other end of the bracket
    t, x = np.full_like(low, 0.5), a.copy()
    done = fa == 0
    for _ in range(200):
        if done.all():
            break
        trial = np.where(done, x, a + t * (b - a))
        f = margin(trial)
        f = np.where(np.isnan(f), -1.0, f)
        same = (f > 0) == (fa > 0)
        c, fc = np.where(same, a, b), np.where(same, fa, fb)
        b, fb = np.where(same, b, a), np.where(same, fb, fa)
        a, fa = trial, f
        x = np.where(done, x, np.where(np.abs(fa) < np.abs(fb), a, b))
        width = np.maximum(np.abs(b - a), 1e-300)
        done = done | (width < 1e-14) | (fa == 0)
        t = np.clip(_step(a, b, c, fa, fb, fc), *(np.minimum(0.5e-14 / width, 0.5), 1 - np.minimum(0.5e-14 / width, 0.5)))
    return x


def _step(a: Array, b: Array, c: Array, fa: Array, fb: Array, fc: Array) -> Array:
    """Next trial as a fraction of the way from a to b: inverse quadratic interpolation inside Chandrupatla's region, else 1/2."""
    safe = (fa != fb) & (fb != fc) & (fc != fa) & (b != c) & (a != b)
    ab, bc, ca_ = (np.where(safe, d, 1.0) for d in (fb - fa, fb - fc, fc - fa))
    xi, phi = (a - b) / np.where(safe, c - b, 1.0), ab / bc
    inside = safe & (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
    quadratic = fa / ab * fc / bc - (c - a) / np.where(safe, b - a, 1.0) * fa / ca_ * fb / bc
    return np.where(inside, quadratic, 0.5)
