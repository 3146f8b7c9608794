"""``reentry modulator``: numbers of the paper, one JSON object, exit codes, files."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "modulator")


def answer(run: Run, *arguments: object) -> tuple[dict[str, Any], str]:
    code, out, err = run(*arguments, "--json")
    assert code == 0, err
    return json.loads(out), err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--k", 1, "--delta", 0), [[0], [-1, -1, 1, 1], [-1, 0, 1, 0]]),
        (("--k", 0.8, "--delta", 0), [[0], [-1, 0, 1, 0]]),
        (("--k", 0.8, "--delta", 0.01), [[0]]),
        (("--k", 0.75, "--delta", 0), [[0]]),
        (("--k", 5.2, "--delta", 0), [[0], [-1, -1, 1, 1]]),
        (("--k", 1, "--ts", 0.5, "--tau-m", 0.2), [[0], [-1, 0, 1], [-1, 1, 0]]),  # n < 0
        (("--k", 1, "--h", 0.2, "--r", 0.5), [[0, 0, 0, 1, 1, 0, 0, 1, 1]]),  # a duty cycle of 4/9
    ],
)
def test_census(run: Run, options: tuple[object, ...], words: list[list[int]]) -> None:
    data, _ = answer(run, "census", *options)
    assert data["decided"] is True
    assert [cycle["word"] for cycle in data["cycles"]] == words
    for cycle in data["cycles"]:
        assert cycle["period"] == len(cycle["word"]) == len(cycle["x"])
        assert 0 < cycle["basin"]["fraction"] <= 1 + 1e-12
    assert sum(cycle["basin"]["fraction"] for cycle in data["cycles"]) == pytest.approx(1)


def test_census_that_is_undecided(run: Run) -> None:
    data, err = answer(run, "census", "--k", 0.766875)
    assert data["decided"] is False
    assert data["borders"]
    assert "there may be others: an orbit meets a threshold" in err
    code, out, _ = run("census", "--k", 0.766875)
    assert code == 0
    assert "UNDECIDED" in out


def test_census_for_people(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("census", "--k", 1, "--out", "place")
    assert code == 0
    assert "[-1, 0, 1, 0]: x = -0.586797, 0.0880196, 0.586797, -0.0880196" in out
    assert json.loads((tmp_path / "place" / "census.json").read_text())["decided"] is True


def test_duty(run: Run, tmp_path: Path) -> None:
    data, _ = answer(run, "duty", "--r", 0.5, "--r", 0.05, "--k", 1, "--h", 0.2)
    assert data["fraction"] == ["4/9", "0"]
    # exact on and off times of the continuous modulator at r = 0.5: km (r - 1) = -2, km r = 2
    on, off = -np.log((0.25 + 2) / (0.45 + 2)), -np.log((2 - 0.45) / (2 - 0.25))
    assert data["continuous"][0] == pytest.approx(on / (on + off), rel=1e-12)
    assert answer(run, "duty", "--r", 0.5, "--k", 1)[0]["fraction"] == ["8/19"]
    code, out, _ = run("duty", "--points", 5, "--out", "place")
    assert code == 0
    assert "1/2" in out
    assert (tmp_path / "place" / "duty.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(("frequency", "word"), [(1.0, [-1, 0, 1, 0]), (0.5, [-1, -1, 1, 1])])
def test_demand_that_ends_leaves_a_cycle(run: Run, frequency: float, word: list[int]) -> None:
    data, _ = answer(run, "track", "--k", 1, "--amplitude", 1, "--frequency", frequency, "--until", 5, "--time", 9)
    assert data["ends_in"] == word
    assert [data["y"][-4:], data["y"][-8:-4]] == [data["y"][-4:]] * 2
    assert answer(run, "track", "--k", 0.8, "--delta", 0.01, "--amplitude", 1, "--until", 5, "--time", 9)[0]["ends_in"] == [0]


def test_tracking(run: Run, tmp_path: Path) -> None:
    data, _ = answer(run, "track", "--amplitude", 0.5, "--frequency", 1, "--time", 12, "--out", "place")
    t = np.array(data["t"])
    assert data["impulse_demand"] == pytest.approx(0.5 * (1 - np.cos(t)), abs=1e-12)
    y = np.array(data["y"])
    assert data["impulse_output"][0] == 0
    assert np.diff(data["impulse_output"]) == pytest.approx(0.06 * y[:-1], abs=1e-12)
    assert data["firing_time_s"] == pytest.approx(0.06 * np.abs(y).sum())
    assert data["max_impulse_error"] < 0.2  # a tenth of what the demand asks for at its most
    assert data["ends_in"] is None
    assert {p.name for p in (tmp_path / "place").iterdir()} == {"track.json", "track.png"}
    assert run("track")[0] == 0


def test_demand_that_ends_after_the_last_sample(run: Run) -> None:
    """The last sample still has the demand in it, and two outputs of zero are no rest: the ending is that of a longer record."""
    endings = []
    for last in range(60, 84):  # samples; the demand ends half a sample after the last one
        until, time = (last + 0.5) * 0.06, (last + 0.9) * 0.06
        given = ("--k", 0.8, "--amplitude", 1, "--frequency", 1, "--until", until)
        short, _ = answer(run, "track", *given, "--time", time)
        long, _ = answer(run, "track", *given, "--time", time + 12)
        assert short["samples"] == last + 1
        assert short["ends_in"] == long["ends_in"]
        assert long["y"][-8:] == [*long["y"][-4:], *long["y"][-4:]]
        endings.append(long["ends_in"])
    assert [0] in endings
    assert [-1, 0, 1, 0] in endings


def test_duty_of_a_low_threshold_needs_no_hysteresis_from_the_user(run: Run) -> None:
    assert answer(run, "duty", "--r", 0.5, "--u-on", 0.1)[0]["h_continuous"] == 0.1


def test_duty_of_a_filter_that_never_forgets_is_not_decided(run: Run) -> None:
    data, err = answer(run, "duty", "--r", 0.5, "--ts", 1e-20)
    assert data["decided"] == [False]
    assert "Warning" not in err


def test_census_says_how_many_states_were_not_followed(run: Run) -> None:
    """Two words of 100 and more symbols: decided, but their basins have too many intervals."""
    given = ("--km", 0.3166, "--tau-m", 0.0618, "--u-on", 0.0647, "--h", 0.0285, "--k", 1, "--ts", 90.12, "--r", 1)
    data, err = answer(run, "census", *given)
    assert data["decided"] is True
    assert data["unknown_fraction"] == pytest.approx(1 - sum(cycle["basin"]["fraction"] for cycle in data["cycles"]))
    assert data["unknown_fraction"] > 0.5
    assert "of the states were not followed to their end" in err


def test_map(run: Run, tmp_path: Path) -> None:
    data, _ = answer(run, "map", "--points", "25,9", "--delta-range", "0,0.08", "--out", "place")
    assert data["undecided"] == 0
    assert np.array(data["map"]).shape == (25, 9)
    words = [word["word"] for word in data["words"]]
    kinds = [{tuple(words[i]) for i in kind} for kind in data["kinds"]]
    here = {data["k"][i]: kinds[data["map"][i][0]] for i in range(25)}
    assert here[0.5] == {(0,)}
    assert here[1.0] == {(0,), (-1, -1, 1, 1), (-1, 0, 1, 0)}
    assert data["quiet"] == sum(kinds[n] == {(0,)} for row in data["map"] for n in row)
    assert (tmp_path / "place" / "map.png").is_file()
    code, out, _ = run("map", "--points", "9,3")
    assert code == 0
    assert "{-0+0}" in out


def test_design(run: Run, tmp_path: Path) -> None:
    data, _ = answer(run, "design", "--k-range", "0.7,0.9", "--delta-range", "0,0.02", "--out", "place")
    assert data["margin"]["proven"] >= 1
    assert data["margin"]["refuted"] < 1.05 * data["margin"]["proven"]
    k, delta = data["k"], data["delta"]
    for dk in (-0.01, 0.01):
        for dd in (-0.001, 0.001):
            corner, _ = answer(run, "census", "--k", k + dk, "--delta", delta + dd)
            assert [cycle["word"] for cycle in corner["cycles"]] == [[0]]
    assert (tmp_path / "place" / "design.png").is_file()
    code, out, _ = run("design", "--k-range", "0.79,0.8", "--delta-range", "0.01,0.02")
    assert code == 0
    assert "nearest cycle found" in out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("census", "--k", "nan"), "k: expected a finite number"),
        (("census", "--k", -1), "k = -1; expected >= 0"),
        (("census", "--h", 0.5), "h = 0.5 is more than u_on = 0.45"),
        (("census", "--ts", 0), "Ts = 0; expected > 0"),
        (("census", "--delta", -0.1), "delta = -0.1; expected >= 0"),
        (("census", "--r", "inf"), "r: expected a finite number"),
        (("census", "--k", "much"), "Usage"),
        (("census", "--ts", 1e-20), "use a sample time nearer to 2 tau_m"),
        (("census", "--ts", 1e20), "use a sample time nearer to 2 tau_m"),
        (("census", "--km", 1e308), "above 1e+100"),
        (("census", "--r", 1e308), "above 1e+100"),
        (("map", "--points", "3,3", "--delta-range", "0,1e308"), "above 1e+100"),
        (("track", "--amplitude", 1e300), "--amplitude: found 1e+300"),
        (("duty", "--r", "nan"), "expected a finite number"),
        (("track", "--frequency", 0), "--frequency: found 0.0"),
        (("track", "--time", 1e9), "more than ten million samples"),
        (("track", "--amplitude", "nan"), "expected a finite number"),
        (("map", "--k-range", "1"), "--k-range: found '1'"),
        (("map", "--k-range", "2,1"), "expected the lower number first"),
        (("map", "--points", "2.5,3"), "expected two whole numbers"),
        (("design", "--margin-k", -1), "expected >= 0"),
        (("design", "--k-range", "1.4,1.5"), "keeps the margin"),
    ],
)
def test_wrong_input(run: Run, arguments: tuple[object, ...], part: str) -> None:
    code, out, err = run(*arguments)
    assert code == 2
    assert part in " ".join(err.split())
    assert "Traceback" not in out + err


def test_filter_that_alternates_is_explained(run: Run) -> None:
    _, err = answer(run, "census", "--ts", 0.4)
    assert "at least 2 tau_m = 0.4 s" in err


def test_help_loads_nothing_heavy() -> None:
    code = "import sys; from studies import cli; cli.main(['modulator', '--help']); sys.exit(bool({'numpy', 'casadi'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "census" in done.stdout
