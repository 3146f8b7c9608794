"""Margins and designs without cycles: the proof against points, the margin against the closed form of the nearest cycle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.census import census
from models.checked import ModelError
from models.modulator_design import OPEN, PROVEN, REFUTED, design_quiet, linearity, prove_quiet, quiet_margin
from models.modulators import DiscretePWPF
from models.modulators_runs import run
from models.sampled_cycles import delta_limit_mc1, k_range_mc1, region

PAPER = DiscretePWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.0, k=0.8, delta=0.01, Ts=0.06)


def test_boxes_are_proven_up_to_the_border():
    border = k_range_mc1(PAPER)[0]
    assert prove_quiet(PAPER, (0.0, border - 1e-3), (0.0, 0.0)) == PROVEN
    assert prove_quiet(PAPER, (0.0, border - 2e-3), (-0.001, 0.003)) == PROVEN
    assert prove_quiet(PAPER, (0.7, border + 1e-3), (0.0, 0.0)) == REFUTED
    assert prove_quiet(PAPER, (0.7, border), (0.0, 0.0)) == OPEN  # the cycle begins on the border of the box
    assert prove_quiet(PAPER, (0.8, 0.8), (delta_limit_mc1(PAPER) + 1e-5, 0.05)) == PROVEN


def test_margin_ends_at_the_nearest_cycle():
    for modulator in (
        PAPER,
        replace(PAPER, k=0.75, delta=0.0),
        DiscretePWPF(km=6.0, tau_m=0.15, u_on=0.6, h=0.0, k=0.65, delta=0.02, Ts=0.05),
    ):
        found = quiet_margin(modulator, step_k=0.01, step_delta=0.001)
        assert 0 < found.proven < found.refuted < 1.03 * found.proven
        where = region(modulator, found.word)
        assert where.contains(*found.at)
        # the size at which a corner, or the middle of a side, enters the half planes of that cycle
        sizes = np.linspace(0, 2 * found.refuted, 4001)
        corners = [(modulator.k + 0.01 * s * a, modulator.delta + 0.001 * s * b) for s in sizes for a in (-1, 1) for b in (-1, 0, 1)]
        inside = np.array([where.contains(k, abs(d)) for k, d in corners]).reshape(-1, 6).any(axis=1)
        assert found.proven <= sizes[inside].min() <= found.refuted * 1.001


def test_margin_in_one_direction_is_the_closed_form():
    found = quiet_margin(PAPER, step_k=0.0, step_delta=1e-3)
    assert found.proven == pytest.approx((0.01 - delta_limit_mc1(PAPER)) / 1e-3, rel=0.011)
    assert quiet_margin(replace(PAPER, delta=0.0)).proven == 0.0
    assert quiet_margin(replace(PAPER, delta=0.0)).word == (-1, 0, 1, 0)


def test_linearity_is_that_of_long_runs():
    found = linearity(PAPER, demands=21)
    y = run(PAPER, np.repeat(found.r[:, None], 30_000, axis=1)).y
    assert found.duty == pytest.approx(y[:, 1000:].mean(axis=1), abs=2e-3)
    assert found.error == pytest.approx(np.sqrt(np.mean((found.duty - found.r) ** 2)))
    assert found.bend < found.error + 1e-12
    assert linearity(replace(PAPER, k=0.5), demands=21).error > 3 * found.error


def test_design_keeps_its_margin_and_is_the_best_of_its_candidates():
    found = design_quiet(PAPER, k=(0.6, 1.0), delta=(0.0, 0.02), margin_k=0.01, margin_delta=0.001, points=(21, 11), demands=21)
    chosen = found.modulator
    assert found.margin.proven >= 1
    rng = np.random.default_rng(1)
    for k, delta in zip(rng.uniform(-0.01, 0.01, 40) + chosen.k, rng.uniform(-0.001, 0.001, 40) + chosen.delta, strict=True):
        assert census(replace(chosen, k=k, delta=max(delta, 0.0))).quiet
    assert np.nanmin(found.error) == found.error[(found.k == chosen.k) & (found.delta == chosen.delta)][0]
    refused = np.flatnonzero(~found.proven)[:40]
    for i in refused:  # a candidate without the margin has a cycle somewhere in its box
        corners = [(found.k[i] + a, max(found.delta[i] + b, 0.0)) for a in (-0.01, 0, 0.01) for b in (-0.001, 0, 0.001)]
        assert not all(census(replace(PAPER, k=k, delta=d)).quiet for k, d in corners)


def test_wrong_input():
    with pytest.raises(ModelError, match="expected 0 <= k"):
        prove_quiet(PAPER, (0.8, 0.7), (0.0, 0.1))
    with pytest.raises(ModelError, match="not both 0"):
        quiet_margin(PAPER, step_k=0.0, step_delta=0.0)
    with pytest.raises(ModelError, match="keeps the margin"):
        design_quiet(PAPER, k=(1.4, 1.5), points=(3, 3))
    with pytest.raises(ModelError, match="delta: expected 0 <= low <= high"):
        design_quiet(PAPER, delta=(0.1, 0.0))
