"""Pieces of the state space of sampled modulators pushed through one step, for many parameter points at once (NumPy).

With a constant input the state of the sampled modulator is (x, y1, y2), its last trigger input and its last two outputs, and one step is

    x' = n x + c(y1, y2),   c = m (2 f(r) - k (y1 + y2)),   y' = Schmitt(x', y1).

For each of the nine histories (y1, y2) the set of possible x is kept as disjoint closed intervals, the pieces.  All numbers are
intervals that are rounded outwards, so a piece holds every state that the exact step, or the step in floating point, can reach.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.checked import Array, ModelError

Ints = NDArray[np.int64]
Symbols = NDArray[np.int8]
DECIDED, UNDECIDED, OVERFLOW = 0, 1, 2
HISTORIES = 9  # 3 (y1 + 1) + (y2 + 1)
# columns of a parameter row
N_LOW, N_HIGH, ON, OFF_LOW, OFF_HIGH, X_LOW, X_HIGH, C_LOW, C_HIGH = 0, 1, 2, 3, 4, 5, 6, 7, 16
WIDTH = 25
_EPS, _TINY = 2.0**-52, 1e-300
PAD = 8.0  # units in the last place of the largest state by which c is widened
LOOK = 8  # steps between two looks whether anything still changes, or too much has been done
STEPS, WORK = 20_000, 20_000_000  # most steps, and pieces pushed, of one point
FORGETS = 1e-9  # least 1 - |n|: below it the rounding of n alone would move the invariant interval by more than the room around it
LARGEST = 1e100  # of |c|, so that nothing overflows


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Disjoint closed intervals of x, sorted by point, history and x.

    Attributes
    ----------
    point, history : ndarray of int, shape (N,)
        Row of the parameters, and 3 (y1 + 1) + (y2 + 1).
    low, high : ndarray, shape (N,)
    """

    point: Ints
    history: Ints
    low: Array
    high: Array

    def of(self, chosen: np.ndarray) -> Pieces:
        """Those of a mask or an index."""
        return Pieces(self.point[chosen], self.history[chosen], self.low[chosen], self.high[chosen])

    @property
    def y(self) -> Ints:
        """Last output, y1."""
        return self.history // 3 - 1


@dataclass(frozen=True, slots=True, eq=False)
class Words:
    """What a census of G points found, in no particular order.

    Attributes
    ----------
    outcome : ndarray of int, shape (G,)
        DECIDED: the cycles are all there are.  UNDECIDED: they exist, but a piece straddles a threshold.  OVERFLOW: nothing is known.
    point, first, period : ndarray of int, shape (C,)
        Point, place of the first symbol and number of symbols of each cycle.
    symbols : ndarray of int8, shape (S,)
        Outputs in {-1, 0, 1}.
    """

    outcome: Ints
    point: Ints
    first: Ints
    period: Ints
    symbols: Symbols

    def word(self, cycle: int) -> tuple[int, ...]:
        """Outputs of one cycle in the lexicographically smallest rotation."""
        return smallest_rotation(self.symbols[self.first[cycle] : self.first[cycle] + self.period[cycle]].tolist())


def smallest_rotation(word: list[int]) -> tuple[int, ...]:
    """Lexicographically smallest rotation of a word."""
    return min(tuple(word[i:] + word[:i]) for i in range(len(word)))


def down(value: Array) -> Array:
    """A number below `value` by one or two units in the last place; monotone, and the same in C."""
    return value - (np.abs(value) * _EPS + _TINY)


def up(value: Array) -> Array:
    """A number above `value` by one or two units in the last place; monotone, and the same in C."""
    return value + (np.abs(value) * _EPS + _TINY)


