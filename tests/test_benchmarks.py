"""The benchmarks compare equal answers: the tools agree.  Times are never asserted."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from benchmarks import _entry, ensemble, entry, tvlqr

HERE = Path(__file__).resolve().parent.parent
RNG = np.random.default_rng(3)


def points(p, count=5):
    """Scaled states of an entry, inputs apart from the reference's, and S > 0."""
    x = np.column_stack([
        RNG.uniform(500, 7800, count), RNG.uniform(-0.6, -0.02, count), RNG.uniform(2e4, 7e4, count), RNG.uniform(0, 2e6, count),
    ])  # fmt: skip
    half = RNG.normal(size=(count, 4, 4))
    return x / _entry.SCALE, half @ half.transpose(0, 2, 1)


def test_hand_written_flight_and_jacobians_are_the_models():
    p, model = _entry.problem(), _entry.model_of()
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u")
    exact = ca.Function("exact", [x, u], [model.rhs(x, u, model.p0), ca.jacobian(model.rhs(x, u, model.p0), ca.vertcat(x, u))])
    rate, input_rate, jacobian = _entry.flight_rate(p), _entry.input_rate(p), _entry.hand_jacobian(p)
    for z, _ in zip(*points(p), strict=True):
        f, J = (np.asarray(v) for v in exact(z * _entry.SCALE, p.u))
        assert np.array(rate(0.0, z)) == pytest.approx(f[:, 0] / _entry.SCALE, rel=1e-12)
        zu = [*z, p.u]
        assert np.array(input_rate(zu)) == pytest.approx(f[:, 0] / _entry.SCALE, rel=1e-12)
        scaled = J * np.append(_entry.SCALE, 1.0) / _entry.SCALE[:, None]
        assert jacobian(zu) == pytest.approx(scaled, rel=1e-11)
        for central, accuracy in ((True, 1e-7), (False, 1e-5)):
            found = _entry.difference_jacobian(p, central=central)(zu)
            assert np.abs(found - scaled).max() < accuracy * np.abs(scaled).max()


def test_written_out_riccati_equation_is_the_matrix_one():
    p = _entry.problem()
    floats, matrices = _entry.joint_rate(p), _entry.matrix_rate(p, _entry.hand_jacobian(p))
    for z, S in zip(*points(p), strict=True):
        y = np.concatenate([z, S[_entry.UPPER]])
        wanted = matrices(0.0, y)
        assert np.abs(np.array(floats(0.0, y)) - wanted).max() < 1e-12 * np.abs(wanted).max()


def test_all_tools_give_the_same_gains():
    result = tvlqr.measure(quick=True)
    assert result["agreement_of_accurate_answers"] < 1e-9
    tools = {row["tool"]: row for row in result["rows"]}
    wrong = {name: row["error"] for name, row in tools.items() if row["error"] is None or row["error"] > 2e-5}
    assert wrong == {}  # differences of one side may miss the target, but not by much
    reached = [name for name, row in tools.items() if row["reached"] and row["error"] <= row["target"]]
    assert sum(name.startswith("workbench") for name in reached) == 4
    assert any(name.startswith("scipy") and "written out" in name for name in reached)


@pytest.mark.skipif(importlib.util.find_spec("pydrake") is None, reason="Drake is not installed")
def test_drake_gives_the_same_gains():
    p = _entry.problem()
    times, truth = tvlqr.scipy_gains(p, _entry.joint_rate(p), forward=("DOP853", 1e-12), backward=("DOP853", 1e-12))
    (row,) = tvlqr.drake_rows(p, 1e-6, times, truth, quick=True)
    assert row.reached
    assert row.error < 1e-6


def test_ensemble_lands_where_plain_loops_land():
    result = ensemble.measure(quick=True)
    differences = {row["tool"]: row["largest_difference_m"] for row in result["rows"]}
    assert differences.pop("RK4 in plain Python") < 1e-5
    assert max(differences.values()) < 1e-2
    assert 0.05 < result["rms_miss_km"] < 5.0


@pytest.mark.parametrize("name", ["ensemble"])
def test_json_is_one_object_and_nothing_else(name):
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--json"], cwd=HERE, capture_output=True, text=True, check=True
    )
    assert {"machine", "rows"} <= set(json.loads(done.stdout))


def test_entries_end_at_the_same_place():
    result = entry.measure(quick=True)
    assert result["agreement_of_accurate_answers_m"] < 1e-3
    wrong = {row["tool"]: row["error_m"] for row in result["rows"] if not row["error_m"] <= result["target_m"]}
    assert wrong == {}
