"""`reentry land`: the reference against hand-written equations, dispersed sets, targets out of reach, messages."""

import dataclasses
import json

import numpy as np
import pytest

from benchmarks import _landing_scipy
from benchmarks import landing as landing_benchmark
from models import native
from models.core import ModelError
from models.entry_cartesian import to_cartesian
from models.units import DEG
from ocp.landing import target
from studies import cli
from studies import landing_flight as flights
from studies.landing_scenario import LandingScenario
from studies.scenario_text import ScenarioError

compiled = pytest.mark.skipif(not native.native_available(), reason="no compiler: minutes")


def land(capsys, *arguments, code=0):
    assert cli.main(["land", *arguments]) == code
    return capsys.readouterr()


def answer(capsys, *arguments):
    return json.loads(land(capsys, *arguments, "--json").out)


def test_reference_flight(capsys):
    flight = answer(capsys, "--reference")["flight"]
    assert flight["t_f_s"] == pytest.approx(541.273, rel=2e-6)
    assert flight["range_m"] == pytest.approx(2501.30e3, rel=4e-6)
    assert flight["peak_load_g"] == pytest.approx(3.2977, rel=2e-4)
    assert flight["miss_downrange_m"] == pytest.approx(0.0, abs=1e-3)
    assert flight["miss_crossrange_m"] == pytest.approx(0.0, abs=1e-3)
    assert flight["bank_travel_deg"] == pytest.approx(90.0)
    assert flight["reversals"] == 1


def test_sensitivities_are_central_differences_of_scipy(capsys):
    found = answer(capsys, "--reference", "--sensitivities")["sensitivities"]
    x0 = to_cartesian([100e3, 108 * DEG, 17 * DEG, 7650.0, -1.6 * DEG, 8 * DEG])
    T, B = np.array([245.0, 275.0]), np.array([45.0, -45.0]) * DEG

    def point(beta, shift):
        return _landing_scipy.fall(x0, T + shift, B * (1 + beta), stop=10e3, rtol=1e-12, atol=1e-6)[1][:3]

    axes = target(x0[:3], point(0, 0), radius=6371e3)
    by_beta = (axes.miss(point(1e-3, 0)) - axes.miss(point(-1e-3, 0))) / 2e-3
    by_time = (axes.miss(point(0, 0.2)) - axes.miss(point(0, -0.2))) / 0.4
    wanted = {"dL_dbeta": by_beta[0], "dD_dbeta": by_beta[1], "dL_dtn": by_time[0], "dD_dtn": by_time[1]}
    assert found == pytest.approx(wanted, rel=1e-4)
    assert found["dD_dtn"] > 0  # a later reversal from right to left lands farther to the right
    assert found["dL_dbeta"] < 0  # more bank, less lift upwards, less range


@compiled
@pytest.mark.parametrize(
    ("law", "name", "within", "p95", "largest"),
    [("paper", "density", 95.0, 1.2, 3.0), ("modern", "medium", 99.5, 0.25, 1.0), ("modern", "hard", 99.0, 0.5, 2.0)],
)
def test_dispersed_sets(capsys, law, name, within, p95, largest):
    found = answer(capsys, "--cases", "40", "--seed", "11", "--set", f"dispersions.set={name}", "--set", f"guidance.law={law}")
    assert found["landed"] == 40
    assert found["miss"]["within_1km"] >= within
    assert found["miss"]["p95_km"] <= p95
    assert found["miss"]["max_km"] <= largest
    assert found["peak_load_g"]["max"] <= 5.0
    assert found["outside_footprint"]["outside"] == 0


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_hundreds_of_cases_of_every_set(capsys, seed):
    bounds = {
        ("paper", "density"): (98.0, 1.2, 2.0), ("paper", "medium"): (93.0, 1.2, 3.0), ("modern", "medium"): (99.5, 0.25, 1.0),
        ("modern", "hard"): (99.0, 0.5, 2.0),
    }  # fmt: skip
    for (law, name), (within, p95, largest) in bounds.items():
        found = answer(capsys, "--cases", "300", "--seed", str(seed), "--set", f"dispersions.set={name}", "--set", f"guidance.law={law}")
        assert found["miss"]["within_1km"] >= within, (law, name)
        assert found["miss"]["p95_km"] <= p95
        assert found["miss"]["max_km"] <= largest
        assert found["peak_load_g"]["max"] <= 5.0
    slow = answer(capsys, "--cases", "300", "--seed", str(seed), "--set", "actuator.rate_deg_s=15")
    assert slow["miss"]["within_1km"] >= 98.5
    one = answer(capsys, "--cases", "300", "--seed", str(seed), "--set", "guidance.law=paper")
    assert 60.0 < one["miss"]["within_1km"] < 90.0  # the hard set is too much for one reversal


@compiled
@pytest.mark.parametrize(("change", "least", "most"), [("reference.path_angle_deg=-2.2", 5.0, 25.0), ("truth.lift_factor=0.7", 30.0, 80.0)])
def test_a_target_out_of_reach_is_said_aloud(capsys, change, least, most):
    told = land(capsys, "--set", change, "--json")
    found = json.loads(told.out)
    assert found["status"] == "OUTSIDE_FOOTPRINT"
    assert "outside the footprint" in told.err
    flown = np.hypot(found["flight"]["miss_downrange_m"], found["flight"]["miss_crossrange_m"])
    assert least < found["footprint"]["nearest_m"] / 1e3 < most
    assert found["footprint"]["nearest_m"] <= flown < 1.1 * found["footprint"]["nearest_m"]


