"""Blending study: what must be shown on the STS-1 case, the loop against plain Python, counts from the record, command line."""

import json
import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy import stats

from allocation import blending
from models import ModelError
from models.checked import evaluate
from models.native import native_available
from ocp.pitch_law import rate_reference
from studies import blend, blend_design, blend_loop, blend_methods, cli
from studies.blend_tables import pulses

DEG = math.pi / 180
X0 = np.array(list(blend_design.START.values()))


@pytest.fixture(scope="module")
def study():
    return blend.run()


@pytest.fixture(scope="module")
def loop(study):
    return study.loop


def test_nominal_flight(study):
    found = study.to_dict()
    assert found["tracking"]["rms_deg"] <= 0.25
    assert found["tracking"]["max_deg"] <= 0.7
    assert found["tracking"]["steady_deg"] < 0.2
    assert 64 <= found["events"]["q1_s"] <= 67
    assert 77 <= found["events"]["q2_s"] <= 79.5
    assert 3.8 <= found["loads"]["peak_g"] <= 4.3
    assert 20 <= found["rcs"]["pulses"] <= 170
    assert 8 <= found["rcs"]["propellant_kg"] <= 45
    assert found["rcs"]["pulses_above_q2"] == 0
    assert found["rcs"]["sign_alternations"] == 0
    assert not found["authority"]["out_of_authority"]
    assert study.remarks == ()
    json.dumps(found, allow_nan=False)


def test_counts_are_those_of_the_record(study):
    flight, found = study.flight, study.to_dict()
    t, dt = flight["t"], 0.01
    error = (flight["alpha"] - flight["alpha_cmd"]) / DEG
    after = t > 10 - 1e-6
    assert len(t) == 30000
    np.testing.assert_allclose(t, dt * np.arange(30000), atol=1e-9)
    assert found["tracking"]["rms_deg"] == pytest.approx(np.sqrt(np.mean(error[after] ** 2)), rel=1e-9)
    assert found["tracking"]["max_deg"] == pytest.approx(np.abs(error[after]).max(), rel=1e-12)
    assert found["tracking"]["steady_deg"] == pytest.approx(abs(error[t > 240 - 1e-6].mean()), rel=1e-9)
    jets = flight["jets"][::6]
    assert np.array_equal(np.repeat(jets, 6), flight["jets"])  # held for a cycle
    starts = np.flatnonzero((jets != 0) & (jets != np.concatenate([[0], jets[:-1]])))
    qbar = flight["qbar"][::6][starts]
    rcs = found["rcs"]
    assert rcs["pulses"] == len(starts)
    assert [rcs["pulses_below_q1"], rcs["pulses_between"], rcs["pulses_above_q2"]] == [
        (qbar < 1000).sum(), ((qbar >= 1000) & (qbar <= 2500)).sum(), (qbar > 2500).sum(),
    ]  # fmt: skip
    assert rcs["highest_pulse_pa"] == pytest.approx(qbar.max())
    assert rcs["propellant_kg"] == pytest.approx(np.abs(jets).sum() * 0.06 * 6 * 3870 / (289 * 9.80665), rel=1e-9)
    moved = np.abs(np.diff(np.append(flight["delta_e"], study.flight.end["delta_e"]))) / DEG
    assert found["elevon"]["travel_deg"] == pytest.approx(moved.sum(), rel=1e-9)
    assert found["elevon"]["max_rate_deg_s"] == pytest.approx(moved.max() / dt, rel=1e-9)
    assert found["loads"]["peak_g"] == pytest.approx(flight["load"].max())
    for name, level in (("q1_s", 1000.0), ("q2_s", 2500.0)):
        i = np.argmax(flight["qbar"] >= level)
        assert found["events"][name] == pytest.approx(np.interp(level, flight["qbar"][i - 1 : i + 1], t[i - 1 : i + 1]), abs=1e-9)
    fired = pulses(flight)
    assert len(fired) == rcs["pulses"]
    assert fired[:, 1].sum() == pytest.approx(np.abs(flight["jets"]).sum() * dt)
    quiet = fired[(fired[:, 0] > 42) & (fired[:, 0] < found["events"]["q1_s"])]
    assert len(set(quiet[:, 2])) == 1