def parameter_rows(
    *, km: ArrayLike, tau_m: ArrayLike, u_on: ArrayLike, h: ArrayLike, Ts: ArrayLike, k: ArrayLike, f: ArrayLike,
    k_high: ArrayLike | None = None, f_high: ArrayLike | None = None,
) -> Array:  # fmt: skip
    """Rows of interval parameters for :func:`levels`, shape (G, 25); all arguments are broadcast against each other.

    Parameters
    ----------
    km, tau_m, u_on, h, Ts, k : array_like
        Parameters of the modulators; tau_m and Ts in s, tau_m, Ts > 0.
    f : array_like
        Constant f(r) behind the dead zone.
    k_high, f_high : array_like, optional
        With them k and f are whole intervals, and what is found holds for every value in them.

    Raises
    ------
    ModelError
        Ts so far from 2 tau_m that the filter does not forget in double precision, or numbers beyond its range.
    """
    given = (km, tau_m, u_on, h, Ts, k, f, k if k_high is None else k_high, f if f_high is None else f_high)
    values = [np.asarray(v, dtype=np.float64) for v in given]
    km_, tau, on, width, period, k0, f0, k1, f1 = (np.ravel(v) for v in np.broadcast_arrays(*values))
    rows = np.empty((len(km_), WIDTH))
    n, m = _filter(km_, tau, period)
    # two roundings in each of n and m: four units hold the exact quotient of the given numbers
    rows[:, N_LOW], rows[:, N_HIGH] = n - 4 * _EPS * np.abs(n), n + 4 * _EPS * np.abs(n)
    largest = np.max(np.abs([f0, f1, k0, k1]), axis=0)
    if not (max(float(largest.max()), float(km_.max()), float(on.max())) <= LARGEST):
        raise ModelError(f"census: a demand, an offset or a gain above {LARGEST:g}; expected ordinary numbers, fractions of full thrust")
    reach = m * (2 * np.maximum(np.abs(f0), np.abs(f1)) + 2 * np.maximum(np.abs(k0), np.abs(k1)))
    # the pad holds the roundings of c, and of a modulator that adds up the same products in another order
    pad = PAD * _EPS * reach / (1 - np.abs(n)) + _TINY
    total = np.array([y1 + y2 for y1 in (-1, 0, 1) for y2 in (-1, 0, 1)])
    fed_back = np.sort(np.stack([k0[:, None] * total, k1[:, None] * total]), axis=0)
    rows[:, C_LOW : C_LOW + 9] = m[:, None] * (2 * f0[:, None] - fed_back[1]) - pad[:, None]
    rows[:, C_HIGH : C_HIGH + 9] = m[:, None] * (2 * f1[:, None] - fed_back[0]) + pad[:, None]
    rows[:, ON] = on
    rows[:, OFF_LOW], rows[:, OFF_HIGH] = down(on - width), up(on - width)
    low, high = rows[:, C_LOW : C_LOW + 9].min(axis=1), rows[:, C_HIGH : C_HIGH + 9].max(axis=1)
    ahead, back = np.maximum(n, 0), np.minimum(n, 0)
    first = np.where(n >= 0, low / (1 - ahead), (low + back * high) / (1 - back**2))
    last = np.where(n >= 0, high / (1 - ahead), (high + back * low) / (1 - back**2))
    # a little wider than the invariant interval, so that every orbit of the line enters it in finitely many steps
    room = 2.0**-20 * (np.maximum(np.abs(first), np.abs(last)) + on)
    rows[:, X_LOW], rows[:, X_HIGH] = first - room, last + room
    return rows


def _filter(km: Array, tau_m: Array, Ts: Array) -> tuple[Array, Array]:
    """Pole n and gain m of the sampled filter (paper 000, eq 3), refused where the pole is 1 or -1 but for rounding."""
    with np.errstate(over="ignore", invalid="ignore"):
        n, m = (2 * tau_m - Ts) / (2 * tau_m + Ts), km * Ts / (2 * tau_m + Ts)
    bad = np.flatnonzero(~((1 - np.abs(n) >= FORGETS) & np.isfinite(m)))
    if bad.size:
        i = bad[0]
        raise ModelError(
            f"census: Ts = {Ts[i]:.6g} s with tau_m = {tau_m[i]:.6g} s: the filter's pole n is within {FORGETS:g} of 1 or -1, so it does"
            " not forget in double precision and nothing can be proven; use a sample time nearer to 2 tau_m"
        )
    return n, m


def step_limit(rows: Array) -> Ints:
    """Number of steps after which a point is given up, shape (G,).

    A twentieth is enough to shrink the first interval to rounding width; orbits that creep past a threshold need several such times.
    """
    contraction = np.clip(np.abs(rows[:, [N_LOW, N_HIGH]]).max(axis=1), 1e-3, 1 - 1e-6)
    return np.minimum(np.ceil(800.0 / -np.log(contraction)).astype(np.int64) + 64, STEPS)


