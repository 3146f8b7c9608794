"""Worker processes: the same bytes, workers that die, a chunk that kills, other code, a scheduler that goes away."""

from __future__ import annotations

import functools
import hashlib
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from models.checked import ModelError
from models.native import native_available
from studies import campaign, campaign_workers
from studies.campaign import Campaign
from studies.campaign_flight import fly_remote
from studies.scenario import Scenario

distributed = pytest.importorskip("distributed")

ROOT = Path(__file__).resolve().parent.parent
SCENARIO = Scenario.default().edit({"campaign.cases": 22, "campaign.chunk": 5})
# dask's own threads and sockets end after its cluster is closed; that is not what is tested here
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def digest(done: Campaign) -> str:
    return hashlib.sha256(b"".join(name.encode() + done.data[name].tobytes() for name in sorted(done.data))).hexdigest()


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return campaign.run(SCENARIO, tmp_path_factory.mktemp("campaign") / "store")


# Run on the workers, which import this file by its name.


def poison(value: float, text: str, drawn: Any, native: Any, code: str, tasks: int) -> Any:
    """The chunk whose first draw has this value kills its worker, always."""
    if drawn[0, 0] == value:
        os._exit(1)
    return fly_remote(text, drawn, native, code, tasks)


def unreliable(folder: str, text: str, drawn: Any, native: Any, code: str, tasks: int) -> Any:
    """A worker leaves with every second chunk, but no chunk sees more than two of them leave."""
    left = Path(folder) / hashlib.sha256(drawn.tobytes()).hexdigest()
    deaths = len(left.read_text()) if left.exists() else 0
    if deaths < 2 and random.random() < 0.5:
        left.write_text("x" * (deaths + 1))
        time.sleep(random.uniform(0, 0.2))
        os._exit(1)
    return fly_remote(text, drawn, native, code, tasks)


def other_code(text: str, drawn: Any, native: Any, code: str, tasks: int) -> Any:
    return fly_remote(text, drawn, native, "0" * 64, tasks)


def compiled_by_this_worker(folder: str, text: str, drawn: Any, native: Any, code: str, tasks: int) -> Any:
    """Note how many threads the compiled code was divided among, on a machine of eight processors."""
    from models import native as compiled

    if not hasattr(compiled, "counted"):
        in_threads = compiled.in_threads
        parts: list[int] = []

        def counted(run: Any, rows: int, lanes: int, threads: int, *, keep: Any, vectors_each: int = 1) -> None:
            ran: list[int] = []

            def part(first: int, last: int) -> None:
                ran.append(first)
                run(first, last)

            in_threads(part, rows, 1, 8, keep=keep, vectors_each=1)  # as many as are allowed
            parts.append(len(ran))

        setattr(compiled, "counted", parts)  # noqa: B010 (kept between the chunks of one worker)
        compiled.in_threads, compiled.processors = counted, lambda: 8
    flown = fly_remote(text, drawn, native, code, tasks)
    (Path(folder) / f"{os.getpid()}").write_text(f"{tasks} {max(compiled.counted)}")
    return flown


