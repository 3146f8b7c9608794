"""Blending study: cases on top of changes, comparison under the same settings, statistics of lost, slow and failed flights."""

import inspect
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from allocation.blending import Handover
from models import ModelError
from models.shuttle_trim import trim_elevon
from models.units import INCH
from studies import blend, blend_cases, blend_design, blend_loop, blend_methods, blend_tables, cli, cli_blend

DEG = math.pi / 180
X0 = np.array(list(blend_design.START.values()))
DOCS = Path(__file__).parents[1] / "docs"
SHORT = blend_loop.LoopSettings(duration_s=30.0)


@pytest.fixture(scope="module")
def study():
    return blend.run()


@pytest.fixture(scope="module")
def loop(study):
    return study.loop


@pytest.fixture
def flown(monkeypatch):
    """Calls of `fly_many`, answered at once: rms error and trim time of a case by its parameters; recorded flights last 30 s."""
    calls, ends = [], {}

    def fly_many(loop, x0, p):
        calls.append((loop, x0, p))
        one = dict.fromkeys(loop.carry, np.ones(len(p))) | dict.fromkeys(("trim_limit_s", "outside_s", "slow_s"), np.zeros(len(p)))
        return one | {"sum_square": p[:, loop.params.index("Cm_factor")] ** 2 * DEG**2, "finite": np.ones(len(p))} | ends

    def fly(loop, x0, p):
        return blend_loop.fly(replace(loop, settings=replace(loop.settings, duration_s=30.0)), x0, p)

    monkeypatch.setattr(blend, "fly_many", fly_many)
    monkeypatch.setattr(blend, "fly", fly)
    return calls, ends


def test_a_case_comes_on_top_of_the_changes():
    changes = {"Cm_factor": 1.1, "cg_aft": 0.02, "up_share": 0.5, "stress": 0.01, "mass": 9e4}
    more = {"Cm_factor": 1.2, "cg_aft": -0.05, "up_share": 5 / 6, "stress": -0.03, "CL_factor": 0.8}
    found = blend_cases.combined(changes, more)
    assert found == pytest.approx(
        {"Cm_factor": 1.32, "cg_aft": -0.03, "up_share": 5 / 12, "stress": -0.03, "mass": 9e4, "CL_factor": 0.8}, rel=1e-14
    )
    assert changes["Cm_factor"] == 1.1
    for case in blend_cases.SINGLES.values():  # nothing changed: the case itself, to the last bit
        assert blend_cases.combined({}, case) == dict(case)


def test_changes_are_split_into_start_and_parameters(loop):
    x0, given = blend_cases.split(loop, {"h": 74e3, "Cm_factor": 1.1, "stress": 0.02})
    assert x0[2] == 74e3
    assert np.array_equal(np.delete(x0, 2), np.delete(X0, 2))
    assert given == {"Cm_factor": 1.1, "stress": 0.02}
    with pytest.raises(ModelError, match=r"Cm_factor.*down_share.*stress.*theta"):  # nothing near: parameters and states are listed
        blend_cases.split(loop, {"xyzzy": 1.0})
    with pytest.raises(ModelError, match="did you mean 'gamma'"):
        blend_cases.split(loop, {"gama": 1.0})


def test_dispersions_come_on_top_of_the_changes(loop):
    plain = blend_cases.dispersed(loop, 5, seed=7)
    draws = np.random.Generator(np.random.Philox(7)).random((5, 6))
    for j, (name, (low, high)) in enumerate(blend_cases.SPREAD.items()):
        assert np.array_equal(plain[:, loop.params.index(name)], low + (high - low) * draws[:, j])
    changed = blend_cases.dispersed(loop, 5, seed=7, changes={"Cm_factor": 1.1, "cg_aft": 0.02, "stress": 0.01, "up_share": 0.5})
    expected = plain.copy()
    for name, make in {
        "Cm_factor": lambda v: 1.1 * v,
        "cg_aft": lambda v: v + 0.02,
        "stress": lambda v: 0.01,
        "up_share": lambda v: 0.5,
    }.items():
        expected[:, loop.params.index(name)] = make(expected[:, loop.params.index(name)])
    np.testing.assert_allclose(changed, expected, rtol=1e-15)
    with pytest.raises(ModelError, match=r"dispersions of Cm_factor.*10\.8"):
        blend_cases.dispersed(loop, 5, seed=7, changes={"Cm_factor": 9.0})  # allowed, but not with 20 % more
    with pytest.raises(ModelError, match=r"single case 'wind x 1\.5'"):
        blend_cases.single_parameters(loop, {"wind_factor": 8.0})


