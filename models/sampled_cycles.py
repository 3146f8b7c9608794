"""Closed forms of the periodic outputs of the sampled modulator: trigger inputs, and the (k, delta) for which each exists.

A periodic output y determines its trigger inputs, x_i = offset + gain_i k with

    offset = km f(r),   gain_i = -m/(1 - n^P) sum_{j=0}^{P-1} n^j (y_{i-1-j} + y_{i-2-j}),

both linear in (k, delta), so each cycle exists inside a convex polygon of that plane (Lu & Zhang 2012, paper 000, eqs 12-19, give one of
them, M_c = 1 of period 4 Ts).  The census (:mod:`models.census`) finds the words; this module says where they begin and end.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from models.checked import Array, ModelError, frozen
from models.modulators import DiscretePWPF

# Table 2 of paper 000: period in samples and M_c (samples of plus / samples of minus), with the outputs that have them.
MODES: Mapping[tuple[int, str], tuple[tuple[int, ...], ...]] = MappingProxyType(
    {
        (2, "1"): ((1, -1),),
        (3, "1"): ((1, -1, 0), (1, 0, -1)),
        (3, "1/2"): ((1, -1, -1), (1, 1, -1)),
        (4, "1"): ((1, 0, -1, 0),),
        (4, "2"): ((1, 1, -1, -1),),
        (5, "1"): ((1, 0, -1, 0, 0), (1, 0, 0, -1, 0)),
        (5, "1/2"): ((1, 0, -1, -1, 0), (1, 1, 0, -1, 0)),
        (5, "2"): ((1, 1, 0, -1, -1), (1, 1, -1, -1, 0)),
        (5, "2/3"): ((1, 1, -1, -1, -1), (1, 1, 1, -1, -1)),
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Where a periodic output exists: all (k, delta) with A [k, delta] > b, row by row.

    On the border itself an input of the trigger is equal to a threshold.

    Attributes
    ----------
    word : tuple of int
    A : ndarray, shape (R, 2)
    b : ndarray, shape (R,)
    """

    word: tuple[int, ...]
    A: Array
    b: Array

    def contains(self, k: float, delta: float) -> bool:
        """True inside the region."""
        return bool((self.A @ np.array([k, delta]) > self.b).all())

    def k_range(self, delta: float) -> tuple[float, float] | None:
        """Open interval of the gains k >= 0 for one delta; None if it is empty, infinity where there is no upper end."""
        return _interval(self.A[:, 0], self.b - self.A[:, 1] * delta)

    def delta_range(self, k: float) -> tuple[float, float] | None:
        """Open interval of the offsets delta >= 0 for one k; None if it is empty."""
        return _interval(self.A[:, 1], self.b - self.A[:, 0] * k)


def _interval(slope: Array, bound: Array) -> tuple[float, float] | None:
    """Values v >= 0 with slope v > bound in every row."""
    level = slope == 0
    if (bound[level] >= 0).any():
        return None
    ends = bound[~level] / slope[~level]
    rising = slope[~level] > 0
    low = float(max(0.0, ends[rising].max(initial=0.0)))
    high = float(ends[~rising].min(initial=math.inf))
    return (low, high) if low < high else None


def gains(modulator: DiscretePWPF, word: Iterable[int]) -> Array:
    """Part of each trigger input that is proportional to k, x_i = km f(r) + gain_i k, shape (P,).

    Source: geometric sums of the recursion; for M_c = 1 of period 4 Ts they are the limits of paper 000, eqs 14 and 15.
    """
    y = _checked_word(word)
    n, period = modulator.n, len(y)
    weight = n ** np.arange(period) / (1 - n**period)
    place = (np.arange(period)[:, None] - np.arange(period)) % period  # i - j
    return frozen(-modulator.m * ((np.roll(y, 1) + np.roll(y, 2))[place] @ weight))


def region(modulator: DiscretePWPF, word: Iterable[int], *, r: float = 0.0) -> Region:
    """Conditions on (k, delta) for a periodic output; those of the modulator are not used.

    Counterpart of paper 000, eqs 16, 17 and 19, for any word, hysteresis, constant demand and sample time.

    Raises
    ------
    ModelError
        An empty word, or symbols other than -1, 0, 1.
    """
    y = _checked_word(word)
    before = np.roll(y, 1)
    gain = gains(modulator, word)
    behind = modulator.km * (float(modulator.f(r)) - modulator.delta)
    upper = np.where(before == 1, modulator.u_off, modulator.u_on)
    lower = np.where(before == -1, -modulator.u_off, -modulator.u_on)
    rows, bounds = [], []
    for i in range(len(y)):
        x = np.array([gain[i], modulator.km])
        if y[i] >= 0:  # above the lower threshold, or the upper one if it fires
            rows.append(x)
            bounds.append((upper[i] if y[i] > 0 else lower[i]) - behind)
        if y[i] <= 0:
            rows.append(-x)
            bounds.append(behind - (lower[i] if y[i] < 0 else upper[i]))
    return Region(tuple(y.tolist()), frozen(rows), frozen(bounds))


def _checked_word(word: Iterable[int]) -> np.ndarray:
    y = np.array(list(word))
    if y.ndim != 1 or y.size == 0 or not np.isin(y, (-1, 0, 1)).all():
        raise ModelError(f"word: expected outputs -1, 0 and 1 of one period, got {y.tolist()}")
    return y.astype(int)