def by_hand(loop, x0, p, cycles, *, start=0):
    """The same loop written out in Python with the modulator's and the allocator's NumPy forms, from rest."""
    model, dt = loop.model, loop.settings.control_s
    out = {v.name: i for i, v in enumerate(model.outputs)}
    x, z, trim, control, jets = x0.copy(), loop.modulator.init(), 0.0, 0.0, 0.0
    params, stress = p[: len(model.params)], p[len(model.params)]
    mach = evaluate(model.out, x, np.zeros(4), params)[0][out["mach"]]
    before, rows = float(loop.command(0.0, mach, 0.0)), []
    S, c, Iyy = loop.vehicle.area, loop.vehicle.chord, loop.vehicle.Iyy
    for k in range(6 * cycles):
        u = np.array([trim + control, loop.settings.body_flap, jets > 0, jets < 0], dtype=float)
        y = evaluate(model.out, x, u, params)[0]
        qbar, mach, alpha = (y[out[n]] for n in ("qbar", "mach", "alpha"))
        command = float(loop.command(k * dt, mach, stress))
        if k % 6 == 0:
            K = [float(np.asarray(v).item()) for v in loop.gains.at(np.array(mach), np.array(qbar))]
        wanted = rate_reference((command - before) / dt, y[out["gamma_dot"]], x[0], x[1], 6371e3 + x[2])
        v = -K[0] * (alpha - command) - K[1] * (x[5] - float(wanted))
        slope = qbar * S * c * min(float(loop.aero.elevon_slope(mach, alpha, trim + control)), -1e-3)
        demand = Iyy * v / slope
        control, share = (float(a) for a in blending.share_arrays(demand, qbar, trim))
        if k % 6 == 0:
            moment = share * slope * demand
            duty = moment / loop.jets.moment_up if moment > 0 else -moment / loop.jets.moment_down
            z, jets = loop.modulator.step(z, min(max(duty, -1.0), 1.0))
            jets = float(jets)
        rows.append([*x, trim, control, demand, jets])
        u = np.array([trim + control, loop.settings.body_flap, jets > 0, jets < 0], dtype=float)
        k1 = evaluate(model.rhs, x, u, params)[0]
        k2 = evaluate(model.rhs, x + dt / 2 * k1, u, params)[0]
        k3 = evaluate(model.rhs, x + dt / 2 * k2, u, params)[0]
        k4 = evaluate(model.rhs, x + dt * k3, u, params)[0]
        if qbar > 300:
            slow = slope * max(qbar, 1000.0) / qbar
            trim += dt * (-K[2] * (alpha - command) * Iyy / slow)
        trim = min(max(trim, -33 * DEG), 18 * DEG)
        x, before = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), command
    return np.array(rows)


def test_the_loop_is_the_plain_one(loop):
    # first in thin air, then inside the blending window (started low and slow enough for the trim and the hand-over to work)
    low = dict(zip(blend_design.START, X0, strict=True)) | {"h": 52e3, "theta": 0.1, "gamma": -0.02, "delta_e": -0.1}
    names = ["V", "gamma", "h", "s", "theta", "q", "delta_e", "delta_bf", "trim", "control", "demand", "jets"]
    for x0, changes in ((X0, {}), (np.array(list(low.values())), {"Cm_factor": 1.1, "wind_factor": 0.7, "cg_aft": 0.03})):
        p = loop.parameters(changes)
        wanted = by_hand(loop, x0, p, 20)
        short = replace(loop, settings=replace(loop.settings, duration_s=1.2, transient_s=0.0))
        flight = blend_loop.fly(short, x0, p)
        found = np.column_stack([flight[n] for n in names])
        scale = np.abs(wanted).max(axis=0) + 1e-9
        np.testing.assert_allclose(found / scale, wanted / scale, atol=1e-9)
        assert np.abs(wanted[:, -1]).max() == 1.0
    assert np.abs(wanted[:, 9]).max() > 0.01  # the elevon's control term took part
    assert np.abs(wanted[:, 8]).max() > 1e-4  # and the trim


