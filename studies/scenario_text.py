"""Reading of scenario text: the plain part of YAML 1.2, with the line of every key, and nothing that can run or explode.

Only mappings, lists and scalars are accepted. Anchors, aliases (and with them alias bombs), tags, duplicate keys, several
documents and deep nesting are refused while the text is being scanned, before anything is built.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from models.checked import ModelError

MAX_BYTES = 64_000  # ten times the full scenario with its comments; the scanner needs about a second for it
MAX_DEPTH = 6

_INTEGER = re.compile(r"[-+]?[0-9]{1,18}")
_REAL = re.compile(r"[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
_WORDS: dict[str, Any] = {
    "": None, "~": None, "null": None, "Null": None, "NULL": None,
    "true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False,
}  # fmt: skip
_NONFINITE = {"nan": float("nan"), "inf": float("inf"), "+inf": float("inf"), "-inf": float("-inf")}

Place = tuple[str | int, ...]


class ScenarioError(ModelError):
    """A scenario that cannot be accepted: the text gives file and line, key, value found, what was expected and what to do."""


def dotted(place: Place) -> str:
    """``("weights", "terminal", 1)`` -> ``"weights.terminal[1]"``."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def read_text(path: Path, *, command: str = "gains") -> str:
    """Text of a scenario file; a missing one is answered with how `command` writes it.

    Raises
    ------
    ScenarioError
        A missing file, a folder, a file above 64 kB, or one that is not UTF-8.
    OSError
        The machine fails to read it (no permission, input/output error).
    """
    if path.is_dir():
        raise ScenarioError(f"{path}: is a folder, expected a scenario file; name the YAML file inside it")
    try:
        with path.open("rb") as stream:
            raw = stream.read(MAX_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise ScenarioError(f"{path}: no such file; write one with: reentry {command} --print-scenario > scenario.yaml") from None
    if len(raw) > MAX_BYTES:
        raise ScenarioError(f"{path}: larger than {MAX_BYTES // 1000} kB, expected a scenario of a few kB; is this the right file?")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ScenarioError(f"{path}:{line}: not UTF-8 text (byte 0x{raw[error.start]:02x}); save the file as UTF-8") from None


def parse_text(text: str, *, name: str) -> tuple[Any, dict[Place, int]]:
    """Values of one YAML document and the line on which each key or item stands.

    Parameters
    ----------
    text : str
    name : str
        File name for messages.

    Returns
    -------
    value : dict, list, str, int, float, bool or None
    lines : dict
        Path of keys and list positions -> line number from 1.

    Raises
    ------
    ScenarioError
    """
    if len(text.encode("utf-8", "replace")) > MAX_BYTES:
        raise ScenarioError(f"{name}: larger than {MAX_BYTES // 1000} kB, expected a scenario of a few kB; is this the right file?")
    return _Reader(name, _events(text, name)).document()


def parse_value(text: str, *, name: str) -> Any:
    """Value of a short text as it would stand after ``key: `` in a file, such as ``0.3`` or ``[0.1, 250, 200, 500]``."""
    value, _ = parse_text(text, name=name)
    return value


def _events(text: str, name: str) -> Iterator[Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError, YAMLStreamError

    reader = YAML(typ="safe", pure=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # remarks on YAML versions; what matters is refused below
            yield from reader.parse(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"{name}:{mark.line + 1}" if mark is not None else name
        problem = error.problem or error.context
        raise ScenarioError(f"{where}: not readable as YAML: {problem}; check indentation, colons and brackets") from None
    except (YAMLError, YAMLStreamError) as error:
        line = text.count("\n", 0, getattr(error, "position", 0) or 0) + 1
        reason = getattr(error, "reason", None) or "the text has a character that YAML does not allow"
        raise ScenarioError(f"{name}:{line}: not readable as YAML: {reason}; remove that character") from None
    except (ValueError, IndexError, KeyError, AttributeError, TypeError, AssertionError, RecursionError):
        # the scanner meets malformed directives and escapes with Python's own exceptions
        raise ScenarioError(f"{name}: not readable as YAML; check directives (%), escapes (\\) and brackets") from None


class _Reader:
    """Builder of plain values from a stream of YAML events."""

    def __init__(self, name: str, events: Iterator[Any]) -> None:
        self._name = name
        self._events = events
        self.lines: dict[Place, int] = {}

    def document(self) -> tuple[Any, dict[Place, int]]:
        value: Any = None
        count = 0
        for event in self._events:
            kind = type(event).__name__
            if kind in ("StreamStartEvent", "StreamEndEvent", "DocumentEndEvent"):
                continue
            if kind == "DocumentStartEvent":
                count += 1
                if count > 1:
                    self._fail(event, "a second document begins", "keep one document in a file and remove the line ---")
                continue
            value = self._value(event, (), 0)
        return value, self.lines

    def _fail(self, event: Any, found: str, remedy: str) -> None:
        raise ScenarioError(f"{self._name}:{event.start_mark.line + 1}: {found}; {remedy}")

    def _value(self, event: Any, path: Place, depth: int) -> Any:
        kind = type(event).__name__
        if kind == "AliasEvent" or getattr(event, "anchor", None) is not None:
            self._fail(event, "anchors (&) and aliases (*) are not accepted in a scenario", "write the value out")
        if event.tag is not None:
            tag = str(event.tag)[:40]
            self._fail(event, f"tags (here {tag!r}) are not accepted in a scenario", "write a plain number, text, list or section")
        if depth > MAX_DEPTH:
            self._fail(event, f"nested deeper than {MAX_DEPTH} levels", "a scenario has at most three; check indentation and brackets")
        if kind == "ScalarEvent":
            return _scalar(event.value) if event.implicit[0] else event.value
        return self._sequence(path, depth) if kind == "SequenceStartEvent" else self._mapping(path, depth)

    def _sequence(self, path: Place, depth: int) -> list[Any]:
        items: list[Any] = []
        for event in self._events:
            if type(event).__name__ == "SequenceEndEvent":
                break
            place = (*path, len(items))
            self.lines[place] = event.start_mark.line + 1
            items.append(self._value(event, place, depth + 1))
        return items

    def _mapping(self, path: Place, depth: int) -> dict[str, Any]:
        section: dict[str, Any] = {}
        for event in self._events:
            if type(event).__name__ == "MappingEndEvent":
                break
            if type(event).__name__ != "ScalarEvent" or event.anchor is not None or event.tag is not None:
                self._fail(event, "a key must be a plain word", "write key: value")
            key = event.value
            place = (*path, key)
            if key in section:
                self._fail(event, f"{dotted(place)}: given twice (first on line {self.lines[place]})", "keep one of the two")
            self.lines[place] = event.start_mark.line + 1
            section[key] = self._value(next(self._events), place, depth + 1)
        return section


def _scalar(text: str) -> Any:
    """Plain scalar by the core rules of YAML 1.2: null, booleans, decimal numbers; everything else is text."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _REAL.fullmatch(text):
        return float(text)
    lowered = text.lower()
    sign, word = (lowered[0], lowered[1:]) if lowered[0] in "+-" else ("", lowered)
    return _NONFINITE.get(sign + word.removeprefix("."), text) if word.startswith(".") else text
