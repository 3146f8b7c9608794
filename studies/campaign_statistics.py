"""Estimates with confidence intervals in closed form, for independent cases.

Sources: Wilson 1927, "Probable inference, the law of succession, and statistical inference"; David and Nagaraja 2003, "Order
Statistics", section 7.1 (quantiles); Massart 1990, "The tight constant in the Dvoretzky-Kiefer-Wolfowitz inequality".
Latin hypercube and Sobol points are not independent: for them means scatter less than these intervals say.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom, norm

from models.core import Array, ModelError

CONFIDENCE = 0.95
QUANTILES = (0.5, 0.9, 0.95, 0.99, 0.997)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A value with its confidence interval; an end is None where the cases are too few to give one."""

    value: float
    low: float | None
    high: float | None


def proportion(hits: int, cases: int, *, confidence: float = CONFIDENCE) -> Estimate:
    """Probability from `hits` among `cases`, with the interval of Wilson."""
    if not 0 <= hits <= cases or cases < 1:
        raise ModelError(f"proportion: found {hits} of {cases}, expected 0 <= hits <= cases and at least one case")
    z = float(norm.ppf(0.5 + confidence / 2))
    share = hits / cases
    centre = (share + z * z / (2 * cases)) / (1 + z * z / cases)
    half = z / (1 + z * z / cases) * math.sqrt(share * (1 - share) / cases + z * z / (4 * cases**2))
    low = 0.0 if hits == 0 else max(centre - half, 0.0)
    high = 1.0 if hits == cases else min(centre + half, 1.0)
    return Estimate(share, low, high)


def mean(values: Array, *, confidence: float = CONFIDENCE) -> Estimate:
    """Mean of values (N,), with the normal interval of its standard error."""
    average = float(np.mean(values))
    if len(values) < 2:
        return Estimate(average, None, None)
    half = float(norm.ppf(0.5 + confidence / 2)) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return Estimate(average, average - half, average + half)


def rms(values: Array, *, confidence: float = CONFIDENCE) -> Estimate:
    """Root mean square of values (N,): root of the mean square and of the ends of its interval."""
    square = mean(np.square(values), confidence=confidence)
    if square.low is None or square.high is None:
        return Estimate(math.sqrt(square.value), None, None)
    return Estimate(math.sqrt(square.value), math.sqrt(max(square.low, 0.0)), math.sqrt(square.high))


def quantile(ordered: Array, share: float, *, confidence: float = CONFIDENCE) -> Estimate:
    """Quantile of values (N,) in ascending order, with two of them as the ends of its interval.

    The number of values below the true quantile is binomial, whatever their law, so the coverage is at least `confidence`.
    """
    n = len(ordered)
    if n == 0 or not 0 < share < 1:
        raise ModelError(f"quantile: found share {share} of {n} values, expected 0 < share < 1 and at least one value")
    tail = (1 - confidence) / 2
    low = int(binom.ppf(tail, n, share))  # P(count < low) <= tail, so the low-th value from below is a bound
    high = int(binom.ppf(1 - tail, n, share)) + 1
    value = float(ordered[min(max(math.ceil(n * share) - 1, 0), n - 1)])
    return Estimate(value, float(ordered[low - 1]) if low >= 1 else None, float(ordered[high - 1]) if high <= n else None)


def band(cases: int, *, confidence: float = CONFIDENCE) -> float:
    """Half-width of a band around the empirical distribution function that holds everywhere at once (Massart)."""
    return math.sqrt(math.log(2 / (1 - confidence)) / (2 * cases))


def running_rms(values: Array, *, points: int = 120, confidence: float = CONFIDENCE) -> tuple[np.ndarray, Array, Array, Array]:
    """(n, rms, low, high) of the first n values, for up to `points` numbers n spread evenly on a logarithmic axis."""
    square = np.square(values)
    n = np.unique(np.geomspace(min(10, len(values)), len(values), points).astype(int))
    first, second = np.cumsum(square)[n - 1] / n, np.cumsum(square**2)[n - 1] / n
    half = float(norm.ppf(0.5 + confidence / 2)) * np.sqrt(np.maximum(second - first**2, 0.0) / np.maximum(n - 1, 1))
    return n, np.sqrt(first), np.sqrt(np.maximum(first - half, 0.0)), np.sqrt(first + half)
