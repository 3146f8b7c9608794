"""Sampling designs: slices are the whole, each design has its own defining property, laws are inverse distribution functions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from models.checked import ModelError
from studies.campaign_design import DRAWN, NAMES, advice, design, deviations, dispersed
from studies.scenario import Scenario
from studies.synthesis import build_reference

KINDS = ("independent", "latin_hypercube", "sobol")


@pytest.mark.parametrize("kind", KINDS)
def test_any_slice_is_that_of_the_whole(kind: Any) -> None:
    plan = design(kind, seed=7, cases=1000)
    whole = plan.slice(0, 1000)
    assert whole.shape == (1000, len(DRAWN))
    assert ((whole > 0) & (whole < 1)).all()
    rng = np.random.default_rng(1)
    for chunk in (1, 7, 64, 1000):
        for first in rng.permutation(np.arange(0, 1000, chunk))[:40]:
            count = min(chunk, 1000 - int(first))
            again = design(kind, seed=7, cases=1000).slice(int(first), count) if chunk == 64 else plan.slice(int(first), count)
            assert again.tobytes() == whole[first : first + count].tobytes()


@pytest.mark.parametrize("kind", ["independent", "sobol"])
def test_cases_do_not_depend_on_their_number(kind: Any) -> None:
    assert design(kind, seed=7, cases=10).slice(0, 10).tobytes() == design(kind, seed=7, cases=10**6).slice(0, 10).tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_seeds_differ_and_columns_are_uniform_and_uncorrelated(kind: Any) -> None:
    one, two = (design(kind, seed=seed, cases=4096).slice(0, 4096) for seed in (1, 2))
    assert not np.array_equal(one, two)
    assert min(stats.kstest(column, "uniform").pvalue for column in one.T) > 1e-3
    assert np.abs(np.corrcoef(one.T) - np.eye(6)).max() < 0.08


def test_latin_hypercube_has_one_case_in_each_stratum() -> None:
    whole = design("latin_hypercube", seed=3, cases=250).slice(0, 250)
    for column in whole.T:
        assert sorted(np.floor(column * 250).astype(int)) == list(range(250))


def test_sobol_points_are_balanced_in_every_dyadic_block() -> None:
    whole = design("sobol", seed=3, cases=1024).slice(0, 1024)
    for first in range(0, 1024, 128):
        for column in whole[first : first + 128].T:
            assert sorted(np.floor(column * 128).astype(int)) == list(range(128))


def test_laws_are_inverse_distribution_functions() -> None:
    changes = {"campaign.distributions.density.law": "normal", "campaign.distributions.density.spread": 0.1}
    laws = Scenario.default().edit(changes).campaign.distributions
    numbers = design("independent", seed=1, cases=500).slice(0, 500)
    drawn = dict(zip(NAMES, deviations(numbers, laws).T, strict=True))
    column = dict(zip(NAMES, numbers.T, strict=True))
    np.testing.assert_allclose(drawn["density"], stats.norm(scale=0.1).ppf(column["density"]), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(np.degrees(drawn["gamma"]), stats.uniform(-0.1, 0.2).ppf(column["gamma"]), rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(drawn["V"], stats.uniform(-10, 20).ppf(column["V"]), rtol=1e-9, atol=1e-12)
    assert (drawn["wave_phase"].min() >= 0, drawn["wave_phase"].max() < 2 * math.pi) == (True, True)


def test_deviations_go_where_they_belong() -> None:
    scenario = Scenario.default().edit({"campaign.distributions.wave_amplitude": 0.05, "campaign.distributions.wave_length_m": 2e4})
    reference = build_reference(scenario)
    drawn = np.array([[3.0, -0.001, 0.2, -0.1, 0.05, 1.5]])
    states, params = dispersed(reference.model, reference.x[0], drawn, scenario.campaign.distributions)
    named = dict(zip([v.name for v in reference.model.params], params[0], strict=True))
    assert states[0] - reference.x[0] == pytest.approx([3.0, -0.001, 0.0, 0.0], rel=1e-9)
    expected = {
        "rho_factor": 1.2,
        "CD_factor": 0.9,
        "CL_factor": 1.05,
        "wave_amplitude": 0.05,
        "wave_length": 2e4,
        "wave_phase": 1.5,
    }
    assert {name: named[name] for name in expected} == pytest.approx(expected)


def test_wrong_requests_are_named() -> None:
    with pytest.raises(ModelError, match="found 'halton'"):
        design("halton", seed=1, cases=5)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="at least 1 case"):
        design("sobol", seed=1, cases=0)
    plan = design("sobol", seed=1, cases=5)
    for first, count in ((-1, 1), (0, 6), (4, 2), (0, 0)):
        with pytest.raises(ModelError, match="are not among 0 to 4"):
            plan.slice(first, count)


def test_advice_for_sobol_only() -> None:
    assert advice("sobol", 1024) is None
    assert advice("independent", 1000) is None
    assert "512 or 1024" in str(advice("sobol", 1000))
