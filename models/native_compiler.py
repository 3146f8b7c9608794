"""The C compiler of this machine: which one, for which processor, with which flags, and what to say when there is none."""

from __future__ import annotations

import errno
import os
import platform
import shlex
import shutil
import subprocess
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

COMPILE_TIME = 600.0  # s, after which the compiler is stopped
_PLAIN = (
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "log", "log1p", "expm1", "erf",
    "pow", "atan2", "hypot", "fmod", "remainder", "fmin", "fmax",
)  # fmt: skip


class NativeWarning(UserWarning):
    """Something about compiled code that costs time and changes no number: no compiler, a damaged cache entry, no cache."""


class NotCompiledError(Exception):
    """The code cannot be compiled or loaded; the text says why."""


@lru_cache(maxsize=256)
def warn_once(reason: str) -> None:
    """One NativeWarning for each reason."""
    warnings.warn(reason, NativeWarning, stacklevel=4)


@dataclass(frozen=True, slots=True)
class Compiler:
    """A C compiler: command and the text of its version."""

    command: tuple[str, ...]
    version: str


def compiler() -> Compiler:
    """The C compiler of this machine: CC of the environment, or else cc, gcc or clang.

    Raises
    ------
    NotCompiledError
        There is none, or it does not answer.
    """
    wanted = os.environ.get("CC", "").strip()
    for candidate in [wanted] if wanted else ["cc", "gcc", "clang"]:
        command = shlex.split(candidate)
        found = shutil.which(command[0]) if command else None
        if found:
            status = os.stat(found)
            return _identified((os.path.realpath(found), *command[1:]), status.st_mtime_ns, status.st_size)
    raise NotCompiledError(f"no C compiler was found (looked for {wanted or 'cc, gcc, clang'}); install one, or set CC to its path")


@lru_cache(maxsize=8)
def _identified(command: tuple[str, ...], changed: int, size: int) -> Compiler:
    try:
        answer = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=30, check=True, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.SubprocessError) as error:
        raise NotCompiledError(f"the C compiler {command[0]} does not answer ({type(error).__name__}); repair it or set CC") from None
    return Compiler(command, f"{answer.stdout.strip()} {changed} {size}")


@lru_cache(maxsize=1)
def cpu_target() -> str:
    """Name of the instruction set that this processor has, as the compiler calls it; empty for the compiler's own default."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return ""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace")
    except OSError:
        return "x86-64"
    line = next((row for row in text.splitlines() if row.startswith("flags")), "")
    flags = set(line.partition(":")[2].split())
    v3 = {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"} <= flags
    v4 = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= flags
    return "x86-64-v4" if v3 and v4 else "x86-64-v3" if v3 else "x86-64"


def flags_for(target: str, *, fast: bool) -> tuple[str, ...]:
    """Compile flags.  No -ffast-math anywhere: the state of the floating-point unit stays as it is, NaN stays NaN.

    Without `fast` nothing is rounded differently from the text of the program: no fused products, and no identities between
    elementary functions (some compilers replace sin(atan(x)) on their own).
    """
    flags = [
        "-std=gnu11", "-O2", "-ftree-vectorize", "-fPIC", "-fvisibility=hidden", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math",
        "-fno-strict-aliasing", "-w", "-pipe",
    ]  # fmt: skip
    if target:
        flags.append(f"-march={target}")
    if target == "x86-64-v4":
        flags.append("-mprefer-vector-width=512")
    if fast:
        return (*flags, "-ffp-contract=fast")
    return (*flags, "-ffp-contract=off", *(f"-fno-builtin-{name}" for name in _PLAIN))


def compiled(place: Path, source: str, flags: tuple[str, ...], cc: Compiler) -> bytes:
    """Bytes of the library made from `source` in the folder `place`.

    Compiled and linked apart: a flag of the first step must never reach the second, where it could change the whole process.

    Raises
    ------
    NotCompiledError
        The compiler fails or takes too long.
    OSError
        The disk is full.
    """
    (place / "unit.c").write_text(source, encoding="ascii")
    _run([*cc.command, *flags, "-c", "unit.c", "-o", "unit.o"], place)
    _run([*cc.command, "-shared", "unit.o", "-o", "unit.so", "-lm"], place)
    return (place / "unit.so").read_bytes()


def _run(command: list[str], place: Path) -> None:
    environment = {**os.environ, "LC_ALL": "C", "TMPDIR": str(place)}
    try:
        done = subprocess.run(
            command, cwd=place, env=environment, capture_output=True, text=True, errors="replace", timeout=COMPILE_TIME,
            stdin=subprocess.DEVNULL, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise NotCompiledError(f"the C compiler took more than {COMPILE_TIME:.0f} s; make the function smaller") from None
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if "error" in line.lower()] or done.stderr.splitlines()
        said = lines[0].strip()[:200] if lines else f"exit code {done.returncode}"
        if "No space left" in done.stderr:
            raise OSError(errno.ENOSPC, "No space left on device", str(place))
        raise NotCompiledError(f"the C compiler {command[0]} failed: {said}")
