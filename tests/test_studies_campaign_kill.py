"""A campaign killed at any moment, also between numbers and marker, ends with the same bytes after it is resumed."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from studies import campaign, campaign_store
from studies.campaign import Campaign
from studies.scenario import Scenario

ROOT = Path(__file__).resolve().parent.parent
CASES, CHUNK, NUMBERS = 40, 3, 13  # variables of a chunk
CHUNKS = -(-CASES // CHUNK)

# Everything is imported and synthesized once; each campaign runs in a fork of that.
KILLED = """
import os, random, signal, sys, time
from pathlib import Path
from studies import campaign, campaign_store
from studies.campaign_flight import prepared
from studies.scenario import Scenario

scenario = Scenario.default().edit({{"campaign.cases": {cases}, "campaign.chunk": {chunk}}})
prepared(scenario, "time_varying")
campaign_store.code_digest = lambda: "0" * 64  # that of another test
die = lambda: os.kill(os.getpid(), signal.SIGKILL)

def counted(module, name, limit, leave=None):
    real, calls = getattr(module, name), [0]
    def call(*arguments, **options):
        calls[0] += 1
        if calls[0] > limit:
            if leave: leave(*arguments)
            die()
        return real(*arguments, **options)
    setattr(module, name, call)

def leave(path, content):
    (path.parent / ("." + path.name + ".x.partial")).write_text("half")

def child(store, number, rng):
    kind = number % 5
    if kind == 1: counted(campaign_store, "_mark", rng.randrange({chunks}))                   # numbers, no marker
    if kind == 2: counted(campaign_store, "_mark", rng.randrange({chunks}), leave)            # half a marker
    if kind == 3: counted(campaign_store, "_digest", rng.randrange({chunks} * {numbers}))     # some variables of a chunk
    campaign.run(scenario, store)
    os._exit(0)

start = time.perf_counter()
pid = os.fork()
if not pid: child(Path(sys.argv[1]) / "whole", 0, None)
os.waitpid(pid, 0)
whole = time.perf_counter() - start
for number in range(int(sys.argv[2]), int(sys.argv[3])):
    rng = random.Random(number)
    pid = os.fork()
    if not pid: child(Path(sys.argv[1]) / str(number), number, rng)
    if number % 5 in (0, 4):
        time.sleep(rng.uniform(0, whole))
        os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
"""


def digest(done: Campaign) -> str:
    return hashlib.sha256(b"".join(name.encode() + done.data[name].tobytes() for name in sorted(done.data))).hexdigest()


def kill_and_resume(place: Path, first: int, last: int, monkeypatch: pytest.MonkeyPatch) -> None:
    script = KILLED.format(cases=CASES, chunk=CHUNK, chunks=CHUNKS, numbers=NUMBERS)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore::DeprecationWarning"}
    done = subprocess.run(
        [sys.executable, "-c", script, str(place), str(first), str(last)], env=environment, capture_output=True, text=True, timeout=250
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    whole = campaign.load(place / "whole")
    assert whole.complete
    scenario = Scenario.default().edit({"campaign.cases": CASES, "campaign.chunk": CHUNK})
    monkeypatch.setattr(campaign_store, "code_digest", lambda: "0" * 64)
    flown: list[int] = []
    fly = campaign.fly_drawn

    def counted(given: Scenario, drawn: Any, native: Any) -> Any:
        flown.append(len(drawn))
        return fly(given, drawn, native)

    monkeypatch.setattr(campaign, "fly_drawn", counted)
    partial = 0
    for number in range(first, last):
        store = place / str(number)
        kept = len(campaign_store.open_store(store).marks()) if store.exists() else 0
        partial += 0 < kept < CHUNKS
        flown.clear()
        again = campaign.run(scenario, store, resume=True)
        assert len(flown) == CHUNKS - kept, number
        assert again.complete
        assert digest(again) == digest(whole), number
        assert again.notes == ()
    assert not list(place.rglob("*.partial"))
    assert partial >= (last - first) // 2  # most were really caught in the middle


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_campaigns_resume_to_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kill_and_resume(tmp_path, 0, 5, monkeypatch)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_campaigns_resume_to_the_same_bytes_50_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kill_and_resume(tmp_path, 5, 55, monkeypatch)
