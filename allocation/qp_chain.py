"""Many bounded least-squares problems in the order of time: each begins where the ones before it lead, several chains in the lanes."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import casadi as ca
import numpy as np

from allocation.active_set import TOLERANCE
from models import native, native_source
from models.checked import Array, evaluate
from models.native_cache import Library
from models.native_compiler import NotCompiledError

LONGEST = 128  # problems of one chain
CHAINS = 64  # before a chain has more than one problem: enough for the lanes of all threads
ROUNDS = 40  # steps before a problem is given up

Found = tuple[Array, Array, Array, np.ndarray]  # u (N, n), y (N, m), kkt (N, 3), solved (N,)

_DRIVER = """
#define EXPORT __attribute__((visibility("default")))
INLINE M rw_good(const L *kkt) {{ return (kkt[0] <= {tolerance}) & (kkt[1] <= {tolerance}) & (kkt[2] <= {tolerance}); }}
EXPORT void rw_chain(const double *const *arg, const i64 *stride, const double *given, double *u, double *y, double *kkt,
                     unsigned char *solved, i64 *taken, i64 rows, i64 length) {{
  static const i64 size[] = {{{sizes}}};
  i64 chains = (rows + length - 1) / length;
  for (i64 c; (c = LANES * __atomic_fetch_add(taken, 1, __ATOMIC_RELAXED)) < chains;) {{
    L x[{total} + {m}], start[{m}], now[{m}], before[{m}], found[{n} + {m} + 3], other[{n} + {m} + 3];
    i64 row[LANES] = {{0}};
    for (i64 i = 0, at = 0; i < {inputs}; at += size[i++])
      for (i64 k = 0; k < size[i]; k++) x[at + k] = lane_rows(arg[i] + k, row, stride[i]);
    for (i64 k = 0; k < {m}; k++) now[k] = before[k] = lane_all(0.0);
    for (i64 s = 0; s < length; s++) {{
      M on;
      for (i64 l = 0; l < LANES; l++) {{
        i64 r = (c + l) * length + s;
        on[l] = -(i64)(c + l < chains && r < rows);
        row[l] = on[l] ? r : rows - 1;
      }}
      for (i64 i = 0, at = 0; i < {inputs}; at += size[i++])
        if (stride[i]) for (i64 k = 0; k < size[i]; k++) x[at + k] = lane_rows(arg[i] + k, row, stride[i]);
      M open = on;
      for (i64 t = given || s ? {rounds} : 0; t < {rounds} && lane_any(open); t++) {{  // the first of a chain, from zero
        for (i64 k = 0; k < {m}; k++) x[{total} + k] = now[k];
        {step}(x, other);
        for (i64 k = 0; k < {m}; k++) before[k] = now[k] = lane_choose(open, other[k], now[k]);
        open &= other[{m}] == 0.0;
      }}
      for (i64 k = 0; k < {m}; k++) {{
        start[k] = given ? lane_rows(given + k, row, {m}) : now[k];
        x[{total} + k] = given ? start[k] : now[k] + (now[k] - before[k]);
      }}
      {ending}(x, found);
      M good = rw_good(found + {n} + {m});
      for (int again = 0; again < 2; again++) {{  // the second time from zero: what is met exactly by nothing at all is met from there
        open = on & ~good;
        if (__builtin_expect(!lane_any(open), 1)) break;
        if (again) for (i64 k = 0; k < {m}; k++) start[k] = lane_choose(open, lane_all(0.0), start[k]);
        for (i64 t = 0; t < {rounds} && lane_any(open); t++) {{
          for (i64 k = 0; k < {m}; k++) x[{total} + k] = start[k];
          {step}(x, other);
          M settled = other[{m}] != 0.0;
          for (i64 k = 0; k < {m}; k++) x[{total} + k] = start[k] = lane_choose(open, other[k], start[k]);
          {ending}(x, other);
          for (i64 k = 0; k < {n} + {m} + 3; k++) found[k] = lane_choose(open, other[k], found[k]);
          good = rw_good(found + {n} + {m});
          open &= ~(good | settled);
        }}
      }}
      for (i64 k = 0; k < {m}; k++) {{
        before[k] = s ? now[k] : found[{n} + k];
        now[k] = found[{n} + k];
      }}
      for (i64 l = 0; l < LANES; l++) {{
        if (!on[l]) continue;
        i64 r = row[l];
        for (i64 k = 0; k < {n}; k++) u[r * {n} + k] = found[k][l];
        for (i64 k = 0; k < {m}; k++) y[r * {m} + k] = found[{n} + k][l];
        for (i64 k = 0; k < 3; k++) kkt[r * 3 + k] = found[{n} + {m} + k][l];
        solved[r] = good[l] != 0;
      }}
    }}
  }}
}}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Solver of N problems in chains; make it with :func:`make`.

    The first try of a problem begins at the prices that the two problems before it lead to in a straight line, and mostly ends
    there; the others go on from the prices of the problem before by steps with a line search, and at last from zero.
    """

    step: ca.Function
    ending: ca.Function
    lanes: int
    threads: int
    library: Library | None

    def run(self, columns: list[Array], rows: int, y: Array | None) -> Found:
        """Answers for checked problem data, each (n_i,) or (rows, n_i); y (rows, m) is a warm start of each problem."""
        length = min(LONGEST, max(1, rows // CHAINS))
        if self.library is None:
            return _interpreted(self.step, self.ending, columns, rows, length, y)
        n, m = (self.ending.size1_out(o) for o in (0, 1))
        u, prices, kkt = np.empty((rows, n)), np.empty((rows, m)), np.empty((rows, 3))
        solved, taken = np.empty(rows, dtype=bool), np.zeros(1, dtype=np.int64)
        values = [np.ascontiguousarray(c) for c in columns]
        given = None if y is None else np.ascontiguousarray(y)
        arg, stride = native.pointers(values), native.strides(values)
        outputs = [native.address(a) for a in (u, prices, kkt, solved, taken)]
        entry = self.library.entry("rw_chain")
        start = None if given is None else native.address(given)
        # each thread takes the next chains until none is left
        native.in_threads(
            lambda first, last: entry(arg, stride, start, *outputs, ctypes.c_longlong(rows), ctypes.c_longlong(length)),
            -(-rows // length), self.lanes, self.threads, vectors_each=1,
            keep=(self.library, values, given, u, prices, kkt, solved, taken),
        )  # fmt: skip
        return u, prices, kkt, solved


def make(step: ca.Function, ending: ca.Function, *, compiled: bool) -> Chain:
    """Chain of the functions of :func:`allocation.active_set.steps` (one step) and :func:`allocation.active_set.ending`."""
    plain = Chain(step, ending, 1, 1, None)
    if not compiled or native.switched_off():
        return plain
    workers = native.options(step, "auto", "auto", "fast")
    sizes = [step.numel_in(i) for i in range(step.n_in() - 1)]
    try:
        written = native.write((step, ending), "auto", "fast")
        library = written.library(_DRIVER.format(
            step=written.names[0], ending=written.names[1], n=ending.size1_out(0), m=ending.size1_out(1), inputs=len(sizes),
            total=sum(sizes), sizes=", ".join(map(str, sizes)), rounds=ROUNDS, tolerance=repr(TOLERANCE),
        ))  # fmt: skip
    except (native_source.Unsupported, NotCompiledError, RuntimeError) as error:  # RuntimeError: CasADi has no C code for it
        native.interpreted(step, error)
        return plain
    return Chain(step, ending, written.lanes, workers, library)


def _interpreted(step: ca.Function, ending: ca.Function, columns: list[Array], rows: int, length: int, y: Array | None) -> Found:
    """The same by CasADi's interpreter: one problem of every chain at a time."""
    n, m = (ending.size1_out(o) for o in (0, 1))
    u, prices, kkt, solved = np.empty((rows, n)), np.empty((rows, m)), np.empty((rows, 3)), np.empty(rows, dtype=bool)
    now = before = np.zeros((-(-rows // length), m))
    for s in range(length):
        at = np.arange(s, rows, length)
        data = pick(columns, at)
        now, before = now[: len(at)], before[: len(at)]
        if s == 0 and y is None:
            now = before = settled(step, data, now)
        start = (now if y is None else y[at]).copy()
        found = evaluate(ending, *data, now + (now - before) if y is None else start)
        for again in (False, True):  # the second time from zero
            open_ = np.flatnonzero(~good(found[2]))
            if again:
                start[open_] = 0.0
            for _ in range(ROUNDS):
                if not open_.size:
                    break
                part = pick(data, open_)
                start[open_], done = evaluate(step, *part, start[open_])
                answers = evaluate(ending, *part, start[open_])
                for whole, new in zip(found, answers, strict=True):
                    whole[open_] = new
                open_ = open_[~good(answers[2]) & (done[:, 0] == 0)]
        u[at], prices[at], kkt[at], solved[at] = *found, good(found[2])
        now, before = found[1], now if s else found[1]
    return u, prices, kkt, solved


def settled(step: ca.Function, columns: list[Array], y: Array) -> Array:
    """Prices after as many steps as they need, fewer and fewer problems in each round."""
    y, open_ = y.copy(), np.arange(len(y))
    for _ in range(ROUNDS):
        y[open_], done = evaluate(step, *pick(columns, open_), y[open_])
        open_ = open_[done[:, 0] == 0]
        if not open_.size:
            break
    return y


def good(kkt: Array) -> np.ndarray:
    """Which rows of residuals are small enough."""
    return np.asarray((kkt <= TOLERANCE).all(axis=1))


def pick(columns: list[Array], rows: np.ndarray) -> list[Array]:
    """Rows of problem data; what all problems share stays."""
    return [c[rows] if c.ndim == 2 else c for c in columns]
