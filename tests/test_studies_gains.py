"""The gain study: printed numbers, two routes, an independent integration, and dispersed flights."""

import json
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import models
from ocp import linearize
from ocp.schedule import Schedule
from studies import gains, guidance, schedules, synthesis
from studies.scenario import Scenario

OTHER = {
    "vehicle.lift_to_drag": 0.3, "reference.bank_deg": 60, "reference.path_angle_deg": -1.6, "reference.altitude_m": 120000,
}  # fmt: skip


@pytest.fixture(scope="module")
def study() -> gains.GainsStudy:
    return gains.run(Scenario.default(), dispersions=60)


def test_reference_n1(study: gains.GainsStudy) -> None:
    found = study.to_dict()["reference"]
    wanted = {"t_f_s": 547.064, "range_m": 2720773, "peak_axial_g": 3.3145, "peak_load_g": 3.4165, "peak_time_s": 402.3}
    for key, value in wanted.items():
        assert found[key] == pytest.approx(value, rel=2e-4), key


def test_time_means_meet_the_printed_constants(study: gains.GainsStudy) -> None:
    printed = {"K1": -0.62, "K2": -1.5e-3, "K3a": -5.2e-6, "K3b": -2.2e-5, "K4": -7.5e-4}
    assert study.time_mean == pytest.approx(printed, rel=0.03)


def test_certificate(study: gains.GainsStudy) -> None:
    proof = study.certificate()
    assert proof["riccati_residual"] < 1e-8
    assert proof["riccati_residual_state_route"] < 1e-8
    assert proof["routes_difference"] < 1e-5
    assert proof["terminal_gain_error"] < 1e-12
    assert proof["min_eig_S"] >= 0


def independent_gains(s: Scenario, times: np.ndarray) -> np.ndarray:
    """K(t) by one adaptive backward integration of reference and P in state coordinates, with differences for Jacobians."""
    mu, R0 = s.planet.gravitational_parameter_m3_s2, s.planet.radius_m
    BC, u = s.vehicle.ballistic_coefficient_kg_m2, s.vehicle.lift_to_drag * math.cos(math.radians(s.reference.bank_deg))

    def drag(x):  # m/s2
        return s.atmosphere.surface_density_kg_m3 * np.exp(-x[2] / s.atmosphere.scale_height_m) * x[0] ** 2 / (2 * BC)

    def f(x, u):
        V, gamma, h, _ = x
        r, D = R0 + h, drag(x)
        g = mu / r**2
        return np.array(
            [-D - g * np.sin(gamma), u * D / V + (V / r - g / V) * np.cos(gamma), V * np.sin(gamma), R0 * V * np.cos(gamma) / r]
        )

    def measured(x):
        return np.array([-drag(x) / 9.80665, x[0] * np.sin(x[1]), x[3], R0 * x[0] * np.cos(x[1]) / (R0 + x[2])])

    def jacobian(function, x):  # complex step: exact to rounding
        columns = []
        for i in range(4):
            z = x.astype(complex)
            z[i] += 1e-30j
            columns.append(function(z).imag / 1e-30)
        return np.array(columns).T

    x0 = np.array([s.reference.speed_m_s, math.radians(s.reference.path_angle_deg), s.reference.altitude_m, 0.0])

    def landed(_t, x):
        return x[2] - s.reference.stop_altitude_m

    landed.terminal = True
    flight = solve_ivp(lambda _t, x: f(x, u), (0, 3000), x0, "DOP853", rtol=1e-12, atol=1e-12, events=landed)
    end = flight.y[:, -1]
    Q, F = np.diag(1 / np.square(s.weights.state)), np.diag(1 / np.square(s.weights.terminal))
    R = 1 / s.weights.control**2
    M = jacobian(measured, end)

    def b(x):
        return np.array([0.0, drag(x) / x[0], 0.0, 0.0])

    def backward(_t, z):
        x, P = z[:4], z[4:].reshape(4, 4)
        A, m = jacobian(lambda y: f(y, u), x), jacobian(measured, x)
        Pb = P @ b(x)
        return np.concatenate([f(x, u), (-P @ A - A.T @ P + np.outer(Pb, Pb) / R - m.T @ Q @ m).ravel()])

    start = np.concatenate([end, (M.T @ F @ M).ravel()])
    scale = np.concatenate([[1e3, 0.1, 1e4, 1e6], (np.outer(d := np.array([1e3, 0.1, 1e4, 1e5]), d) ** -1).ravel() * 1e4])
    back = solve_ivp(backward, (flight.t[-1], 0), start, "DOP853", rtol=1e-9, atol=1e-11 * np.abs(scale), dense_output=True)
    rows = []
    for t in times:
        z = back.sol(t)
        K = -(b(z[:4]) @ z[4:].reshape(4, 4)) / R
        rows.append(np.linalg.solve(jacobian(measured, z[:4]).T, K))
    return np.array(rows)