@pytest.mark.parametrize("sign", [1, -1])
def test_stress_case(sign):
    found = blend.run(changes={"stress": sign * 2 * DEG}).to_dict()
    assert found["tracking"]["max_deg"] < 1.5
    assert found["rcs"]["pulses_between"] >= 10
    assert found["rcs"]["highest_pulse_pa"] < 1.2 * 2500
    assert found["elevon"]["max_rate_deg_s"] <= 20 * (1 + 1e-9)


def test_stress_command_is_the_published_form():
    command = blend_design.alpha_command()
    t = np.linspace(60, 90, 301)
    added = np.array([float(command(s, 6.3, 2 * DEG)) - float(command(s, 6.3, 0.0)) for s in t]) / DEG
    s = np.clip((t - 66) / 14, 0, 1)
    np.testing.assert_allclose(added, 2 * np.sin(2 * np.pi * s) * np.sin(np.pi * s) ** 2 / 0.65, atol=1e-9)
    assert np.abs(added).max() == pytest.approx(2.0, rel=1e-2)
    for mach, alpha in ((6.5, 35), (6, 35), (5, 28), (3, 15), (2.5, 12)):
        assert float(command(100.0, mach, 0.0)) / DEG == pytest.approx(alpha, rel=1e-9)
    assert float(command(0.0, 6.9, 0.0)) / DEG == pytest.approx(5)
    assert float(command(20.0, 6.9, 0.0)) / DEG == pytest.approx(20)


@pytest.mark.slow
def test_single_dispersions():
    found = blend.run(singles=True)
    corner = found.singles["Cm +20 %, elevon -20 %"]
    for name, numbers in found.singles.items():
        if numbers is corner or "stress" in name:
            continue
        assert numbers.max_deg < 0.7, name
        assert numbers.pulses_above_q2 == 0, name
        assert not numbers.out_of_authority, name
    assert corner.out_of_authority
    assert corner.max_deg > 1.5
    lost = [remark for remark in found.remarks if "out of authority" in remark]
    assert [remark.split(":")[0] for remark in lost] == ["Cm +20 %, elevon -20 %"]
    data = found.to_dict()
    assert data["singles"]["Cm +20 %, elevon -20 %"]["authority"]["out_of_authority"] is True


def test_the_corner_is_reported():
    found = blend.run(changes={"Cm_factor": 1.2, "elevon_factor": 0.8})
    assert found.numbers.out_of_authority
    assert "out of authority" in found.remarks[0]
    assert found.to_dict()["remarks"]


@pytest.mark.parametrize("jets", [2, 4])
def test_fewer_jets(jets):
    flown = blend.run(jets=jets)
    found, fired = flown.to_dict(), pulses(flown.flight)
    assert found["tracking"]["max_deg"] < 0.7
    assert found["rcs"]["pulses_above_q2"] == 0
    assert found["rcs"]["pulses"] == len(fired)
    assert fired[:, 1].max() > 0.1  # pulses of several cycles count once
    burnt = jets * 0.01 * np.abs(flown.flight["jets"]).sum() * 3870 / (289 * 9.80665)
    assert found["rcs"]["propellant_kg"] == pytest.approx(burnt, rel=1e-9)


def test_the_quadratic_program_flies_the_same(study):
    other = blend.run(method="qp")
    assert other.numbers.pulses == study.numbers.pulses
    for name in ("alpha", "delta_e", "trim"):
        np.testing.assert_allclose(other.flight[name], study.flight[name], atol=1e-7)


