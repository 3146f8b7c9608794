"""What every scenario can do: read from YAML, be edited key by key, and be written back with the meaning of its keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import ValidationError

from studies.scenario_errors import locate, nested_key, translate
from studies.scenario_sections import Section
from studies.scenario_text import Place, ScenarioError, parse_text, parse_value, read_text

_WRAP = 120


class ScenarioDocument(Section):
    """A whole scenario: sections, each with its keys. Frozen."""

    COMMAND: ClassVar[str]  # that prints it, for messages
    SUBJECT: ClassVar[str]
    EMPTY_IS_DEFAULT: ClassVar[bool] = False

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Scenario of a YAML file; keys left out keep their defaults.

        Raises
        ------
        ScenarioError
            A file that is missing, unreadable as text or YAML, or that holds a wrong key or value: with file and line.
        OSError
            The machine fails to read it.
        """
        return cls.parse(read_text(Path(path), command=cls.COMMAND), name=str(path))

    @classmethod
    def parse(cls, text: str, *, name: str = "scenario") -> Self:
        """As :meth:`load`, from text; `name` stands for the file in messages."""
        values, lines = parse_text(text, name=name)
        if values is None and not cls.EMPTY_IS_DEFAULT:
            raise ScenarioError(f"{name}: is empty, expected sections such as vehicle: or reference:; write {{}} for the default scenario")
        return cls._checked({} if values is None else values, where=lambda path: locate(name, path, lines))

    def edit(self, changes: Mapping[str, Any], *, origin: str = "edit") -> Self:
        """Scenario with some keys changed.

        Parameters
        ----------
        changes : mapping
            Dotted key -> value: a number, text, a list, or the text that would stand in a file, such as
            ``{"reference.bank_deg": 60, "weights.terminal": "[0.1, 250, 200, 500]"}``.
        origin : str
            Where the changes come from, for messages.

        Raises
        ------
        ScenarioError
            An unknown key (with the nearest known one) or a value that is refused.
        """
        if not isinstance(changes, Mapping):
            raise ScenarioError(f"{origin}: found {type(changes).__name__}, expected a mapping of dotted keys to values")
        values = self.model_dump(mode="json")
        for key, value in changes.items():
            parent, last, is_text = nested_key(type(self), values, key, origin)
            plain = _plain_values(value)
            if isinstance(plain, str) and not is_text:
                plain = parse_value(plain, name=f"{origin}: {key}")
            parent[last] = plain
        return self._checked(values, where=lambda path: origin)

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, ready for JSON."""
        return self.model_dump(mode="json")

    def to_yaml(self) -> str:
        """Complete YAML text with the meaning of every key as a comment; :meth:`parse` gives the same scenario back."""
        head = [f"# Scenario of {self.SUBJECT}. Keys that are left out keep their default values.", ""]
        return "\n".join(head + _yaml_lines(self, "")) + "\n"

    @classmethod
    def _checked(cls, values: Any, *, where: Callable[[Place], str]) -> Self:
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ScenarioError(translate(cls, error, where)) from None


def _plain_values(value: Any) -> Any:
    """NumPy scalars and arrays, and tuples, as plain Python values."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain_values(item) for item in value]
    return value


def _yaml_lines(section: Section, indent: str) -> list[str]:
    """Lines of YAML text of a section and those in it, with the meaning of every key as a comment."""
    lines: list[str] = []
    for key, info in type(section).model_fields.items():
        value = getattr(section, key)
        text = info.description or ""
        extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        components = extra.get("components")
        if isinstance(components, list):
            text = f"{text}: {', '.join(str(c) for c in components)}"
        if isinstance(value, Section):
            if not indent and lines:
                lines.append("")
            lines += [f"{indent}# {text}", f"{indent}{key}:", *_yaml_lines(value, indent + "  ")]
        else:
            line = f"{indent}{key}: {_yaml_value(value)}"
            lines += [f"{line}  # {text}"] if len(line) + len(text) < _WRAP else [f"{indent}# {text}", line]
    return lines


def _yaml_value(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_yaml_value(item) for item in value) + "]"
    if isinstance(value, float):
        return _shortest(value)
    if isinstance(value, str):
        # every name is quoted, so that none can be read as a number, a date or a key
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return str(value)


def _shortest(value: float) -> str:
    plain = repr(value)
    if "e" not in plain and len(plain) <= 10:
        return plain
    # the first power-of-ten form that reads back as the same number
    power = next(f"{value:.{digits}e}" for digits in range(17) if float(f"{value:.{digits}e}") == value)
    mantissa, exponent = power.split("e")
    return min(plain, f"{mantissa if '.' in mantissa else mantissa + '.0'}e{int(exponent)}", key=len)
