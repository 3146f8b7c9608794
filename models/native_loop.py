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

RUNNING, CROSSED, NONFINITE = 0, 1, 2
_CHUNK = 32  # groups between two looks at the margins, without a compiler

_DRIVER = """
#define EXPORT __attribute__((visibility("default")))
EXPORT void rw_loop(const double *c0, const double *q, const double *p, i64 groups, double *before, double *after, i64 *index,
                    unsigned char *outcome, i64 first, i64 last) {{
  for (i64 r = first; r < last; r += LANES) {{
    L x[{nc} + {nq} + {np}], y[{nc}], z[{nc} + {np} + 1], g[1];
    i64 row[LANES], count = last - r < LANES ? last - r : LANES;
    M alive;
    for (i64 l = 0; l < LANES; l++) {{ row[l] = r + (l < count ? l : count - 1); alive[l] = -(i64)(l < count); }}
    for (i64 k = 0; k < {nc}; k++) x[k] = lane_rows(c0 + k, row, {nc});
    for (i64 k = 0; k < {np}; k++) z[{nc} + k] = x[{nc} + {nq} + k] = lane_rows(p + k, row, {np});
    for (i64 m = 0; m < groups && lane_any(alive); m++) {{
      for (i64 k = 0; k < {nq}; k++) x[{nc} + k] = lane_all(q[m * {nq} + k]);
      {group}(x, y);
      M bad = {{0}};
      for (i64 k = 0; k < {nc}; k++) {{ bad |= lane_bad(y[k]); z[k] = y[k]; }}
      {margin}(z, g);
      bad |= lane_nan(g[0]);
      M ended = alive & (bad | (g[0] <= 0.0));
      if (lane_any(ended))
        for (i64 l = 0; l < count; l++) if (ended[l]) {{
          for (i64 k = 0; k < {nc}; k++) {{ before[(r + l) * {nc} + k] = x[k][l]; after[(r + l) * {nc} + k] = y[k][l]; }}
          index[r + l] = m; outcome[r + l] = bad[l] ? {nonfinite} : {crossed};
        }}
      alive &= ~ended;
      for (i64 k = 0; k < {nc}; k++) x[k] = lane_choose(alive, y[k], x[k]);
    }}
    for (i64 l = 0; l < count; l++) if (alive[l]) {{
      for (i64 k = 0; k < {nc}; k++) before[(r + l) * {nc} + k] = after[(r + l) * {nc} + k] = x[k][l];
      index[r + l] = groups; outcome[r + l] = {running};
    }}
  }}
}}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """How N cases ended.

    Attributes
    ----------
    before, after : ndarray, shape (N, nc)
        Carry at the start and at the end of the group in which the case ended; both the last carry where it was not ended.
    index : ndarray of int, shape (N,)
        That group, or the number of groups.
    outcome : ndarray of int, shape (N,)
        0 RUNNING at the last group's end, 1 CROSSED (margin <= 0), 2 NONFINITE (a carry, or a NaN margin).
    """

    before: Array
    after: Array
    index: np.ndarray
    outcome: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class NativeLoop:
    """A compiled closed loop; backend, reason, lanes, threads and mode as those of :class:`models.native.Native`."""

    group: ca.Function
    margin: ca.Function
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
            array = np.ascontiguousarray(as_finite(f"{self.group.name()}: {name}", value))
            if array.ndim != 2 or array.shape[1] != size:
                raise ModelError(f"{self.group.name()}: {name}: expected shape (N, {size}), got {np.shape(value)}; one row for each")
            values.append(array)
        cases = len(values[0])
        if len(values[2]) != cases or cases == 0:
            raise ModelError(f"{self.group.name()}: {cases} rows of c0 beside {len(values[2])} of p; give equal numbers, at least one")
        if self.library is None:
            return _interpreted(self.group, self.margin, values[0], values[1], values[2])
        before, after = np.empty_like(values[0]), np.empty_like(values[0])
        index, outcome = np.empty(cases, dtype=np.int64), np.empty(cases, dtype=np.uint8)
        entry = self.library.entry("rw_loop")
        given: list[Any] = [native.address(a) for a in values]
        given += [ctypes.c_longlong(len(values[1])), *(native.address(a) for a in (before, after, index, outcome))]
        native.in_threads(lambda first, last: entry(*given, ctypes.c_longlong(first), ctypes.c_longlong(last)),
                          cases, self.lanes, self.threads, vectors_each=1)  # fmt: skip
        return Ends(before, after, index, outcome.astype(np.int64))


def compile_loop(
    group: ca.Function, margin: ca.Function, *, lanes: int | Literal["auto"] = "auto", threads: int | Literal["auto"] = "auto",
    mode: native.Mode = "accurate",
) -> NativeLoop:  # fmt: skip
    """Compile the loop c -> group(c, q_m, p) over groups m, ended case by case where ``margin(c, p)`` is <= 0.

    Parameters
    ----------
    group : casadi.Function
        (c (nc,), q (nq,), p (np,)) -> c_next (nc,), ...; further outputs are left out.
    margin : casadi.Function
        (c, p) -> scalar, positive before the stop.
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
        return NativeLoop(group, margin, "interpreter", "REENTRY_NATIVE is off", 1, 1, mode, None)
    try:
        written = native.write((group, margin), lanes, mode)
        driver = _DRIVER.format(
            group=written.names[0], margin=written.names[1], nc=nc, nq=nq, np=np_, running=RUNNING, crossed=CROSSED, nonfinite=NONFINITE
        )  # fmt: skip
        library = written.library(driver)
    except (native_source.Unsupported, NotCompiledError, RuntimeError) as error:  # RuntimeError: CasADi has no C code for it
        return NativeLoop(group, margin, "interpreter", native.interpreted(group, error), 1, 1, mode, None)
    return NativeLoop(group, margin, written.backend, written.reason, written.lanes, workers, mode, library)


def _first_output(function: ca.Function) -> ca.Function:
    kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    symbols = [kind.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    return ca.Function(function.name(), symbols, [ca.densify(function.call(symbols)[0])], function.name_in(), function.name_out()[:1])


def _interpreted(group: ca.Function, margin: ca.Function, c0: Array, q: Array, p: Array) -> Ends:
    """The same by CasADi's interpreter, some groups of all running cases at a time."""
    cases, nc = c0.shape
    ends = Ends(c0.copy(), c0.copy(), np.full(cases, len(q)), np.full(cases, RUNNING))
    c, active = c0.copy(), np.arange(cases)
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
        for k in np.flatnonzero(ended):
            i, m = active[k], where[k]
            ends.before[i], ends.after[i], ends.index[i] = c[i] if m == 0 else flown[k, m - 1], flown[k, m], first + m
            ends.outcome[i] = NONFINITE if np.isnan(margins[k, m]) else CROSSED
        c[active] = flown[:, -1]
        active = active[~ended]
    ends.before[active] = ends.after[active] = c[active]
    return ends
