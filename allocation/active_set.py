"""Bounded weighted least squares for few axes and many effectors: a fixed number of steps, written in CasADi symbols.

    minimize  sum_k W_k^2 (B u - v)_k^2 + sum_j b_j^2 (u_j - p_j)^2   over  lower <= u <= upper

With y = W^2 (v - B u) the optimum is u = p + B'y/b^2 held inside the limits, and y (as many numbers as axes) is the zero of

    F(y) = y/W^2 + B u(y) - v,

the gradient of a strictly convex, piecewise quadratic function phi.  Each step solves the m x m system that is right as long as no
effector reaches or leaves a limit (all limits change at once: block pivoting), and then goes along that direction to where phi is
least: the kinks of the piecewise linear slope are halved, in their logarithm, until none is left in the bracket.  When no kink lies
between here and the full step, the step is the solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import casadi as ca
import numpy as np

from models.checked import Array, ModelError

MOST_AXES = 6
TOLERANCE = 1e-9  # of the KKT residuals, relative; above it an answer is not called solved
TINY, HUGE = 1e-200, 1e200
WRITTEN_OUT = 40_000  # instructions up to which the steps of a solver are written out one after the other
FAR = 2.0  # kinks outside (0, 1) are put here
PROBLEM = ("B", "demand", "lower", "upper", "axis_weight", "effector_weight", "preferred")


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Symbols of one problem: B (m, n); demand, axis_weight (m,); lower, upper, effector_weight, preferred (n,)."""

    B: ca.SX
    demand: ca.SX
    lower: ca.SX
    upper: ca.SX
    axis_weight: ca.SX
    effector_weight: ca.SX
    preferred: ca.SX

    @property
    def compliance(self) -> ca.SX:
        """1/W^2, shape (m,)."""
        return 1.0 / self.axis_weight**2

    @property
    def gain(self) -> ca.SX:
        """1/b^2, shape (n,)."""
        return 1.0 / self.effector_weight**2


Expression = TypeVar("Expression", ca.SX, ca.MX)
Given = tuple[list[ca.SX], Problem]  # input columns, and the problem that they make


def symbols(m: int, n: int) -> Given:
    """Input columns in the order of ``PROBLEM`` (B by columns) and the problem that they make."""
    if not 1 <= m <= MOST_AXES or n < 1:
        raise ModelError(f"active set: {m} axes and {n} effectors: expected 1 to {MOST_AXES} axes and at least one effector")
    sizes = (m * n, m, n, n, m, n, n)
    columns = [ca.SX.sym(name, size) for name, size in zip(PROBLEM, sizes, strict=True)]
    return columns, Problem(ca.reshape(columns[0], m, n), *columns[1:])


def constants(B: Array, *, lower: Array, upper: Array, axis_weight: Array, effector_weight: Array, preferred: Array) -> Given:
    """As :func:`symbols`, with the demand as the only input: everything else is written into the code."""
    demand = ca.SX.sym("demand", B.shape[0])
    data = [ca.SX(ca.DM(np.atleast_1d(v))) for v in (lower, upper, axis_weight, effector_weight, preferred)]
    return [demand], Problem(ca.SX(ca.DM(B)), demand, *data)


def newton(problem: Problem, y: ca.SX, *, searches: int) -> tuple[ca.SX, ca.SX]:
    """One step.

    Parameters
    ----------
    problem : Problem
    y : SX, shape (m,)
    searches : int
        Evaluations of the slope along the direction.

    Returns
    -------
    y : SX, shape (m,)
    settled : SX, scalar
        1 if no effector reaches or leaves a limit on the full step: then y is the solution.
    """
    q = problem
    w = q.preferred + (q.B.T @ y) * q.gain
    free = (w >= q.lower) * (w <= q.upper)
    F = y * q.compliance + q.B @ clip(w, q.lower, q.upper) - q.demand
    d = -solve(_matrix(q, free), F)
    Bd = q.B.T @ d
    kinks, jumps, offsets = _kinks(q, w, Bd)
    t, settled = _search(kinks, jumps, offsets, start=ca.dot(d, F), slope=_slope(q, free, d, Bd), searches=searches)
    return usable(y + t * d), settled


