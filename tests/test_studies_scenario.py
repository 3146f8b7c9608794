"""The scenario: defaults, round trip, edits, and several hundred mutations, none of which may pass in silence."""

from __future__ import annotations

import copy
import itertools
import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from ruamel.yaml import YAML

from studies.scenario import Scenario, ScenarioError
from studies.scenario_text import MAX_BYTES


def leaves(values: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


def sections(values: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield (*path, key)
            yield from sections(value, (*path, key))


DEFAULT = Scenario.default().to_dict()
LEAVES = list(leaves(DEFAULT))
NUMBERS = [path for path, value in LEAVES if isinstance(value, float)]
LISTS = [path for path, value in LEAVES if isinstance(value, list)]


def mutated(path: tuple[str, ...], value: Any, *, key: str | None = None) -> str:
    """YAML (JSON is YAML) of the default with one leaf or section changed, or renamed to `key`."""
    values = copy.deepcopy(DEFAULT)
    parent = values
    for part in path[:-1]:
        parent = parent[part]
    del parent[path[-1]]
    parent[key or path[-1]] = value
    return json.dumps(values).replace("NaN", ".nan").replace("Infinity", ".inf")


def refusal(text: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        Scenario.parse(text, name="case.yaml")
    return str(caught.value)


def test_defaults_are_the_printed_ones() -> None:
    scenario = Scenario.default()
    assert scenario.weights.terminal == (0.1, 250.0, 200.0, 500.0)
    assert scenario.weights.state == (0.5, 750.0, 7500.0, 2000.0)
    assert scenario.weights.control == 0.06
    gains = scenario.guidance.paper_gains
    assert (gains.K1, gains.K2, gains.K3a, gains.K3b, gains.K4) == (-0.62, -1.5e-3, -5.2e-6, -2.2e-5, -7.5e-4)
    assert (scenario.vehicle.lift_to_drag, scenario.vehicle.ballistic_coefficient_kg_m2) == (0.25, 450.0)
    assert (scenario.reference.bank_deg, scenario.reference.path_angle_deg, scenario.reference.speed_m_s) == (45.0, -1.36, 7800.0)
    halves = dict(scenario.dispersions.sets.items())
    assert list(halves) == ["small", "large", "large_wave"]
    assert [halves[name].density for name in halves] == [0.10, 0.30, 0.30]
    assert [halves[name].path_angle_deg for name in halves] == [0.05, 0.1, 0.1]
    assert [halves[name].wave_amplitude for name in halves] == [0.0, 0.0, 0.10]


def test_every_default_satisfies_its_own_range() -> None:
    assert Scenario.model_validate(DEFAULT) == Scenario.default()


def test_yaml_round_trip_and_comments() -> None:
    scenario = Scenario.default().edit(
        {"vehicle.name": 'ab "c": \\ # [x] \U0001f680', "planet.gravitational_parameter_m3_s2": 4.2828e13 / 3}
    )
    text = scenario.to_yaml()
    assert Scenario.parse(text) == scenario
    assert YAML(typ="safe", pure=True).load(text) == scenario.to_dict()  # an independent reader sees the same values
    for path, _ in LEAVES:
        line = next(i for i, line in enumerate(text.splitlines()) if line.strip().startswith(path[-1] + ":"))
        assert "#" in text.splitlines()[line] or "#" in text.splitlines()[line - 1], path


def test_partial_file_keeps_other_defaults(tmp_path: Any) -> None:
    path = tmp_path / "my scenario.yaml"
    path.write_text("\ufeff# mine\nvehicle:\n  lift_to_drag: 0.3\ndispersions: {sets: {large_wave: {density: 0.2}}}\n", encoding="utf-8")
    scenario = Scenario.load(path)
    wave = scenario.dispersions.sets.large_wave
    assert (scenario.vehicle.lift_to_drag, scenario.vehicle.ballistic_coefficient_kg_m2) == (0.3, 450.0)
    assert (wave.density, wave.wave_amplitude, wave.path_angle_deg) == (0.2, 0.10, 0.1)
    assert Scenario.parse("{}") == Scenario.default()
    assert Scenario.parse("vehicle: {}") == Scenario.default()


@pytest.mark.parametrize(("text", "value"), [("1e-1", 0.1), ("+.5", 0.5), ("2.", 2.0), ("1E0", 1.0), ("3", 3.0)])
def test_numbers_as_people_write_them(text: str, value: float) -> None:
    assert Scenario.parse(f"vehicle: {{lift_to_drag: {text}}}").vehicle.lift_to_drag == value


def test_edit_takes_values_and_text() -> None:
    scenario = Scenario.default().edit(
        {"weights.terminal": "[0.2, 250, 200, 500]", "weights.state": np.array([1.0, 2, 3, 4]), "reference.bank_deg": np.int64(60)}
    )
    assert scenario.weights.terminal == (0.2, 250.0, 200.0, 500.0)
    assert scenario.weights.state == (1.0, 2.0, 3.0, 4.0)
    assert scenario.reference.bank_deg == 60.0
    assert Scenario.default().reference.bank_deg == 45.0
    assert Scenario.default().edit({"vehicle.name": "a: [b"}).vehicle.name == "a: [b"


def test_frozen() -> None:
    with pytest.raises(ValidationError):
        Scenario.default().vehicle.lift_to_drag = 0.5  # type: ignore[misc]


@pytest.mark.parametrize("path", [path for path, _ in LEAVES], ids=".".join)
def test_misspelt_key_names_the_nearest(path: tuple[str, ...]) -> None:
    whole = ".".join(path)
    for wrong in (path[-1] + "x", path[-1][:-1], path[-1].upper() if path[-1] != path[-1].upper() else path[-1].lower()):
        if (*path[:-1], wrong) in dict(LEAVES):
            continue
        message = refusal(mutated(path, 1.0, key=wrong))
        assert f"unknown key '{'.'.join((*path[:-1], wrong))}'" in message
    typo = path[-1] + "_"
    assert f"did you mean '{whole}'?" in refusal(mutated(path, 1.0, key=typo))
    with pytest.raises(ScenarioError, match=re.escape(f"--set: unknown key '{whole}_'; did you mean '{whole}'?")):
        Scenario.default().edit({whole + "_": "1"}, origin="--set")


BAD_NUMBERS = [math.nan, math.inf, -math.inf, None, True, "text", "0.3", "1,5", [1.0], {}, {"a": 1}, 1e300, -1e300, 10**400]


@pytest.mark.parametrize("path", NUMBERS, ids=".".join)
def test_wrong_number_names_the_key(path: tuple[str, ...]) -> None:
    whole = ".".join(path)
    for value in BAD_NUMBERS:
        message = refusal(mutated(path, value))
        assert message.startswith("case.yaml:1: " + whole), (value, message)
        assert "expected" in message
        with pytest.raises(ScenarioError, match=re.escape(f"edit: {whole}: found")):
            Scenario.default().edit({whole: {"nested": 1} if value == "0.3" else value})


@pytest.mark.parametrize("path", [path for path in NUMBERS if "paper_gains" not in path], ids=".".join)
def test_wrong_sign_is_refused(path: tuple[str, ...]) -> None:
    value = dict(LEAVES)[path]
    if value != 0.0:
        assert ".".join(path) in refusal(mutated(path, -value))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("reference.altitude_m", 100), ("reference.speed_m_s", 7.8), ("reference.path_angle_deg", -0.0237),
        ("reference.path_angle_deg", 1.36),
        ("reference.stop_altitude_m", 10), ("planet.radius_m", 6371), ("planet.gravitational_parameter_m3_s2", 398600.4418),
        ("atmosphere.scale_height_m", 7.11), ("dispersions.sets.large.density", 30), ("vehicle.ballistic_coefficient_kg_m2", -450),
    ],
)  # fmt: skip
def test_wrong_unit_is_refused(key: str, value: float) -> None:
    with pytest.raises(ScenarioError, match=re.escape(key)):
        Scenario.default().edit({key: value})


def test_bank_in_radians_is_remarked() -> None:
    assert Scenario.default().remarks() == []
    (note,) = Scenario.default().edit({"reference.bank_deg": math.radians(45)}).remarks()
    assert "write 45" in note


@pytest.mark.parametrize("path", LISTS, ids=".".join)
def test_lists_are_checked_by_component(path: tuple[str, ...]) -> None:
    whole, good = ".".join(path), dict(LEAVES)[path]
    for value in (1.0, [], good[:3], [*good, 1.0], "0.1", None, {"n_x": 1}):
        message = refusal(mutated(path, value))
        assert f"{whole}: found" in message
        assert "4 numbers > 0 [n_x (g), hdot (m/s), s (m), sdot (m/s)]" in message
    for i, value in itertools.product(range(4), (0.0, -1.0, math.nan, math.inf, "x", None, [1.0], True)):
        wrong = [*good[:i], value, *good[i + 1 :]]
        message = refusal(mutated(path, wrong))
        assert f"{whole}[{i}], the scale of {('n_x', 'hdot', 's', 'sdot')[i]} (" in message


@pytest.mark.parametrize("path", list(sections(DEFAULT)), ids=".".join)
def test_section_that_is_none(path: tuple[str, ...]) -> None:
    for value in (None, [], [1], 3.0, "text", True):
        message = refusal(mutated(path, value))
        assert f"{'.'.join(path)}: found" in message
        assert "expected a section" in message
    with pytest.raises(ScenarioError, match="is a section; set one of its keys"):
        Scenario.default().edit({".".join(path): 1})


def test_line_of_each_key() -> None:
    text = Scenario.default().to_yaml()
    for number, line in enumerate(text.splitlines(), start=1):
        match = re.fullmatch(r"( *\w+): (?!\[|\")([^ #]+).*", line)
        if match:
            lines = text.splitlines()
            lines[number - 1] = f"{match[1]}: wrong"
            assert refusal("\n".join(lines)).startswith(f"case.yaml:{number}: "), line


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "is empty"),
        ("# only a remark\n", "is empty"),
        ("null", "is empty"),
        ("[]", "the scenario: found a list of 0"),
        ("just text", "the scenario: found 'just text'"),
        ("vehicle: &a {lift_to_drag: 0.3}\n", ":1: anchors"),
        ("vehicle:\n  lift_to_drag: *a\n", ":2: anchors"),
        ("vehicle: !!python/object/apply:os.system ['true']\n", ":1: tags"),
        ("vehicle:\n  lift_to_drag: !!float 0.3\n", ":2: tags"),
        ("!!map {}", ":1: tags"),
        ("vehicle: {lift_to_drag: 0.3}\nvehicle: {}\n", ":2: vehicle: given twice (first on line 1)"),
        ("vehicle:\n  lift_to_drag: 1\n  lift_to_drag: 2\n", ":3: vehicle.lift_to_drag: given twice (first on line 2)"),
        ("--- {}\n--- {}\n", ":2: a second document"),
        ("vehicle: [\n", "not readable as YAML"),
        ("vehicle:\n\tlift_to_drag: 1\n", ":2: not readable as YAML"),
        ("vehicle: {name: \x01}", ":1: not readable as YAML"),
        ("? [a]\n: 1\n", ":1: a key must be a plain word"),
        ("[" * 1000, ":1: nested deeper"),
        ("reference: {stop_altitude_m: 120000}", "reference.stop_altitude_m: found 120000.0, expected less than reference.altitude_m"),
        ("atmosphere: {model: us76_smooth, scale_height_m: 7000}", "atmosphere.scale_height_m: found 7000.0, but it has no effect"),
        ("atmosphere: {model: us76}", "expected one of exponential, us76_smooth"),
        ("dispersions: {seed: 1.5}", "dispersions.seed: found 1.5, expected an integer"),
        ("dispersions: {seed: -1}", "dispersions.seed: found -1"),
        ("dispersions: {sets: {larg: {density: 0.1}}}", "did you mean 'dispersions.sets.large'?"),
        ("lift_to_drag: 0.3", "did you mean 'vehicle.lift_to_drag'?"),
        ("vehicle: {bank_deg: 3}", "did you mean 'reference.bank_deg'?"),
        ('vehicle: {name: ""}', "vehicle.name: found ''"),
        ('vehicle: {name: "a\\nb"}', "vehicle.name: control characters"),
        (f"vehicle: {{name: {'x' * 81}}}", "expected text of 1 to 80 characters"),
        ("#" * (MAX_BYTES + 1), "larger than"),
    ],
)  # fmt: skip
def test_refused_texts(text: str, part: str) -> None:
    assert part in refusal(text)