@pytest.mark.parametrize("law", ["paper", "modern"])
def test_a_flight_that_skips_out_is_a_failed_case(capsys, law):
    skip = ("--set", "reference.path_angle_deg=-0.5", "--set", "reference.speed_m_s=12000", "--set", f"guidance.law={law}")
    told = land(capsys, *skip, "--json", code=3)
    found = json.loads(told.out)
    assert found["status"] == "STOP_NOT_REACHED"  # not NONFINITE: the prediction stays finite
    assert "footprint" not in found
    assert "case 0: STOP_NOT_REACHED" in told.err


@compiled
def test_the_nearest_point_is_never_farther_than_the_flight_itself():
    scenario = LandingScenario()
    set_up = flights.setting(scenario)
    case = flights.draw(scenario.edit({"truth.lift_factor": 0.7}), set_up, 1, name="none")
    for flown, status in ((np.array([300.0, -400.0]), "OK"), (np.array([-30e3, 0.0]), "OUTSIDE_FOOTPRINT")):
        distance, miss, told = flights.reach_of(set_up, case.x0[0], case.p[0], t_f=530.0, flown=flown)
        assert (miss == flown).all()
        assert distance == pytest.approx(np.hypot(*flown))
        assert told.name == status


def test_sensitivities_of_a_reversal_that_began_before_entry(capsys):
    """Of a reversal under way at entry only the bank angle of each moment moves with its time."""
    found = answer(capsys, "--reference", "--sensitivities", "--set", "reference.reversal_at_s=10")["sensitivities"]
    scenario = LandingScenario()
    set_up = flights.setting(scenario)

    def miss(at):
        moved = scenario.edit({"reference.reversal_at_s": at})
        return set_up.target.miss(flights.reference_flight(moved, set_up).x[-1, :3])

    wanted = (miss(10.1) - miss(9.9)) / 0.2
    assert [found["dL_dtn"], found["dD_dtn"]] == pytest.approx(wanted, rel=1e-4)


def test_sensitivities_need_a_landing():
    scenario = LandingScenario().edit({"vehicle.lift_to_drag": 1.5, "reference.bank_deg": 20})
    with pytest.raises(ModelError, match="does not land within"):
        flights.sensitivities(scenario, flights.setting(scenario))


def test_the_same_seed_draws_the_same_cases():
    scenario = LandingScenario()
    set_up = flights.setting(scenario)
    first, again, other = (flights.draw(scenario, set_up, 5, seed=s) for s in (4, 4, 5))
    assert (first.p == again.p).all()
    assert (first.x0 == again.x0).all()
    assert not (first.p == other.p).all()
    many = flights.draw(scenario, set_up, 4000)
    factor = many.p[:, set_up.truth.index("rho_factor")]
    assert 0.7 < factor.min() < 0.71
    assert 1.29 < factor.max() < 1.3
    assert factor.std() == pytest.approx(0.6 / np.sqrt(12), rel=0.03)


def test_scenario_round_trip_and_refusals(tmp_path, capsys):
    scenario = LandingScenario().edit({"guidance.law": "paper", "sensors.position_m": 100})
    path = tmp_path / "land.yaml"
    path.write_text(scenario.to_yaml(), encoding="utf-8")
    assert LandingScenario.load(path).to_dict() == scenario.to_dict()
    for key, value in (("guidance.law", "newest"), ("dispersions.set", "easy"), ("actuator.rate_deg_s", "0"), ("guidance.low", "paper")):
        with pytest.raises(ScenarioError):
            scenario.edit({key: value})
    assert "guidance.law" in land(capsys, "--set", "guidance.lw=paper", code=2).err
    assert "--reference" in land(capsys, "--sensitivities", code=2).err
    assert "reentry land --print-scenario" in land(capsys, str(tmp_path / "none.yaml"), code=2).err
    assert "step_s" in land(capsys, "--set", "numerics.step_s=1", code=2).err  # the servo would be unstable
    assert "--cases" in land(capsys, "--reference", "--cases", "5", code=2).err


def test_answer_is_written_and_shown(tmp_path, capsys):
    told = land(capsys, "--reference", "--out", str(tmp_path / "a"))
    assert "541.273" in told.out
    assert json.loads((tmp_path / "a" / "land.json").read_text(encoding="utf-8"))["flight"]["reversals"] == 1
    assert (tmp_path / "a" / "landing_bank.svg").read_text(encoding="utf-8").startswith("<svg")
    assert "reversal_at_s" in land(capsys, "--print-scenario").out
    land(capsys, "--cases", "3", "--out", str(tmp_path / "b"))
    assert {path.name for path in (tmp_path / "b").iterdir()} == {"land.json", "landing_miss.svg", "landing_trade.svg"}


@compiled
def test_benchmark_compares_equal_answers():
    rows = landing_benchmark.cycles(quick=True)
    assert rows[0]["error_m"] < 0.1
    assert rows[1]["error_m"] < 5.0
    assert max(row["error_of_derivatives"] for row in rows) < 1e-3


@pytest.mark.slow
@compiled
def test_study_reports_everything(monkeypatch):
    from studies import landing

    monkeypatch.setattr(landing, "CHANGES", landing.CHANGES[:1])
    monkeypatch.setattr(landing, "FROM", (0.0,))
    monkeypatch.setattr(landing, "WORST", 1)
    study = landing.run(cases=16)
    result = study.result()
    assert {item.name for item in result.figures} == {"landing_miss", "landing_share", "landing_footprint", "landing_bank", "landing_trade"}
    assert not result.failed
    assert result.data["best_profiles"][0]["best_km"] < 0.01
    assert result.data["best_profiles"][0]["replay_error_m"] < 1.0
    assert dataclasses.is_dataclass(result)