def usable(y: Expression) -> Expression:
    """The same prices, zero where they are not finite: what a bad sample leaves must not spoil the samples after it."""
    return ca.if_else(ca.fabs(y) < HUGE, y, 0.0)


def beginning(demand: Expression, y: Expression) -> Expression:
    """Prices to begin with: usable ones, and zero for a demand of zero, which leaves nothing to be relative to but exact zeros."""
    return ca.if_else(ca.sumsqr(demand) == 0, 0.0, usable(y))


def _matrix(q: Problem, free: ca.SX) -> ca.SX:
    """Jacobian of F for a set of free effectors (ones and zeros): diag(1/W^2) + B_F diag(1/b^2) B_F'."""
    m, n = q.B.shape
    J = ca.SX.zeros(m, m)
    chosen = [ca.if_else(free[j], q.gain[j], 0) for j in range(n)]
    for a in range(m):
        scaled = [q.B[a, j] * chosen[j] for j in range(n)]
        for b in range(a + 1):
            J[a, b] = sum((scaled[j] * q.B[b, j] for j in range(n)), ca.SX(0.0))
        J[a, a] += q.compliance[a]
    return J


def solve(J: ca.SX, right: ca.SX) -> ca.SX:
    """J^-1 right for a positive definite matrix of which the lower triangle is given (LDL', written out)."""
    m = J.shape[0]
    L: dict[tuple[int, int], ca.SX] = {}
    D, x = [ca.SX(0.0)] * m, [ca.SX(0.0)] * m
    for a in range(m):
        row = [J[a, b] for b in range(a + 1)]
        for b in range(a):
            for c in range(b):
                row[b] -= row[c] * L[b, c]  # row[c] is still L[a, c] D[c]
        for b in range(a):
            L[a, b] = row[b] / D[b]
            row[a] -= L[a, b] * row[b]
        D[a] = row[a]
        x[a] = right[a] - sum((L[a, b] * x[b] for b in range(a)), ca.SX(0.0))
    for a in reversed(range(m)):
        x[a] = x[a] / D[a] - sum((L[b, a] * x[b] for b in range(a + 1, m)), ca.SX(0.0))
    return ca.vertcat(*x)


def clip(value: ca.SX, lower: ca.SX, upper: ca.SX) -> ca.SX:
    """Value held inside the limits."""
    return ca.fmin(ca.fmax(value, lower), upper)


def _slope(q: Problem, free: ca.SX, d: ca.SX, Bd: ca.SX) -> ca.SX:
    """Derivative of the slope of phi along d at the start."""
    return ca.dot(d, d * q.compliance) + ca.sum1(ca.if_else(free, Bd * Bd * q.gain, 0))


def _kinks(q: Problem, w: ca.SX, Bd: ca.SX) -> tuple[list[ca.SX], list[ca.SX], list[ca.SX]]:
    """Where along the step an effector enters or leaves its range, and what that adds to the slope of phi: jump * t + offset.

    An effector that starts inside leaves at the limit ahead; one that starts outside and goes inwards enters and may leave again.
    """
    kinks, jumps, offsets = [], [], []
    for j in range(q.B.shape[1]):
        rise = Bd[j] * q.gain[j]
        moves, forward = ca.fabs(rise) > TINY, rise > 0
        inverse = 1.0 / ca.if_else(moves, rise, 1.0)
        near, far = ca.if_else(forward, q.lower[j], q.upper[j]), ca.if_else(forward, q.upper[j], q.lower[j])
        for limit, sign in ((near, 1.0), (far, -1.0)):
            t = (limit - w[j]) * inverse
            begun = t > 0 if sign > 0 else t >= 0  # on a limit it counts as free: then it has entered, but may be about to leave
            kinks.append(ca.if_else(moves * begun * (t < 1), t, FAR))
            jumps.append(sign * Bd[j] * rise)
            offsets.append(-sign * Bd[j] * (limit - w[j]))
    return kinks, jumps, offsets