def start(rows: Array, points: Ints) -> Pieces:
    """The whole invariant interval with every history."""
    point = np.repeat(points, HISTORIES)
    return Pieces(point, np.tile(np.arange(HISTORIES), len(points)), rows[point, X_LOW], rows[point, X_HIGH])


def image(rows: Array, pieces: Pieces) -> tuple[Array, Array]:
    """Interval of the next x of each piece."""
    q, c = rows[pieces.point], pieces.history
    products = np.stack([q[:, i] * end for i in (N_LOW, N_HIGH) for end in (pieces.low, pieces.high)])
    at = np.arange(len(c))
    return down(down(products.min(axis=0)) + q[at, C_LOW + c]), up(up(products.max(axis=0)) + q[at, C_HIGH + c])


def children(rows: Array, pieces: Pieces) -> tuple[Pieces, Ints, np.ndarray]:
    """Images cut at the thresholds.

    Returns
    -------
    parts : Pieces, shape (N',)
        Not sorted.  An image that touches a threshold has a part on both sides of it.
    parent : ndarray of int, shape (N',)
    straddles : ndarray of bool, shape (N,)
        Pieces with more than one part.
    """
    low, high = image(rows, pieces)
    q, y1 = rows[pieces.point], pieces.y
    upper_low, upper_high = np.where(y1 == 1, q[:, OFF_LOW], q[:, ON]), np.where(y1 == 1, q[:, OFF_HIGH], q[:, ON])
    lower_low, lower_high = np.where(y1 == -1, -q[:, OFF_HIGH], -q[:, ON]), np.where(y1 == -1, -q[:, OFF_LOW], -q[:, ON])
    cuts = (
        (low, np.minimum(high, lower_high), low <= lower_high),
        (np.maximum(low, lower_low), np.minimum(high, upper_high), (low <= upper_high) & (high >= lower_low)),
        (np.maximum(low, upper_low), high, high >= upper_low),
    )  # outputs -1, 0, 1
    parents = [np.flatnonzero(there) for _, _, there in cuts]
    parent = np.concatenate(parents)
    after = np.repeat(np.arange(3), [len(p) for p in parents])
    parts = Pieces(
        pieces.point[parent], 3 * after + pieces.history[parent] // 3,
        np.concatenate([cut[0][p] for cut, p in zip(cuts, parents, strict=True)]),
        np.concatenate([cut[1][p] for cut, p in zip(cuts, parents, strict=True)]),
    )  # fmt: skip
    straddles = cuts[0][2].astype(int) + cuts[1][2] + cuts[2][2] > 1
    return parts, parent, straddles


def merged(parts: Pieces) -> Pieces:
    """Sorted, with pieces of one history that overlap or touch made one."""
    key = HISTORIES * parts.point + parts.history
    by_high = np.lexsort((parts.high, key))
    rank = np.empty(len(key), dtype=np.int64)
    rank[by_high] = np.arange(len(key))  # later keys have the higher ranks: one running maximum serves all
    order = np.lexsort((parts.low, key))
    reach = np.maximum.accumulate(rank[order])
    highest = parts.high[by_high][reach]
    sorted_key, low = key[order], parts.low[order]
    begins = np.ones(len(key), dtype=bool)
    begins[1:] = (sorted_key[1:] != sorted_key[:-1]) | (low[1:] > highest[:-1])
    firsts = np.flatnonzero(begins)
    lasts = np.append(firsts[1:], len(key)) - 1
    return Pieces(parts.point[order][firsts], parts.history[order][firsts], low[firsts], highest[lasts])


def successors(pieces: Pieces, parts: Pieces, parent: Ints, straddles: np.ndarray) -> Ints:
    """Index of the piece that holds the image of each piece; N for one that straddles a threshold.  Shape (N + 1,)."""
    count = len(pieces.low)
    single = ~straddles[parent]
    key = np.concatenate([HISTORIES * pieces.point + pieces.history, (HISTORIES * parts.point + parts.history)[single]])
    low = np.concatenate([pieces.low, parts.low[single]])
    order = np.lexsort((np.arange(len(key)) >= count, low, key))
    before = np.cumsum(order < count) - 1  # the last piece that begins at or before the part
    holder = np.empty(len(key), dtype=np.int64)
    holder[order] = before
    after = np.full(count + 1, count)
    found = holder[count:]
    inside = parts.high[single] <= pieces.high[found]
    after[parent[single]] = np.where(inside, found, count)
    return after


