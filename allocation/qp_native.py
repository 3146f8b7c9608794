"""Many bounded weighted least-squares problems: checked input, chains of neighbours, and histories with rate limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from allocation import active_set, qp_chain
from models import native
from models.checked import Array, ModelError, as_finite, evaluate, frozen

WORTH_COMPILING = 1000  # problems; compiling takes seconds the first time
CHAIN = 50  # samples of a history in one call
LONG = 20_000  # samples of a history worth compiling: its steps stop as soon as they may in the interpreter as well
LINKS = 16  # steps for each of them at most

Call = Callable[..., tuple[Array, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Solutions:
    """Answers to N problems.

    Attributes
    ----------
    u : ndarray, shape (N, n)
    y : ndarray, shape (N, m)
        Prices W^2 (v - B u): the warm start of the next call.
    kkt : ndarray, shape (N, 3)
        Primal, dual, gap (:func:`allocation.active_set.kkt`).
    solved : ndarray of bool, shape (N,)
        Each KKT residual at most 1e-9.
    """

    u: Array
    y: Array
    kkt: Array
    solved: np.ndarray


def solve_many(
    B: Array, demand: Array, *, lower: Array, upper: Array, axis_weight: Array, effector_weight: Array, preferred: Array,
    y: Array | None = None, compiled: bool | None = None,
) -> Solutions:  # fmt: skip
    """Solve min sum W^2 (B u - v)^2 + sum b^2 (u - p)^2 over lower <= u <= upper for N problems.

    Parameters
    ----------
    B : ndarray, shape (m, n) or (N, m, n)
    demand : ndarray, shape (N, m)
        In the order of time if they follow each other: neighbours help each other.
    lower, upper, effector_weight, preferred : ndarray, shape (n,) or (N, n)
    axis_weight : ndarray, shape (m,) or (N, m)
        Weights W and b, all > 0.
    y : ndarray, shape (N, m), optional
        Warm start.
    compiled : bool, optional
        Compiled or interpreted; by the number of problems unless given.

    Raises
    ------
    ModelError
        A shape that does not fit, NaN, a weight that is not positive, crossed limits.
    """
    columns = _columns("solve_many", B, demand, lower, upper, axis_weight, effector_weight, preferred)
    N, m, n = _sizes(columns)
    kit = _kit(m, n, N >= WORTH_COMPILING if compiled is None else compiled)
    return _solve(kit, columns, N, None if y is None else _prices("solve_many", y, (N, m)))


@dataclass(frozen=True, slots=True, eq=False)
class FixedSolver:
    """A solver for effectors, limits and weights that do not change: they are written into the compiled code; use :func:`fixed`.

    1.3 to 1.9 times as fast as :func:`solve_many` (measured), and compiled anew for every other matrix.
    """

    m: int
    n: int
    kit: _Kit

    def __call__(self, demand: Array, y: Array | None = None) -> Solutions:
        """Solutions for demands (N, m) in the order of time; warm start y (N, m).

        Raises
        ------
        ModelError
            A wrong shape, NaN.
        """
        values = np.ascontiguousarray(as_finite("fixed solver: demand", demand))
        if values.ndim != 2 or values.shape[1] != self.m or not values.size:
            raise ModelError(f"fixed solver: demand has shape {np.shape(demand)}, expected (N, {self.m})")
        return _solve(self.kit, [values], len(values), None if y is None else _prices("fixed solver", y, values.shape))


def fixed(
    B: Array, *, lower: Array, upper: Array, axis_weight: Array, effector_weight: Array, preferred: Array, compiled: bool = True
) -> FixedSolver:
    """A solver for one B, limits and weights; arguments as for :func:`solve_many` without the leading axis."""
    matrix = as_finite("fixed: B", B)
    if matrix.ndim != 2 or not matrix.size:
        raise ModelError(f"fixed: B has shape {matrix.shape}, expected (m, n)")
    m, n = matrix.shape
    data = _columns("fixed", matrix, np.zeros((1, m)), lower, upper, axis_weight, effector_weight, preferred)
    if any(c.ndim != 1 for c in data[2:]):
        raise ModelError("fixed: limits and weights must be those of one problem, without a leading axis")
    given = active_set.constants(matrix, lower=data[2], upper=data[3], axis_weight=data[4], effector_weight=data[5], preferred=data[6])
    return FixedSolver(m, n, _make_kit(given, compiled))


def _solve(kit: _Kit, columns: list[Array], rows: int, y: Array | None) -> Solutions:
    u, prices, residuals, solved = kit.chain.run(columns, rows, y)
    left = np.flatnonzero(~solved)
    if left.size:
        u[left], prices[left], residuals[left] = kit.anew(qp_chain.pick(columns, left), left.size)
        solved[left] = qp_chain.good(residuals[left])
    for array in (u, prices, residuals):
        array.flags.writeable = False
    return Solutions(u, prices, residuals, solved)


def solve_history(
    B: Array, demand: Array, *, lower: Array, upper: Array, axis_weight: Array, effector_weight: Array, preferred: Array, room: Array,
    start: Array, compiled: bool | None = None,
) -> Solutions:  # fmt: skip
    """As :func:`solve_many` for problems that follow each other: each command within `room` of the one before.

    Parameters
    ----------
    room : ndarray, shape (n,)
        Largest change from one sample to the next; infinite where nothing limits it.
    start : ndarray, shape (n,)
        Commands before the first sample.

    Raises
    ------
    ModelError
        As :func:`solve_many`; a room that is negative or not a number, a wrong shape of room or start.

    Notes
    -----
    A command that lies beyond limits that have moved comes back as fast as it may.  CHAIN samples are one call; a sample that
    the steps in it do not solve is solved alone, with exact line searches, and the chain goes on behind it.
    """
    columns = _columns("solve_history", B, demand, lower, upper, axis_weight, effector_weight, preferred)
    N, m, n = _sizes(columns)
    native_wanted = N >= LONG if compiled is None else compiled
    chain, kit = _chain(m, n, native_wanted), _kit(m, n, False)  # of the kit only what solves one problem alone: nothing to compile
    before, room = as_finite("solve_history: start", start), np.asarray(room, dtype=float)
    if before.shape != (n,):
        raise ModelError(f"solve_history: start has shape {before.shape}, expected ({n},)")
    if room.shape != (n,) or not (room >= 0).all():
        raise ModelError(f"solve_history: room: expected {n} numbers >= 0 (infinite where nothing limits), got {room}")
    span = float(np.max(columns[3] - columns[2])) + 1.0 + float(np.max(np.abs(before)))
    room = np.minimum(np.where(np.isinf(room), 2 * span, room), 2 * span)
    rows = np.hstack([np.broadcast_to(np.atleast_2d(c), (N, c.shape[-1])) for c in columns])
    rows = np.vstack([rows, np.repeat(rows[-1:], CHAIN, axis=0)])  # always whole parts; the last row again
    table, carry, k = np.empty((N, n + m + 3)), np.concatenate([before, np.zeros(m)]), 0
    while k < N:
        part = chain(carry, rows[k : k + CHAIN].ravel(), room)[0].reshape(CHAIN, -1)[: N - k]
        bad = np.flatnonzero(~qp_chain.good(part[:, n + m :]))
        good = int(bad[0]) if bad.size else len(part)
        table[k : k + good] = part[:good]
        if bad.size:
            last = part[good - 1, :n] if good else carry[:n]
            problem = [c[k + good] if c.ndim == 2 else c for c in columns]
            problem[1], (problem[2], problem[3]) = problem[1][None], within(problem[2], problem[3], last, room)
            table[k + good] = np.concatenate([result[0] for result in kit.anew(problem, 1)])
            good += 1
        k += good
        carry = table[k - 1, : n + m]
    kkt = table[:, n + m :]
    return Solutions(frozen(table[:, :n]), frozen(table[:, n : n + m]), frozen(kkt), qp_chain.good(kkt))


def within(lower: Array, upper: Array, before: Array, room: Array) -> tuple[Array, Array]:
    """Limits that are left for the next sample; a command beyond limits that have moved comes back as fast as it may."""
    low = np.minimum(np.maximum(lower, before - room), before + room)
    high = np.maximum(np.minimum(upper, before + room), before - room)
    return low, high


@lru_cache(maxsize=32)
def _chain(m: int, n: int, compiled: bool) -> Call:
    """(u and y, CHAIN rows of problem data, room) -> CHAIN rows of u, y, kkt.

    Each step is a call behind a branch: a sample costs the steps that it needs, and the C code holds them once.
    """
    given = active_set.symbols(m, n)
    newton, end = active_set.steps(given, count=1, name="wls_step"), active_set.ending(given)
    inputs = newton.mx_in()
    as_it_is = ca.Function("wls_hold", inputs, [inputs[-1], ca.MX(1.0)])
    once = ca.Function.if_else("wls_once", newton, as_it_is)
    carry, row, room = ca.MX.sym("carry", n + m), ca.MX.sym("row", sum(c.numel() for c in given[0])), ca.MX.sym("room", n)
    data = ca.vertsplit(row, list(np.cumsum([0, *(c.numel() for c in given[0])])))
    before, y = carry[:n], active_set.beginning(data[1], carry[n:])
    data[2], data[3] = (
        ca.fmin(ca.fmax(data[2], before - room), before + room), ca.fmax(ca.fmin(data[3], before + room), before - room)
    )  # fmt: skip
    settled = ca.MX(0.0)
    for _ in range(LINKS):
        y, settled = once(settled == 0, *data, y)
    u, y, kkt = end(*data, y)
    sample = ca.Function("wls_sample", [carry, row, room], [ca.vertcat(u, y), ca.vertcat(u, y, kkt)])
    rows = ca.MX.sym("rows", row.numel() * CHAIN)
    _, found = sample.mapaccum("wls_chain", CHAIN)(carry, ca.reshape(rows, -1, CHAIN), ca.repmat(room, 1, CHAIN))
    chain = ca.Function("wls_history", [carry, rows, room], [ca.vec(found)], ["carry", "rows", "room"], ["found"])
    if not compiled:
        return lambda *arguments: evaluate(chain, *arguments)
    return native.compile(chain, lanes=1, threads=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Kit:
    """Functions of one size: chains, compiled or not, and what solves the rare problem that they leave."""

    chain: qp_chain.Chain
    thorough: ca.Function
    ending: ca.Function

    def anew(self, columns: list[Array], rows: int) -> tuple[Array, Array, Array]:
        """u, y, kkt from the beginning, with exact line searches; the best of all steps."""
        y = np.zeros((rows, self.ending.size1_out(1)))
        best = list(evaluate(self.ending, *columns, y))
        left = np.arange(rows)
        for _ in range(qp_chain.ROUNDS):
            data = qp_chain.pick(columns, left)
            y[left], settled = evaluate(self.thorough, *data, y[left])
            found = evaluate(self.ending, *data, y[left])
            better = found[2].max(axis=1) < best[2][left].max(axis=1)
            for whole, new in zip(best, found, strict=True):
                whole[left[better]] = new[better]
            left = left[(settled[:, 0] == 0) & ~qp_chain.good(best[2][left])]
            if not left.size:
                break
        return best[0], best[1], best[2]


@lru_cache(maxsize=32)
def _kit(m: int, n: int, compiled: bool) -> _Kit:
    return _make_kit(active_set.symbols(m, n), compiled)


def _make_kit(given: active_set.Given, compiled: bool) -> _Kit:
    ending = active_set.ending(given)
    chain = qp_chain.make(active_set.steps(given, count=1, name="wls_step"), ending, compiled=compiled)
    return _Kit(chain, active_set.steps(given, count=1, searches=8, name="wls_thorough"), ending)


def _columns(what: str, *values: Array) -> list[Array]:
    """Checked problem data in the order of ``active_set.PROBLEM``; B by columns."""
    names = active_set.PROBLEM
    data = [as_finite(f"{what}: {name}", value) for name, value in zip(names, values, strict=True)]
    B, demand = data[0], data[1]
    if demand.ndim != 2 or not demand.size or B.ndim not in (2, 3) or B.shape[-2] != demand.shape[1]:
        raise ModelError(f"{what}: B has shape {B.shape} and demand {demand.shape}, expected (m, n) or (N, m, n), and (N, m)")
    N, m, n = len(demand), demand.shape[1], B.shape[-1]
    sizes = (None, m, n, n, m, n, n)
    for name, value, size in zip(names[2:], data[2:], sizes[2:], strict=True):
        if value.shape not in ((size,), (N, size)):
            raise ModelError(f"{what}: {name} has shape {value.shape}, expected ({size},) or ({N}, {size})")
    if B.ndim == 3 and len(B) != N:
        raise ModelError(f"{what}: {len(B)} matrices B beside {N} demands; give one, or one for each")
    for name in ("axis_weight", "effector_weight"):
        if (data[names.index(name)] <= 0).any():
            raise ModelError(f"{what}: {name} has an entry that is not > 0; give small weights instead of zero")
    if (data[2] > data[3]).any():
        raise ModelError(f"{what}: a lower limit is above its upper limit; correct the limits")
    return [np.ascontiguousarray(np.swapaxes(B, -1, -2)).reshape(*B.shape[:-2], m * n), *data[1:]]


def _sizes(columns: list[Array]) -> tuple[int, int, int]:
    """N, m, n of problem data."""
    N, m = columns[1].shape
    return N, m, columns[0].shape[-1] // m


def _prices(what: str, y: Array, shape: tuple[int, ...]) -> Array:
    """Checked warm start."""
    values = as_finite(f"{what}: y", y)
    if values.shape != shape:
        raise ModelError(f"{what}: y has shape {values.shape}, expected {shape}: one row of prices for each demand")
    return values
