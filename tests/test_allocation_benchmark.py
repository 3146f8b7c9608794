"""The allocation benchmark compares equal answers: the tools solve the same problem.  Times are never asserted."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import allocation

EXACT = ("own, effectors in the code", "own, effectors as data", "daqp", "quadprog", "scipy lsq_linear")


def test_tools_agree_on_three_effectors():
    rows = {row.tool: row for row in allocation.run(3, demands=80, budget=0.05, repeat=1)}
    assert set(EXACT) <= set(rows)
    for tool, row in rows.items():
        assert row.note or row.distance < (1e-8 if tool in EXACT else 2e-2)
        assert row.note or tool not in EXACT or row.kkt < 1e-8


@pytest.mark.parametrize("n", [10, 44])
def test_problems_are_sensible(n):
    p = allocation.problem(n, 50)
    assert p.B.shape == (3, n)
    assert np.linalg.matrix_rank(p.B) == 3
    assert np.linalg.eigvalsh(p.H).min() > 0
    assert p.f == pytest.approx(-(p.demand @ p.B))


@pytest.mark.slow
def test_command_writes_json():
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.allocation", "--quick", "--json"], cwd=root, capture_output=True, text=True, check=True
    )
    data = json.loads(done.stdout)
    assert {row["effectors"] for row in data["rows"]} == {3, 10, 44}