@pytest.mark.parametrize("cases", [-1, 2.0, True])
def test_a_number_of_cases_that_is_none_is_refused(loop, cases):
    with pytest.raises(ModelError, match="cases: expected a whole number, 0 or more"):
        blend_cases.dispersed(loop, cases, seed=7)


@pytest.mark.parametrize(("name", "changes"), [("nominal", {}), ("as changed", {"h": 74e3})])
def test_what_is_said_of_this_flight_is_said_once(study, name, changes):
    lost = blend.one(numbers(1, below_tables_s=np.ones(1), trim_at_limit_s=np.full(1, 9.0), outside_tables_s=np.ones(1)), 0)
    found = replace(study, changes=changes, singles={name: lost, "Cm +20 %": lost})
    assert [remark.split(":")[0] for remark in found.remarks] == ["Cm +20 %"] * 3


def test_singles_fly_the_changed_vehicle(flown, loop):
    calls, _ = flown
    found = blend.run(changes={"wind_factor": 0.8, "cg_aft": 0.01, "stress": 0.02, "h": 74e3}, singles=True)
    assert list(found.singles) == ["as changed", *list(blend_cases.SINGLES)[1:]]
    ((_, x0, p),) = calls
    assert x0[2] == 74e3
    rows = dict(zip(blend_cases.SINGLES, p, strict=True))
    column = loop.params.index
    assert rows["nominal"][[column("wind_factor"), column("cg_aft"), column("stress")]] == pytest.approx([0.8, 0.01, 0.02])
    assert rows["wind x 1.5"][column("wind_factor")] == pytest.approx(1.2)
    assert rows["c.g. 2 in forward"][column("cg_aft")] == pytest.approx(0.01 - 2 * INCH)
    assert rows["Cm +20 %"][[column("Cm_factor"), column("wind_factor")]] == pytest.approx([1.2, 0.8])
    assert rows["stress -2 deg"][column("stress")] == -2 * DEG
    assert found.stress["stress -2 deg"].p == pytest.approx(rows["stress -2 deg"])
    assert found.stress["stress +2 deg"]["h"][0] == 74e3
    assert next(iter(blend.run(singles=True).singles)) == "nominal"


def test_the_comparison_flies_what_is_asked(flown, capsys):
    calls, _ = flown
    options = ["--q1", "500", "--q2", "2000", "--set", "Cm_factor=1.5", "--set", "h=74000", "--stress", "2", "--jets", "4", "--seed", "9"]
    assert cli.main(["blend", "--json", "--dispersions", "4", "--compare", "--method", "literal", *options]) == 0
    data = json.loads(capsys.readouterr().out)
    assert list(data["methods"]["methods"]) == ["paper", "qp", "pinv", "literal"]
    assert data["methods"]["differences"]["from"] == "paper"
    assert list(data["methods"]["differences"]["methods"]) == ["qp", "pinv", "literal"]
    assert sorted(loop.allocator.name() for loop, _, _ in calls) == ["blend_literal", "blend_paper", "blend_pinv", "blend_qp"]
    for loop, x0, p in calls:
        assert (loop.settings.q1, loop.settings.q2, len(loop.jets.up), x0[2]) == (500.0, 2000.0, 4, 74e3)
        assert np.array_equal(p, calls[0][2])
        assert (p[:, loop.params.index("stress")] == 2 * DEG).all()
        assert (1.2 <= p[:, loop.params.index("Cm_factor")]).all()
    cm = calls[0][2][:, loop.params.index("Cm_factor")]
    assert data["methods"]["methods"]["qp"]["rms_deg"]["mean"] == pytest.approx(cm.mean(), rel=1e-12)
    calls.clear()
    assert cli.main(["blend", "--json", "--dispersions", "4", "--compare"]) == 0
    assert len(calls) == 3  # its own ensemble is not flown twice


def numbers(cases, **given):
    return blend.Figures(**({name: np.arange(float(cases)) for name in blend.Figures.__dataclass_fields__} | sound(cases) | given))


def sound(cases):
    return {name: np.zeros(cases) for name in ("trim_at_limit_s", "outside_tables_s", "below_tables_s")}


