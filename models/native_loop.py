"""Closed loops inside compiled code: groups of steps until a margin falls to zero, each case in its own lane."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import native, native_source
from models.checked import Array, ModelError, as_finite, evaluate
from models.native_cache import Library
from models.native_compiler import NotCompiledError

RUNNING, CROSSED, NONFINITE, REFUSED = 0, 1, 2, 3
_CHUNK = 32  # groups between two looks at the margins, without a compiler
_FOUND = 2.0
_MOST = 1000  # evaluations of a search; a search that needs more has no end

_DRIVER = """
#define EXPORT __attribute__((visibility("default")))
EXPORT void rw_loop(const double *c0, const double *q, const double *p, i64 groups, double *before, double *after, double *fraction,
                    i64 *index, unsigned char *outcome, i64 *taken, i64 cases) {{
  for (i64 r; (r = LANES * __atomic_fetch_add(taken, 1, __ATOMIC_RELAXED)) < cases;) {{
    L x[{nc} + {nq} + {np}], y[{nc}], z[{nc} + {np} + 1], g[1], b[{nc}], e[{nc}];
    i64 row[LANES], last = cases - r < LANES ? cases - r : LANES;
    M alive, met = {{0}}, bad = {{0}}, at = {{0}};
    for (i64 l = 0; l < LANES; l++) {{ row[l] = r + (l < last ? l : last - 1); alive[l] = -(i64)(l < last); }}
    for (i64 k = 0; k < {nc}; k++) b[k] = e[k] = x[k] = lane_rows(c0 + k, row, {nc});
    for (i64 k = 0; k < {nq}; k++) x[{nc} + k] = lane_all(groups ? q[k] : 0.0);
    for (i64 k = 0; k < {np}; k++) z[{nc} + k] = x[{nc} + {nq} + k] = lane_rows(p + k, row, {np});
    M refused = {{0}};
{refuse}
    alive &= ~refused;
    for (i64 m = 0; m < groups && lane_any(alive); m++) {{
      for (i64 k = 0; k < {nq}; k++) x[{nc} + k] = lane_all(q[m * {nq} + k]);
      {group}(x, y);
      M wrong = {{0}};
      for (i64 k = 0; k < {nc}; k++) {{ wrong |= lane_bad(y[k]); z[k] = y[k]; }}
      {margin}(z, g);
      wrong |= lane_nan(g[0]);
      M ended = alive & (wrong | (g[0] <= 0.0));
      if (__builtin_expect(lane_any(ended), 0)) {{
        for (i64 k = 0; k < {nc}; k++) {{ b[k] = lane_choose(ended, x[k], b[k]); e[k] = lane_choose(ended, y[k], e[k]); }}
        at = (at & ~ended) | (ended & m);
        bad |= ended & wrong; met |= ended & ~wrong;
        alive &= ~ended;
      }}
      for (i64 k = 0; k < {nc}; k++) x[k] = lane_choose(alive, y[k], x[k]);
    }}
    at = (at & ~alive) | (alive & groups);
    for (i64 k = 0; k < {nc}; k++) {{ b[k] = lane_choose(alive, x[k], b[k]); e[k] = lane_choose(alive, x[k], e[k]); }}
    L part = lane_number(met);
{search}
    for (i64 l = 0; l < last; l++) {{
      for (i64 k = 0; k < {nc}; k++) {{ before[(r + l) * {nc} + k] = b[k][l]; after[(r + l) * {nc} + k] = e[k][l]; }}
      index[r + l] = at[l]; fraction[r + l] = part[l];
      outcome[r + l] = refused[l] ? {refused} : bad[l] ? {nonfinite} : met[l] ? {crossed} : {running};
    }}
  }}
}}
"""
_REFUSE = "    {start}(x, g);\n    refused = alive & ~(g[0] > 0.0);"
_SEARCH = """    if (lane_any(met)) {{
      L a[2 * {nc} + {nq} + {np} + 1], w[{nc} + {nq} + {np} + {ns}], v[{nc} + {ns}];
      M there = met & at;
      for (i64 k = 0; k < {nc}; k++) {{ a[k] = w[k] = b[k]; a[{nc} + k] = e[k]; }}
      for (i64 k = 0; k < {nq}; k++) {{
        L t;
        for (i64 l = 0; l < LANES; l++) t[l] = q[there[l] * {nq} + k];
        a[2 * {nc} + k] = w[{nc} + k] = t;
      }}
      for (i64 k = 0; k < {np}; k++) a[2 * {nc} + {nq} + k] = w[{nc} + {nq} + k] = z[{nc} + k];
      a[2 * {nc} + {nq} + {np}] = lane_all(1.0);
      L *s = w + {nc} + {nq} + {np};
      {bracket}(a, s);
      M open = met;
      for (i64 n = 0; n < {most} && lane_any(open); n++) {{
        part = lane_choose(open, s[0], part);
        {probe}(w, v);
        for (i64 k = 0; k < {nc}; k++) e[k] = lane_choose(open, v[k], e[k]);
        for (i64 k = 0; k < {ns}; k++) s[k] = lane_choose(open, v[{nc} + k], s[k]);
        open &= s[{state}] != {found};
      }}
    }}"""


@dataclass(frozen=True, slots=True, eq=False)
class Stopping:
    """How a loop finds the place inside a group where the margin is zero.

    Attributes
    ----------
    start : casadi.Function
        (c, q, p) -> margin before a group; a case that begins with one <= 0 (or NaN) is refused.
    bracket : casadi.Function
        (c, c_after, q, p, reach) -> s: state of the search over the fractions [0, reach] of a group.
    probe : casadi.Function
        (c, q, p, s) -> (carry at the fraction s[0], s_next); the search ends where ``s_next[state]`` is 2.
    state : int
    """

    start: ca.Function
    bracket: ca.Function
    probe: ca.Function
    state: int

    def locate(self, c: Array, after: Array, q: Array, p: Array, reach: Array) -> tuple[Array, Array]:
        """Fractions (M,) of M groups at which the margin is zero, and the carries (M, nc) there, by CasADi's interpreter.

        Parameters
        ----------
        c, after : ndarray, shape (M, nc)
            Carries before a group and at its fraction `reach` (M,), where the margin is <= 0.
        q : ndarray, shape (M, nq)
        p : ndarray, shape (M, np)
        """
        s = evaluate(self.bracket, c, after, q, p, reach[:, None], finite=False)[0]
        fraction, found = reach.copy(), after.copy()
        active = np.arange(len(c))
        for _ in range(_MOST):
            if active.size == 0:
                break
            fraction[active] = s[active, 0]
            found[active], s[active] = self._probed(c[active], q[active], p[active], s[active])
            active = active[s[active, self.state] != _FOUND]
        return fraction, found

    def _probed(self, c: Array, q: Array, p: Array, s: Array) -> tuple[Array, Array]:
        try:
            at, following = evaluate(self.probe, c, q, p, s, finite=False)
        except RuntimeError:  # an adaptive integrator gave up
            if len(c) > 1:
                parts = [self._probed(*(a[i : i + 1] for a in (c, q, p, s))) for i in range(len(c))]
                return np.vstack([a for a, _ in parts]), np.vstack([b for _, b in parts])
            s = s.copy()
            s[:, self.state] = _FOUND
            return np.full(c.shape, np.nan), s
        return at, following


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """How N cases ended.

    Attributes
    ----------
    before, after : ndarray, shape (N, nc)
        Carry at the start and at the end of the group in which the case ended; both the last carry where it was not ended.
        With a search, `after` is the carry at the stop.
    index : ndarray of int, shape (N,)
        That group, or the number of groups.
    outcome : ndarray of int, shape (N,)
        0 RUNNING at the last group's end, 1 CROSSED (margin <= 0), 2 NONFINITE (a carry, or a NaN margin), 3 REFUSED (with a search:
        the margin was not positive at the start).
    fraction : ndarray, shape (N,)
        Part of the last group that was flown, 1 without a search; 0 unless CROSSED.
    """

    before: Array
    after: Array
    index: np.ndarray
    outcome: np.ndarray
    fraction: Array


@dataclass(frozen=True, slots=True, eq=False)
class NativeLoop:
    """A compiled closed loop; backend, reason, lanes, threads and mode as those of :class:`models.native.Native`."""

    group: ca.Function
    margin: ca.Function
    stopping: Stopping | None
    backend: native.Backend
    reason: str
    lanes: int
    threads: int
    mode: native.Mode
    library: Library | None

    def run(self, c0: Array, q: Array, p: Array) -> Ends:
        """Advance every case through the groups until its margin is <= 0 or a number is not finite.

        Parameters
        ----------
        c0 : ndarray, shape (N, nc)
            Carry at the start.
        q : ndarray, shape (M, nq)
            What each group reads, the same for all cases.
        p : ndarray, shape (N, np)

        Raises
        ------
        ModelError
            A wrong shape or an argument that is not finite.
        """
        sizes = [self.group.size1_in(i) for i in range(3)]
        values = []
        for name, value, size in zip(("c0", "q", "p"), (c0, q, p), sizes, strict=True):
            ready = isinstance(value, np.ndarray) and value.dtype == np.float64 and np.isfinite(value).all()
            array = np.ascontiguousarray(value if ready else as_finite(f"{self.group.name()}: {name}", value))
            if array.ndim != 2 or array.shape[1] != size:
                raise ModelError(f"{self.group.name()}: {name}: expected shape (N, {size}), got {np.shape(value)}; one row for each")
            values.append(array)
        cases = len(values[0])
        if len(values[2]) != cases or cases == 0:
            raise ModelError(f"{self.group.name()}: {cases} rows of c0 beside {len(values[2])} of p; give equal numbers, at least one")
        if self.library is None:
            return _interpreted(self.group, self.margin, self.stopping, *values)
        before, after, fraction = np.empty_like(values[0]), np.empty_like(values[0]), np.empty(cases)
        index, outcome, taken = np.empty(cases, dtype=np.int64), np.empty(cases, dtype=np.uint8), np.zeros(1, dtype=np.int64)
        entry = self.library.entry("rw_loop")
        given: list[Any] = [native.address(a) for a in values]
        given += [ctypes.c_longlong(len(values[1])), *(native.address(a) for a in (before, after, fraction, index, outcome, taken))]
        # each thread takes the next vector of cases until none is left: a busy processor then holds up nobody
        native.in_threads(
            lambda first, last: entry(*given, ctypes.c_longlong(cases)), cases, self.lanes, self.threads, vectors_each=1,
            keep=(self.library, values, before, after, fraction, index, outcome, taken),
        )  # fmt: skip
        return Ends(before, after, index, outcome.astype(np.int64), fraction)


def compile_loop(
    group: ca.Function, margin: ca.Function, *, stopping: Stopping | None = None, lanes: int | Literal["auto"] = "auto",
    threads: int | Literal["auto"] = "auto", mode: native.Mode = "accurate",
) -> NativeLoop:  # fmt: skip
    """Compile the loop c -> group(c, q_m, p) over groups m, ended case by case where ``margin(c, p)`` is <= 0.

    Parameters
    ----------
    group : casadi.Function
        (c (nc,), q (nq,), p (np,)) -> c_next (nc,), ...; further outputs are left out.
    margin : casadi.Function
        (c, p) -> scalar, positive before the stop.
    stopping : Stopping, optional
        Also find the place in the last group where the margin is zero.
    lanes, threads, mode : as in :func:`models.native.compile`

    Raises
    ------
    ModelError
        Functions of other sizes, or an option that is not known.
    """
    workers = native.options(group, lanes, threads, mode)
    nc, nq, np_ = (group.size1_in(i) for i in range(3)) if group.n_in() == 3 else (-1, -1, -1)
    if nc < 1 or group.size_out(0) != (nc, 1):
        raise ModelError(f"native: {group.name()}: expected (c (nc,), q (nq,), p (np,)) -> c_next (nc,), got {group}")
    if margin.n_in() != 2 or [margin.size1_in(i) for i in range(2)] != [nc, np_] or margin.size_out(0) != (1, 1):
        raise ModelError(f"native: {margin.name()}: expected (c ({nc},), p ({np_},)) -> scalar, got {margin}")
    group, margin = _first_output(group), _first_output(margin)
    if native.switched_off():
        return NativeLoop(group, margin, stopping, "interpreter", "REENTRY_NATIVE is off", 1, 1, mode, None)
    more = () if stopping is None else (stopping.start, stopping.bracket, stopping.probe)
    try:
        written = native.write((group, margin, *more), lanes, mode)
        sizes: dict[str, Any] = {"group": written.names[0], "margin": written.names[1], "nc": nc, "nq": nq, "np": np_}
        texts = {"refuse": "", "search": ""}
        if stopping is not None:
            names = dict(zip(("start", "bracket", "probe"), written.names[2:], strict=True))
            texts["refuse"] = _REFUSE.format(**names)
            more_sizes = {"ns": stopping.probe.size1_in(3), "state": stopping.state, "found": _FOUND, "most": _MOST}
            texts["search"] = _SEARCH.format(**sizes, **names, **more_sizes)
        codes = {"running": RUNNING, "crossed": CROSSED, "nonfinite": NONFINITE, "refused": REFUSED}
        library = written.library(_DRIVER.format(**sizes, **texts, **codes))
    except (native_source.Unsupported, NotCompiledError, RuntimeError) as error:  # RuntimeError: CasADi has no C code for it
        return NativeLoop(group, margin, stopping, "interpreter", native.interpreted(group, error), 1, 1, mode, None)
    return NativeLoop(group, margin, stopping, written.backend, written.reason, written.lanes, workers, mode, library)


def _first_output(function: ca.Function) -> ca.Function:
    kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    symbols = [kind.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    return ca.Function(function.name(), symbols, [ca.densify(function.call(symbols)[0])], function.name_in(), function.name_out()[:1])


def _interpreted(group: ca.Function, margin: ca.Function, stopping: Stopping | None, c0: Array, q: Array, p: Array) -> Ends:
    """The same by CasADi's interpreter, some groups of all running cases at a time."""
    cases, nc = c0.shape
    ends = Ends(c0.copy(), c0.copy(), np.full(cases, len(q)), np.full(cases, RUNNING), np.zeros(cases))
    c, active = c0.copy(), np.arange(cases)
    if stopping is not None and len(q):
        refused = ~(evaluate(stopping.start, c, q[0], p, finite=False)[0][:, 0] > 0)
        ends.outcome[refused], ends.index[refused] = REFUSED, 0
        active = np.flatnonzero(~refused)
    for first in range(0, len(q), _CHUNK):
        if active.size == 0:
            break
        count = min(_CHUNK, len(q) - first)
        chain = group.mapaccum(count).map(len(active))
        given = [c[active].T, np.tile(q[first : first + count].T, (1, len(active))), np.repeat(p[active], count, axis=0).T]
        flown = np.asarray(chain.call([ca.DM(g) for g in given])[0].full()).T.reshape(len(active), count, nc)
        finite = np.isfinite(flown).all(axis=2)
        margins = np.full((len(active), count), np.nan)
        rows = np.repeat(p[active], count, axis=0).reshape(len(active), count, -1)
        if finite.any():
            margins[finite] = evaluate(margin, flown[finite], rows[finite], finite=False)[0][:, 0]
        event = ~(margins > 0)
        ended, where = event.any(axis=1), np.argmax(event, axis=1)
        i, m, k = active[ended], where[ended], np.flatnonzero(ended)
        ends.before[i] = np.where((m == 0)[:, None], c[i], flown[k, np.maximum(m - 1, 0)])
        ends.after[i], ends.index[i] = flown[k, m], first + m
        ends.outcome[i] = np.where(np.isnan(margins[k, m]), NONFINITE, CROSSED)
        c[active] = flown[:, -1]
        active = active[~ended]
    ends.before[active] = ends.after[active] = c[active]
    hit = np.flatnonzero(ends.outcome == CROSSED)
    ends.fraction[hit] = 1.0
    if stopping is not None and hit.size:
        found = stopping.locate(ends.before[hit], ends.after[hit], q[ends.index[hit]], p[hit], np.ones(hit.size))
        ends.fraction[hit], ends.after[hit] = found
    return ends