@pytest.mark.parametrize("changes", [{}, OTHER], ids=["N1", "other"])
def test_an_independent_integration_confirms_the_gains(changes: dict) -> None:
    scenario = Scenario.default().edit(changes)
    times = np.array([0.0, 50.0, 100.0, 200.0, 300.0, 400.0, 450.0, 500.0, 530.0])
    found = np.array(list(gains.run(scenario, at=times).to_dict()["K"].values())).T
    wanted = independent_gains(scenario, times)
    largest = np.abs(wanted).max(axis=0)  # near its zero crossing a gain is compared with its own size
    np.testing.assert_allclose(found / largest, wanted / largest, rtol=1e-4, atol=1e-7)


def test_leaving_out_the_rate_of_the_map_changes_k1(study: gains.GainsStudy) -> None:
    # the total derivative of M matters by a factor of about three (a known trap of the method)
    from dataclasses import replace

    from ocp import transform, tvlqr

    s = study.synthesis
    frozen_map = replace(s.to, Mdot=np.zeros_like(s.to.Mdot))
    Q, R, F = synthesis.weights(study.scenario)
    wrong = -tvlqr(transform(linearize(s.reference), frozen_map), Q=Q, R=R, Qf=F).K[:, 0]
    ratio = np.trapezoid(wrong[:, 0], s.reference.t) / np.trapezoid(s.K[:, 0], s.reference.t)
    assert not 0.5 < ratio < 2


def test_closed_loops_are_ordered_as_published(study: gains.GainsStudy) -> None:
    small, large = study.closed_loop["small"], study.closed_loop["large"]
    assert study.failed == []
    assert small["time_varying"].rms < 0.3
    assert large["time_varying"].rms < 0.8
    assert small["paper"].rms == pytest.approx(0.6, rel=0.25)
    assert small["open_loop"].rms == pytest.approx(60, rel=0.3)
    assert large["open_loop"].rms == pytest.approx(130, rel=0.3)
    for flights in study.closed_loop.values():
        assert flights["time_varying"].rms < flights["least_squares"].rms < 0.7 * flights["paper"].rms
        assert flights["time_varying"].rms < flights["paper"].rms < flights["paper_unsplit"].rms < flights["open_loop"].rms


def test_a_case_is_the_same_whatever_the_number_of_cases() -> None:
    s = synthesis.synthesize(Scenario.default(), synthesis.build_reference(Scenario.default()))
    widths = {"gamma": 1e-3, "V": 10.0, "density": 0.1, "drag": 0.05, "lift": 0.05, "wave_amplitude": 0.1, "wave_length": 3e4}
    few, many = (
        guidance.dispersed_cases(s.reference.model, s.reference.x[0], widths, cases=n, seed=(1, 2)) for n in (3, 50)
    )  # fmt: skip
    np.testing.assert_array_equal(few[0], many[0][:3])
    np.testing.assert_array_equal(few[1], many[1][:3])
    other = guidance.dispersed_cases(s.reference.model, s.reference.x[0], widths, cases=3, seed=(1, 3))
    assert not np.array_equal(few[0], other[0])