def _search(
    kinks: list[ca.SX], jumps: list[ca.SX], offsets: list[ca.SX], *, start: ca.SX, slope: ca.SX, searches: int
) -> tuple[ca.SX, ca.SX]:
    """Zero of the increasing, piecewise linear slope of phi on (0, 1], or a point before it; and whether no kink lies there."""

    def at(t: ca.SX) -> ca.SX:
        passed = [k < t for k in kinks]
        more = sum((ca.if_else(p, j, 0) for p, j in zip(passed, jumps, strict=True)), ca.SX(0.0))
        return start + slope * t + more * t + sum((ca.if_else(p, o, 0) for p, o in zip(passed, offsets, strict=True)), ca.SX(0.0))

    one = ca.SX(1.0)
    a, ga, b, gb = ca.SX(0.0), start, one, at(one)
    whole = gb <= 0  # the full step still goes downhill
    settled = _first(kinks) > 1
    for _ in range(searches):
        low, high = _extent(kinks, a, b)
        t = ca.if_else(low <= high, ca.sqrt(low * high), 0.5 * (a + b))
        g = at(t)
        before = g <= 0
        a, ga = ca.if_else(before, t, a), ca.if_else(before, g, ga)
        b, gb = ca.if_else(before, b, t), ca.if_else(before, gb, g)
    low, high = _extent(kinks, a, b)
    chord = a - ga * (b - a) / ca.fmax(gb - ga, TINY)
    t = ca.if_else(low > high, chord, ca.if_else(a > 0, a, b))
    return ca.if_else(ca.logic_or(whole, settled), 1.0, t), settled


def _first(kinks: list[ca.SX]) -> ca.SX:
    first = kinks[0]
    for k in kinks[1:]:
        first = ca.fmin(first, k)
    return first


def _extent(kinks: list[ca.SX], a: ca.SX, b: ca.SX) -> tuple[ca.SX, ca.SX]:
    """First and last kink strictly between a and b; the first is greater than the last when there is none."""
    low, high = ca.SX(FAR), ca.SX(0.0)
    for k in kinks:
        inside = (k > a) * (k < b)
        low = ca.fmin(low, ca.if_else(inside, k, FAR))
        high = ca.fmax(high, ca.if_else(inside, k, 0.0))
    return low, high