def test_the_redistributed_pseudo_inverse():
    function = blend_methods.allocator("pinv")
    slope, up, down = -1e6, 267e3, -253e3
    rng = np.random.default_rng(1)
    for _ in range(300):
        demand, qbar, trim = rng.uniform(-0.6, 0.6), rng.uniform(0, 4000), rng.uniform(-0.5, 0.2)
        elevon, duty, share = (float(v) for v in function(demand, qbar, trim, slope, up, down, 0.0))
        k = np.clip((qbar - 1000) / 1500, 0, 1)
        low, high = max(k * -33 * DEG, -33 * DEG - trim), min(k * 18 * DEG, 18 * DEG - trim)
        jets = 0.0 if qbar > 2500 else (up if demand < 0 else -down)
        assert low - 1e-12 <= elevon <= high + 1e-12
        assert abs(duty) <= 1 + 1e-12
        wanted, reach = slope * demand, abs(slope) * (-low if demand < 0 else high)
        got = slope * elevon + duty * (up if duty > 0 else -down)
        assert got == pytest.approx(np.sign(wanted) * min(abs(wanted), reach + jets), rel=1e-9)
        ideal = abs(wanted) * reach**2 / (reach**2 + jets**2) if reach + jets > 0 else 0.0
        if ideal <= reach and abs(wanted) - ideal <= jets:  # nobody at a limit: shares by the squares of the limits
            assert slope * elevon == pytest.approx(np.sign(wanted) * ideal, rel=1e-9, abs=1e-9)
        assert share == pytest.approx(abs(duty) * (up if demand < 0 else -down) / abs(wanted), rel=1e-9, abs=1e-12)


def test_methods_are_compared_over_the_same_flights():
    rng = np.random.default_rng(2)
    base = {name: rng.uniform(1, 2, 40) for name in blend.Figures.__dataclass_fields__} | {"trim_at_limit_s": np.zeros(40)}
    other = base | {"propellant_kg": base["propellant_kg"] + 1.0}
    found = blend_methods.MethodComparison({"a": blend.Figures(**base), "b": blend.Figures(**other)}, np.arange(40) < 30)
    mean, half = found.interval("a", "rms_deg")
    values = base["rms_deg"][:30]
    low, high = stats.t.interval(0.95, 29, loc=values.mean(), scale=stats.sem(values))
    assert (mean - half, mean + half) == pytest.approx((low, high), rel=1e-9)
    assert found.difference("b", "a", "propellant_kg") == pytest.approx((1.0, 0.0), abs=1e-12)
    assert found.to_dict()["kept"] == 30
    assert [row[0] for row in found.table().rows] == ["a", "b"]
    differences = found.to_dict()["differences"]
    assert differences["from"] == "a"
    data = differences["methods"]
    assert list(data) == ["b"]
    assert data["b"]["propellant_kg"]["mean"] == pytest.approx(1.0)
    assert data["b"]["rms_deg"] == {"mean": 0.0, "half_width": 0.0}
    (row,) = found.differences().rows
    assert list(row[:2]) == ["b", "0 ± 0"]
    assert str(row[4]).startswith("1 ± ")
    with pytest.raises(ModelError, match="cases"):
        blend_methods.compare(cases=1)
    with pytest.raises(ModelError, match="magic"):
        blend_methods.compare(("magic",), cases=2)


@pytest.mark.slow
def test_comparison_of_flown_methods():
    found = blend_methods.compare(("paper", "qp", "pinv"), cases=12, seed=3)
    assert found.kept.sum() >= 10
    for name in ("rms_deg", "propellant_kg", "pulses"):
        assert found.difference("qp", "paper", name)[0] == pytest.approx(0.0, abs=1e-4)
    assert found.difference("pinv", "paper", "propellant_kg")[0] >= 0  # shares what the elevon could do alone