@pytest.mark.parametrize("workers", [1, 4])
def test_workers_give_the_same_bytes(workers: int, original: Campaign, tmp_path: Path) -> None:
    seen: list[int] = []
    done = campaign.run(SCENARIO, tmp_path / "store", workers=workers, progress=lambda done, total: seen.append(done))
    assert digest(done) == digest(original)
    assert done.complete
    assert (seen[0], seen[-1], seen == sorted(seen)) == (0, 22, True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["store"]


def test_a_chunk_that_kills_its_workers_is_recorded(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "fly_remote", functools.partial(poison, original.data["draw_V"][10]))
    done = campaign.run(SCENARIO, tmp_path / "store", workers=2)
    assert done.failed_chunks == {2: "its worker died 3 times while it flew this chunk alone"}
    assert [number for _, number, _ in done.failed] == [10, 11, 12, 13, 14]
    for name in ("miss_km", "t_f", "final_V"):
        assert done.data[name][:10].tobytes() == original.data[name][:10].tobytes()
        assert done.data[name][15:].tobytes() == original.data[name][15:].tobytes()
    monkeypatch.undo()
    assert digest(campaign.run(None, tmp_path / "store", resume=True)) == digest(original)


@pytest.mark.skipif(not native_available(), reason="no compiler")
@pytest.mark.parametrize("workers", [1, 2])
def test_workers_share_the_processors_and_give_the_same_bytes(workers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "backend_for", lambda scenario: "accurate")
    original = campaign.run(SCENARIO.edit({"campaign.chunk": 1000}), tmp_path / "original")
    (tmp_path / "seen").mkdir()
    monkeypatch.setattr(campaign, "fly_remote", functools.partial(compiled_by_this_worker, str(tmp_path / "seen")))
    done = campaign.run(SCENARIO.edit({"campaign.chunk": 11}), tmp_path / "store", workers=workers)
    assert digest(done) == digest(original)
    assert {path.read_text() for path in (tmp_path / "seen").iterdir()} == {f"{workers} {8 // workers}"}


def leaving_workers(original: Campaign, place: Path, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(times):
        (place / f"left{number}").mkdir()
        monkeypatch.setattr(campaign, "fly_remote", functools.partial(unreliable, str(place / f"left{number}")))
        done = campaign.run(SCENARIO, place / f"store{number}", workers=2)
        assert done.complete
        assert digest(done) == digest(original)


def test_workers_that_leave_change_nothing(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaving_workers(original, tmp_path, 1, monkeypatch)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_workers_that_leave_change_nothing_20_times(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leaving_workers(original, tmp_path, 20, monkeypatch)


def test_a_worker_with_other_code_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "fly_remote", other_code)
    with pytest.raises(ModelError, match="a worker runs other code"):
        campaign.run(SCENARIO, tmp_path / "store", workers=1)
    assert len(campaign.load(tmp_path / "store").cases) == 0


CLUSTER = """
import sys, time
from distributed import LocalCluster
if __name__ == "__main__":
    cluster = LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
    print(cluster.scheduler_address, flush=True)
    time.sleep(200)
"""


@pytest.mark.parametrize("status", ["finished", "error"])
def test_a_connection_that_breaks_while_a_result_is_fetched(status: str) -> None:
    """The loss of the scheduler is told; an error of the chunk itself stays what it is."""
    from distributed.comm.core import CommClosedError

    released = []

    class Fetched:
        def __init__(self) -> None:
            self.status = status

        def result(self) -> None:
            raise CommClosedError("in <TCP (closed)>: ConnectionResetError")

        def release(self) -> None:
            released.append(True)

    expected = campaign_workers.WorkersLostError if status == "finished" else CommClosedError
    with pytest.raises(expected, match="CommClosedError" if status == "finished" else "ConnectionResetError"):
        campaign_workers._outcome(Fetched(), 3)
    assert released == [True]


def test_a_running_scheduler_is_used_and_its_loss_is_told(original: Campaign, tmp_path: Path) -> None:
    import dask

    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen([sys.executable, str(script)], env=environment, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            done = campaign.run(SCENARIO, tmp_path / "store", scheduler=address)
            assert digest(done) == digest(original)

            def kill(done: int, total: int) -> None:
                if done:
                    process.kill()

            start = time.monotonic()
            many = SCENARIO.edit({"campaign.cases": 3000, "campaign.chunk": 50})
            with dask.config.set({"distributed.comm.timeouts.connect": "3s", "distributed.comm.retry.count": 0}):
                lost = campaign.run(many, tmp_path / "lost", scheduler=address, progress=kill)
            assert time.monotonic() - start < 60
            assert lost.lost
            assert 0 < len(lost.cases) < 3000
            assert not campaign.load(tmp_path / "lost").complete
        finally:
            process.kill()


def test_no_scheduler_is_an_error_of_the_machine(tmp_path: Path) -> None:
    from studies import campaign_workers

    with pytest.raises(OSError, match=r"127\.0\.0\.1:1"), campaign_workers.client_of(0, "tcp://127.0.0.1:1", patience=2.0):
        pass