def test_without_dispersion_every_schedule_flies_the_reference() -> None:
    scenario = Scenario.default()
    s = synthesis.synthesize(scenario, synthesis.build_reference(scenario))
    onward = guidance.continued(s.reference, 0.5)
    none = dict.fromkeys(("gamma", "V", "density", "drag", "lift", "wave_amplitude"), 0.0) | {"wave_length": 3e4}
    cases = guidance.dispersed_cases(s.reference.model, s.reference.x[0], none, cases=1, seed=(0, 0))
    for name, plan in schedules.plans(scenario, s, onward)[0].items():
        law = guidance.guidance_law(onward, plan, sample=1.0, limit=0.25, gate=0.05, name=name)
        miss = guidance.fly(law, s.reference, cases, stop_altitude=1e4, t_max=900.0, step=0.5)
        assert miss.worst < 1e-3, name  # km; RK4 against RK8


def test_the_command_is_the_papers_law(study: gains.GainsStudy) -> None:
    s = study.synthesis
    onward = guidance.continued(s.reference, 0.5)
    K = np.array([[-0.5, -1e-3, -1e-5, -5e-4]])
    law = guidance.guidance_law(onward, Schedule(guidance.MEASURED, np.zeros(0), K, 0.0), sample=1.0, limit=0.25, gate=0.05, name="test")
    model, t = s.reference.model, np.array([20.0, 300.0, 300.0])
    x = onward.at(t).x + np.array([[30.0, 1e-3, 200.0, 500.0], [30.0, 1e-3, 200.0, 500.0], [3000.0, 0.02, -9000.0, 5e5]])
    found = guidance.commands(law, model, t, x, model.p0)[:, 0]

    def measured(x):
        y = model.y(x, np.zeros((len(x), 1)))
        return np.column_stack([y[:, 0], y[:, 2], x[:, 3], y[:, 3]])

    u_ref = 0.25 * math.cos(math.pi / 4)
    wanted = u_ref + ((measured(x) - measured(onward.at(t).x)) @ K[0])
    assert measured(x)[0, 0] > -0.05  # below the gate: the reference command
    assert found[0] == pytest.approx(u_ref, rel=1e-12)
    assert found[1] == pytest.approx(wanted[1], rel=1e-6)
    assert abs(wanted[2]) > 0.25
    assert abs(found[2]) == 0.25  # saturated


def test_a_case_that_fails_is_reported_and_the_others_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = Scenario.default()
    s = synthesis.synthesize(scenario, synthesis.build_reference(scenario))
    none = dict.fromkeys(("gamma", "V", "density", "drag", "lift", "wave_amplitude"), 0.0) | {"wave_length": 3e4}
    states, params = guidance.dispersed_cases(s.reference.model, s.reference.x[0], none, cases=3, seed=(0, 0))
    states[1, 1] = 0.2  # climbs away
    params[2, s.reference.model.index("rho_factor")] = 1e9
    law = guidance.guidance_law(
        guidance.continued(s.reference, 0.5), guidance.interpolated(s.reference.t, s.K), sample=1.0, limit=0.25, gate=0.05, name="k"
    )  # fmt: skip
    miss = guidance.fly(law, s.reference, (states, params), stop_altitude=1e4, t_max=900.0, step=0.5)
    assert [number for number, _ in miss.failed] == [1, 2]
    assert "STOP_NOT_REACHED" in miss.failed[0][1]
    assert "OUT_OF_DOMAIN" in miss.failed[1][1]
    assert miss.cases.tolist() == [0]
    assert miss.worst < 1e-3


def test_sensitivities_against_resynthesis(study: gains.GainsStudy) -> None:
    table = study.sensitivity
    index = table.names.index("Q[s]")
    up, down = (
        gains.run(study.scenario.edit({"weights.state": [0.5, 750, 7500 * factor, 2000]})).synthesis.K for factor in (1 + 5e-5, 1 - 5e-5)
    )
    # the weight is 1/scale^2: d ln(weight) = -2 d ln(scale)
    wanted = (up - down) / (2 * -2 * 5e-5)
    found = -table.log_dK[index, :, 0]  # K of the paper is the negative of the workbench's
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max(axis=0).max(), rtol=1e-3)


