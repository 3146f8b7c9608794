"""Any CasADi function as compiled code: NumPy in and out, several cases in the lanes of SIMD vectors, all cores."""

from __future__ import annotations

import ctypes
import itertools
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache
from queue import Empty, SimpleQueue
from threading import get_ident
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np

from models import native_source
from models.checked import Array, ModelError, as_arguments, evaluate
from models.native_cache import Library, load
from models.native_compiler import NativeWarning, NotCompiledError, compiler, cpu_target, flags_for, warn_once
from models.native_export import export

__all__ = ["Mode", "Native", "NativeWarning", "compile", "export", "native_available", "shared_by"]

Mode = Literal["accurate", "fast"]
Backend = Literal["lanes", "c", "interpreter"]
LANES = (1, 2, 4, 8, 16)
BEST_LANES = {"x86-64-v4": 8, "x86-64-v3": 8}  # measured on flights; 2 elsewhere
WORTH_A_THREAD = 64  # vectors of cases; below, starting a thread costs more than it saves
_MOST_POOL = 256  # threads that one process may start for batches
_MOST_THREADS: ContextVar[int | None] = ContextVar("most_threads", default=None)  # inside shared_by

_DRIVER = """
#define EXPORT __attribute__((visibility("default")))
EXPORT void rw_run(const double *const *arg, const i64 *stride, double *const *res, unsigned char *finite, i64 first, i64 last) {{
  static const i64 n_in[] = {{{n_in}0}}, n_out[] = {{{n_out}0}};
  for (i64 r = first; r < last; r += LANES) {{
    L x[{total_in} + 1], y[{total_out} + 1];
    i64 row[LANES];
    i64 count = last - r < LANES ? last - r : LANES;
    for (i64 l = 0; l < LANES; l++) row[l] = r + (l < count ? l : count - 1);
    L *to = x;
    for (int i = 0; i < {inputs}; i++)
      for (i64 k = 0; k < n_in[i]; k++) *to++ = lane_rows(arg[i] + k, row, stride[i]);
    {name}(x, y);
    M bad = {{0}};
    const L *from = y;
    for (int o = 0; o < {outputs}; o++)
      for (i64 k = 0; k < n_out[o]; k++, from++) {{
        bad |= lane_bad(*from);
        for (i64 l = 0; l < count; l++) res[o][(r + l) * n_out[o] + k] = (*from)[l];
      }}
    for (i64 l = 0; l < count; l++) finite[r + l] = !bad[l];
  }}
}}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Native:
    """A compiled CasADi function; call it as :func:`models.checked.evaluate` calls the function itself.

    Attributes
    ----------
    function : casadi.Function
    backend : {"lanes", "c", "interpreter"}
        SIMD lanes; C of one case at a time; CasADi itself, where the function cannot be compiled on this machine.
    reason : str
        Why it is not "lanes"; empty if it is.
    lanes, threads : int
        Cases in a vector, and threads that share a batch.  Numbers do not depend on the threads, nor on the lanes in accurate mode.
    mode : {"accurate", "fast"}
    """

    function: ca.Function
    backend: Backend
    reason: str
    lanes: int
    threads: int
    mode: Mode
    library: Library | None

    def __call__(self, *arguments: Array) -> tuple[Array, ...]:
        """Outputs for arguments of shape (n_i,) or (N, n_i).

        Returns
        -------
        tuple of ndarray
            Output of shape (a, 1) -> (a,) or (N, a); (a, b) with b > 1 -> (a, b) or (N, a, b).

        Raises
        ------
        ModelError
            A missing or extra argument, a wrong shape, a non-finite argument or result.
        """
        outputs, finite = self.run(*arguments)
        if not finite.all():
            row = int(np.argmin(finite))
            batch = any(np.ndim(a) == 2 for a in arguments)
            index = next(i for i, out in enumerate(outputs) if not np.isfinite(out[row] if batch else out).all())
            raise ModelError(
                f"{self.function.name()}: output {self.function.name_out(index)} is not finite (row {row});"
                " the arguments leave the domain of the model"
            )
        return outputs

    def run(self, *arguments: Array) -> tuple[tuple[Array, ...], np.ndarray]:
        """As a call, but a row that is not finite raises nothing.

        Returns
        -------
        outputs : tuple of ndarray
        finite : ndarray of bool, shape (N,)
            Rows all of whose outputs are finite; N = 1 for arguments without a leading axis.
        """
        checked, count = as_arguments(self.function, arguments)
        values = [np.ascontiguousarray(value) for value in checked]
        rows = 1 if count is None else count
        if self.library is None:
            plain = evaluate(self.function, *values, finite=False)
            return plain, np.all([np.isfinite(out).reshape(rows, -1).all(axis=1) for out in plain], axis=0)
        f = self.function
        flat = [np.empty((rows, f.numel_out(o))) for o in range(f.n_out())]
        mask = np.empty(rows, dtype=np.uint8)
        arg, stride, res = pointers(values), strides(values), pointers(flat)
        entry = self.library.entry("rw_run")
        in_threads(lambda first, last: entry(arg, stride, res, address(mask), ctypes.c_longlong(first), ctypes.c_longlong(last)),
                   rows, self.lanes, self.threads, keep=(self.library, values, flat, mask))  # fmt: skip
        outputs = []
        for o, out in enumerate(flat):
            a, b = f.size_out(o)
            shaped = out if b == 1 else np.ascontiguousarray(out.reshape(rows, b, a).swapaxes(1, 2))
            outputs.append(shaped if count is not None else shaped[0])
        return tuple(outputs), mask.astype(bool)


def compile(
    function: ca.Function, *, lanes: int | Literal["auto"] = "auto", threads: int | Literal["auto"] = "auto", mode: Mode = "accurate"
) -> Native:
    """Compile a CasADi function.  Where that is not possible it is interpreted, with one warning and the same numbers.

    Parameters
    ----------
    function : casadi.Function
        Inputs that are columns.
    lanes : int or "auto"
        Cases in one vector: 1 (plain C), 2, 4, 8 or 16; "auto" takes what was measured to be fastest on processors of this kind.
    threads : int or "auto"
        Threads for large batches; "auto" takes the processors that this process may use.
    mode : {"accurate", "fast"}
        Accurate: the same operations in the same order with the C library's functions, equal to the interpreter.  Fast: products
        and sums may be fused, and exp, log, sin, ... come from the vector library (at most 4 units in the last place).

    Raises
    ------
    ModelError
        An input that is a matrix, a free symbol, an unknown mode, number of lanes or threads.

    Notes
    -----
    REENTRY_NATIVE=off makes every function interpreted; CC names the compiler; REENTRY_CACHE the folder of compiled code.
    """
    workers = options(function, lanes, threads, mode)
    if switched_off():
        return Native(function, "interpreter", "REENTRY_NATIVE is off", 1, 1, mode, None)
    try:
        written = write((function,), lanes, mode)
        n_in = [function.numel_in(i) for i in range(function.n_in())]
        n_out = [function.numel_out(o) for o in range(function.n_out())]
        driver = _DRIVER.format(
            name=written.names[0], inputs=len(n_in), outputs=len(n_out), total_in=sum(n_in), total_out=sum(n_out),
            n_in="".join(f"{n}, " for n in n_in), n_out="".join(f"{n}, " for n in n_out),
        )  # fmt: skip
        library = written.library(driver)
    except (native_source.Unsupported, NotCompiledError, RuntimeError) as error:  # RuntimeError: CasADi has no C code for it
        return Native(function, "interpreter", interpreted(function, error), 1, 1, mode, None)
    return Native(function, written.backend, written.reason, written.lanes, workers, mode, library)


@dataclass(frozen=True, slots=True, eq=False)
class Written:
    """C code of some functions, without its driver: their names there, and in what form they were written."""

    unit: native_source.Unit
    names: tuple[str, ...]
    backend: Backend
    lanes: int
    reason: str
    mode: Mode

    def library(self, driver: str) -> Library:
        """Compile (or find) it with a driver.

        Raises
        ------
        NotCompiledError
        """
        return load(self.unit.source(driver), flags_for(cpu_target(), fast=self.mode == "fast"))


def write(functions: Sequence[ca.Function], lanes: int | str, mode: Mode) -> Written:
    """C code of functions in the form asked for; with lanes "auto" in as many as this processor takes best.

    Raises
    ------
    Unsupported, RuntimeError
        Neither lanes nor CasADi's generator can write a function.
    """
    fast, wanted = mode == "fast", BEST_LANES.get(cpu_target(), 2) if lanes == "auto" else int(lanes)
    reason = "one lane was asked for"
    if wanted > 1:
        unit = native_source.Unit(fast, wanted)
        try:
            names = tuple(unit.lane_function(f) for f in functions)
            if unit.whole_in_c(names[0]):
                reason = "it holds operations that are written for one case at a time only"
            else:
                return Written(unit, names, "lanes", wanted, "", mode)
        except native_source.Unsupported as error:
            reason = str(error)
    unit = native_source.Unit(fast, 1)
    return Written(unit, tuple(unit.single_function(f) for f in functions), "c", 1, reason, mode)


def interpreted(function: ca.Function, error: Exception) -> str:
    """Say once that a function is interpreted, and return the reason."""
    reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
    what = "functions run" if isinstance(error, NotCompiledError) else f"{function.name()} runs"
    warn_once(f"native code: {what} in CasADi's interpreter, with the same numbers but slower: {reason}")
    return reason


def options(function: ca.Function, lanes: int | str, threads: int | str, mode: str) -> int:
    """Check the options; the number of threads."""
    name = function.name()
    if mode not in get_args(Mode):
        raise ModelError(f"native: {name}: mode must be one of {', '.join(get_args(Mode))}, got {mode!r}")
    if lanes != "auto" and (lanes not in LANES or isinstance(lanes, bool)):
        raise ModelError(f"native: {name}: lanes must be 'auto' or one of {LANES}, got {lanes!r}")
    if threads != "auto" and (not isinstance(threads, int) or isinstance(threads, bool) or threads < 1):
        raise ModelError(f"native: {name}: threads must be 'auto' or an integer >= 1, got {threads!r}")
    if function.has_free():
        raise ModelError(f"native: {name} has free symbols {function.get_free()}; make every one an input")
    for i in range(function.n_in()):
        if function.size2_in(i) > 1:
            raise ModelError(f"{name}: {function.name_in(i)}: is a matrix {function.size_in(i)}; declare a vector")
    return processors() if threads == "auto" else int(threads)


def native_available() -> bool:
    """True if this machine has a C compiler that answers, and the environment allows its use."""
    try:
        compiler()
    except NotCompiledError:
        return False
    return not switched_off()


def switched_off() -> bool:
    """True if the environment forbids compiled code."""
    return os.environ.get("REENTRY_NATIVE", "").strip().lower() in ("off", "0", "no", "false")


@contextmanager
def shared_by(tasks: int) -> Iterator[None]:
    """Context in which compiled code takes its part of the processors only; numbers do not depend on it.

    Parameters
    ----------
    tasks : int
        Tasks that share this machine, this one among them; each gets ``processors // tasks`` threads, at least one.

    Raises
    ------
    ModelError
    """
    if tasks < 1:
        raise ModelError(f"native: tasks that share the processors: expected an integer >= 1, got {tasks}; count this one too")
    before = _MOST_THREADS.set(max(1, processors() // tasks))
    try:
        yield
    finally:
        _MOST_THREADS.reset(before)


def in_threads(
    run: Callable[[int, int], None], rows: int, lanes: int, threads: int, *, keep: Sequence[object], vectors_each: int = WORTH_A_THREAD
) -> None:
    """Call ``run(first, last)`` for fixed parts of the rows, each a whole number of vectors, at once where it pays.

    Parameters
    ----------
    run : callable
    rows, lanes, threads : int
    keep : sequence
        Arrays and libraries that `run` uses by their addresses: they live as long as any thread works with them.
    vectors_each : int
        Vectors that are worth a thread.
    """
    vectors, most = -(-rows // lanes), _MOST_THREADS.get()
    parts = max(1, min(threads, vectors // vectors_each, threads if most is None else most))
    if parts == 1:
        run(0, rows)
        return
    edges = [min(rows, lanes * (vectors * k // parts)) for k in range(parts)] + [rows]
    todo = deque(itertools.pairwise(edges))
    active: set[int] = set()  # threads that may hold a part; no lock, which an interrupt could leave closed: these steps are atomic
    ended: SimpleQueue[None] = SimpleQueue()
    errors: list[BaseException] = []

    def work(_keep: Sequence[object] = keep) -> None:  # what is kept lives in the task, even where an interrupt ends the wait
        active.add(get_ident())
        try:
            while todo:
                try:
                    part = todo.popleft()
                except IndexError:  # another thread was faster
                    break
                run(*part)
        except BaseException as error:
            errors.append(error)
            todo.clear()
        finally:
            active.discard(get_ident())
            ended.put(None)

    with suppress(RuntimeError):  # no more threads, or the interpreter is about to end: whoever is free does what is left
        for _ in range(parts - 1):
            _pool().submit(work)
    try:
        work()
    finally:
        todo.clear()
        _wait(active, ended)
    if errors:
        raise errors[0]


def _wait(active: set[int], ended: SimpleQueue[None]) -> None:
    """Wait for all other threads even if interrupted: they write into arrays of the caller."""
    others: set[int] = {0}
    interrupted: BaseException | None = None
    while others:
        try:
            others = active - {get_ident()}
            if others:
                with suppress(Empty):
                    ended.get(timeout=0.05)
        except BaseException as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    """Threads that stay: starting two takes longer than many a batch."""
    return ThreadPoolExecutor(_MOST_POOL, thread_name_prefix="reentry")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not outlive a fork


def address(array: np.ndarray) -> ctypes.c_void_p:
    """Pointer to the data of an array."""
    return ctypes.c_void_p(array.ctypes.data)


def pointers(arrays: Sequence[np.ndarray]) -> Any:
    """C array of pointers to the data of arrays, which must outlive it."""
    return (ctypes.c_void_p * (len(arrays) + 1))(*[a.ctypes.data for a in arrays], None)


def strides(arrays: Sequence[np.ndarray]) -> Any:
    """C array of row lengths; 0 for an argument that all rows share."""
    return (ctypes.c_longlong * (len(arrays) + 1))(*[a.shape[1] if a.ndim == 2 else 0 for a in arrays], 0)


def processors() -> int:
    """Processors that this process may use."""
    try:
        return max(1, len(os.sched_getaffinity(0)))
    except AttributeError:
        return os.cpu_count() or 1
