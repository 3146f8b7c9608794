"""``reentry campaign``: exit codes, one JSON object, what stands after an interruption."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run

from studies import campaign, campaign_workers
from studies.scenario import Scenario

ROOT = Path(__file__).resolve().parent.parent
SMALL = ("--cases", 12, "--set", "campaign.chunk=5")


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "campaign")


def test_run_show_and_replay(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("campaign: {seed: 5, design: sobol}\n")
    code, out, err = run("mine.yaml", "--out", "store", "--json", *SMALL)
    assert code == 0
    assert "12 is not a power of two, so the Sobol points are not balanced; 8 or 16 would be" in err
    data = json.loads(out)
    assert (data["store"], data["report"]) == ("store", "store-report/index.html")
    assert (data["campaign"]["computed"], data["campaign"]["complete"]) == (12, True)
    done = campaign.load("store")
    assert data["campaign"]["rms_km"]["value"] == pytest.approx(np.sqrt(np.mean(done.data["miss_km"] ** 2)))
    assert "Dispersion campaign" in (tmp_path / "store-report" / "index.html").read_text()
    code, out, _ = run("show", "store", "--report", "elsewhere", "--json")
    assert (code, json.loads(out)["campaign"]) == (0, data["campaign"])
    assert (tmp_path / "elsewhere" / "index.html").is_file()
    code, out, err = run("replay", "store", 7, "--out", "pictures", "--json")
    again = json.loads(out)
    assert (code, err, again["same"], again["changed"]) == (0, "", True, [])
    assert again["stored"]["miss_km"] == again["flown"]["miss_km"] == done.data["miss_km"][7]
    assert (tmp_path / "pictures" / "case_7.png").read_bytes()[:4] == b"\x89PNG"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["elsewhere", "mine.yaml", "pictures", "store", "store-report"]


def test_tables_for_people(run: Run) -> None:
    code, out, err = run("--out", "store", *SMALL)
    assert (code, err) == (0, "")
    assert "rms miss" in out
    assert "99.7 % of |miss| below" in out
    assert run("show", "store")[1] == out
    code, out, _ = run("replay", "store", 3)
    assert code == 0
    assert repr(float(campaign.load("store").data["t_f"][3])) in out


def test_wrong_input(run: Run, tmp_path: Path) -> None:
    assert run("--out", "store", *SMALL)[0] == 0
    before = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "store").rglob("*"))
    (tmp_path / "bad.yaml").write_text("campaign: {design: halton}\n")
    for arguments, part in (
        (("--out", "store", *SMALL), "store: is not empty; continue a campaign with --resume"),
        (("--out", "store", "--resume", "--set", "campaign.seed=1"), "campaign.seed is 20000503 in the store and 1 now"),
        (("--out", "store", "--resume", "--cases", 13), "campaign.cases is 12 in the store and 13 now"),
        (("--cases", 5), "--out: not given"),
        (("bad.yaml", "--out", "x"), "bad.yaml:1: campaign.design: found 'halton', expected one of independent"),
        (("none.yaml", "--out", "x"), "no such file"),
        (("--out", "bad.yaml"), "is a file"),
        (("--out", "x", "--set", "seed"), "expected key=value"),
        (("--out", "x", "--set", "campaign.sede=1"), "unknown key 'campaign.sede'; did you mean 'campaign.seed'?"),
        (("--out", "x", "--workers", 1, "--scheduler", "tcp://a:1"), "give one of them"),
        (("show", "nothing"), "no such store"),
        (("show", "."), "is not a campaign store"),
        (("replay", "store", 12), "give a number from 0 to 11"),
        (("replay", "store", "x"), "Usage"),
    ):
        code, _, err = run(*arguments)
        assert code == 2, (arguments, err)
        assert part in err, (arguments, err)
        assert "Traceback" not in err
    assert sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "store").rglob("*")) == before
    assert not (tmp_path / "x").exists()


def test_scenario_is_printed(run: Run) -> None:
    code, out, _ = run("--print-scenario", "--cases", 77)
    assert code == 0
    assert Scenario.parse(out).campaign.cases == 77


def test_failed_cases_end_with_3(run: Run) -> None:
    law = ("--set", "campaign.distributions.density.law=normal", "--set", "campaign.distributions.density.spread=0.9")
    code, out, err = run("--out", "store", "--json", *SMALL, *law, "--cases", 40)
    assert code == 3
    failed = json.loads(out)["campaign"]["failed"]
    assert failed > 0
    assert f"reentry: {failed} case(s) failed" in err
    number = int(err.split("failed: case ")[1].split()[0])
    code, out, err = run("replay", "store", number)
    assert code == 0
    assert "not flown: it starts outside the valid range" in out


def test_lost_workers_end_with_3(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(todo: Any, call: Any) -> Any:
        yield campaign_workers.Outcome(0, call(0))
        raise campaign_workers.WorkersLostError("the scheduler is gone")

    monkeypatch.setattr(campaign_workers, "here", lost)
    code, out, err = run("--out", "store", *SMALL)
    assert code == 3
    assert "(partial)" in out
    assert "the workers were lost: the scheduler is gone; store is partial, continue with --resume" in err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_leaves_a_partial_store(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "studies.cli", "campaign", "--out", "store", "--cases", "1900", "--set", "campaign.chunk=20"]
    with subprocess.Popen(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 60
        while not (tmp_path / "store" / "markers" / "1.json").exists():
            assert time.monotonic() < deadline
            assert process.poll() is None
            time.sleep(0.02)
        start = time.monotonic()
        process.send_signal(number)
        _, err = process.communicate(timeout=20)
        assert time.monotonic() - start < 3
    assert process.returncode == 130, err
    assert "store: partial; the complete chunks stand, continue with --resume" in err
    part = campaign.load(tmp_path / "store")
    assert not part.complete
    assert 40 <= len(part.cases) < 1900