def test_json_is_plain_and_complete(study: gains.GainsStudy) -> None:
    data = json.loads(json.dumps(study.to_dict(), allow_nan=False))
    assert set(data["closed_loop"]) == {"small", "large", "large_wave"}
    assert {"open_loop", "time_varying", "paper", "paper_unsplit"} <= set(data["closed_loop"]["small"])
    assert {"rms_km", "p95_km", "max_km"} <= set(data["closed_loop"]["small"]["paper"])
    assert len(data["t_s"]) == len(data["K"]["K1"])
    assert data["t_s"][0] == 0
    assert data["t_s"][-1] == pytest.approx(547.064, rel=1e-5)


def test_result_for_the_report(study: gains.GainsStudy) -> None:
    result = study.result()
    assert {f.name for f in result.figures} == {"gains", "misses", "reference", "sensitivity", "coordinates"}
    assert [row.met for row in result.comparisons if row.tolerance is not None] == [True] * 5


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"reference.path_angle_deg": -0.3, "reference.bank_deg": 0, "vehicle.lift_to_drag": 2.0}, "STOP_NOT_REACHED"),
        ({"reference.t_max_s": 100.0}, r"reference\.t_max_s"),
    ],
)
def test_a_reference_that_does_not_arrive_is_explained(changes: dict, text: str) -> None:
    with pytest.raises(models.ModelError, match=text):
        gains.run(Scenario.default().edit(changes))


@pytest.mark.parametrize("at", [[-1.0], [548.0], [], [math.nan]])
def test_bad_times_are_refused(at: list[float]) -> None:
    with pytest.raises(models.ModelError, match="at"):
        gains.run(Scenario.default(), at=at)


def test_tabulated_atmosphere_is_certified_too() -> None:
    study = gains.run(Scenario.default().edit({"atmosphere.model": "us76_smooth"}), at=[0.0])
    assert study.certificate()["riccati_residual"] < 1e-6
    assert study.certificate()["routes_difference"] < 1e-5


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"guidance.split_s": 20.0}, "breakpoints"),
        ({"reference.stop_altitude_m": 99990.0}, "gate_load_g"),
    ],
)
def test_a_fit_that_is_impossible_costs_only_itself(changes: dict, text: str) -> None:
    study = gains.run(Scenario.default().edit(changes), dispersions=3)
    assert set(study.closed_loop["small"]) == {"open_loop", "time_varying", "time_mean", "paper", "paper_unsplit"}
    assert any("no constants are fitted" in remark and text in remark for remark in study.remarks)


def test_fitted_constants_come_from_other_cases_above_the_gate(study: gains.GainsStudy) -> None:
    assert schedules.TRAINING_STREAM >= len(list(study.scenario.dispersions.sets.items()))
    s = study.synthesis
    onward = guidance.continued(s.reference, 0.5)
    low, high = (
        schedules.fitted(study.scenario.edit({"guidance.gate_load_g": gate}), s, onward) for gate in (0.05, 0.9)
    )  # fmt: skip
    assert not np.allclose(low.K, high.K, rtol=1e-2)


def test_an_infinite_condition_number_is_null_in_json() -> None:
    study = gains.run(Scenario.default().edit({"weights.terminal": [0.1, 250, 0.01, 500]}), at=[0.0])
    text = json.dumps(study.to_dict(), allow_nan=False)
    assert json.loads(text)["certificate"]["riccati_residual"] < 1e-6


def test_aims_that_are_missed_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthesis, "HALVINGS", 0)
    monkeypatch.setattr(synthesis, "DEFECT", 1e-12)
    study = gains.run(Scenario.default(), at=[0.0])
    assert "aim 1e-12" in study.remarks[0]
    assert study.to_dict()["remarks"] == list(study.remarks)


@pytest.mark.parametrize("bad", [2.5, True, -1])
def test_a_wrong_number_of_cases_is_refused(bad: object) -> None:
    with pytest.raises(models.ModelError, match="dispersions"):
        gains.run(Scenario.default(), dispersions=bad)


def test_flying_past_the_vertical_is_said() -> None:
    study = gains.run(Scenario.default().edit({"reference.bank_deg": 180, "reference.stop_altitude_m": 0}), at=[0.0])
    assert any("vertical" in remark for remark in study.remarks)
