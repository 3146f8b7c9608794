"""Closed forms of periodic outputs: published numbers, plain recursion, brute force in the (k, delta) plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.checked import ModelError
from models.modulators import DiscretePWPF
from models.sampled_cycles import (
    MODES,
    delta_limit_mc1,
    delta_limit_mc2,
    gains,
    k_limit_mc2,
    k_range_mc1,
    limits_mc1,
    limits_mc2,
    region,
    transient,
)

PAPER = DiscretePWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.0, k=1.0, Ts=0.06)


def recursion(modulator, f, word, a, e, count):
    """x_1, x_2, ... while the outputs are forced to be `word`; plain floats, written apart from the product."""
    m = modulator.km * modulator.Ts / (2 * modulator.tau_m + modulator.Ts)
    n = (2 * modulator.tau_m - modulator.Ts) / (2 * modulator.tau_m + modulator.Ts)
    x, out = a, []
    for i in range(count):
        e_next = f - modulator.k * word[i % len(word)]
        x, e = n * x + m * (e_next + e), e_next
        out.append(x)
    return out


def test_numbers_of_the_paper():
    assert k_range_mc1(PAPER) == pytest.approx((0.7669, 5.1125), abs=5e-5)
    assert k_range_mc1(PAPER) == pytest.approx((0.766875, 5.1125), rel=1e-12)
    assert delta_limit_mc1(PAPER) == pytest.approx(0.0342, abs=5e-5)
    assert delta_limit_mc1(replace(PAPER, k=0.8)) == pytest.approx(0.0049, abs=5e-5)
    assert np.abs(limits_mc1(PAPER)) == pytest.approx([0.5868, 0.0880], abs=5e-5)
    # the equations give 0.902206 where 0.9023 is printed, and 0.0122 where 0.0128 is
    assert k_limit_mc2(PAPER) == pytest.approx(0.45 * 818 / 408, rel=1e-12)
    assert delta_limit_mc2(PAPER) == pytest.approx(0.0122, abs=5e-5)


@pytest.mark.parametrize("delta", [0.0, 0.013])
def test_transient_is_the_recursion(delta):
    modulator = replace(PAPER, k=0.9, delta=delta)
    word = (1, 0, -1, 0)
    found = transient(modulator, 0.7, 0.3, 14)
    assert found[0] == 0.7
    assert found[1:] == pytest.approx(recursion(modulator, delta, word, 0.7, 0.3, 13), rel=1e-13)
    assert transient(modulator, 0.7, 0.3, 401)[[400, 399]] == pytest.approx(
        [limits_mc1(modulator)[0], 2 * modulator.km * delta - limits_mc1(modulator)[1]], rel=1e-12
    )


@pytest.mark.parametrize(("Ts", "r"), [(0.06, 0.0), (0.3, 0.11), (0.4, -0.2), (0.55, 0.07)])
def test_orbits_of_all_modes_are_the_recursion(Ts, r):
    modulator = DiscretePWPF(km=3.3, tau_m=0.2, u_on=0.4, h=0.1, k=1.7, delta=0.02, Ts=Ts)
    for words in MODES.values():
        for word in words:
            wanted = np.array(recursion(modulator, 0.02 + r, word, 0.3, 0.0, 400 * len(word))[-len(word) :])
            found = gains(modulator, word) * modulator.k + modulator.km * (0.02 + r)
            assert np.roll(found, -1) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_special_forms_are_the_general_one():
    for modulator in (PAPER, DiscretePWPF(km=6.0, tau_m=0.13, u_on=0.7, h=0.0, k=1.9, Ts=0.04)):
        one, two = region(modulator, (1, 0, -1, 0)), region(modulator, (-1, 1, 1, -1))
        assert one.k_range(0.0) == pytest.approx(k_range_mc1(modulator), rel=1e-12)
        assert one.delta_range(modulator.k) == pytest.approx((0.0, delta_limit_mc1(modulator)), rel=1e-10)
        assert two.k_range(0.0)[0] == pytest.approx(k_limit_mc2(modulator), rel=1e-12)
        assert two.delta_range(modulator.k)[1] == pytest.approx(delta_limit_mc2(modulator), rel=1e-10)
        offset = modulator.km * modulator.delta
        assert gains(modulator, (1, 1, -1, -1))[:2] * modulator.k + offset == pytest.approx(limits_mc2(modulator), rel=1e-12)
    assert region(PAPER, (1, 0, -1, 0)).k_range(0.1) is None
    assert region(PAPER, (1, 1, -1, -1)).k_range(0.0)[1] == np.inf  # whatever k: this cycle outlasts the range of the other


def flies(modulator, word, r):
    """Whether the modulator repeats the word 30 times from the state that 400 forced periods leave."""
    f = modulator.delta + r
    # forced to the end of a period but one symbol: the input that goes with the last symbol
    x = recursion(modulator, f, word, 0.0, 0.0, 400 * len(word) - 1)[-1]
    z, seen = np.array([x, f - modulator.k * word[-2], word[-1]]), []
    for _ in range(30 * len(word)):
        z, y = modulator.step(z, r)
        seen.append(int(y))
    return seen == list(word) * 30


@pytest.mark.parametrize(("h", "r"), [(0.0, 0.0), (0.25, 0.0), (0.1, 0.03)])
def test_regions_are_where_the_modulator_repeats_the_word(h, r):
    rng = np.random.default_rng(11)
    hits = 0
    for (period, _), words in MODES.items():
        for word in words:
            where = region(replace(PAPER, h=h), word, r=r)
            for _ in range(6):
                k, delta = rng.uniform(0, 6), rng.uniform(0, 0.11)
                slack = np.abs(where.A @ np.array([k, delta]) - where.b).min()
                if slack < 1e-6:
                    continue
                modulator = replace(PAPER, h=h, k=k, delta=delta)
                assert where.contains(k, delta) == flies(modulator, word, r), (word, k, delta, period)
                hits += where.contains(k, delta)
    assert hits >= 3


def test_wrong_input():
    with pytest.raises(ModelError, match="expected outputs -1, 0 and 1"):
        region(PAPER, (1, 2))
    with pytest.raises(ModelError, match="expected outputs"):
        gains(PAPER, ())
    with pytest.raises(ModelError, match=r"h = 0\.2; this formula is for h = 0"):
        k_range_mc1(replace(PAPER, h=0.2))
    with pytest.raises(ModelError, match="Ts < 2 tau_m"):
        k_limit_mc2(replace(PAPER, Ts=0.5))
