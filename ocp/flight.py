"""The engine of the simulator: groups of steps as one CasADi function, chunks of groups, crossings for many cases at once."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from models.core import Array, Model, ModelError, Status, as_finite, as_scalar, evaluate
from models.native_loop import Stopping
from ocp.laws import BoundLaw
from ocp.methods import Method, group_of_steps
from ocp.stops import Stop, partial, stopping

GROUP = 4  # steps in a group of a continuous law: a step over the group and two half steps find their midpoints among the nodes
CHUNK = 64  # groups flown between two looks at the stop condition
BLOCK = 4096  # cases that the interpreter flies together, with the carries of a chunk: bounds the memory
STATUSES = tuple(Status)
CODE = {status: code for code, status in enumerate(STATUSES)}


@lru_cache(maxsize=64)
def group_function(model: Model, step: ca.Function | None, n_z: int, n_w: int, method: Method, n: int) -> tuple[ca.Function, ca.Function]:
    """One group of `n` steps under a law, with c = [x; z; u] and q = [t; H; w].

    Returns
    -------
    group : (c, q, p) -> (c_next, X (nx, n), U (nu, n))
    prepare : (c, q, p) -> (x, H, [u at the start; u at the end], z_next)
    """
    nx, nu = len(model.states), len(model.inputs)
    c, q, p = ca.SX.sym("c", nx + n_z + nu), ca.SX.sym("q", 2 + n_w), ca.SX.sym("p", len(model.params))
    # with [rows, :], because an empty slice of a 1-by-1 by one index is a row, which vertcat then takes for an element
    x, z, held, w = c[:nx, :], c[nx : nx + n_z, :], c[nx + n_z :, :], q[2:, :]
    if step is None:
        ends, z_next = (ca.vertcat(w, w) if n_w == nu else w), z  # of equal ends the slope is gone, and what depends on u alone shared
    else:
        u, z_next = step(q[0], x, model.out(x, held, p), z, w)
        ends = ca.vertcat(u, u)
    symbol = ca.SX.sym("ends", 2 * nu)
    flow = group_of_steps(model, method, n, ([symbol], lambda sigma, _: symbol[:nu] + sigma * (symbol[nu:] - symbol[:nu])))
    prepare = ca.Function(f"{model.name}_prepare", [c, q, p], [x, q[1], ends, z_next])
    kind: Any = ca.SX if flow.is_a("SXFunction") else ca.MX
    outer = [kind.sym(name, prepare.size1_in(i)) for i, name in enumerate("cqp")]
    x0, duration, w01, zn = prepare.call(outer)
    states, inputs = flow.call([x0, duration, outer[2], w01])
    c_next = ca.vertcat(states[:, -1], zn, inputs[:, -1])
    return ca.Function(f"{model.name}_group", outer, [c_next, states, inputs], ["c", "q", "p"], ["c_next", "X", "U"]), prepare


@lru_cache(maxsize=64)
def _loop(group: ca.Function, count: int, store: bool) -> ca.Function:
    """(c0, Q, p) -> (C, X, U) of `count` groups in a row; without `store` only C (nc, count)."""
    c0, q = ca.MX.sym("c0", group.size1_in(0)), ca.MX.sym("Q", group.size1_in(1), count)
    p = ca.MX.sym("p", group.size1_in(2))
    results = group.mapaccum(count)(c0, q, ca.repmat(p, 1, count))
    return ca.Function(f"{group.name()}_loop", [c0, q, p], list(results) if store else [results[0]])


@dataclass(frozen=True, slots=True, eq=False)
class Engine:
    """A model under a law, ready to fly over given group edges (times, s, shape (M + 1,)) to a stop condition, if there is one."""

    model: Model
    bound: BoundLaw
    group: ca.Function
    prepare: ca.Function
    n: int
    edges: Array
    margin: ca.Function | None
    stopping: Stopping | None

    def start(self, x0: Array) -> Array:
        """Carry c (N, nc) at the first edge; no input has been given yet, so it stands at zero."""
        n = len(x0)
        return np.hstack([x0, np.tile(self.bound.z0, (n, 1)), np.zeros((n, len(self.model.inputs)))])

    def queue(self, start: Array, end: Array) -> Array:
        """Per-group values q = [t; H; w], shape (M, 2 + nw)."""
        signals = as_finite("law: signals", self.bound.signals(start, end))
        if signals.shape != (len(start), self.bound.n_signals):
            raise ModelError(
                f"law: signals returned shape {signals.shape} for {len(start)} times, expected {(len(start), self.bound.n_signals)};"
                " return one row for each time and set n_signals to its length"
            )
        return np.column_stack([start, end - start, signals])

    def memory(self, c: Array) -> Array:
        """Memory of the law in carries (..., nc), shape (..., nz)."""
        nx = len(self.model.states)
        return c[..., nx : nx + len(self.bound.z0)]

    def split(self, c: Array) -> tuple[Array, Array]:
        """States and inputs of carries (..., nc)."""
        nx, nu = len(self.model.states), len(self.model.inputs)
        return c[..., :nx], c[..., c.shape[-1] - nu :]

    def fly(self, c: Array, p: Array, first: int, count: int, *, store: bool) -> tuple[Array, ...]:
        """Groups first .. first + count - 1 of N cases: carries (N, count, nc) after each group, and, with `store`, X and U."""
        q = self.queue(self.edges[first : first + count], self.edges[first + 1 : first + count + 1])
        loop = _loop(self.group, count, store)
        cases = len(c)
        mapped = loop if cases == 1 else loop.map(f"{loop.name()}_{cases}", "serial", cases, [1], [])
        try:
            results = mapped.call([ca.DM(c.T), ca.DM(q.T), ca.DM(p.T)])
        except RuntimeError:  # an adaptive integrator gave up somewhere: find out in which case and group
            return self._fly_apart(c, p, q, store=store)
        out = []
        for i, result in enumerate(results):
            rows, columns = loop.size_out(i)
            out.append(np.moveaxis(np.asarray(result.full()).reshape(rows, cases, columns), 0, -1))
        return tuple(out)

    def _fly_apart(self, c: Array, p: Array, q: Array, *, store: bool) -> tuple[Array, ...]:
        """As :meth:`fly`, one group of one case at a time; NaN from the group on that cannot be integrated."""
        cases, count, (nx, nu) = len(c), len(q), (len(self.model.states), len(self.model.inputs))
        C, X, U = (np.full((cases, count * k, width), np.nan) for k, width in ((1, c.shape[1]), (self.n, nx), (self.n, nu)))
        for i in range(cases):
            carry = c[i]
            for j in range(count):
                try:
                    results = self.group.call([ca.DM(carry), ca.DM(q[j]), ca.DM(p[i])])
                except RuntimeError:
                    break
                steps = slice(j * self.n, (j + 1) * self.n)
                C[i, j], X[i, steps], U[i, steps] = (np.asarray(r.full()).T for r in results)
                carry = C[i, j]
        return (C, X, U) if store else (C,)

    def steps(self) -> Array:
        """The queue of all groups, shape (M, 2 + nw)."""
        return self.queue(self.edges[:-1], self.edges[1:])

    def margins(self, c: Array, p: Array) -> Array:
        """Margin to the stop of each carry (M, nc), shape (M,); NaN where a state or an output is not finite."""
        assert self.margin is not None
        out = np.full(len(c), np.nan)
        finite = np.isfinite(c).all(axis=1)
        if finite.any():
            out[finite] = evaluate(self.margin, c[finite], p[finite], finite=False)[0][:, 0]
        return out

    def first_margins(self, x0: Array, p: Array) -> Array:
        """Margins at the start with the law's first input, shape (N,)."""
        assert self.stopping is not None
        first = self.queue(self.edges[:1], self.edges[1:2])[0]
        return np.asarray(evaluate(self.stopping.start, self.start(x0), first, p, finite=False)[0][:, 0])

    def part(self, index: np.ndarray, fraction: Array) -> Array:
        """Queue rows (M, 2 + nw) of the first `fraction` (M,) of groups `index` (M,).

        A linear input ends where it has got to by then; a sampled law has read its tables at the start of the group.
        """
        groups, row = np.unique(index, return_inverse=True)
        q = self.queue(self.edges[groups], self.edges[groups + 1])[row]
        part = partial(q.T, fraction, len(self.model.inputs), held=self.bound.holds(len(self.model.inputs)))
        return np.ascontiguousarray(part.T)

    def carry(self, c: Array, p: Array, index: np.ndarray, fraction: Array) -> Array:
        """Carries (M, nc) after fractions (M,) of the groups `index` (M,)."""
        try:
            return evaluate(self.group, c, self.part(index, fraction), p, finite=False)[0]
        except RuntimeError:
            return np.full(c.shape, np.nan)

    def reach(self, c: Array, p: Array, index: int) -> float:
        """Fraction of a group that ends without a finite state at which the stop has just been met; 0 if it is not met before."""
        low, high = 0.0, 1.0
        for _ in range(4):  # 64^4: the stop may lie just before the edge of the model's domain
            fractions = np.linspace(low, high, 65)[1:]
            rows = [np.repeat(a[None], 64, axis=0) for a in (c, p)]
            margins = self.margins(self.carry(rows[0], rows[1], np.full(64, index), fractions), rows[1])
            first = int(np.argmax(~(margins > 0)))
            if margins[first] <= 0:
                return float(fractions[first])
            low, high = fractions[first] - (high - low) / 64, float(fractions[first])
        return 0.0


