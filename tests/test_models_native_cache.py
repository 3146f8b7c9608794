"""Faults around compiled code: a harmed or hostile cache, races, edits, compilers that fail, disks that are full. Never a wrong number."""

import gc
import os
import shutil
import signal
import stat
import subprocess
import sys
import time
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from models import native, native_cache, native_compiler
from models.native_compiler import NativeWarning

needs_compiler = pytest.mark.skipif(not native.native_available(), reason="no C compiler on this machine")
needs_users = pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes of files here")
kills_groups = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="kills a group of processes")
HERE = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache of this test, and every reason to be said again."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("REENTRY_CACHE", str(folder))
    monkeypatch.delenv("REENTRY_NATIVE", raising=False)
    native_compiler.warn_once.cache_clear()
    forget()
    yield folder
    assert leftovers(folder) == []
    native_compiler.warn_once.cache_clear()


def forget():
    """As a new process: no library is loaded any more."""
    gc.collect()
    native_cache._loaded.clear()


def leftovers(folder):
    return sorted(p.name for p in folder.iterdir() if p.suffix != ".lib") if folder.is_dir() else []


def scaled(k):
    x = ca.SX.sym("x", 2)
    return ca.Function("scaled", [x], [ca.vertcat(k * x[0], x[0] * x[1], x[1] - k)])


X = np.arange(10.0).reshape(5, 2)


def wanted(k):
    return np.column_stack([k * X[:, 0], X[:, 0] * X[:, 1], X[:, 1] - k])


def right(k, backend="lanes"):
    compiled = native.compile(scaled(k))
    assert np.array_equal(compiled(X)[0], wanted(k))
    assert compiled.backend == backend
    return compiled


def entry(folder):
    (path,) = folder.glob("*.lib")
    return path


@needs_compiler
def test_entries_are_private_found_again_and_without_litter(cache, monkeypatch):
    right(2.0)
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    path = entry(cache)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    forget()
    monkeypatch.setattr(native_cache, "compiled", lambda *_: pytest.fail("compiled although the cache has it"))
    right(2.0)


def refusals(folder, changes):
    """Each content is refused before it is loaded, said, and removed."""
    path, wrong = entry(folder), 0
    key, good = path.stem, path.read_bytes()
    for change in changes:
        native_compiler.warn_once.cache_clear()
        path.write_bytes(change(good))
        path.chmod(0o600)
        with pytest.warns(NativeWarning, match="its bytes are not those"):
            wrong += native_cache._checked_bytes(path, key) is not None
        assert not path.exists()
    path.write_bytes(good)
    path.chmod(0o600)
    return wrong


def truncations(count):
    random = np.random.default_rng(0)
    return [lambda good, r=r: good[: int(r * len(good))] for r in random.uniform(0, 1, count)]


