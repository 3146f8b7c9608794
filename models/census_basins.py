"""Basins of the cycles of a sampled modulator: which states end in which cycle, as intervals of x for each history."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from models.census_pieces import HISTORIES, X_HIGH, X_LOW, Ints, Pieces, step_limit
from models.checked import Array, frozen
from models.modulators import DiscretePWPF

_UNKNOWN = -1
_WORK = 4_000_000  # strips moved by one step; what is left then belongs to no basin


@dataclass(frozen=True, slots=True, eq=False)
class Basin:
    """States that lead to one cycle, within the invariant interval of x and all nine histories (y1, y2).

    Attributes
    ----------
    fraction : float
        Share of the basin in the length of the nine intervals: the probability of the cycle for a state drawn evenly from them, or
        less where not every state could be followed to its end (the fractions of all cycles then do not add up to 1).
    y1, y2 : ndarray of int, shape (N,)
        Outputs of the last two samples, y1 the newer.
    low, high : ndarray, shape (N,)
        Intervals of x.
    """

    fraction: float
    y1: Ints
    y2: Ints
    low: Array
    high: Array

    def holds(self, x: Array, y1: Ints, y2: Ints) -> np.ndarray:
        """Which of N states are in the basin, shape (N,)."""
        inside = (self.low <= np.asarray(x)[:, None]) & (np.asarray(x)[:, None] <= self.high)
        return np.asarray((inside & (self.y1 == np.asarray(y1)[:, None]) & (self.y2 == np.asarray(y2)[:, None])).any(axis=1))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        columns = (self.y1.tolist(), self.y2.tolist(), self.low.tolist(), self.high.tolist())
        intervals = [{"y1": a, "y2": b, "x": [low, high]} for a, b, low, high in zip(*columns, strict=True)]
        return {"fraction": self.fraction, "intervals": intervals}


@dataclass(frozen=True, slots=True, eq=False)
class _Strips:
    """Intervals on their way: where they are now (history, low, high) and which states they came from (origin, first to last).

    `first` belongs to `low` and `last` to `high`; with n < 0 they are turned about in every step.
    """

    history: Ints
    low: Array
    high: Array
    origin: Ints
    first: Array
    last: Array

    def of(self, chosen: np.ndarray) -> _Strips:
        return _Strips(*(getattr(self, name)[chosen] for name in self.__slots__))


def basins_of(modulator: DiscretePWPF, f: float, row: Array, pieces: Pieces, final: Ints, heads: Ints, *, decided: bool) -> list[Basin]:
    """Basins of the cycles `heads`.

    Parameters
    ----------
    modulator : DiscretePWPF
    f : float
        Constant behind its dead zone.
    row : ndarray, shape (25,)
        Its interval parameters.
    pieces : Pieces
        Last pieces of its census, which no orbit leaves.
    final : ndarray of int
        Head of the cycle that each piece leads to, the number of pieces where it leads to none.
    heads : ndarray of int, shape (C,)
    decided : bool
        There are no other cycles.
    """
    if not len(heads):
        return []
    begin = np.arange(HISTORIES)
    low, high = np.full(HISTORIES, row[X_LOW]), np.full(HISTORIES, row[X_HIGH])
    strips = _Strips(begin, low, high, begin, low, high)
    if decided and len(heads) == 1:
        return [Basin(1.0, begin // 3 - 1, begin % 3 - 1, frozen(low), frozen(high))]
    done, labels, work = [], [], 0
    for _ in range(int(step_limit(row[None, :])[0])):
        label = _labels(strips, pieces, final)
        arrived = label != _UNKNOWN
        done.append(strips.of(arrived))
        labels.append(label[arrived])
        strips = strips.of(~arrived)
        work += len(strips.low)
        if not strips.low.size or work > _WORK:
            break
        strips = _advanced(modulator, f, strips)
    origin = np.concatenate([s.origin for s in done])
    ends = np.sort(np.stack([np.concatenate([s.first for s in done]), np.concatenate([s.last for s in done])]), axis=0)
    return [_basin(origin, ends, np.concatenate(labels) == head, float(row[X_HIGH] - row[X_LOW])) for head in heads]


def _labels(strips: _Strips, pieces: Pieces, final: Ints) -> Ints:
    """Head of the cycle of the piece that holds each strip, the number of pieces where that is cut by a threshold, -1 where none does."""
    label = np.full(len(strips.low), _UNKNOWN)
    for history in range(HISTORIES):
        mine = np.flatnonzero(strips.history == history)
        theirs = np.flatnonzero(pieces.history == history)
        if not (mine.size and theirs.size):
            continue
        place = np.searchsorted(pieces.low[theirs], strips.low[mine], side="right") - 1
        holder = theirs[np.maximum(place, 0)]
        inside = (place >= 0) & (strips.high[mine] <= pieces.high[holder])
        label[mine[inside]] = final[holder[inside]]
    return label


def _advanced(modulator: DiscretePWPF, f: float, s: _Strips) -> _Strips:
    """One step, cut at the thresholds."""
    y1 = s.history // 3 - 1
    drive = modulator.m * (2 * f - modulator.k * (y1 + s.history % 3 - 1))
    n = modulator.n
    low, high, first, last = n * s.low + drive, n * s.high + drive, s.first, s.last
    if n < 0:
        low, high, first, last = high, low, last, first
    upper, lower = np.where(y1 == 1, modulator.u_off, modulator.u_on), np.where(y1 == -1, -modulator.u_off, -modulator.u_on)
    width = np.where(high > low, high - low, 1.0)

    def at(x: Array) -> Array:
        return np.asarray(first + (last - first) * np.clip((x - low) / width, 0.0, 1.0))

    parts = []
    # a strip without width lies on one side; the side of a strip that ends on a threshold has no length and does not matter
    cuts = ((low, np.minimum(high, lower), low <= lower), (np.maximum(low, lower), np.minimum(high, upper), (low < upper) & (high > lower)),
            (np.maximum(low, upper), high, (high > upper) | (low >= upper)))  # fmt: skip
    for y, (a, b, there) in enumerate(cuts):
        begins, ends = np.where(a == low, first, at(a)), np.where(b == high, last, at(b))
        parts.append(_Strips(3 * y + s.history // 3, a, b, s.origin, begins, ends).of(there))
    return _Strips(*(np.concatenate([getattr(p, name) for p in parts]) for name in _Strips.__slots__))


def _basin(origin: Ints, ends: Array, mine: np.ndarray, length: float) -> Basin:
    """Intervals of one basin, those that touch made one."""
    low, high, key = ends[0, mine], ends[1, mine], origin[mine]
    order = np.lexsort((high, low, key))
    low, high, key = low[order], high[order], key[order]
    slack = 1e-12 * length  # the cuts of two neighbours are rounded apart
    begins = np.ones(len(key), dtype=bool)
    begins[1:] = (key[1:] != key[:-1]) | (low[1:] > high[:-1] + slack)
    firsts = np.flatnonzero(begins)
    lasts = np.append(firsts[1:], len(key)) - 1 if len(key) else firsts
    fraction = float(np.sum(high - low)) / (HISTORIES * length)
    kept = high[lasts] > low[firsts]
    firsts, lasts = firsts[kept], lasts[kept]
    return Basin(fraction, key[firsts] // 3 - 1, key[firsts] % 3 - 1, frozen(low[firsts]), frozen(high[lasts]))
