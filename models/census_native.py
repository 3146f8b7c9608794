"""The census of many parameter points as compiled C: the arithmetic and the answers of :mod:`models.census_pieces`, point by point."""

from __future__ import annotations

import ctypes

import numpy as np

from models import native
from models.census_pieces import LOOK, OVERFLOW, WIDTH, WORK, Words, census_of, step_limit
from models.checked import Array
from models.native_cache import Library, load
from models.native_compiler import NotCompiledError, cpu_target, flags_for, warn_once

CYCLES, SYMBOLS = 24, 256  # of one point; a point with more is done by NumPy
_BLOCK = 1 << 16  # points whose answers are held at a time
_ROOM = 192  # pieces of one history

_SIZES = {"ROOM": _ROOM, "MAX_CYCLES": CYCLES, "MAX_SYMBOLS": SYMBOLS, "WIDTH": WIDTH, "LOOK": LOOK, "WORK": WORK}
_SOURCE = (
    "".join(f"#define {name} {value}\n" for name, value in _SIZES.items())
    + """
#include <math.h>
#include <string.h>
#define EXPORT __attribute__((visibility("default")))
typedef long long i64;
typedef struct { double low, high; int y; } Piece;
typedef struct { int count[9]; Piece piece[9][ROOM]; } Set;
enum { DECIDED, UNDECIDED, OVERFLOW };

static double down(double v) { return v - (fabs(v) * 0x1p-52 + 1e-300); }
static double up(double v) { return v + (fabs(v) * 0x1p-52 + 1e-300); }
static double least(double a, double b) { return a < b ? a : b; }
static double most(double a, double b) { return a > b ? a : b; }

/* parts of the image of one piece, one for each output that it may give */
static int parts_of(const double *q, int history, Piece p, Piece *part) {
  int y1 = history / 3 - 1, count = 0;
  double a = q[0] * p.low, b = q[0] * p.high, c = q[1] * p.low, d = q[1] * p.high;
  double low = down(down(least(least(a, b), least(c, d))) + q[7 + history]);
  double high = up(up(most(most(a, b), most(c, d))) + q[16 + history]);
  double upper_low = y1 == 1 ? q[3] : q[2], upper_high = y1 == 1 ? q[4] : q[2];
  double lower_low = y1 == -1 ? -q[4] : -q[2], lower_high = y1 == -1 ? -q[3] : -q[2];
  if (low <= lower_high) part[count++] = (Piece){low, least(high, lower_high), -1};
  if (low <= upper_high && high >= lower_low) part[count++] = (Piece){most(low, lower_low), least(high, upper_high), 0};
  if (high >= upper_low) part[count++] = (Piece){most(low, upper_low), high, 1};
  return count;
}

static void merge(Set *s) {
  for (int h = 0; h < 9; h++) {
    Piece *p = s->piece[h];
    int kept = 0;
    for (int i = 1; i < s->count[h]; i++) {
      Piece x = p[i];
      int j = i;
      for (; j > 0 && p[j - 1].low > x.low; j--) p[j] = p[j - 1];
      p[j] = x;
    }
    for (int i = 0; i < s->count[h]; i++) {
      if (kept && p[i].low <= p[kept - 1].high) p[kept - 1].high = most(p[kept - 1].high, p[i].high);
      else p[kept++] = p[i];
    }
    s->count[h] = kept;
  }
}

static int same(const Set *a, const Set *b) {
  for (int h = 0; h < 9; h++) {
    if (a->count[h] != b->count[h]) return 0;
    for (int i = 0; i < a->count[h]; i++)
      if (a->piece[h][i].low != b->piece[h][i].low || a->piece[h][i].high != b->piece[h][i].high) return 0;
  }
  return 1;
}

/* one step of all pieces: 1 if one straddles a threshold, 0 if none does, -1 without room */
static int push(const double *q, const Set *from, Set *to) {
  int straddles = 0;
  memset(to->count, 0, sizeof to->count);
  for (int h = 0; h < 9; h++)
    for (int i = 0; i < from->count[h]; i++) {
      Piece part[3];
      int count = parts_of(q, h, from->piece[h][i], part);
      straddles |= count > 1;
      for (int j = 0; j < count; j++) {
        int next = 3 * (part[j].y + 1) + h / 3;
        if (to->count[next] == ROOM) return -1;
        to->piece[next][to->count[next]++] = part[j];
      }
    }
  return straddles;
}

/* cycles of the graph of pieces; 0 if an image lies in no piece, -1 without room */
static int cycles_of(const double *q, const Set *s, int *periods, int *cycles, signed char *symbols) {
  static const int none = -1;
  int base[10] = {0}, whole = 1, used = 0;
  int after[9 * ROOM], seen[9 * ROOM], y[9 * ROOM];
  for (int h = 0; h < 9; h++) base[h + 1] = base[h] + s->count[h];
  for (int h = 0; h < 9; h++)
    for (int i = 0; i < s->count[h]; i++) {
      Piece part[3];
      int node = base[h] + i, to = none;
      if (parts_of(q, h, s->piece[h][i], part) == 1) {
        int next = 3 * (part[0].y + 1) + h / 3;
        for (int j = 0; j < s->count[next]; j++)
          if (s->piece[next][j].low <= part[0].low && part[0].high <= s->piece[next][j].high) to = base[next] + j;
        whole &= to >= 0;
      }
      after[node] = to; seen[node] = 0; y[node] = h / 3 - 1;
    }
  *cycles = 0;
  for (int node = 0; node < base[9]; node++) {
    int now = node;
    while (now >= 0 && !seen[now]) { seen[now] = node + 1; now = after[now]; }
    if (now < 0 || seen[now] != node + 1) continue;
    int period = 0, head = now;
    if (*cycles == MAX_CYCLES) return -1;
    do {
      if (used == MAX_SYMBOLS) return -1;
      symbols[used++] = (signed char)y[now];
      period++; now = after[now];
    } while (now != head);
    periods[(*cycles)++] = period;
  }
  return whole;
}

static int point(const double *q, i64 limit, Set *now, Set *next, int *periods, int *cycles, signed char *symbols) {
  *cycles = 0;
  for (int h = 0; h < 9; h++) { now->count[h] = 1; now->piece[h][0] = (Piece){q[5], q[6], 0}; }
  i64 work = 0;
  for (i64 step = 1;; step++) {
    int straddles = push(q, now, next);
    if (straddles < 0) return OVERFLOW;
    int ended = !straddles;
    if (straddles) merge(next);
    if (straddles && step % LOOK == 0) {
      for (int h = 0; h < 9; h++) work += LOOK * now->count[h];
      ended = step >= limit || work >= WORK || same(now, next);
    }
    if (ended) {
      int whole = cycles_of(q, now, periods, cycles, symbols);
      return whole < 0 ? OVERFLOW : !straddles && whole ? DECIDED : UNDECIDED;
    }
    Set *swapped = now; now = next; next = swapped;
  }
}

EXPORT void rw_census(const double *rows, const i64 *limits, unsigned char *outcome, int *cycles, int *periods, signed char *symbols,
                      i64 first, i64 last) {
  Set a, b;
  for (i64 i = first; i < last; i++)
    outcome[i] = (unsigned char)point(rows + i * WIDTH, limits[i], &a, &b, periods + i * MAX_CYCLES, cycles + i, symbols + i * MAX_SYMBOLS);
}
"""
)