def flips(count):
    def flip(good, r):
        bit = int(r * len(good) * 8)
        return good[: bit // 8] + bytes([good[bit // 8] ^ (1 << bit % 8)]) + good[bit // 8 + 1 :]

    return [lambda good, r=r: flip(good, r) for r in np.random.default_rng(1).uniform(0, 1, count)]


@needs_compiler
def test_harmed_entries_are_refused_and_compiled_again(cache):
    right(3.0)
    assert refusals(cache, [*truncations(30), *flips(150)]) == 0
    for change in (*truncations(2), *flips(2), lambda good: b"", lambda good: good + b"x"):
        path = entry(cache)
        path.write_bytes(change(path.read_bytes()))
        forget()
        native_compiler.warn_once.cache_clear()
        with pytest.warns(NativeWarning, match="compiled again"):
            right(3.0)


@needs_compiler
@pytest.mark.slow
def test_many_harmed_entries_are_refused(cache):
    right(3.0)
    assert refusals(cache, [*truncations(300), *flips(1500)]) == 0


@needs_compiler
def test_the_library_of_another_function_is_refused(cache):
    right(4.0)
    other = entry(cache).read_bytes()
    entry(cache).unlink()
    right(5.0)
    entry(cache).write_bytes(other)
    forget()
    with pytest.warns(NativeWarning, match="its bytes are not those"):
        right(5.0)


@needs_compiler
@needs_users
@pytest.mark.parametrize("kind", ["group-writable", "link", "folder", "pipe"])
def test_entries_that_others_could_have_placed_are_refused(cache, tmp_path, kind):
    right(6.0)
    path = entry(cache)
    if kind == "group-writable":
        path.chmod(0o620)
    elif kind == "link":
        shutil.move(path, tmp_path / "elsewhere")
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.unlink()
        path.mkdir() if kind == "folder" else os.mkfifo(path)
    forget()
    with pytest.warns(NativeWarning, match="was not used because"):
        right(6.0)
    assert stat.S_ISREG(os.lstat(path).st_mode)


@needs_compiler
@needs_users
@pytest.mark.parametrize("kind", ["group-writable", "link", "foreign"])
def test_a_folder_that_is_not_private_is_not_used(cache, tmp_path, monkeypatch, kind):
    right(7.0)
    before = entry(cache).read_bytes()
    if kind == "group-writable":
        cache.chmod(0o770)
    elif kind == "link":
        (tmp_path / "link").symlink_to(cache)
        monkeypatch.setenv("REENTRY_CACHE", str(tmp_path / "link"))
    else:
        monkeypatch.setattr(os, "getuid", lambda: 4242)
    forget()
    monkeypatch.setattr(native_cache, "_checked_bytes", lambda *_: pytest.fail("read from a folder that is not private"))
    with pytest.warns(NativeWarning, match="cache cannot be used"):
        right(7.0)
    assert entry(cache).read_bytes() == before


@needs_compiler
def test_the_cache_is_bounded_and_the_oldest_go_first(cache, monkeypatch):
    right(1.0)
    first = entry(cache)
    os.utime(first, (1, 1))
    monkeypatch.setattr(native_cache, "LIMIT", int(1.5 * first.stat().st_size))
    right(2.0)
    assert first.exists()  # swept before something new is built
    right(3.0)
    assert not first.exists()


# Races.

WORKER = """
import sys
import casadi as ca, numpy as np
from models import native
x = ca.SX.sym("x", 2)
for k in map(int, sys.argv[1:]):
    compiled = native.compile(ca.Function("scaled", [x], [ca.vertcat(k * x[0], x[1] ** k)]))
    out = compiled(np.array([[1.5, 2.0], [0.5, 1.0]]))[0]
    assert compiled.backend == "lanes", compiled.reason
    assert np.array_equal(out, [[1.5 * k, 2.0**k], [0.5 * k, 1.0]]), out
"""


def wrapped_compiler(tmp_path, monkeypatch, before=""):
    """A compiler that notes in a file, for every compilation, the process that asked for it; the numbers of these processes."""
    log, script = tmp_path / "log", tmp_path / "wrapped_cc"
    script.write_text(
        f'#!/bin/sh\ncase "$*" in *" -c "*) echo $PPID >> "{log}"; {before} ;; esac\nexec {shutil.which("cc") or "gcc"} "$@"\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    return lambda: [int(line) for line in log.read_text().splitlines()] if log.exists() else []


def start(*numbers):
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", WORKER, *map(str, numbers)], cwd=HERE, env={**os.environ, "PYTHONPATH": "."},
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def race(processes, functions, tmp_path, monkeypatch, *, killed=False):
    """Number of compilations by processes that all want the same functions, each in its own order; one dies while it compiles."""
    compiles = wrapped_compiler(tmp_path, monkeypatch)
    order = np.random.default_rng(0)
    running = [start(*order.permutation(np.arange(2, 2 + functions))) for _ in range(processes)]
    victim = None
    while killed and victim is None:
        assert any(process.poll() is None for process in running)
        time.sleep(0.002)
        if len(compiles()) > functions // 2:
            victim = next((process for process in running if process.pid == compiles()[-1] and process.poll() is None), None)
    if victim is not None:
        os.killpg(victim.pid, signal.SIGKILL)  # the group that this test started, with its compiler
    for process in running:
        said = process.communicate(timeout=250)[1]
        assert process.returncode == (-signal.SIGKILL if process is victim else 0), said
    count = len(compiles())
    afterwards = start(*range(2, 3 + functions))  # one more, which sweeps what the dead one left
    assert afterwards.communicate(timeout=250)[1] == ""
    assert afterwards.returncode == 0
    assert len(compiles()) == count + 1
    return count


@needs_compiler
@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=kills_groups)])
def test_processes_on_a_cold_cache_compile_each_function_once(cache, tmp_path, monkeypatch, killed):
    assert 4 <= race(3, 4, tmp_path, monkeypatch, killed=killed) <= 4 + killed
    assert len(list(cache.glob("*.lib"))) == 5


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=kills_groups)])
def test_sixteen_processes_on_a_cold_cache(cache, tmp_path, monkeypatch, killed):
    assert 20 <= race(16, 20, tmp_path, monkeypatch, killed=killed) <= 20 + killed
    assert len(list(cache.glob("*.lib"))) == 21