def test_the_literal_logic_can_fire_above_q2():
    # 1 deg of demand at full authority is the elevon's alone; 0.25 deg is also given to the jets by half unless they are inhibited
    ends = {}
    for name in ("paper", "literal"):
        elevon, duty, share = blend_methods.allocator(name)(0.25 * DEG, 3000.0, -0.1, -1e6, 267e3, -253e3, 0.0)
        assert float(elevon) == pytest.approx(0.25 * DEG)
        ends[name] = float(share), float(duty)
    assert ends["paper"] == (0.0, 0.0)
    assert ends["literal"][0] == pytest.approx(0.5)
    assert ends["literal"][1] == pytest.approx(0.5 * -1e6 * 0.25 * DEG / 253e3)


@pytest.mark.skipif(not native_available(), reason="no C compiler")
def test_compiled_and_interpreted_are_equal(loop):
    short = replace(loop, settings=replace(loop.settings, duration_s=24.0))
    p = np.stack([short.parameters({"Cm_factor": f, "wind_factor": f}) for f in (0.9, 1.0, 1.1)])
    plain = [blend_loop.fly(short, X0, row) for row in p]
    many = blend_loop.fly_many(short, X0, p)
    assert many["finite"].all()
    for name in short.carry:
        np.testing.assert_allclose(many[name], [f.end[name] for f in plain], rtol=1e-12, atol=1e-13, err_msg=name)
    compiled = blend_loop.fly(short, X0, p[1], compiled=True)
    np.testing.assert_allclose(compiled.record, plain[1].record, rtol=1e-12, atol=1e-12)


def test_statistics_name_the_lost_flights():
    values = {name: np.arange(4.0) for name in blend.Figures.__dataclass_fields__}
    values |= {"trim_at_limit_s": np.array([0.0, 0.2, 7.0, 0.0]), "outside_tables_s": np.array([0.0, 0.0, 3.0, 0.01])}
    found = blend.ensemble_statistics(blend.Figures(**values))
    assert (found["cases"], found["out_of_authority"], found["outside_tables"], found["lost"]) == (4, 1, 2, [2, 3])
    assert found["max_deg"] == {"median": 0.5, "p95": pytest.approx(0.95), "max": 1.0}
    assert found["slower_than_mach_2"] == 3
    values["outside_tables_s"] = np.ones(4)
    assert "max_deg" not in blend.ensemble_statistics(blend.Figures(**values))


def test_a_flight_that_leaves_the_tables_says_so():
    found = blend.run(changes={"theta": -4 * DEG, "wind_factor": 0.0}, settings=replace(blend_loop.LoopSettings(), duration_s=30.0))
    assert found.numbers.outside_tables
    assert 0 < found.to_dict()["tables"]["alpha_outside_s"] < 15
    assert any("aerodynamic tables" in remark for remark in found.remarks)


def test_a_flight_below_the_ground_says_so():
    short = replace(blend_loop.LoopSettings(), duration_s=30.0)
    found = blend.run(changes={"h": 3e3, "gamma": -0.5, "V": 600.0, "theta": -0.4}, settings=short)
    assert found.flight["h"].min() < 0
    assert any("below sea level" in remark for remark in found.remarks)


def test_many_flights_do_not_depend_on_their_number(loop):
    few, more = blend.dispersed(loop, 3, seed=5), blend.dispersed(loop, 9, seed=5)
    np.testing.assert_array_equal(few, more[:3])
    assert not np.array_equal(few, blend.dispersed(loop, 3, seed=6))
    j = loop.params.index("wind_factor")
    assert 0.5 <= more[:, j].min() < more[:, j].max() <= 1.5
    assert (more[:, loop.params.index("mass")] == loop.model.p0[0]).all()