def finish(problem: Problem, y: ca.SX, *, passes: int = 2, refinements: int = 2) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Commands for the set of free effectors that y implies, refined so that both the wrench and the prices are exact.

    u is carried beside y, not computed from it: with very unequal weights B'y/b^2 loses the digits that cancel in B'y.

    Returns
    -------
    u : SX, shape (n,)
    y : SX, shape (m,)
    kkt : SX, shape (3,)
        Primal, dual, gap; see :func:`kkt`.
    """
    q = problem
    for last in (False,) * (passes - 1) + (True,):
        w = q.preferred + (q.B.T @ y) * q.gain
        free = (w > q.lower) * (w < q.upper)
        J = _matrix(q, free)
        u = clip(w, q.lower, q.upper)
        for _ in range(refinements if last else 1):
            dy = solve(J, q.demand - y * q.compliance - q.B @ u)
            y = usable(y + dy)
            u = u + ca.if_else(free, (q.B.T @ dy) * q.gain, 0)
    u = clip(u, q.lower, q.upper)
    return u, y, kkt(q, u, y)


def kkt(problem: Problem, u: ca.SX, y: ca.SX) -> ca.SX:
    """Primal, dual and gap of a pair (u, y), relative.

    primal: max over axes of |B u + y/W^2 - v|, over |v| + |B||u|, and over effectors of the excess beyond a limit, over the range.
    dual: with r = b^2 (u - p) - B'y, in units of s = b^2 |u - p| + |B'||y|: how far a command that could still move from a price of
    zero, min(|r|/s, distance to the limit that r points to, over the range).  Small terms count fully: s is made of
    prices, not of W^2 |B||v|, which hides an answer that is wrong by half.
    gap: sum |r| distance over sum s range, what is left to gain.
    What cannot be judged, because something is not a number, is infinite.
    """
    q = problem
    tiny = 1e-300
    delivered = ca.fabs(q.demand) + ca.fabs(q.B) @ ca.fabs(u) + tiny
    span = q.upper - q.lower
    span = ca.if_else(span > 0, span, 1.0)
    outside = ca.fmax(ca.fmax(_worst((q.lower - u) / span), _worst((u - q.upper) / span)), 0.0)
    primal = ca.fmax(_worst(ca.fabs(q.B @ u + y * q.compliance - q.demand) / delivered), outside)
    weight = 1.0 / q.gain
    r = weight * (u - q.preferred) - q.B.T @ y
    scale = weight * ca.fabs(u - q.preferred) + ca.fabs(q.B).T @ ca.fabs(y) + tiny
    room = ca.fmax(ca.if_else(r > 0, u - q.lower, q.upper - u), 0.0)
    dual = _worst(ca.fmin(ca.fabs(r) / scale, room / span))
    gap = _worst(ca.sum1(ca.fabs(r) * room) / (ca.sum1(scale * span)))
    return ca.vertcat(primal, dual, gap)


def _worst(values: ca.SX) -> ca.SX:
    """Largest of some values, infinite if one of them is not a number: fmax alone would pass over that."""
    return ca.mmax(ca.if_else(values <= HUGE, values, ca.inf))


def searches_for(n: int) -> int:
    """Evaluations in one line search: enough that an unfinished one is rare."""
    return 3 if n <= 4 else 4 if n <= 12 else 5


def steps(given: Given, *, count: int, searches: int = 0, name: str = "wls_steps") -> ca.Function:
    """Function (columns of `given`, y) -> (y, settled): `count` steps; a settled y stays as it is."""
    columns, problem = given
    m, n = problem.B.shape
    y = start = ca.SX.sym("y", m)
    settled = ca.SX(0.0)
    for _ in range(count):
        new, done = newton(problem, y, searches=searches or searches_for(n))
        y = ca.if_else(settled, y, new)
        settled = ca.fmax(settled, done)
    return ca.Function(name, [*columns, start], [y, settled])


def ending(given: Given, *, passes: int = 2, refinements: int = 2, name: str = "wls_ending") -> ca.Function:
    """Function (columns of `given`, y) -> (u, y, kkt)."""
    columns, problem = given
    y = ca.SX.sym("y", problem.B.shape[0])
    return ca.Function(name, [*columns, y], list(finish(problem, y, passes=passes, refinements=refinements)))


def solver(m: int, n: int, *, count: int = 0, name: str = "wls") -> ca.Function:
    """The whole solver as one function for closed loops, compiled with them.

    Parameters
    ----------
    m, n : int
        Axes (1 to 6) and effectors.
    count : int
        Steps; 0 takes 3 for one axis and 12 for more.
    name : str

    Returns
    -------
    casadi.Function
        (B (m n,) by columns, demand (m,), lower, upper (n,), axis_weight (m,), effector_weight, preferred (n,), y (m,))
        -> (u (n,), y_next (m,), kkt (3,), solved).  Weights > 0, lower <= upper.  y is the warm start: zeros, or y_next of the
        call before.  solved is 1 if each KKT residual is at most 1e-9; u always lies inside the limits.  NaN or infinity in the
        problem gives solved = 0 and does not reach the calls after it: y_next is finite, and a y that is not counts as zero.
    """
    columns, problem = symbols(m, n)
    start = ca.SX.sym("y", m)
    y, settled = beginning(problem.demand, start), ca.SX(0.0)
    number = count or (3 if m == 1 else 12)
    once = _one_step(m, n, name=f"{name}_step", apart=False)
    if number * once.n_instructions() > WRITTEN_OUT:
        once = _one_step(m, n, name=f"{name}_step", apart=True)
    for _ in range(number):
        y, settled = once.call([*columns, y, settled])
    u, y, residuals = finish(problem, y)
    solved = ca.if_else(ca.mmax(residuals) <= TOLERANCE, 1.0, 0.0)
    return ca.Function(name, [*columns, start], [u, y, residuals, solved], [*PROBLEM, "y"], ["u", "y_next", "kkt", "solved"])


def _one_step(m: int, n: int, *, name: str, apart: bool) -> ca.Function:
    """(problem columns, y, settled) -> (y, settled); apart: called, not written out, wherever it is used."""
    columns, problem = symbols(m, n)
    y, settled = ca.SX.sym("y", m), ca.SX.sym("settled")
    new, done = newton(problem, y, searches=searches_for(n))
    results = [ca.if_else(settled, y, new), ca.fmax(settled, done)]
    return ca.Function(name, [*columns, y, settled], results, {"never_inline": apart})
