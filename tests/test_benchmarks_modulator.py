"""The modulator benchmark compares equal answers; times are never asserted."""

import json
import subprocess
import sys
from pathlib import Path

from benchmarks import modulator

HERE = Path(__file__).resolve().parent.parent


def test_tools_agree():
    result = modulator.measure(quick=True)
    assert {row["tool"]: row["differing"] for row in result["rows"] if row["differing"] != 0} == {}
    assert {"workbench", "plain Python"} <= {row["tool"] for row in result["rows"]}
    assert [row["same"] for row in result["map"]] == [True, True]
    cycle = {row["what"]: row for row in result["cycle"]}
    assert cycle["exact cycle, closed form"]["error"] < 1e-12  # beside the flown cycle
    assert cycle["describing function, closed form"]["error"] < 1e-12
    assert cycle["describing function, any linear part"]["error"] < 1e-9
    assert 1e-3 < cycle["describing function, closed form"]["from_the_flown_cycle"] < 1e-2
    if "describing function, formula given to it" in cycle:
        assert cycle["describing function, formula given to it"]["error"] < 1e-3


def test_json_is_one_object_and_nothing_else():
    command = [sys.executable, "-m", "benchmarks.modulator", "--quick", "--json"]
    done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, check=True)
    assert {"machine", "rows", "map", "cycle"} <= set(json.loads(done.stdout))
