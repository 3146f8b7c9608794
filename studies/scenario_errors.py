"""Messages for a refused scenario: place, key, value found, what was expected, what to do."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from annotated_types import Ge, Le, MaxLen, MinLen
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from studies.scenario_text import Place, ScenarioError, dotted

_MOST = 10  # messages of one refusal


def locate(name: str, path: Place, lines: Mapping[Place, int]) -> str:
    """``file.yaml:12`` for the key or the nearest section around it that stands in the file."""
    for length in range(len(path), 0, -1):
        if path[:length] in lines:
            return f"{name}:{lines[path[:length]]}"
    return name


def leaves(model: type[BaseModel], prefix: str = "") -> list[str]:
    """Dotted names of all keys below a section."""
    names = []
    for key, info in model.model_fields.items():
        section = _section(info)
        names += leaves(section, f"{prefix}{key}.") if section else [prefix + key]
    return names


def nested_key(model: type[BaseModel], values: dict[str, Any], key: object, origin: str) -> tuple[dict[str, Any], str, bool]:
    """Mapping that holds a dotted key, its last part, and whether its value is text.

    Raises
    ------
    ScenarioError
        A key that is unknown, that names a section, or that reaches into a list.
    """
    if not isinstance(key, str):
        raise ScenarioError(f"{origin}: found {key!r} as a key, expected text such as 'vehicle.lift_to_drag'")
    parts = key.split(".")
    current: type[BaseModel] | None = model
    parent = values
    for i, part in enumerate(parts):
        if current is None:
            whole = ".".join(parts[:i])
            raise ScenarioError(f"{origin}: unknown key {key!r}; {whole} is a single value or list, give it whole as {whole}=...")
        info = current.model_fields.get(part)
        if info is None:
            raise ScenarioError(f"{origin}: unknown key {key!r}; {_near(key, leaves(model))}")
        current = _section(info)
        if i < len(parts) - 1 and current is not None:
            parent = parent[part]
    if current is not None:
        raise ScenarioError(f"{origin}: {key!r} is a section; set one of its keys: {', '.join(leaves(current, key + '.'))}")
    return parent, parts[-1], _info(model, tuple(parts))[1] is str


def translate(model: type[BaseModel], error: ValidationError, where: Callable[[Place], str]) -> str:
    """Text of a refusal, one line for each wrong key."""
    problems: list[str] = []
    for item in error.errors(include_url=False)[: 2 * _MOST]:
        place: Place = tuple(item["loc"])
        context = item.get("ctx") or {}
        if item["type"] == "cross" and "key" in context:
            place = (*place, context["key"])
        text = _problem(model, place, item)
        line = f"{where(place)}: {text}"
        if line not in problems:
            problems.append(line)
    if error.error_count() > _MOST:
        problems = [*problems[:_MOST], f"... and {error.error_count() - _MOST} more"]
    return "\n".join(problems)


def _problem(model: type[BaseModel], place: Place, item: Any) -> str:
    kind, found = item["type"], _found(item.get("input"))
    name = dotted(place) or "the scenario"
    if kind == "extra_forbidden":
        section, _ = _around(model, place)
        known = [dotted((*place[:-1], key)) for key in section.model_fields]
        return f"unknown key {name!r}; {_near(name, known, leaves(model))}"
    if kind == "cross":
        return f"{name}: {item['ctx']['found']}"
    info, annotation = _info(model, tuple(p for p in place if isinstance(p, str)))
    if info is None or (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
        section = annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else model
        keys = ", ".join(section.model_fields)
        return f"{name}: found {found}, expected a section with keys from: {keys}; delete the key or fill the section"
    extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
    components = extra.get("components")
    remedy = extra.get("remedy") or _remedy(item)
    if isinstance(components, list):
        index = next((p for p in place if isinstance(p, int)), None)
        if index is None:
            return f"{name}: found {found}, expected a list of {len(components)} numbers > 0 [{', '.join(map(str, components))}]; {remedy}"
        return f"{name}, the scale of {components[index]}: found {found}, expected a number from 1e-09 to 1e+09; {remedy}"
    return f"{name}: found {found}, expected {_expected(info, annotation)}; {remedy}"


def _expected(info: FieldInfo, annotation: Any) -> str:
    low = next((m.ge for m in info.metadata if isinstance(m, Ge)), None)
    high = next((m.le for m in info.metadata if isinstance(m, Le)), None)
    if typing.get_origin(annotation) is typing.Literal:
        return "one of " + ", ".join(str(choice) for choice in typing.get_args(annotation))
    if annotation is str:
        short = next((m.min_length for m in info.metadata if isinstance(m, MinLen)), 0)
        long = next((m.max_length for m in info.metadata if isinstance(m, MaxLen)), None)
        return f"text of {short} to {long} characters"
    word = "an integer" if annotation is int else "a number"
    return f"{word} from {_short(low)} to {_short(high)}"


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _remedy(item: Any) -> str:
    value = item.get("input")
    if item["type"] == "shape":
        return "give the whole list in this order"
    if value is None:
        return "give a value or delete the key to keep its default"
    if isinstance(value, bool) or item["type"] in ("float_type", "int_type"):
        return "write a plain number, without quotes, unit or separators" if not isinstance(value, float) else "write a whole number"
    if item["type"] == "finite_number":
        return "write a finite number"
    return "correct the value"


def _found(value: Any) -> str:
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:37] + "...")
    if isinstance(value, Mapping):
        return "a section"
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}"
    if isinstance(value, int) and abs(value) >= 10**18:
        return "an integer of more than 18 digits"
    return repr(value)[:60]


def _near(name: str, known: Iterable[str], others: Iterable[str] = ()) -> str:
    """Hint with the nearest known key: among the neighbours first, then a key of the same last part or spelling elsewhere."""
    neighbours, last = list(known), name.rpartition(".")[2]
    names = [*neighbours, *others]
    near = [k for k in names if k.rpartition(".")[2] == last] or difflib.get_close_matches(name, neighbours, n=1, cutoff=0.8)
    near = near or [k for k in names if difflib.get_close_matches(last, [k.rpartition(".")[2]], cutoff=0.75)]
    near = near or difflib.get_close_matches(name, names, n=1)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known: {', '.join(neighbours)}" if len(neighbours) <= _MOST else "list the known keys with --print-scenario"


def _section(info: FieldInfo) -> type[BaseModel] | None:
    kind = info.annotation
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _around(model: type[BaseModel], place: Place) -> tuple[type[BaseModel], Place]:
    """Innermost section around a place."""
    section: type[BaseModel] = model
    for i, part in enumerate(place[:-1]):
        inner = _section(section.model_fields[part]) if part in section.model_fields else None
        if inner is None:
            return section, place[:i]
        section = inner
    return section, place[:-1]


def _info(model: type[BaseModel], path: Place) -> tuple[FieldInfo | None, Any]:
    """Field and annotation of a key; (None, model) for the whole scenario or an unknown key."""
    info: FieldInfo | None = None
    current: type[BaseModel] | None = model
    for part in path:
        if current is None or part not in current.model_fields:
            return None, model
        info = current.model_fields[str(part)]
        current = _section(info)
    return info, (info.annotation if info is not None else model)