def test_many_faults_stay_readable() -> None:
    message = refusal("\n".join(f"k{i}: {i}" for i in range(2000)))
    assert len(message.splitlines()) == 11
    assert message.endswith("and 1990 more")


def test_alias_bomb_is_refused_while_scanning() -> None:
    bomb = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30))
    assert refusal(bomb).startswith("case.yaml:1: anchors")


def test_files_that_are_none(tmp_path: Any) -> None:
    with pytest.raises(ScenarioError, match="no such file"):
        Scenario.load(tmp_path / "missing.yaml")
    with pytest.raises(ScenarioError, match="is a folder"):
        Scenario.load(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"vehicle:\n  name: Sch\xe4fer\n")
    with pytest.raises(ScenarioError, match=r"latin\.yaml:2: not UTF-8 text \(byte 0xe4\)"):
        Scenario.load(tmp_path / "latin.yaml")
    with pytest.raises(ScenarioError, match="no such file"):
        Scenario.load(tmp_path / "latin.yaml" / "below.yaml")
    with (tmp_path / "huge.yaml").open("wb") as stream:
        stream.truncate(1 << 30)  # a sparse gigabyte
    with pytest.raises(ScenarioError, match="larger than"):
        Scenario.load(tmp_path / "huge.yaml")


@pytest.mark.parametrize(
    ("key", "value", "part"),
    [
        ("weights.terminal.0", 1, "give it whole as weights.terminal=..."),
        ("bank_deg", 1, "did you mean 'reference.bank_deg'?"),
        ("qqq", 1, "--print-scenario"),
        ("", 1, "unknown key"),
        (3, 1, "found 3 as a key"),
        ("vehicle.lift_to_drag", "", "found nothing"),
        ("vehicle.lift_to_drag", "&a 1", "anchors"),
        ("vehicle.lift_to_drag", 1j, "found 1j"),
        ("weights.state", "[1, 2", "not readable"),
        ("weights.state", {1.0, 2.0, 3.0, 4.0}, "weights.state: found"),
        ("vehicle.name", 3, "vehicle.name: found 3, expected text"),
    ],
)
def test_refused_edits(key: Any, value: Any, part: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(part)):
        Scenario.default().edit({key: value})
    with pytest.raises(ScenarioError, match="expected a mapping"):
        Scenario.default().edit([("vehicle.lift_to_drag", 0.3)])  # type: ignore[arg-type]


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.data())
def test_damaged_text_never_ends_in_a_traceback(data: st.DataObject) -> None:
    text = Scenario.default().to_yaml()[:900]
    start = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 40))
    damage = data.draw(st.text(alphabet="[]{}:,&*!|>'\"%@`?#-\t\n \\0~<=.\x00\x85\u2028aé\U0001f600", max_size=12))
    try:
        Scenario.parse(text[:start] + damage + text[start + length :])
    except ScenarioError as error:
        message = str(error)
    else:
        message = "scenario accepted"
    assert message.startswith("scenario")


def test_schema_describes_every_key_and_accepts_partial_files() -> None:
    schema = Scenario.json_schema()
    json.dumps(schema, allow_nan=False)
    definitions = schema["$defs"]
    assert schema["additionalProperties"] is False
    for name, definition in definitions.items():
        assert definition["additionalProperties"] is False, name
        assert "required" not in definition, name
        assert all("description" in entry for entry in definition["properties"].values()), name
    ratio = definitions["Vehicle"]["properties"]["lift_to_drag"]
    assert (ratio["default"], ratio["minimum"], ratio["maximum"]) == (0.25, 0.01, 4.0)
