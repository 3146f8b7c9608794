"""What every command shares: exit codes, messages on stderr, one JSON object on stdout, tables, progress."""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from studies.scenario_document import ScenarioDocument

Progress = Callable[[str, float], None]


class Code(IntEnum):
    """Exit codes of the command line."""

    DONE = 0
    INPUT = 2
    CASES_FAILED = 3
    MACHINE = 4
    INTERRUPTED = 130


class InputError(ValueError):
    """A command-line value that cannot be accepted; the text names the option, the value, what was expected and what to do."""


def guard(call: Callable[[], None]) -> int:
    """Run a command and turn every way in which it can end into an exit code and, where due, one message on stderr."""
    try:
        try:
            call()
        finally:
            _flush()
    except SystemExit as end:
        return _code_of(end)
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        _drop_stdout()
        return Code.DONE
    except (OSError, MemoryError) as error:
        _drop_stdout()
        say(f"reentry: the machine refused: {_machine_text(error)}")
        return Code.MACHINE
    except ImportError as error:
        say(f"reentry: a part of the installation is missing: {error}; run `reentry doctor`")
        return Code.MACHINE
    except Exception as error:
        if isinstance(error, _input_errors()):
            say(str(error))
            return Code.INPUT
        if os.environ.get("REENTRY_DEBUG") == "1":
            raise
        say(
            f"reentry: internal error: {type(error).__name__}: {error}\n"
            "This is a fault of the program, not of your input. Please report it with the command line and the scenario"
            " (--print-scenario); REENTRY_DEBUG=1 shows where it happened."
        )
        return Code.MACHINE
    return Code.DONE


@contextlib.contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """SIGTERM ends a command as Ctrl-C does, so that private files are removed on the way out."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def say(text: str) -> None:
    """One message for people, on stderr; a closed stderr is no reason to fail."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def print_text(text: str) -> None:
    """Text on stdout, delivered at once so that a full disk shows here."""
    print(text, flush=True)