def prepare(model: Model, bound: BoundLaw, method: Method, t_max: float, until: Stop | None, *, alone: bool = False) -> Engine:
    """Choose the groups of a flight over [0, t_max] and build its functions; `alone`: each step of a continuous law is a group."""
    if bound.sample is None:
        n = 1 if alone else GROUP
        kinks = [0.0, *(t for t in bound.kinks if 0 < t < t_max), t_max]
        pieces = []
        length = GROUP * method.step
        _check_count(t_max / length, t_max)
        for k, (start, end) in enumerate(itertools.pairwise(kinks)):
            count = int(np.ceil((end - start) / length * (1 - 1e-12)))
            if k + 2 == len(kinks):  # the last piece keeps the full step: it normally ends at a stop condition
                pieces.append(start + length * np.arange(count))
            else:
                pieces.append(np.linspace(start, end, count, endpoint=False))
        edges = np.concatenate([*pieces, [t_max]])
        if alone:  # the same steps as those inside the groups
            edges = np.append((edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(GROUP) / GROUP)).ravel(), t_max)
    else:
        _check_count(t_max / bound.sample, t_max)
        n = max(1, int(np.ceil(bound.sample / method.step * (1 - 1e-12))))
        count = int(np.ceil(t_max / bound.sample * (1 - 1e-12)))
        edges = np.append(bound.sample * np.arange(count), t_max)
    group, first = group_function(model, bound.step, len(bound.z0), bound.n_signals, method, n)
    margin, search = (None, None) if until is None else stopping(group, first, model, until, held=bound.holds(len(model.inputs)))
    return Engine(model, bound, group, first, n, edges, margin, search)