@needs_compiler
@kills_groups
def test_a_process_killed_while_it_compiles_leaves_nothing_that_matters(cache, tmp_path, monkeypatch):
    slow = tmp_path / "slow"
    slow.touch()
    compiles = wrapped_compiler(tmp_path, monkeypatch, before=f'[ -e "{slow}" ] && sleep 60')
    victim = start(3)
    deadline = time.monotonic() + 60
    while not compiles() and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(victim.pid, signal.SIGKILL)  # the group that this test started
    victim.communicate()
    assert leftovers(cache) != []  # a lock and a half-built folder
    assert list(cache.glob("*.lib")) == []
    (cache / ("0" * 64 + ".lock")).touch()  # of another function, left by another process
    slow.unlink()
    began = time.monotonic()
    heir = start(3)
    assert heir.communicate(timeout=100)[1] == ""
    assert heir.returncode == 0
    assert time.monotonic() - began < 15  # starting Python included
    assert len(list(cache.glob("*.lib"))) == 1


# Moving ground.


@needs_compiler
def test_edits_in_one_process_give_new_numbers(cache):
    kept = [right(float(k)) for k in range(20)]
    assert all(np.array_equal(f(X)[0], wanted(float(k))) for k, f in enumerate(kept))
    assert len(list(cache.glob("*.lib"))) == 20


@needs_compiler
@pytest.mark.slow
def test_a_hundred_edits_and_dropped_libraries_are_unmapped(cache):
    def mapped():
        return Path("/proc/self/maps").read_text().count("/reentry-") if sys.platform.startswith("linux") else 0

    gc.collect()
    before = mapped()
    for k in range(100):
        right(float(k) + 0.5)
    forget()
    assert mapped() <= before


@needs_compiler
def test_another_processor_compiler_or_version_is_a_miss(cache, tmp_path, monkeypatch):
    right(8.0)
    for change in (
        lambda: monkeypatch.setattr(native_cache, "cpu_target", lambda: "x86-64"),
        lambda: monkeypatch.setattr(native_cache, "FORMAT", "other"),
        lambda: monkeypatch.setattr(native_cache.ca.CasadiMeta, "version", lambda: "9.9"),
        lambda: wrapped_compiler(tmp_path, monkeypatch),
        lambda: monkeypatch.setattr(native, "flags_for", lambda target, *, fast: (*native_compiler.flags_for(target, fast=fast), "-O1")),
    ):
        count = len(list(cache.glob("*.lib")))
        change()
        right(8.0)
        assert len(list(cache.glob("*.lib"))) == count + 1


@needs_compiler
@pytest.mark.skipif(native_compiler.cpu_target() not in ("x86-64", "x86-64-v3", "x86-64-v4"), reason="instruction sets of x86-64")
def test_the_code_of_a_richer_processor_is_not_loaded(cache, monkeypatch):
    """Neither found, nor believed under the name of the one for this processor."""
    other = "x86-64-v3" if native_compiler.cpu_target() == "x86-64-v4" else "x86-64-v4"
    with monkeypatch.context() as patch:
        for module in (native, native_cache):
            patch.setattr(module, "cpu_target", lambda: other)
        native.compile(scaled(8.5), lanes=4)  # is not called
    alien = entry(cache)
    forget()
    monkeypatch.setitem(native.BEST_LANES, native_compiler.cpu_target(), 4)
    right(8.5)
    (own,) = set(cache.glob("*.lib")) - {alien}
    own.write_bytes(alien.read_bytes())
    forget()
    with pytest.warns(NativeWarning, match="its bytes are not those"):
        right(8.5)


# Hostile machines.


