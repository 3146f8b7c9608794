"""Confidence intervals: published values, exact coverage, closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom, norm

from models.checked import ModelError
from studies import campaign_statistics as statistics


def test_wilson_against_scipy() -> None:
    from scipy.stats import binomtest

    for hits, cases in ((0, 60), (1, 10), (10, 100), (37, 4000), (50, 50)):
        other = binomtest(hits, cases).proportion_ci(method="wilson")
        found = statistics.proportion(hits, cases)
        assert (found.value, found.low, found.high) == pytest.approx((hits / cases, other.low, other.high), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("n", "share"), [(60, 0.5), (60, 0.9), (2000, 0.99), (20, 0.3)])
def test_quantile_interval_covers(n: int, share: float) -> None:
    ordered = np.arange(1.0, n + 1)
    found = statistics.quantile(ordered, share)
    # the number of values below the true quantile is binomial: the interval [x_l, x_h] holds it with P(l <= count < h)
    low = 0 if found.low is None else found.low
    high = math.inf if found.high is None else found.high
    covered = binom.cdf(high - 1, n, share) - binom.cdf(low - 1, n, share)
    assert 0.95 <= covered < 0.992
    assert found.value == math.ceil(n * share)


def test_quantile_of_few_cases_has_no_upper_end() -> None:
    assert statistics.quantile(np.arange(1.0, 101.0), 0.997).high is None
    assert statistics.quantile(np.array([4.0]), 0.5).value == 4.0


def test_mean_and_rms_cover_as_often_as_they_say() -> None:
    rng = np.random.default_rng(3)
    held = np.zeros(2)
    for _ in range(1000):
        x = rng.normal(1.0, 2.0, 400)
        for k, (found, truth) in enumerate(((statistics.mean(x), 1.0), (statistics.rms(x), math.sqrt(5.0)))):
            assert found.low is not None
            assert found.high is not None
            held[k] += found.low <= truth <= found.high
    assert (np.abs(held / 1000 - 0.95) < 0.025).all()


def test_running_rms_ends_at_the_rms() -> None:
    x = np.random.default_rng(5).normal(size=3000)
    n, value, low, high = statistics.running_rms(x)
    whole = statistics.rms(x)
    assert (n[0], n[-1]) == (10, 3000)
    assert (value[-1], low[-1], high[-1]) == pytest.approx((whole.value, whole.low, whole.high), rel=1e-12)
    assert value[0] == pytest.approx(math.sqrt(np.mean(x[:10] ** 2)))
    assert len(statistics.running_rms(x[:1])[0]) == 1


def test_band_is_massart() -> None:
    assert statistics.band(1000) == pytest.approx(1.3581 / math.sqrt(1000), rel=1e-4)  # the tabulated 95 % constant of Kolmogorov's band


def test_one_value_has_no_interval_and_none_is_an_error() -> None:
    assert (statistics.mean(np.array([2.0])).low, statistics.rms(np.array([-2.0])).value) == (None, 2.0)
    for call in (lambda: statistics.quantile(np.zeros(0), 0.5), lambda: statistics.proportion(2, 1), lambda: statistics.proportion(0, 0)):
        with pytest.raises(ModelError, match="expected"):
            call()
    assert norm.ppf(0.975) == pytest.approx(1.959964, rel=1e-6)