def to_json(data: Mapping[str, Any]) -> str:
    """JSON text; NaN and infinity are refused."""
    return json.dumps(data, indent=1, allow_nan=False)


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Table on stdout, in parts where the terminal is too narrow; cells are shown as they are, never read as markup."""
    from rich.console import Console
    from rich.text import Text

    from studies.console_tables import tables

    screen = Console(highlight=False)
    numeric = [bool(rows) and all(isinstance(row[i], (int, float)) for row in rows) for i in range(len(columns))]
    cells = [[_cell(value) for value in row] for row in rows]
    for number, table in enumerate(tables(columns, cells, numeric=numeric, width=screen.width)):
        table.title = None if number else Text(title)
        screen.print(table)
    sys.stdout.flush()


def print_scenario(scenario: ScenarioDocument, *, as_json: bool) -> None:
    """A scenario with all its keys on stdout: YAML ready to edit, or JSON."""
    print_text(to_json(scenario.to_dict()) if as_json else scenario.to_yaml().rstrip("\n"))


def named_values(
    option: str, texts: Sequence[str] | None, *, expected: str, bare: bool = False, again: bool = False
) -> dict[str, str | None]:
    """Names and values of a repeatable option ``--option NAME=VALUE``, without the blanks around them.

    Parameters
    ----------
    option : str
        As the user writes it.
    texts : sequence of str, optional
    expected : str
        Named in the message about a text that cannot be split.
    bare : bool
        A name may stand alone; its value is then None.
    again : bool
        A name may come again: its last value counts.

    Raises
    ------
    InputError
        A text without a name or, unless `bare`, without an equals sign; unless `again`, a name that is given twice.
    """
    found: dict[str, str | None] = {}
    for text in texts or ():
        name, sign, value = (part.strip() for part in text.partition("="))
        if not name or not (sign or bare):
            raise InputError(f"{option}: found {text!r}, expected {expected}")
        if name in found and not again:
            raise InputError(f"{option}: {name} is given twice; give it once")
        found[name] = value if sign else None
    return found


def number(option: str, name: str, value: str | None) -> float:
    """Value of ``--option NAME=VALUE`` that must be a finite number.

    Raises
    ------
    InputError
        It is none.
    """
    try:
        found = float(value or "")
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise InputError(f"{option}: found {f'{name}={value}'!r}, expected a finite number after the =")
    return found


def numbers(option: str, texts: Sequence[str] | None, *, expected: str) -> dict[str, float]:
    """Names and numbers of ``--option NAME=NUMBER``; see :func:`named_values` and :func:`number`."""
    return {name: number(option, name, value) for name, value in named_values(option, texts, expected=expected).items()}


def changes(texts: Sequence[str] | None, *, example: str) -> dict[str, str]:
    """Keys and values of ``--set KEY=VALUE`` of a scenario; of a key that is given twice the last value counts.

    Raises
    ------
    InputError
        A text without key or equals sign; `example` is named in its message.
    """
    found = named_values("--set", texts, expected=f"key=value such as {example}", again=True)
    return {key: value or "" for key, value in found.items()}


def check_out(out: Path | None) -> None:
    """Refuse an output folder that cannot be one, before the work begins; without a folder nothing is asked."""
    if out is not None:
        from studies.files import check_folder

        check_folder(out)


def write_answer(out: Path | None, name: str, data: Mapping[str, Any], *, figures: Callable[[], Mapping[str, Figure]]) -> None:
    """Write ``name.json`` and each figure as SVG into a folder, all or nothing, and say so; without a folder nothing is drawn."""
    if out is None:
        return
    from studies.figures import to_svg
    from studies.files import folder

    with work(), folder(out) as place:
        (place / f"{name}.json").write_text(to_json(data), encoding="utf-8")
        drawn = figures()
        for title, figure in drawn.items():
            (place / f"{title}.svg").write_text(to_svg(figure), encoding="utf-8")
    say(f"wrote {name}.json{' and figures' if drawn else ''} into {out}")


@contextlib.contextmanager
def work() -> Iterator[Progress | None]:
    """Long work: a progress bar on stderr if that is a terminal, and stdout kept free of what libraries print."""
    with libraries_to_stderr():
        if not sys.stderr.isatty():
            yield None
            return
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bars

        columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
        with Bars(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bars:
            tasks: dict[str, Any] = {}

            def report(stage: str, fraction: float) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=1.0)
                bars.update(tasks[stage], completed=min(max(fraction, 0.0), 1.0))

            yield report


@contextlib.contextmanager
def libraries_to_stderr() -> Iterator[None]:
    """Solvers print from C to file descriptor 1; whoever reads our JSON must not see it."""
    _flush()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        with contextlib.suppress(OSError):  # a closed stdout or stderr has nothing to protect
            saved = os.dup(1)
            stack.callback(os.close, saved)
            os.dup2(2, 1)
            stack.callback(os.dup2, saved, 1)
            stack.callback(_flush_c)
        yield


def _flush_c() -> None:
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).fflush(None)


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _flush() -> None:
    if sys.stdout is not None:
        sys.stdout.flush()


def _drop_stdout() -> None:
    """Send what is still buffered nowhere, or the interpreter would fail once more on its way out."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        descriptor = sys.stdout.fileno()
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, descriptor)
        os.close(nowhere)


def _code_of(end: SystemExit) -> int:
    code = end.code if isinstance(end.code, int) else Code.DONE
    if code == Code.INTERRUPTED:
        return _interrupted()
    if code == 1:
        # the reader of a pipe has gone, for instance `reentry gains --json | head -1`: it has all it wanted
        _drop_stdout()
        return Code.DONE
    return code


def _interrupted() -> int:
    say("reentry: interrupted; no file was left half written")
    return Code.INTERRUPTED


def _machine_text(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        place = error.filename2 or error.filename
        return f"{place}: {error.strerror}" if place else error.strerror
    return str(error) or ("not enough memory" if isinstance(error, MemoryError) else type(error).__name__)


def _input_errors() -> tuple[type[Exception], ...]:
    """Exceptions that mean a wrong input; classes of modules never imported cannot have been raised."""
    places = {"models.checked": "ModelError", "studies.scenario_text": "ScenarioError", "studies.files": "OutputError"}
    known = [getattr(sys.modules[module], name) for module, name in places.items() if module in sys.modules]
    return (InputError, *known)