def final_cycles(after: Ints) -> Ints:
    """For each node of a functional graph the least node of the cycle that it leads to, shape (N + 1,); the sink N leads to N."""
    jump, least = after, np.minimum(np.arange(len(after)), after)
    for _ in range(max(1, len(after).bit_length())):
        least = np.minimum(least, least[jump])
        jump = jump[jump]
    # `least` of a node on a cycle is the least of the cycle only; of others also of its way there: ask where it has arrived
    return np.asarray(least[jump])


def levels(rows: Array) -> Iterator[tuple[Ints, Pieces, Ints, np.ndarray]]:
    """Push all points until each is decided or nothing changes any more.

    Yields
    ------
    points : ndarray of int
        Points that are finished now.
    pieces : Pieces
        Their last pieces; every orbit is in them after finitely many steps.
    after : ndarray of int, shape (N + 1,)
        Successor of each piece, N where it straddles a threshold.
    decided : ndarray of bool, shape (G,)
        Whether each of all points is decided now.
    """
    count = len(rows)
    limit, decided = step_limit(rows), np.zeros(count, dtype=bool)
    pieces = start(rows, np.arange(count))
    step, work = 0, np.zeros(count, dtype=np.int64)
    while len(pieces.low):
        parts, parent, straddles = children(rows, pieces)
        step += 1
        running = np.zeros(count, dtype=bool)
        running[pieces.point] = True
        open_ = np.zeros(count, dtype=bool)
        open_[pieces.point[straddles]] = True
        following = merged(parts)
        stuck = np.zeros(count, dtype=bool)
        if step % LOOK == 0:
            work += LOOK * np.bincount(pieces.point, minlength=count)
            stuck = running & (unchanged(pieces, following, count) | (step >= limit) | (work >= WORK))
        ends = running & (~open_ | stuck)
        if ends.any():
            mine = ends[pieces.point]
            renumbered = np.cumsum(mine) - 1
            kept = mine[parent]
            part = parts.of(kept)
            last = pieces.of(mine)
            after = successors(last, part, renumbered[parent[kept]], straddles[mine])
            decided |= ends & ~open_
            lost = last.point[after[:-1] == len(last.low)]
            decided[lost] = False
            yield np.flatnonzero(ends), last, after, decided
            following = following.of(~ends[following.point])
        pieces = following


def unchanged(a: Pieces, b: Pieces, count: int) -> np.ndarray:
    """Points whose pieces are the same in `a` and `b`, shape (count,)."""
    same = np.bincount(a.point, minlength=count) == np.bincount(b.point, minlength=count)
    left, right = a.of(same[a.point]), b.of(same[b.point])
    differs = (left.history != right.history) | (left.low != right.low) | (left.high != right.high)
    same[left.point[differs]] = False
    return same


def census_of(rows: Array) -> Words:
    """Words of all cycles of every point, by NumPy."""
    outcome = np.full(len(rows), UNDECIDED)
    points: list[Ints] = [np.empty(0, dtype=np.int64)]
    words: list[Symbols] = []
    for _, pieces, after, decided in levels(rows):
        outcome[decided] = DECIDED
        sink = len(pieces.low)
        final = final_cycles(after)
        for cycle_points, symbols in _followed(pieces, after, np.setdiff1d(final, [sink])):
            points.append(cycle_points)
            words.extend(symbols)
    period = np.array([len(w) for w in words], dtype=np.int64)
    return Words(
        outcome, np.concatenate(points), np.cumsum(period) - period, period,
        np.concatenate([np.empty(0, dtype=np.int8), *words]),
    )  # fmt: skip


def _followed(pieces: Pieces, after: Ints, heads: Ints) -> Iterator[tuple[Ints, list[Symbols]]]:
    """Outputs along the cycles through `heads`, those of one period together."""
    y, now, tape = pieces.y, heads.copy(), []
    left = np.arange(len(heads))
    while left.size:
        tape.append(np.zeros(len(heads), dtype=np.int8))
        tape[-1][left] = y[now[left]]
        now[left] = after[now[left]]
        closed = left[now[left] == heads[left]]
        if closed.size:
            yield pieces.point[heads[closed]], list(np.stack([row[closed] for row in tape], axis=1))
        left = left[now[left] != heads[left]]