def test_compared_flights_are_sound_under_every_method(study):
    studies = {
        "a": replace(study, ensemble=numbers(6, trim_at_limit_s=np.array([0, 0, 2.0, 0, 0, 0])), failed=(4,)),
        "b": replace(study, ensemble=numbers(6, outside_tables_s=np.array([0.1, 0, 0, 0, 0, 0])), failed=()),
    }
    found = blend_methods.of_studies(studies)
    assert found.kept.tolist() == [False, True, False, True, False, True]
    assert found.interval("b", "rms_deg")[0] == 3.0
    with pytest.raises(ModelError, match="c and a differ in the number of flights: found 5 and 6"):
        blend_methods.of_studies(studies | {"c": replace(study, ensemble=numbers(5))})
    with pytest.raises(ModelError, match="no random dispersions"):
        blend_methods.of_studies({"paper": study})
    with pytest.raises(ModelError, match="no study is given"):
        blend_methods.of_studies({})


@pytest.mark.parametrize("left", [0, 1, 2])
def test_a_comparison_of_too_few_flights_is_reported_without_intervals(flown, capsys, tmp_path, left):
    _, ends = flown
    ends["trim_limit_s"] = np.where(np.arange(3) < left, 0.0, 9.0)
    options = ["blend", "--dispersions", "3", "--compare", "--out", str(tmp_path / "out")]
    assert cli.main([*options, "--json"]) == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert json.loads((tmp_path / "out" / "blend.json").read_text(encoding="utf-8")) == found
    data = found["methods"]
    assert (data["cases"], data["kept"], data["differences"]["from"]) == (3, left, "paper")
    rows = [*data["methods"].values(), *data["differences"]["methods"].values()]
    assert [list(row) for row in rows] == [[name for name, _ in blend_methods.COMPARED] if left == 2 else []] * 5
    said = {0: "0 flights are finite", 1: "1 flight is finite", 2: ""}[left]
    assert ("remark" in data) == (left < 2)
    assert said in data.get("remark", "")
    assert ("note: compare:" in shown.err) == (left < 2)
    assert cli.main(options[:-2]) == 0
    assert ("Methods over the same dispersed flights" in capsys.readouterr().out) == (left == 2)


def test_too_few_flights_have_no_interval(study):
    lost = blend_methods.of_studies({"a": replace(study, ensemble=numbers(3, outside_tables_s=np.ones(3)))})
    assert lost.tables() == []
    with pytest.raises(ModelError, match="0 flights are finite, in authority"):
        lost.interval("a", "rms_deg")


def test_only_the_same_flights_are_compared(study):
    a = replace(study, ensemble=numbers(4))
    settings = study.loop.settings
    moved = [replace(study.flight, loop=replace(study.loop, settings=replace(settings, **{q: 1500.0}))) for q in ("q1", "q2")]
    for given, text in (
        ({"seed": 3}, "seed: found 3 and 2012"), ({"changes": {"h": 7e4}}, "changes: found {'h': 70000.0} and {}"),
        ({"jets": 4}, "jets: found 4 and 6"), ({"flight": moved[0]}, "q1: found 1500.0 and 1000.0"),
        ({"flight": moved[1]}, "q2: found 1500.0 and 2500.0"),
    ):  # fmt: skip
        with pytest.raises(ModelError, match=re.escape(f"compare: b and a differ in {text}")):
            blend_methods.of_studies({"a": a, "b": replace(a, **given)})
    assert blend_methods.of_studies({"a": a, "b": replace(a, method="qp")}).kept.all()


def test_a_method_that_is_named_twice_is_flown_once(flown):
    calls, _ = flown
    found = blend_methods.compare(("paper", "qp", "paper"), cases=2, seed=5)
    assert list(found.found) == ["paper", "qp"]
    assert len(calls) == 2
    assert blend.run(cases=2, seed=5).seed == 5


def test_the_level_of_confidence_is_told(study, monkeypatch):
    monkeypatch.setattr(blend_methods, "CONFIDENCE", 0.9)
    assert "with 90 % confidence" in blend_methods.of_studies({"a": replace(study, ensemble=numbers(4))}).table().caption


