"""Event-exact simulation of a trigger with any linear plant: short steps by an exact series, each switching located to rounding.

One CasADi function advances the loop by one step or to the next switching, whichever comes first; thousands of them are chained. Inside a
step the state is a power series in time, which for a short step is exact to rounding, so that the trigger's input is one polynomial and
its first threshold crossing a bracketed root.  Signs: see :mod:`models.flexible_loop`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from models.checked import Array, ModelError, Status, as_finite, as_scalar, evaluate, frozen
from models.flexible_loop import LinearLoop
from models.modulators import SchmittTrigger

ORDER = 16  # of the series; with |lambda| step <= 1/2 the first term left out is 2e-20
REACH = 0.5
CHUNK = 2048  # most steps chained in one call
BISECTIONS, NEWTONS = 26, 40
FAR = 1e30  # the time of a switching that is not pending


@dataclass(frozen=True, slots=True, eq=False)
class LoopRun:
    """A simulated loop.

    Attributes
    ----------
    t : ndarray, shape (N,)
        Nodes, s: the ends of the steps; every switching is a node.
    x : ndarray, shape (N, n)
    y, u : ndarray, shape (N,)
        Trigger output and the same after the delay, both just after the node.
    events : ndarray of int, shape (M,)
        Nodes at which the trigger switched.
    loop, trigger, bias : the arguments of :func:`simulate_loop`
    status : Status
        OK, or MAX_ITERATIONS where it was given up: the switchings follow each other without end (chatter), or t_max needs more than
        ``max_nodes`` steps.
    """

    t: Array
    x: Array
    y: Array
    u: Array
    events: np.ndarray
    loop: LinearLoop
    trigger: SchmittTrigger
    bias: float
    status: Status

    @property
    def s(self) -> Array:
        """Input of the trigger at the nodes, shape (N,)."""
        return np.asarray(self.x @ self.loop.C)

    @property
    def attitude(self) -> Array:
        """Attitude at the nodes, shape (N,)."""
        return np.asarray(self.x @ self.loop.attitude)

    @property
    def flexible(self) -> Array:
        """What the modes contribute to the attitude at the nodes, shape (N,)."""
        return np.asarray(self.x @ self.loop.flexible)

    def dense(self, parts: int = 8) -> tuple[Array, Array]:
        """Time (K,) and state (K, n) with every step divided into `parts`; exact between the nodes too."""
        start = self.t[:-1]
        length = np.diff(self.t)
        rate = self.x[:-1] @ self.loop.A.T + np.outer(self.bias - self.u[:-1], self.loop.B)
        fractions = np.arange(parts) / parts
        dt = np.outer(length, fractions)
        x = np.repeat(self.x[:-1, None, :], parts, axis=1)
        term, power = rate, np.ones_like(dt)
        for k in range(1, ORDER + 1):  # terms of the series, not time
            power = power * dt / k
            x = x + power[:, :, None] * term[:, None, :]
            term = term @ self.loop.A.T
        t = (start[:, None] + dt).ravel()
        return np.append(t, self.t[-1]), np.vstack([x.reshape(-1, self.x.shape[1]), self.x[-1:]])

    def peak_flexible(self, since: float = 0.0) -> float:
        """Largest |flexible part| from the time `since` on, between the nodes too."""
        t, x = self.dense()
        return float(np.abs(x[t >= since] @ self.loop.flexible).max(initial=0.0))

    def peak_attitude(self, since: float = 0.0) -> float:
        """Largest |attitude| from the time `since` on, between the nodes too."""
        t, x = self.dense()
        return float(np.abs(x[t >= since] @ self.loop.attitude).max(initial=0.0))

    def firing(self, since: float = 0.0) -> float:
        """Fraction of the time from `since` on in which a jet fires."""
        length = np.diff(self.t)[self.t[:-1] >= since]
        return float(np.abs(self.u[:-1][self.t[:-1] >= since]) @ length / max(length.sum(), 1e-300))

    def frequency(self, since: float = 0.0) -> float | None:
        """Mean angular frequency of the switchings from off to positive, rad/s; None with fewer than three of them."""
        at = self.events[(self.y[self.events] > 0) & (self.t[self.events] >= since)]
        return None if len(at) < 3 else float(2 * np.pi * (len(at) - 1) / (self.t[at[-1]] - self.t[at[0]]))


def simulate_loop(
    loop: LinearLoop,
    trigger: SchmittTrigger,
    *,
    x0: ArrayLike,
    t_max: float,
    bias: float = 0.0,
    output: float = 0.0,
    settled: bool = False,
    pending: tuple[tuple[float, float], ...] = (),
    applied: float | None = None,
    step: float | None = None,
    max_nodes: int = 200_000,
) -> LoopRun:
    """Simulate xdot = A x + B (bias - y(t - delay)), y = trigger(C x) from t = 0.

    Parameters
    ----------
    loop : LinearLoop
    trigger : SchmittTrigger
    x0 : array_like, shape (n,)
    t_max : float
        End, s, > 0.
    bias : float
        Constant disturbance as a fraction of the jets' torque.
    output : float
        The trigger's output before t = 0: -1, 0 or 1.
    settled : bool
        The trigger has just switched to `output`: it is not asked again at t = 0.
    pending : tuple of (time, level)
        Switchings of the jets that are under way in the delay at t = 0, by increasing time.
    applied : float, optional
        What the jets do at t = 0 with a delay; `output` unless given.
    step : float, optional
        Longest distance of two nodes, s; t_max/200 unless given, and never more than half a radian of the fastest mode.
    max_nodes : int
        Steps after which the simulation is given up (status MAX_ITERATIONS).

    Returns
    -------
    LoopRun

    Raises
    ------
    ModelError
        A wrong shape or a number that is not finite.
    """
    start = as_finite("simulate_loop: x0", x0)
    n = len(loop.A)
    if start.shape != (n,):
        raise ModelError(f"simulate_loop: x0: expected shape ({n},), got {start.shape}; one number for each state of the {loop.name}")
    end, push = as_scalar("simulate_loop: t_max", t_max), as_scalar("simulate_loop: bias", bias)
    if end <= 0:
        raise ModelError(f"simulate_loop: t_max = {end:.6g} s; expected > 0")
    longest = longest_step(loop, end / 200 if step is None else as_scalar("simulate_loop: step", step))
    slots = 0 if loop.delay == 0 else 8
    first = float(output) if settled else float(trigger.step(np.array([output]), float(start @ loop.C))[1])
    u = first if slots == 0 else (output if applied is None else applied)
    queue = [list(pair) for pair in pending] + ([[loop.delay, first]] if slots and first != output else [])
    if len(queue) > slots:
        raise ModelError(f"simulate_loop: pending: {len(queue)} switchings in the delay, at most {slots} are followed")
    times = [pair[0] for pair in queue] + [FAR] * (slots - len(queue))
    levels = [pair[1] for pair in queue] + [0.0] * (slots - len(queue))
    carry = np.array([0.0, first, u, end, *start, *times, *levels])
    chunk = int(min(CHUNK, 64 + 1.5 * end / longest))
    advance = _step_function(loop, trigger, push, longest, slots).mapaccum(chunk)
    blocks = [carry[None]]
    while blocks[-1][-1, 0] < end and len(blocks) * chunk <= max_nodes:
        blocks.append(evaluate(advance, blocks[-1][-1])[0].T)
    nodes = np.vstack(blocks)
    done = nodes[-1, 0] >= end
    if done:
        nodes = nodes[: int(np.argmax(nodes[:, 0] >= end)) + 1]
    if not np.array_equal(nodes[:, 1], nodes[:, 1].round()) or (slots and nodes[:, 4 + n + slots - 1].min() < FAR):
        raise ModelError(f"simulate_loop: more than {slots - 1} switchings are under way in the delay; shorten it")
    events = np.flatnonzero(np.diff(nodes[:, 1]) != 0) + 1
    status = Status.OK if done else Status.MAX_ITERATIONS
    x = nodes[:, 4 : 4 + n]
    return LoopRun(
        frozen(nodes[:, 0]), frozen(x), frozen(nodes[:, 1]), frozen(nodes[:, 2]), events, loop, trigger, push, status
    )  # fmt: skip


def longest_step(loop: LinearLoop, wanted: float) -> float:
    """Longest step <= `wanted` for which the series is exact to rounding, s."""
    fastest = float(np.abs(np.linalg.eigvals(loop.A)).max())
    step = wanted if fastest < 1e-12 * max(float(np.abs(loop.A).max()), 1e-300) else min(wanted, REACH / fastest)
    for _ in range(60):  # a matrix far from normal needs less than its eigenvalues say
        series, term = np.eye(len(loop.A)), np.eye(len(loop.A))
        for k in range(1, ORDER + 1):
            term = term @ loop.A * (step / k)
            series = series + term
        exact = expm(loop.A * step)
        if np.abs(series - exact).max() <= 1e-13 * np.abs(exact).max():
            return step
        step /= 2
    raise ModelError(f"{loop.name}: no step was found for which the series of exp(A t) converges; scale the states")


def _step_function(loop: LinearLoop, trigger: SchmittTrigger, bias: float, longest: float, slots: int) -> ca.Function:
    """Carry [t, y, u, end, x, times and levels of pending switchings] -> carry after one step or one switching."""
    n = len(loop.A)
    c = ca.SX.sym("c", 4 + n + 2 * slots)
    t, y, u, end, x = c[0], c[1], c[2], c[3], c[4 : 4 + n]
    times, levels = c[4 + n : 4 + n + slots], c[4 + n + slots :]
    until = ca.fmin(end, times[0]) if slots else end
    h = ca.fmin(longest, until - t)
    A, row = ca.sparsify(ca.DM(loop.A)), ca.DM(loop.C).T
    rate = ca.mtimes(A, x) + ca.DM(loop.B) * (bias - u)
    terms = [x]
    for k in range(1, ORDER + 1):
        terms.append((ca.mtimes(A, terms[-1]) if k > 1 else rate) * (h / k))
    series = [ca.mtimes(row, term) for term in terms]
    first_root = _root_function()
    up, up_root = first_root(_margin(series, y, trigger, 1.0))
    down, down_root = first_root(_margin(series, y, trigger, -1.0))
    positive = ca.if_else(up, ca.if_else(down, up_root <= down_root, 1), 0)
    fraction = ca.if_else(positive, up_root, ca.if_else(down, down_root, 1))
    switched = ca.logic_or(up, down)
    y_next = ca.if_else(switched, ca.if_else(y == 0, ca.if_else(positive, 1, -1), 0), y)
    x_next = terms[-1]
    for term in reversed(terms[:-1]):
        x_next = term + fraction * x_next
    whole = ca.logic_not(switched)
    t_next = ca.if_else(whole, ca.if_else(h < longest, until, t + h), t + fraction * h)  # the end and a pending time are met exactly
    if not slots:
        return ca.Function("loop_step", [c], [ca.vertcat(t_next, y_next, y_next, end, x_next)], ["c"], ["c_next"])
    take = ca.logic_and(whole, ca.logic_and(times[0] <= end, h < longest))
    u_next = ca.if_else(take, levels[0], u)
    times_next = ca.if_else(take, ca.vertcat(times[1:], FAR), times)
    levels_next = ca.if_else(take, ca.vertcat(levels[1:], 0), levels)
    free = switched
    for i in range(slots):
        here = ca.logic_and(free, times_next[i] >= FAR)
        times_next[i] = ca.if_else(here, t_next + loop.delay, times_next[i])
        levels_next[i] = ca.if_else(here, y_next, levels_next[i])
        free = ca.logic_and(free, ca.logic_not(here))
    return ca.Function("loop_step", [c], [ca.vertcat(t_next, y_next, u_next, end, x_next, times_next, levels_next)], ["c"], ["c_next"])


def _margin(series: list[Any], y: Any, trigger: SchmittTrigger, sign: float) -> Any:
    """Coefficients of the distance to the next switching that the sign is about: on if y = 0, off if y = sign; positive before it."""
    off = y == 0
    slope = ca.if_else(off, -sign, ca.if_else(y == sign, sign, 0))
    level = ca.if_else(off, trigger.u_on, ca.if_else(y == sign, -trigger.u_off, 1))
    return ca.vertcat(level + slope * series[0], *(slope * s for s in series[1:]))


@cache
def _root_function() -> ca.Function:
    """Coefficients b (ORDER + 1,) -> whether sum b_k s^k falls below zero in 0 <= s <= 1, and where it does so first.

    Also where it dips below zero inside and is positive again at the end: the lowest point is found first.  A value that is negative by
    rounding only, just after a switching without hysteresis, rises: it counts as zero.
    """
    given = ca.SX.sym("b", ORDER + 1)
    b = ca.vertsplit(given)
    slope = [k * value for k, value in enumerate(b)][1:]
    b[0] = ca.if_else(slope[0] > 0, ca.fmax(b[0], 0), b[0])
    at_end = _poly(b, ca.SX(1))
    low, high = ca.SX(0), ca.SX(1)
    for _ in range(BISECTIONS):  # iterations of a root, unrolled into the function
        middle = 0.5 * (low + high)
        falls = _poly(slope, middle) < 0
        low, high = ca.if_else(falls, middle, low), ca.if_else(falls, high, middle)
    dips = ca.logic_and(ca.logic_and(slope[0] < 0, _poly(slope, ca.SX(1)) > 0), _poly(b, low) < 0)
    found = ca.logic_and(ca.logic_or(at_end <= 0, dips), ca.logic_or(b[0] != 0, slope[0] != 0))
    low, high = ca.SX(0), ca.if_else(at_end <= 0, 1, low)
    root = 0.5 * high
    for _ in range(NEWTONS):
        value, rate = _poly(b, root), _poly(slope, root)
        low, high = ca.if_else(value > 0, root, low), ca.if_else(value > 0, high, root)
        trial = root - value / ca.if_else(rate == 0, 1e-300, rate)
        root = ca.if_else(ca.logic_and(trial > low, trial < high), trial, 0.5 * (low + high))
    return ca.Function("first_root", [given], [found, root], ["b"], ["found", "root"])


def _poly(b: list[Any], s: Any) -> Any:
    value = b[-1]
    for coefficient in reversed(b[:-1]):
        value = coefficient + s * value
    return value
