"""Stop conditions: where a named state or output crosses a value."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from models.core import Model, ModelError, as_scalar, unknown_name
from models.native_loop import Stopping


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
            total = least + margin
            # a margin that is NaN makes the least one NaN, whichever it is: fmin alone would pass it over
            least = margin if len(self.conditions) == 1 else ca.if_else(total <= ca.inf, ca.fmin(least, margin), total)
        return least


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


TRIAL, STATE = 0, 7  # places in s = [trial, low, its margin, its slope, high, its margin, its slope, state, step, nudge, count]
SEARCHING, LAST, FOUND = 0, 1, 2  # values of s[STATE]
CLOSE = 1e-12  # of a group: how near the crossing the search ends
PATIENCE = 40  # evaluations after which it only halves


def narrowing() -> tuple[ca.Function, ca.Function]:
    """The search for the zero of a decreasing scalar function, as two functions of numbers.

    Returns
    -------
    first : (f_low, slope_low, high, f_high, slope_high) -> s (11,)
        The bracket [0, high].  Only the sign of a value whose slope is not negative is used.
    next : (s, f, slope) -> s
        Take in the value and the slope at the trial s[0], and choose the next.

    Notes
    -----
    The trial is the zero of the inverse cubic through values and slopes at both ends where that cubic increases (Fritsch and Carlson's
    condition), else Newton's step where it stays inside, else the middle; also the middle where the steps do not halve.  So a smooth margin
    takes two or three evaluations and any margin less than a hundred.  A trial nearer to the newest point than a nudge lies beyond the zero
    by that nudge, so that the bracket closes from both sides; nudges grow, since rounding may hide the sign.  NaN is beyond the crossing.
    """
    s, f, slope = ca.SX.sym("s", 11), ca.SX.sym("f"), ca.SX.sym("slope")
    x, step, nudge, count = s[TRIAL], s[8], s[9], s[10]
    value, rate = _usable(f, slope)
    before = value > 0
    low = [ca.if_else(before, a, b) for a, b in zip((x, value, rate), ca.vertsplit(s[1:4]), strict=True)]
    high = [ca.if_else(before, b, a) for a, b in zip((x, value, rate), ca.vertsplit(s[4:7]), strict=True)]
    width = high[0] - low[0]
    steepness = ca.fmin(-rate, 4 * (low[1] - high[1]) / width)  # a slope that the bracket does not bear out proves nothing
    hit = ca.fabs(value) <= CLOSE * steepness  # also an exact zero
    closed = ca.logic_or(width <= 2 * CLOSE, count > 200)
    cubic, good = _inverse_cubic(low, high)
    newton = x - value / ca.if_else(rate < 0, rate, -1)
    inside = ca.logic_and(ca.logic_and(rate < 0, newton > low[0]), newton < high[0])
    middle = 0.5 * (low[0] + high[0])
    trial = ca.if_else(good, cubic, ca.if_else(inside, newton, middle))
    move = ca.fabs(trial - x)
    near = move < nudge
    trial = ca.if_else(near, x + ca.if_else(before, nudge, -nudge), trial)
    inside = ca.logic_and(trial > low[0], trial < high[0])
    fast = ca.logic_and(ca.logic_or(near, move <= 0.5 * step), count < PATIENCE)
    halve = ca.logic_not(ca.logic_and(inside, fast))
    trial = ca.if_else(halve, middle, trial)
    move = ca.if_else(ca.logic_or(halve, near), width, move)
    nearer = ca.if_else(ca.fabs(low[1]) < ca.fabs(high[1]), low[0], high[0])
    end = ca.if_else(hit, x, nearer)
    state = ca.if_else(ca.logic_or(hit, closed), ca.if_else(end == x, FOUND, LAST), SEARCHING)
    trial = ca.if_else(state > SEARCHING, end, trial)
    going = ca.vertcat(trial, *low, *high, state, move, ca.if_else(near, 4 * nudge, nudge), count + 1)
    ended = ca.vertcat(s[:STATE], FOUND, s[STATE + 1 :])
    result = ca.cse(ca.if_else(s[STATE] > SEARCHING, ended, going))
    following = ca.Function("narrow", [s, f, slope], [result], ["s", "f", "slope"], ["s_next"])

    f0, s0, reach, f1, s1 = (ca.SX.sym(n) for n in ("f0", "s0", "reach", "f1", "s1"))
    ahead = f0 > 0  # a law's first input may have moved the margin beyond the stop: then only the sign before it is of use
    v0, r0 = _usable(f0, s0)
    low = [ca.SX(0), ca.if_else(ahead, v0, 1), ca.if_else(ahead, r0, 0)]
    high = [reach, *_usable(f1, s1)]
    cubic, good = _inverse_cubic(low, high)
    trial = ca.if_else(good, cubic, 0.5 * reach)
    first = ca.Function(
        "bracket", [f0, s0, reach, f1, s1], [ca.cse(ca.vertcat(trial, *low, *high, SEARCHING, reach, CLOSE, 0))],
        ["f_low", "slope_low", "high", "f_high", "slope_high"], ["s"],
    )  # fmt: skip
    return first, following


def _usable(f: ca.SX, slope: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Value and slope as finite numbers: of a value that is not finite the side remains, of a slope that is of no use zero."""
    finite = ca.fabs(f) < ca.inf
    falling = ca.logic_and(slope < 0, slope > -ca.inf)
    return ca.if_else(finite, f, ca.if_else(f > 0, 1, -1)), ca.if_else(ca.logic_and(finite, falling), slope, 0)


