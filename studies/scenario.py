"""The scenario of a study: one checked YAML file, the same for the command line and for Python.

A file holds only the keys it changes; every other key keeps the value of reference N1. The unit stands in the name of each key.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

from studies.scenario_errors import locate, nested_key, translate
from studies.scenario_sections import Atmosphere, Campaign, Dispersions, Guidance, Numerics, Planet, Reference, Section, Vehicle, Weights
from studies.scenario_text import Place, ScenarioError, parse_text, parse_value, read_text

if TYPE_CHECKING:
    from studies.gains import GainsStudy

__all__ = ["Scenario", "ScenarioError"]

_WRAP = 120


class Scenario(Section):
    """Vehicle, environment, reference flight, weights, guidance, dispersions and numerics of a study. Frozen.

    Examples
    --------
    >>> Scenario.default().edit({"vehicle.lift_to_drag": 0.3}).vehicle.lift_to_drag
    0.3
    """

    model_config = ConfigDict(title="Scenario of an entry guidance study", hide_input_in_errors=False)

    vehicle: Vehicle = Field(default=Vehicle(), description="the capsule: a point mass with constant lift and drag coefficients")
    planet: Planet = Field(default=Planet(), description="a spherical planet without rotation")
    atmosphere: Atmosphere = Field(default=Atmosphere(), description="density against altitude")
    reference: Reference = Field(default=Reference(), description="the reference flight: entry state, constant bank angle and end")
    weights: Weights = Field(
        default=Weights(), description="quadratic cost, each weight by its scale; the matrix is diag(1/scale^2); order n_x, hdot, s, sdot"
    )
    guidance: Guidance = Field(default=Guidance(), description="how the gains are flown")
    dispersions: Dispersions = Field(default=Dispersions(), description="dispersed closed-loop flights")
    numerics: Numerics = Field(default=Numerics(), description="accuracy")
    campaign: Campaign = Field(default=Campaign(), description="a campaign of many dispersed flights (reentry campaign)")

    @classmethod
    def default(cls) -> Scenario:
        """Reference N1, which meets the printed gains of Tang & Zhao 2000 (paper 003)."""
        return cls()

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Scenario of a YAML file; keys left out keep their defaults.

        Raises
        ------
        ScenarioError
            A file that is missing, unreadable as text or YAML, or that holds a wrong key or value: with file and line.
        OSError
            The machine fails to read it.
        """
        return cls.parse(read_text(Path(path)), name=str(path))

    @classmethod
    def parse(cls, text: str, *, name: str = "scenario") -> Scenario:
        """As :meth:`load`, from text; `name` stands for the file in messages."""
        values, lines = parse_text(text, name=name)
        if values is None:
            raise ScenarioError(f"{name}: is empty, expected sections such as vehicle: or reference:; write {{}} for the default scenario")
        return _checked(values, where=lambda path: locate(name, path, lines))

    def edit(self, changes: Mapping[str, Any], *, origin: str = "edit") -> Scenario:
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
            plain = plain_values(value)
            if isinstance(plain, str) and not is_text:
                plain = parse_value(plain, name=f"{origin}: {key}")
            parent[last] = plain
        return _checked(values, where=lambda path: origin)

    def remarks(self) -> list[str]:
        """Values that are accepted but look unintended, each as one sentence; usually empty."""
        notes = []
        bank = self.reference.bank_deg
        if 0.0 < bank < math.pi:
            notes.append(f"reference.bank_deg = {bank:g} is taken in degrees; if it is meant in radians write {math.degrees(bank):.4g}")
        return notes

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, ready for JSON."""
        return self.model_dump(mode="json")

    def to_yaml(self) -> str:
        """Complete YAML text with the meaning of every key as a comment; :meth:`parse` gives the same scenario back."""
        head = ["# Scenario of an entry guidance study. Keys that are left out keep their default values.", ""]
        return "\n".join(head + yaml_lines(self, "")) + "\n"

    def run(
        self, *, dispersions: int = 0, at: Sequence[float] | None = None, progress: Callable[[str, float], None] | None = None
    ) -> GainsStudy:
        """Synthesize the gains of this scenario, and fly `dispersions` dispersed cases of each set; see :func:`studies.gains.run`."""
        from studies import gains

        return gains.run(self, dispersions=dispersions, at=at, progress=progress)

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """JSON schema (draft 2020-12) for editors."""
        schema = Scenario.model_json_schema()
        # each dispersion set has its own defaults, so that no key of it must be given
        schema["$defs"]["DispersionSet"].pop("required", None)
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _checked(values: Any, *, where: Callable[[Place], str]) -> Scenario:
    try:
        return Scenario.model_validate(values)
    except ValidationError as error:
        raise ScenarioError(translate(Scenario, error, where)) from None


def plain_values(value: Any) -> Any:
    """NumPy scalars and arrays, and tuples, as plain Python values."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(item) for item in value]
    return value


def yaml_lines(section: Section, indent: str) -> list[str]:
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
            lines += [f"{indent}# {text}", f"{indent}{key}:", *yaml_lines(value, indent + "  ")]
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