@pytest.mark.slow
def test_the_comparison_of_a_changed_vehicle():
    changes, hand = {"Cm_factor": 1.05, "h": 74.5e3}, Handover(q1=900.0, q2=2300.0)
    found = blend_methods.compare(("paper", "pinv"), cases=6, seed=3, jets=4, handover=hand, changes=changes)
    loop = blend_design.sts1_loop("pinv", jets=4, handover=hand)
    p = blend_cases.dispersed(loop, 6, seed=3)
    p[:, loop.params.index("Cm_factor")] *= 1.05
    x0 = X0.copy()
    x0[2] = 74.5e3
    ends = blend.figures_of(blend_loop.fly_many(loop, x0, p))
    assert found.found["pinv"].propellant_kg == pytest.approx(ends.propellant_kg, rel=1e-9)
    assert found.found["pinv"].pulses == pytest.approx(ends.pulses)


def test_failed_flights_keep_their_numbers(flown, capsys):
    _, ends = flown
    ends |= {"finite": np.array([1.0, 0, 1, 1]), "trim_limit_s": np.array([0.0, np.nan, 7, 0]), "n_last": np.array([1.0, 0, 1, 1])}
    ends |= {"sum_square": np.array([1.0, -1.0, 400.0, 9.0]) * DEG**2, "sum_last": np.zeros(4)}
    assert cli.main(["blend", "--json", "--dispersions", "4"]) == 3
    shown = capsys.readouterr()
    data = json.loads(shown.out)["ensemble"]
    assert (data["cases"], data["lost"], data["failed"], data["out_of_authority"]) == (4, [2], [1], 1)
    assert data["rms_deg"] == {"median": 2.0, "p95": pytest.approx(2.9), "max": 3.0}
    assert "case 1 " in shown.err


def test_without_a_flight_left_there_are_no_statistics(flown, study, capsys):
    _, ends = flown
    ends["outside_s"] = np.ones(3)
    assert cli.main(["blend", "--dispersions", "3"]) == 0
    shown = capsys.readouterr()
    assert "Random dispersions" not in shown.out
    assert "3 with an angle of attack outside the aerodynamic tables; no flight is left, so there are no statistics" in shown.err
    assert "of the others" not in shown.err
    lost = replace(study, ensemble=numbers(2, trim_at_limit_s=np.full(2, 3.0)))
    assert "Random dispersions" not in [table.title for table in lost.result().tables]
    failed = replace(study, ensemble=numbers(1), failed=(0,))
    assert "no statistics" in failed.remarks[0]
    some = replace(study, ensemble=numbers(2, trim_at_limit_s=np.array([0.0, 3.0])))
    assert "the statistics are of the others" in some.remarks[0]


def test_slow_flights_are_counted_with_their_times(study):
    slow = np.array([0.0, 10.0, 30.0, 50.0, 7.0])
    flights = replace(study, ensemble=numbers(5, below_tables_s=slow), failed=(4,))
    data = blend.ensemble_statistics(flights.ensemble, flights.failed)
    assert (data["slower_than_mach_2"], data["mach_below_2_s"]) == (3, {"median": 30.0, "max": 50.0})
    table = blend_tables.ensemble_table(flights)
    assert "3 of 5 flights slower than Mach 2, for 30.0 s (median) and 50.0 s at most" in table.caption
    assert [row[0] for row in table.rows] == [name.replace("_", " ") for name in blend.STATISTICS]
    assert any("50.0 s at most" in remark for remark in flights.remarks)
    assert "none of 2 flights" in blend_tables.ensemble_table(replace(study, ensemble=numbers(2))).caption
    row = blend.one(numbers(2, below_tables_s=np.array([0.0, 25.4]), trim_at_limit_s=np.array([0.0, 9.0])), 1)
    still = replace(row, below_tables_s=0.0, trim_at_limit_s=0.0)
    rows = blend_tables.singles_table(replace(study, singles={"slow": row, "still": still})).rows
    assert [r[-1] for r in rows] == ["out of authority; below Mach 2 for 25 s", ""]


def test_a_pressure_that_was_not_passed_was_reached_never(study):
    early = blend.run(settings=SHORT)
    assert early.summary()[-2:] == [("q1 reached", "never", ""), ("q2 reached", "never", "")]
    assert early.to_dict()["events"] == {"q1_s": None, "q2_s": None}
    assert study.summary()[-2] == ("q1 reached", study.numbers.q1_s, "s")
    early.result()


