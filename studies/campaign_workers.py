"""Chunks of a campaign in this process, in worker processes of this machine, or on a dask cluster."""

from __future__ import annotations

import contextlib
import logging
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

TRIES = 3  # deaths of a worker with one chunk alone before the chunk counts as failed
PATIENCE = 45.0  # s without any worker before the campaign gives up
_LOOPBACK = "127.0.0.1"


class WorkersLostError(RuntimeError):
    """The scheduler or all workers went away; the chunks that were stored stand."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """A chunk's arrays, or the reason why it has none."""

    chunk: int
    arrays: dict[str, np.ndarray] | None
    failed: str = ""


def here(todo: Sequence[int], call: Callable[[int], dict[str, np.ndarray]]) -> Iterator[Outcome]:
    """Chunks one after the other in this process."""
    for chunk in todo:
        yield Outcome(chunk, call(chunk))


@contextlib.contextmanager
def client_of(workers: int, scheduler: str | None, *, patience: float = 15.0) -> Iterator[Any]:
    """A dask client of `workers` processes of this machine (loopback only), or of a running scheduler that answers in `patience` s.

    Raises
    ------
    ImportError
        dask.distributed is not installed.
    OSError
        The scheduler does not answer.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise ImportError("dask.distributed is needed for workers: pip install 'reentry-workbench[distributed]'") from None
    if scheduler is not None:
        with Client(scheduler, timeout=patience) as client:
            yield client
        return
    # a death is counted here, where it is known which chunks ran beside each other
    settings = {"distributed.scheduler.allowed-failures": 0, "distributed.admin.tick.limit": "1h"}
    with tempfile.TemporaryDirectory(prefix="reentry-", ignore_cleanup_errors=True) as place, dask.config.set(settings):
        cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, host=_LOOPBACK, dashboard_address=f"{_LOOPBACK}:0",
            local_directory=place, silence_logs=logging.CRITICAL,
        )  # fmt: skip
        with cluster, Client(cluster) as client:
            yield client


def on_workers(client: Any, todo: Sequence[int], submit: Callable[[int, int], tuple[Any, ...]]) -> Iterator[Outcome]:
    """Chunks as they are finished; ``submit(chunk, tasks)`` gives (function, arguments...) of one, beside `tasks` on its machine.

    A chunk that was on a worker when it died is flown again at the end, with no other chunk beside it; only a death then is held
    against it, and `TRIES` of them make it a failed chunk.

    Raises
    ------
    WorkersLostError
        The scheduler, or every worker for a while, is gone.
    """
    waiting, suspects = deque(todo), deque[int]()
    running: dict[Any, int] = {}
    slots = {"": 1}
    while waiting or running:
        slots = _slots(client) or slots
        width, tasks = 2 * sum(slots.values()), max(slots.values())  # two on the way for each: no worker waits, no memory fills up
        while waiting and len(running) < width:
            chunk = waiting.popleft()
            running[_submitted(client, submit(chunk, tasks))] = chunk
        # all results are fetched and let go of before one is stored: dask would compute again what a dying worker still holds
        for outcome in [_outcome(future, running.pop(future)) for future in _finished(client, list(running))]:
            if isinstance(outcome, Outcome):
                yield outcome
            else:
                suspects.append(outcome.chunk)
    for chunk in suspects:
        deaths = 0
        while deaths < TRIES:
            (future,) = _finished(client, [_submitted(client, submit(chunk, 1))])
            outcome = _outcome(future, chunk)
            if isinstance(outcome, Outcome):
                yield outcome
                break
            deaths += outcome.deaths
        else:
            yield Outcome(chunk, None, f"its worker died {deaths} times while it flew this chunk alone")


@dataclass(frozen=True, slots=True, eq=False)
class _Death:
    """A chunk that was on a worker when it died, so many times."""

    chunk: int
    deaths: int


def _slots(client: Any) -> dict[str, int]:
    """Chunks that the workers of each machine fly at once, as they are now; empty if that is not known."""
    slots: dict[str, int] = {}
    try:
        for worker, threads in client.nthreads().items():
            machine = worker.rpartition(":")[0]  # of tcp://host:port
            slots[machine] = slots.get(machine, 0) + max(1, threads)
    except OSError:
        return {}
    return slots


def _submitted(client: Any, task: tuple[Any, ...]) -> Any:
    return client.submit(*task, pure=False)


def _finished(client: Any, futures: list[Any]) -> list[Any]:
    """Wait until at least one future is done."""
    from distributed import CancelledError, wait
    from distributed.comm.core import CommClosedError

    alone_since = None
    while True:
        try:
            return list(wait(futures, timeout=1, return_when="FIRST_COMPLETED").done)
        except TimeoutError:
            pass
        except (CancelledError, CommClosedError) as error:  # a lost scheduler cancels every future
            raise WorkersLostError(f"the scheduler is gone ({type(error).__name__})") from None
        alone = _without_workers(client)
        alone_since = (alone_since or time.monotonic()) if alone else None
        if alone_since is not None and time.monotonic() - alone_since > PATIENCE:
            raise WorkersLostError(f"there has been no worker for {PATIENCE:.0f} s")


def _without_workers(client: Any) -> bool:
    if client.status not in ("running", "connecting"):
        raise WorkersLostError(f"the connection to the scheduler is {client.status}")
    try:
        return client.status == "connecting" or not client.nthreads()
    except OSError:  # the connection broke just now
        return True


def _outcome(future: Any, chunk: int) -> Outcome | _Death:
    from distributed import CancelledError
    from distributed.scheduler import KilledWorker

    try:
        return Outcome(chunk, future.result())
    except KilledWorker as error:
        return _Death(chunk, error.allowed_failures + 1)
    except CancelledError:
        raise WorkersLostError("the scheduler dropped the work") from None
    except OSError as error:
        if future.status == "error":  # it is the chunk's own
            raise
        raise WorkersLostError(f"the scheduler is gone ({type(error).__name__})") from None
    finally:
        future.release()