def library() -> Library | None:
    """The compiled kernel, or None, said once, where it cannot be compiled or is not wanted (REENTRY_NATIVE=off)."""
    if native.switched_off():
        return None
    try:
        return load(_SOURCE, flags_for(cpu_target(), fast=False))
    except NotCompiledError as error:
        warn_once(f"native code: the census runs in NumPy, with the same answers but slower: {error}")
        return None


def words_of(rows: Array) -> Words:
    """Words of all cycles of every point, compiled where that is possible.

    Parameters
    ----------
    rows : ndarray, shape (G, 25)
        Of :func:`models.census_pieces.parameter_rows`.
    """
    kernel = library()
    if kernel is None:
        return census_of(rows)
    rows = np.ascontiguousarray(rows)
    blocks = [_compiled(kernel, rows[i : i + _BLOCK]) for i in range(0, len(rows), _BLOCK)]
    return joined(blocks, [_BLOCK * i for i in range(len(blocks))])


def _compiled(kernel: Library, rows: Array) -> Words:
    count = len(rows)
    limits, outcome = step_limit(rows), np.empty(count, dtype=np.uint8)
    cycles, periods = np.zeros(count, dtype=np.int32), np.zeros((count, CYCLES), dtype=np.int32)
    symbols = np.empty((count, SYMBOLS), dtype=np.int8)
    entry = kernel.entry("rw_census")
    given = [native.address(a) for a in (rows, limits, outcome, cycles, periods, symbols)]
    native.in_threads(lambda first, last: entry(*given, ctypes.c_longlong(first), ctypes.c_longlong(last)),
                      count, 16, native.processors(), vectors_each=1,
                      keep=(kernel, rows, limits, outcome, cycles, periods, symbols))  # fmt: skip
    cycles[outcome == OVERFLOW] = 0
    chosen = np.arange(CYCLES) < cycles[:, None]
    point, _ = np.nonzero(chosen)
    period = periods[chosen].astype(np.int64)
    used = np.where(chosen, periods, 0)
    first = SYMBOLS * point + (np.cumsum(used, axis=1) - used)[chosen]
    found = Words(outcome.astype(np.int64), point, first, period, symbols.ravel())
    over = np.flatnonzero(outcome == OVERFLOW)
    if not over.size:
        return found
    rest = census_of(rows[over])
    every = found.outcome.copy()
    every[over] = rest.outcome
    whole = Words(every, found.point, found.first, found.period, found.symbols)
    return joined([whole, Words(rest.outcome[:0], over[rest.point], rest.first, rest.period, rest.symbols)], [0, 0])


def joined(parts: list[Words], offsets: list[int]) -> Words:
    """Several answers as one; `offsets` are added to the points of each."""
    places = np.cumsum([0, *(len(p.symbols) for p in parts)])
    return Words(
        np.concatenate([p.outcome for p in parts]),
        np.concatenate([p.point + o for p, o in zip(parts, offsets, strict=True)]),
        np.concatenate([p.first + s for p, s in zip(parts, places[:-1], strict=True)]),
        np.concatenate([p.period for p in parts]), np.concatenate([p.symbols for p in parts]),
    )  # fmt: skip