def test_the_stress_limit_is_told_in_degrees(capsys):
    assert math.radians(cli_blend._LARGEST_STRESS_DEG) == blend_loop.LARGEST_STRESS
    for value in ("30", "-20.5", "inf"):
        assert cli.main(["blend", "--stress", value]) == 2
        shown = capsys.readouterr().err
        assert "-20 to 20 deg" in shown
        assert "rad" not in shown


def test_starts_are_checked_and_made_at_once(loop, monkeypatch):
    with pytest.raises(ModelError, match=r"x0: expected shape \(8,\)"):
        blend_loop.fly(loop, X0[:3])
    with pytest.raises(ModelError, match=r"x0: expected shape \(8,\) for"):
        blend_loop.fly(loop, np.stack([X0, X0]))
    for wrong in (X0[:3], [list(X0[:3])]):
        with pytest.raises(ModelError, match=r"x0: expected shape \(8,\) or \(N, 8\)"):
            loop.start(wrong)
    with pytest.raises(ModelError, match="x0: h"):
        blend_loop.fly(loop, X0 * [1, 1, -1, 1, 1, 1, 1, 1])
    with pytest.raises(ModelError, match="got None"):
        blend.run(method=None)
    many = X0 * np.linspace(0.9, 1.0, 4)[:, None]
    assert np.array_equal(loop.start(many), np.stack([loop.start(x) for x in many]))
    made, start = [], blend_loop.BlendLoop.start
    monkeypatch.setattr(blend_loop.BlendLoop, "start", lambda self, x: made.append(start(self, x)) or made[-1])
    tiny = replace(loop, settings=replace(loop.settings, duration_s=0.12, transient_s=0.0))
    monkeypatch.setattr(blend_loop.BlendLoop, "compiled", lambda self, mode, alone: _Runs())
    for x0 in (X0, X0[None], np.tile(X0, (5, 1))):
        found = blend_loop.fly_many(tiny, x0, np.tile(loop.parameters(), (5, 1)))
        assert np.array_equal(found["h"], np.full(5, 75e3))
    assert len(made) == 3


class _Runs:
    """A compiled loop that ends where it starts."""

    after: np.ndarray
    outcome: np.ndarray

    def run(self, starts, q, p):
        assert len(starts) == len(p)
        self.after, self.outcome = starts, np.zeros(len(p), dtype=int)
        return self


def test_where_the_orbiter_is_unstable(study):
    f, every = study.flight, slice(None, None, 10)
    t, qbar = f["t"][every], f["qbar"][every]
    at = trim_elevon(f["mach"][every], f["alpha"][every], delta_bf=-11.7 * DEG)
    unstable, late = at.Cm_alpha > 0, t > 60
    spans = t[np.flatnonzero(np.diff(unstable.astype(int))) + 1]
    assert unstable[0]
    assert len(spans) == 5
    text = " ".join((DOCS / "orbiter.md").read_text(encoding="utf-8").split())
    said = re.search(
        r"unstable from (\d+) to (\d+) s \(but for (\d+) to (\d+) s\), at most \+([\d.]+)/rad, and in its first (\d+) s,"
        r".*? at most \+([\d.]+)/rad at a dynamic pressure below (\d+) Pa",
        text,
    )
    *times, late_most, first, early_most, pressure = (float(number) for number in said.groups())
    assert [first, *times] == pytest.approx(spans[[0, 1, 4, 2, 3]], abs=0.6)
    assert late_most == pytest.approx(at.Cm_alpha[late].max(), abs=6e-4)
    assert early_most == pytest.approx(at.Cm_alpha[~late].max(), abs=6e-4)
    assert 0 < pressure - qbar[unstable & ~late].max() < 20


@pytest.mark.parametrize(("jets", "fires"), [(6, False), (2, True)])
def test_the_printed_logic_fires_above_q2_with_few_jets(jets, fires):
    assert (blend.run(method="literal", jets=jets).numbers.pulses_above_q2 > 0) == fires


def test_every_option_stands_in_the_command_table():
    (row,) = [line for line in (DOCS / "command_line.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `reentry blend`")]
    hints = inspect.get_annotations(cli_blend.blend, eval_str=True)
    options = [option for hint in hints.values() for one in getattr(hint, "__metadata__", ()) for option in (one.default, *one.param_decls)]
    assert len(options) == 12
    for option in options:
        assert f"`{option}" in row, option