def test_without_a_compiler_the_interpreter_answers_and_says_so_once(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.warns(NativeWarning, match="no C compiler was found"):
        right(1.0, "interpreter")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right(2.0, "interpreter")
    assert not native.native_available()


@needs_compiler
def test_switched_off_it_says_nothing(monkeypatch):
    monkeypatch.setenv("REENTRY_NATIVE", "off")
    right(1.0, "interpreter")


def fake_compiler(tmp_path, monkeypatch, action):
    script = tmp_path / "fake"
    script.write_text(f'#!/bin/sh\ncase "$1" in --version) echo fake 1.0; exit 0 ;; esac\n{action}\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))


@pytest.mark.skipif(sys.platform.startswith("win"), reason="shell scripts")
@pytest.mark.parametrize(
    ("action", "said"),
    [
        ("echo 'unit.c:1: error: no' >&2; exit 1", "failed: unit.c:1: error: no"),
        ("while :; do :; done", "took more than"),
        ("for last; do :; done; echo rubbish > $last; echo rubbish > unit.so", "no place to compile and load"),
        ("exit 0", "no place to compile and load"),
        ("echo 'as: No space left on device' >&2; exit 1", "No space left"),
    ],
)
def test_a_compiler_that_fails_means_the_interpreter(cache, tmp_path, monkeypatch, action, said):
    monkeypatch.setattr(native_compiler, "COMPILE_TIME", 0.5)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    fake_compiler(tmp_path, monkeypatch, action)
    with pytest.warns(NativeWarning, match=said):
        right(9.0, "interpreter")
    assert list(cache.glob("*.lib")) == []


def test_a_compiler_that_does_not_answer_or_exist(monkeypatch, tmp_path):
    for value, said in (("no-such-compiler", "no-such-compiler"), (sys.executable + " -c raise(SystemExit(3))", "does not answer")):
        monkeypatch.setenv("CC", value)
        with pytest.warns(NativeWarning, match=said):
            right(9.5, "interpreter")


@needs_compiler
@pytest.mark.parametrize("lasting", [True, False])
def test_a_disk_that_is_full_at_any_write(cache, tmp_path, monkeypatch, lasting):
    """The k-th write fails, for every k; or it and all later ones."""
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    monkeypatch.setattr(native_cache.tempfile, "tempdir", None)
    (tmp_path / "scratch").mkdir()
    seen = []
    for k in range(1, 40):
        shutil.rmtree(cache, ignore_errors=True)
        forget()
        native_compiler.warn_once.cache_clear()
        calls = [0]

        def failing(function, calls=calls, k=k):
            def wrapper(*arguments, **options):
                calls[0] += 1
                if calls[0] == k or (lasting and calls[0] > k):
                    raise OSError(28, "No space left on device")
                return function(*arguments, **options)

            return wrapper

        with monkeypatch.context() as patch, warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            patch.setattr(native_cache.tempfile, "mkdtemp", failing(native_cache.tempfile.mkdtemp))
            patch.setattr(native_cache.os, "replace", failing(os.replace))
            patch.setattr(native_cache.os, "utime", failing(os.utime))
            for name in ("write_text", "write_bytes", "mkdir"):
                patch.setattr(Path, name, failing(getattr(Path, name)))
            compiled = native.compile(scaled(11.0))
        assert np.array_equal(compiled(X)[0], wanted(11.0))
        assert (compiled.backend == "interpreter") <= bool(said)
        assert leftovers(cache) == []
        assert list((tmp_path / "scratch").iterdir()) == []
        seen.append(compiled.backend)
        if calls[0] < k:
            break
    assert len(seen) > 6
    assert seen[-1] == "lanes"
    assert ("interpreter" in seen) == lasting


@needs_compiler
def test_a_home_that_cannot_be_written_costs_only_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("REENTRY_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(NativeWarning, match="cache cannot be used"):
        right(12.0)


@needs_compiler
def test_a_disk_without_execution(cache, monkeypatch):
    real = native_cache.Library

    def refuse(path):
        if cache in path.parents:
            raise OSError("failed to map segment from shared object")
        return real(path)

    monkeypatch.setattr(native_cache, "Library", refuse)
    with pytest.warns(NativeWarning, match="failed to map segment"):
        right(13.0)


@needs_compiler
def test_names_of_folders_do_not_matter(tmp_path, monkeypatch):
    folder = tmp_path / ("a user with a name of sixty-four letters, 'quotes' and spaces " * 2)[:100].strip() / "ünïcode"
    monkeypatch.setenv("REENTRY_CACHE", str(folder))
    right(14.0)
    forget()
    right(14.0)
    assert len(list(folder.glob("*.lib"))) == 1
