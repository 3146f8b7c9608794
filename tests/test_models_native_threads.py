"""Parts of a batch in threads: every part once, whatever fails, and nothing that works on after the caller has left."""

import subprocess
import sys
import textwrap
import threading
import time
import weakref

import numpy as np
import pytest

from models import native


class Held:
    """Something whose life can be watched."""


@pytest.fixture
def parts(monkeypatch):
    """Run in parts on a machine of four processors; what was run, in order of the rows."""
    monkeypatch.setattr(native, "processors", lambda: 4)

    def call(run=lambda first, last: None, rows=40):
        seen = []

        def each(first, last):
            seen.append((first, last))
            run(first, last)

        native.in_threads(each, rows, 1, 4, keep=(), vectors_each=1)
        return sorted(seen)

    return call


def test_every_part_runs_once(parts):
    assert parts() == [(0, 10), (10, 20), (20, 30), (30, 40)]
    assert parts(lambda first, last: time.sleep(0.01)) == [(0, 10), (10, 20), (20, 30), (30, 40)]


def test_without_another_thread_the_caller_does_all(parts, monkeypatch):
    native._pool.cache_clear()

    def refused(self):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    here = threading.get_ident()
    ran = []
    assert parts(lambda first, last: ran.append(threading.get_ident())) == [(0, 10), (10, 20), (20, 30), (30, 40)]
    assert set(ran) == {here}
    monkeypatch.undo()
    ran.clear()
    native.in_threads(lambda first, last: None, 40, 1, 4, keep=(), vectors_each=1)
    time.sleep(0.05)
    assert ran == []  # what was queued in vain does nothing afterwards
    native._pool.cache_clear()


def test_a_part_that_a_busy_thread_takes_late_is_waited_for(monkeypatch):
    """The pool has one thread, busy; no other can be started: what it takes when it is free belongs to the batch all the same."""
    native._pool.cache_clear()
    busy, gate = threading.Event(), threading.Event()
    native._pool().submit(lambda: (busy.set(), gate.wait(30)))
    assert busy.wait(30)

    def refused(self):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    caller, ended = threading.get_ident(), []

    def run(first, last):
        if threading.get_ident() == caller:
            gate.set()
            deadline = time.monotonic() + 5
            while not ended and first == 0 and time.monotonic() < deadline and len(taken) < 2:
                time.sleep(0.001)
        taken.append(first)
        time.sleep(0.0 if threading.get_ident() == caller else 0.3)
        ended.append(first)

    taken = []
    native.in_threads(run, 3, 1, 3, keep=(), vectors_each=1)
    assert sorted(ended) == [0, 1, 2]
    monkeypatch.undo()
    native._pool.cache_clear()


def test_an_index_error_of_a_part_is_an_error(parts):
    def run(first, last):
        raise IndexError("broken part")

    with pytest.raises(IndexError, match="broken part"):
        parts(run)


def test_tasks_keep_what_they_use_even_if_nobody_waits(monkeypatch):
    monkeypatch.setattr(native, "_wait", lambda active, ended: None)
    started, gate, alive = threading.Event(), threading.Event(), []
    caller = threading.get_ident()

    def batch():
        held = Held()
        watch = weakref.ref(held)

        def run(first, last):
            if threading.get_ident() == caller:
                assert started.wait(30)
                return
            started.set()
            gate.wait(30)
            alive.append(watch() is not None)

        native.in_threads(run, 2, 1, 2, keep=(held,), vectors_each=1)

    batch()
    gate.set()
    deadline = time.monotonic() + 10
    while not alive and time.monotonic() < deadline:
        time.sleep(0.01)
    assert alive == [True]


@pytest.mark.parametrize("where", ["caller", "other"])
def test_an_error_leaves_when_all_threads_have_ended(where, parts):
    here, running, barrier = threading.get_ident(), [], threading.Barrier(4, timeout=60)

    def run(first, last):
        mine = threading.get_ident() == here
        barrier.wait()  # every part in a thread of its own
        if mine == (where == "caller"):
            raise ValueError("broken part")
        running.append(first)
        time.sleep(0.1)
        running.remove(first)

    with pytest.raises(ValueError, match="broken part"):
        parts(run)
    assert running == []


@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal to itself")
def test_an_interrupt_waits_for_the_others_and_keeps_what_they_use():
    script = """
        import os, signal, threading, time, weakref
        from models import native

        class Held: pass

        held, log = Held(), []
        alive = weakref.ref(held)

        def run(first, last):
            if threading.current_thread() is threading.main_thread():
                time.sleep(0.2)
            else:
                time.sleep(1.0)
                log.append(alive() is not None)

        for delay in (0.1, 0.4, 0.5):
            threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT)).start()

        def batch():
            mine = Held()
            global alive
            alive = weakref.ref(mine)
            native.in_threads(run, 8, 1, 2, keep=(mine,), vectors_each=1)

        try:
            batch()
        except KeyboardInterrupt:
            print("interrupted", log)
    """
    found = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, timeout=60, check=False)
    assert found.stdout.split() == ["interrupted", "[True]"], found.stderr


def test_what_is_kept_is_let_go_at_the_end():
    held = Held()
    watch = weakref.ref(held)
    native.in_threads(lambda first, last: None, 8, 1, 2, keep=(held,), vectors_each=1)
    del held
    deadline = time.monotonic() + 10
    while watch() is not None and time.monotonic() < deadline:  # a thread of the pool may hold its last task for a moment
        time.sleep(0.01)
    assert watch() is None


@pytest.mark.parametrize("late", ["atexit.register(work)", "threading.Thread(target=lambda: (time.sleep(0.3), work())).start()"])
def test_batches_while_the_interpreter_ends(late):
    script = f"""
        import atexit, threading, time
        import numpy as np
        from models import native

        def work():
            seen = []
            native.in_threads(lambda first, last: seen.append(last - first), 40, 1, 4, keep=(), vectors_each=1)
            print(sum(seen))

        work()
        {late}
    """
    found = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, timeout=60, check=False)
    assert found.stdout.split() == ["40", "40"], found.stderr
    assert found.returncode == 0


def test_many_callers_at_once(parts):
    found = []

    def caller(number):
        out = np.zeros(40)

        def run(first, last):
            out[first:last] += number

        parts(run)
        found.append((number, out))

    callers = [threading.Thread(target=caller, args=(k,)) for k in range(20)]
    for thread in callers:
        thread.start()
    for thread in callers:
        thread.join()
    assert sorted(number for number, _ in found) == list(range(20))
    assert all((out == number).all() for number, out in found)