def transient(modulator: DiscretePWPF, a: float, b: float, count: int) -> Array:
    """Trigger inputs while the output is 1, 0, -1, 0, ..., from x_0 = a and e_0 = b with y_0 = 1; r = 0.  Shape (count,).

    x_{2N}   = n^{2N} a + n^{2N-1} m b + m delta (2 S_{2N} - n^{2N-1}) + (-1)^N m k (1 + n) Q_N,
    x_{2N+1} = n^{2N+1} a + n^{2N} m b + m delta (2 S_{2N+1} - n^{2N}) + (-1)^N m k (n (1 + n) Q_N - 1),

    S_p = sum_{l=1}^p n^{l-1},  Q_N = sum_{l=0}^{N-1} (-n^2)^l.

    Source: paper 000, eqs 12 and 13.  Printed there: n^{2N-1} and n^{2N} inside the bracket after 2 m delta (they belong to m delta), the
    upper limit N of the second sum of eq 12 (the recursion gives N - 1), and (-1)^{N+1} in eqs 13 and 15 (the recursion gives (-1)^N: after
    a positive pulse the input is below its mean).  The conditions, eqs 16 to 19, are not affected.
    """
    n, m, k, delta = modulator.n, modulator.m, modulator.k, modulator.delta
    x = np.empty(count)
    for i in range(count):
        if i == 0:
            x[0] = a
            continue
        half, odd = divmod(i, 2)
        series = np.sum(n ** np.arange(i))
        alternating = np.sum((-(n**2)) ** np.arange(half)) if half else 0.0
        pulses = (1 + n) * alternating if not odd else n * (1 + n) * alternating - 1
        x[i] = n**i * a + n ** (i - 1) * m * b + m * delta * (2 * series - n ** (i - 1)) + (-1) ** half * m * k * pulses
    return x


def limits_mc1(modulator: DiscretePWPF) -> tuple[float, float]:
    """(x at y = 1, x at the 0 after it) of the output 1, 0, -1, 0; paper 000, eqs 14 and 15 (sign as in :func:`transient`)."""
    n, m, k = modulator.n, modulator.m, modulator.k
    mean = 2 * m * modulator.delta / (1 - n)
    return m * k * (1 + n) / (1 + n**2) + mean, m * k * (n - 1) / (1 + n**2) + mean


def limits_mc2(modulator: DiscretePWPF) -> tuple[float, float]:
    """(x at the first 1, x at the second) of the output 1, 1, -1, -1: 2 m k/(1 + n^2) and n times it, beside the mean."""
    n, m, k = modulator.n, modulator.m, modulator.k
    mean = 2 * m * modulator.delta / (1 - n)
    return 2 * m * k / (1 + n**2) + mean, 2 * m * k * n / (1 + n**2) + mean


def k_range_mc1(modulator: DiscretePWPF) -> tuple[float, float]:
    """Gains for which 1, 0, -1, 0 exists with delta = 0 and h = 0 (paper 000, eq 18): 0.766875 to 5.1125 for its values."""
    _require_plain(modulator)
    square = 4 * modulator.tau_m**2 + modulator.Ts**2
    return (
        modulator.u_on * square / (2 * modulator.km * modulator.tau_m * modulator.Ts),
        modulator.u_on * square / (modulator.km * modulator.Ts**2),
    )


def delta_limit_mc1(modulator: DiscretePWPF) -> float:
    """Offset above which 1, 0, -1, 0 does not exist for this k, h = 0 (paper 000, eq 19): 0.0342 for k = 1, 0.0049 for k = 0.8.

    Negative or zero where the cycle does not exist for any offset.
    """
    _require_plain(modulator)
    square, ratio = 4 * modulator.tau_m**2 + modulator.Ts**2, modulator.u_on / modulator.km
    first = 2 * modulator.k * modulator.Ts * modulator.tau_m / square - ratio
    return min(first, ratio - modulator.k * modulator.Ts**2 / square)


def k_limit_mc2(modulator: DiscretePWPF) -> float:
    """Least gain for which 1, 1, -1, -1 exists with delta = 0, h = 0 and n > 0: u_on (4 tau_m^2 + Ts^2)/(km Ts (2 tau_m - Ts)).

    0.902206 for the values of paper 000, which prints 0.9023.
    """
    _require_plain(modulator, ahead=True)
    square = 4 * modulator.tau_m**2 + modulator.Ts**2
    return modulator.u_on * square / (modulator.km * modulator.Ts * (2 * modulator.tau_m - modulator.Ts))


def delta_limit_mc2(modulator: DiscretePWPF) -> float:
    """Offset above which 1, 1, -1, -1 does not exist for this k, with h = 0 and n > 0: k Ts (2 tau_m - Ts)/(4 tau_m^2 + Ts^2) - u_on/km.

    0.012194 for k = 1 and the values of paper 000, which prints 0.0128.
    """
    _require_plain(modulator, ahead=True)
    square = 4 * modulator.tau_m**2 + modulator.Ts**2
    return modulator.k * modulator.Ts * (2 * modulator.tau_m - modulator.Ts) / square - modulator.u_on / modulator.km


def _require_plain(modulator: DiscretePWPF, *, ahead: bool = False) -> None:
    if modulator.h != 0:
        raise ModelError(f"sampled_cycles: h = {modulator.h:.6g}; this formula is for h = 0, use region() for a hysteresis")
    if ahead and modulator.n <= 0:
        raise ModelError(f"sampled_cycles: n = {modulator.n:.6g}; this formula is for Ts < 2 tau_m, use region() for any other")