def test_gains_lie_on_their_schedule(study, loop):
    residual, abscissa = loop.gains.riccati_residual, loop.gains.abscissa
    assert residual < 1e-10
    assert abscissa < -0.1
    # between the nodes of the grid, gains must still hold the short period that they are used for
    flight = study.flight
    for i in range(4200, 30000, 1200):
        x = np.array([flight[v.name][i] for v in loop.model.states])
        from ocp import linearize
        from ocp.pitch_law import short_period

        A = short_period(linearize(loop.model, x=x, u=np.zeros(4)))[0]
        K = [flight[n][i] for n in ("K_alpha", "K_q", "K_integral")]
        closed = np.array([[A[0, 0], A[0, 1], 0.0], [A[1, 0] - K[0], A[1, 1] - K[1], -K[2]], [1.0, 0.0, 0.0]])
        assert np.linalg.eigvals(closed).real.max() < -0.1


def test_refusals(loop):
    for arguments, text in (
        ({"method": "magic"}, "magic"), ({"jets": 5}, "count"), ({"changes": {"Cm_facto": 1.0}}, "Cm_factor"), ({"cases": -1}, "cases"),
        ({"changes": {"Cm_factor": math.nan}}, "Cm_factor"), ({"changes": {"h": -5e4}}, "h"),
        ({"changes": {"wind_factor": 100.0}}, "wind_factor"),
    ):  # fmt: skip
        with pytest.raises(ModelError, match=text):
            blend.run(**arguments)
    with pytest.raises(ModelError, match="modulator samples"):
        replace(loop, modulator=replace(loop.modulator, Ts=0.05))
    for settings in ({"duration_s": 5.0}, {"duration_s": 30.05}, {"steps": 0}):
        with pytest.raises(ModelError, match="LoopSettings"):
            replace(loop.settings, **settings)
    x = ca.SX.sym("x")
    with pytest.raises(ModelError, match="allocator takes"):
        replace(loop, allocator=ca.Function("wrong", [x], [x, x, x]))


def test_result_for_the_report(study):
    result = study.result()
    assert [f.name for f in result.figures] == ["blend_flight", "blend_window", "blend_trim", "blend_gains"]
    assert result.comparisons[0].met
    assert len(result.figures[0].figure.axes) == 10
    assert set(study.figures()) == {f.name for f in result.figures}


def test_command_line(capsys, tmp_path):
    assert (
        cli.main(["blend", "--json", "--method", "qp", "--stress", "-2", "--set", "wind_factor=0.8", "--out", str(tmp_path / "out")]) == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert set(found) >= {"tracking", "rcs", "elevon", "loads", "events"}
    assert set(found["tracking"]) == {"rms_deg", "max_deg", "steady_deg"}
    assert set(found["rcs"]) >= {"pulses", "propellant_kg", "pulses_below_q1", "pulses_between", "pulses_above_q2"}
    assert set(found["elevon"]) == {"travel_deg", "max_rate_deg_s"}
    assert found["changes"] == {"wind_factor": 0.8, "stress": pytest.approx(-2 * DEG)}
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {"blend.json", "blend_flight.svg", "blend_window.svg"}


def test_command_line_table_and_refusals(capsys):
    assert cli.main(["blend", "--set", "Cm_factor=1.2", "--set", "elevon_factor=0.8"]) == 0
    shown = capsys.readouterr()
    assert "propellant" in shown.out
    assert "out of authority" in shown.err
    for arguments in (["--set", "Cm_factor"], ["--method", "magic"], ["--jets", "3"], ["--q1", "3000"], ["--stress", "nan"],
                      ["--stress", "1e9"], ["--stress", "2", "--set", "stress=0.01"], ["--set", "h=7e4", "--set", "h=8e4"]):  # fmt: skip
        assert cli.main(["blend", *arguments]) == 2, arguments
        shown = capsys.readouterr()
        assert not shown.out
        assert "Traceback" not in shown.err
        assert shown.err.strip()