def _check_count(groups: float, t_max: float) -> None:
    if groups > 5e6:
        raise ModelError(f"simulate: t_max = {t_max:.6g} s takes {4 * groups:.3g} steps; give a shorter time or a longer step")


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Where each of N cases ended: time, carry, last complete group, fraction of the next one, status as a place in STATUSES."""

    t: Array
    c: Array
    group: np.ndarray
    fraction: Array
    status: np.ndarray


def fly_to_stop(
    engine: Engine, x0: Array, p: Array, *,
    progress: Callable[[float], None] | None = None, record: list[Record] | None = None,
) -> tuple[Outcome, list[tuple[Array, ...]]]:  # fmt: skip
    """Fly N cases until each has stopped, failed or reached the last edge; for N = 1 also all nodes, chunk by chunk.

    `record` receives (case, t, x, u) at the start of every group flown, chunk by chunk.
    """
    cases, store = len(x0), len(x0) == 1
    total = len(engine.edges) - 1
    c, active, result = begin(engine, x0, p)
    chunks: list[tuple[Array, ...]] = []
    for first in range(0, total, CHUNK):
        if active.size == 0:
            break
        count = min(CHUNK, total - first)
        flown = engine.fly(c[active], p[active], first, count, store=store)
        if store:
            chunks.append(flown)
        alive = _settle(engine, c, p, active, flown[0], first, result)
        if record is not None:
            record.append(_recorded(engine, c[active], active, flown[0], first, np.where(alive, count, result.group[active] - first + 1)))
        c[active[alive]] = flown[0][alive, -1]
        active = active[alive]
        if progress is not None:
            progress(1 - active.size / cases * (1 - (first + count) / total))
    result.t[active], result.c[active], result.group[active] = engine.edges[-1], c[active], total
    if engine.stopping is None:
        result.status[active] = CODE[Status.OK]
    return result, chunks


def begin(engine: Engine, x0: Array, p: Array) -> tuple[Array, np.ndarray, Outcome]:
    """Carries (N, nc) at the start, the cases that are to be flown, and the outcome so far: those past the stop are refused."""
    cases, c = len(x0), engine.start(x0)
    result = Outcome(np.zeros(cases), c.copy(), np.zeros(cases, dtype=int), np.zeros(cases), np.full(cases, CODE[Status.STOP_NOT_REACHED]))
    active = np.arange(cases)
    if engine.stopping is not None:
        margins = engine.first_margins(x0, p)
        result.status[~(margins > 0)] = CODE[Status.OUT_OF_DOMAIN]
        active = np.flatnonzero(margins > 0)
    return c, active, result


Record = tuple[np.ndarray, Array, Array, Array]


def _recorded(engine: Engine, before: Array, active: np.ndarray, flown: Array, first: int, groups: np.ndarray) -> Record:
    """(case, t, x, u) at the start of the first `groups` groups of a chunk, case by case."""
    count = flown.shape[1]
    starts = np.concatenate([before[:, None], flown[:, :-1]], axis=1)
    flown_now = np.arange(count) < groups[:, None]
    case, times = np.broadcast_to(active[:, None], flown_now.shape), np.broadcast_to(engine.edges[first : first + count], flown_now.shape)
    # the carry after a group still holds the input of that group
    return case[flown_now], times[flown_now], engine.split(starts)[0][flown_now], engine.split(flown)[1][flown_now]


def _settle(engine: Engine, c: Array, p: Array, active: np.ndarray, flown: Array, first: int, result: Outcome) -> np.ndarray:
    """Record the cases of a chunk that stopped or failed; return the mask of those that fly on."""
    cases, count, nc = flown.shape
    finite = np.asarray(np.isfinite(flown).all(axis=2))
    crossed = np.zeros((cases, count), dtype=bool)
    if engine.stopping is not None:
        margins = engine.margins(flown.reshape(-1, nc), np.repeat(p[active], count, axis=0)).reshape(cases, count)
        crossed, finite = margins <= 0, finite & ~np.isnan(margins)
    event = crossed | ~finite
    ended = np.asarray(event.any(axis=1))
    where = np.argmax(event, axis=1)
    rows = np.arange(cases)
    before = np.where((where == 0)[:, None], c[active], flown[rows, np.maximum(where - 1, 0)])
    after, met = flown[rows, where], crossed[rows, where]
    conclude(engine, before[ended], after[ended], p, active[ended], first + where[ended], met[ended], result)
    return ~ended


def conclude(
    engine: Engine, before: Array, after: Array, p: Array, cases: np.ndarray, index: np.ndarray, crossed: np.ndarray, result: Outcome
) -> None:
    """Record `cases` that ended in the groups `index`: at their stop where they crossed it, else as NONFINITE with the last good carry.

    A case without a finite end of its group may still have met the stop before: it is looked for.
    """
    result.t[cases], result.c[cases], result.group[cases], result.fraction[cases] = engine.edges[index], before, index, 0.0
    result.status[cases] = CODE[Status.NONFINITE]
    if engine.stopping is None:
        return
    reach = crossed.astype(float)
    for k in np.flatnonzero(~crossed):
        reach[k] = engine.reach(before[k], p[cases[k]], int(index[k]))
    short = (reach > 0) & ~crossed
    if short.any():
        after = after.copy()
        after[short] = engine.carry(before[short], p[cases[short]], index[short], reach[short])
    hit = np.flatnonzero(reach > 0)
    if hit.size == 0:
        return
    queue = engine.part(index[hit], np.ones(hit.size))
    fraction, carry = engine.stopping.locate(before[hit], after[hit], queue, p[cases[hit]], reach[hit])
    good = np.isfinite(carry).all(axis=1)
    done, group, part = cases[hit[good]], index[hit[good]], fraction[good]
    result.t[done] = engine.edges[group] + part * (engine.edges[group + 1] - engine.edges[group])
    result.c[done], result.fraction[done], result.status[done] = carry[good], part, CODE[Status.OK]


def nodes(engine: Engine, x0: Array, p: Array, outcome: Outcome, chunks: list[tuple[Array, ...]]) -> tuple[Array, Array, Array]:
    """All nodes (t, x, u) of a single flight, ending at its stop."""
    groups, n = int(outcome.group[0]), engine.n
    nx, nu = x0.shape[1], len(engine.model.inputs)
    carries = np.concatenate([np.zeros((0, engine.start(x0).shape[1])), *[chunk[0][0] for chunk in chunks]])[:groups]
    inner_x = np.concatenate([np.zeros((0, nx)), *[chunk[1][0] for chunk in chunks]])[: groups * n]
    inner_u = np.concatenate([np.zeros((0, nu)), *[chunk[2][0] for chunk in chunks]])[: groups * n]
    edges = engine.edges[: groups + 1]
    if outcome.fraction[0] > 0:
        start = engine.start(x0) if groups == 0 else carries[-1:]
        end = edges[-1:] + outcome.fraction[0] * (engine.edges[groups + 1] - edges[-1])
        _, last_x, last_u = evaluate(engine.group, start, engine.part(np.array([groups]), outcome.fraction), p)
        inner_x = np.concatenate([inner_x, last_x.reshape(1, nx, n)[0].T])
        inner_u = np.concatenate([inner_u, last_u.reshape(1, nu, n)[0].T])
        edges = np.append(edges, end)
    return _assemble(engine, x0[0], edges, inner_x, inner_u)


def _assemble(engine: Engine, x0: Array, edges: Array, inner_x: Array, inner_u: Array) -> tuple[Array, Array, Array]:
    n, groups = engine.n, len(edges) - 1
    if groups == 0:
        return np.zeros(1), x0[None], np.zeros((1, len(engine.model.inputs)))
    length = np.diff(edges)
    ends = (edges[:-1, None] + length[:, None] * np.arange(1, n + 1) / n).ravel()
    ends[n - 1 :: n] = edges[1:]
    t, x = np.concatenate([[0.0], ends]), np.vstack([x0, inner_x])
    if engine.bound.sample is not None:
        # u[k] holds from t[k] on; the last node repeats the last input
        return t, x, np.vstack([inner_u, inner_u[-1:]])
    first_inputs = engine.bound.signals(edges[:-1], edges[1:])[:, : inner_u.shape[1]]
    u = np.vstack([first_inputs[:1], inner_u])
    scale = np.maximum(np.abs(first_inputs[1:]), [v.nominal for v in engine.model.inputs])  # below: rounding of the interpolation
    jump = (np.abs(first_inputs[1:] - inner_u[n - 1 : -1 : n]) > 1e-12 * scale).any(axis=1)
    jump |= np.abs(np.diff(length)) > 1e-9 * length[1:]
    kink = np.isin(edges[1:-1], engine.bound.kinks)
    twice = np.flatnonzero(jump | kink) + 1  # group indices whose first node stands twice
    at = twice * n + 1
    return np.insert(t, at, edges[twice]), np.insert(x, at, x[twice * n], axis=0), np.insert(u, at, first_inputs[twice], axis=0)


def require_until_or_end(until: Stop | None, t_max: float | None) -> float:
    """Check the end of a flight: a stop condition, a time, or both."""
    if until is None and t_max is None:
        raise ModelError("simulate: give a stop condition (until=) or an end time (t_max=), or both")
    end = 3600.0 if t_max is None else as_scalar("simulate: t_max", t_max)
    if end <= 0:
        raise ModelError(f"simulate: t_max must be finite and > 0 s, got {t_max}")
    return end