def _inverse_cubic(low: list[ca.SX], high: list[ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Zero of the inverse cubic through both ends [place, value, slope], and whether it is known to lie between them."""
    drop, width = low[1] - high[1], high[0] - low[0]
    known = ca.logic_and(low[2] < 0, high[2] < 0)
    m0, m1 = (-drop / ca.if_else(end[2] < 0, end[2], -1) for end in (low, high))  # slopes of the inverse, per drop
    part = low[1] / drop
    rest = 1 - part
    zero = low[0] + part * (width * part * (3 - 2 * part) + rest * (m0 * rest - m1 * part))
    return zero, ca.logic_and(known, ca.logic_and(m0 <= 3 * width, m1 <= 3 * width))


@lru_cache(maxsize=64)
def stopping(group: ca.Function, prepare: ca.Function, model: Model, until: Stop, *, held: bool) -> tuple[ca.Function, Stopping]:
    """Margin (c, p) -> scalar after a group made by :func:`ocp.flight.group_function`, and the search for its zero inside one.

    The margin is NaN where an output of the conditions is.  `held`: the input is held over a group.
    """
    sizes = {name: group.size1_in(i) for i, name in enumerate("cqp")} | {"s": 11, "1": 1}
    nx, nu = len(model.states), len(model.inputs)
    x, u, p, dx, du = (ca.SX.sym(n, k) for n, k in (("x", nx), ("u", nu), ("p", sizes["p"]), ("dx", nx), ("du", nu)))
    least = ca.densify(until.expression(model, x, u, p))
    margin = ca.Function(f"{model.name}_margin", [x, u, p], [least])
    slope = ca.jtimes(least, ca.vertcat(x, u), ca.vertcat(dx, du)) if nx + nu else ca.SX(0)
    rated = ca.Function(f"{model.name}_margin_rate", [x, u, p, dx, du], [least, ca.densify(slope)])
    first, following = narrowing()
    kind: Any = ca.SX if group.is_a("SXFunction") else ca.MX
    c, after, q, p, s, reach = (kind.sym(n, sizes[size]) for n, size in zip(("c", "after", "q", "p", "s", "reach"), "ccqps1", strict=True))

    def split(carry: Any) -> tuple[Any, Any]:
        return carry[:nx, :], carry[carry.shape[0] - nu :, :]

    ends = prepare(c, q, p)[2]
    change = kind.zeros(nu, 1) if held else ends[nu:, :] - ends[:nu, :]

    def rate(state: Any, control: Any) -> list[Any]:
        return rated.call([state, control, p, q[1] * model.rhs(state, control, p), change])

    low, high = rate(c[:nx, :], ends[:nu, :]), rate(*split(after))
    at = group(c, partial(q, s[TRIAL], nu, held=held), p)[0]
    names = ["c", "after", "q", "p", "reach"]
    after_group = ca.Function(f"{model.name}_margin", [c, p], [margin(*split(c), p)], ["c", "p"], ["margin"])
    return after_group, Stopping(
        ca.Function(f"{model.name}_start", [c, q, p], [margin(c[:nx, :], ends[:nu, :], p)], ["c", "q", "p"], ["margin"]),
        ca.Function(f"{model.name}_bracket", [c, after, q, p, reach], [first(*low, reach, *high)], names, ["s"]),
        ca.Function(f"{model.name}_probe", [c, q, p, s], [at, following(s, *rate(*split(at)))], ["c", "q", "p", "s"], ["c_at", "s_next"]),
        STATE,
    )


def partial(q: Any, fraction: Any, nu: int, *, held: bool) -> Any:
    """Queue entry (2 + nw,) of the first `fraction` of a group: less time, and of a linear input the part it has run through by then.

    Also for arrays, (2 + nw, M) and (M,).
    """
    stack = np.vstack if isinstance(q, np.ndarray) else lambda rows: ca.vertcat(*rows)
    rest = [q[2:, :]] if held else [q[2 : 2 + nu, :], q[2 : 2 + nu, :] + fraction * (q[2 + nu :, :] - q[2 : 2 + nu, :])]
    return stack([q[:1, :], q[1:2, :] * fraction, *rest])
