"""Many flights at once: the same as one by one, failures kept apart, independent of how the work is cut."""

import math

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, Status, Var, define
from models.native import native_available
from ocp import flight

CAPSULE = models.Vehicle("capsule", 2900.0, 3.8, 0.35, 1.34)
STOP = ocp.falls_below("h", 15e3)


def cases(model, count=7):
    rng = np.random.default_rng(3)
    x0 = np.array([7600.0, -0.025, 9e4, 0.0]) + rng.uniform(-1, 1, (count, 4)) * [30.0, 0.003, 500.0, 100.0]
    p = np.tile(model.p0, (count, 1))
    p[:, model.index("rho_factor")] = rng.uniform(0.7, 1.3, count)
    return x0, p


def laws():
    def steer(t, x, y, z, w):
        return 0.1 - 2e-3 * (y[0] + 1) + 1e-3 * z[0] + w[0], z + 0.01 * x[1]

    table = ocp.sampled(steer, sample=3.0, memory=[0.2], signals=lambda start, end: 1e-4 * start[:, None], n_signals=1)
    return [ocp.constant(lift_ratio=0.15), ocp.profile([0, 150.3, 210.0], lift_ratio=[0.25, 0.1, 0.2]), table]


@pytest.mark.parametrize("law", laws(), ids=lambda law: law.name)
def test_equal_to_single_flights(law):
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model)
    many = ocp.simulate_ensemble(model, law, x0=x0, p=p, until=STOP)
    assert many.ok.all()
    for i in range(len(x0)):
        one = ocp.simulate(model, law, x0=x0[i], p=p[i], until=STOP)
        assert many.t[i] == pytest.approx(one.t[-1], rel=1e-12)
        assert many.x[i] == pytest.approx(one.x[-1], rel=1e-11)
    assert many["h"] == pytest.approx(np.full(7, 15e3), rel=1e-9)
    assert np.ptp(many["s"]) > 1e4  # the cases do differ


def test_how_the_work_is_cut_does_not_matter(monkeypatch):
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 11)
    law = laws()[2]
    whole = ocp.simulate_ensemble(model, law, x0=x0, p=p, until=STOP)
    for block, chunk in ((3, 64), (1, 5), (4096, 1), (4, 7)):
        monkeypatch.setattr(flight, "BLOCK", block)
        monkeypatch.setattr(flight, "CHUNK", chunk)
        cut = ocp.simulate_ensemble(model, law, x0=x0, p=p, until=STOP)
        assert np.array_equal(cut.t, whole.t)
        assert np.array_equal(cut.x, whole.x)
    order = np.random.default_rng(0).permutation(11)
    shuffled = ocp.simulate_ensemble(model, law, x0=x0[order], p=p[order], until=STOP)
    assert np.array_equal(shuffled.x, whole.x[order])


def test_cases_beyond_the_block_size_are_flown(monkeypatch):
    monkeypatch.setattr(flight, "BLOCK", 4)
    model = define("fall", lambda x, u, p: {"h": -p.rate}, states=[Var("h", "m", 1.0)], params={Var("rate"): 1.0})
    rates = np.linspace(0.5, 2.0, 10)
    seen = []
    many = ocp.simulate_ensemble(
        model, ocp.constant(), x0=[1.0], p=rates[:, None], until=ocp.falls_below("h", 0.25), t_max=5.0, progress=seen.append
    )  # fmt: skip
    assert many.t == pytest.approx(0.75 / rates, rel=1e-12)
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)


def test_failed_cases_are_named_and_the_others_stand():
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 6)
    good = ocp.simulate_ensemble(model, ocp.constant(lift_ratio=0.15), x0=x0, p=p, until=STOP, t_max=700.0)
    x0[1, 1] = 1.4  # steeper than the model allows
    p[2, model.index("rho_factor")] = 50.0
    x0[3, 2] = 14e3  # past the stop
    x0[4, :2] = 11000.0, 0.1  # leaves
    many = ocp.simulate_ensemble(model, ocp.constant(lift_ratio=0.15), x0=x0, p=p, until=STOP, t_max=700.0)
    wanted = [Status.OK, Status.OUT_OF_DOMAIN, Status.OUT_OF_DOMAIN, Status.OUT_OF_DOMAIN, Status.STOP_NOT_REACHED, Status.OK]
    assert list(many.status) == wanted
    assert [i for i, _ in many.failures()] == [1, 2, 3, 4]
    assert many.failures()[3][1].startswith("STOP_NOT_REACHED: ")
    assert many.t[1:5].tolist() == [0.0, 0.0, 0.0, 700.0]
    for i in (0, 5):
        assert np.array_equal(many.x[i], good.x[i])


@pytest.mark.parametrize("method", [ocp.RK8(step=0.1), ocp.Adaptive(step=0.1)])
def test_a_case_that_blows_up_does_not_spoil_the_rest(method):
    """a' = p a^2 from 1 is 1/(1 - p t): no solution beyond t = 1/p; the output log(4 - a) ends at a = 4."""
    model = define(
        "blow", lambda x, u, p: {"a": p.k * x.a**2}, states=[Var("a")], params={Var("k"): 1.0}, outputs=[Var("left")],
        out=lambda x, u, p: {"left": ca.log(4 - x.a)},
    )  # fmt: skip
    k = np.array([[0.1], [5.0], [-0.5], [0.2]])
    many = ocp.simulate_ensemble(model, ocp.constant(), x0=[1.0], p=k, t_max=2.0, method=method)
    good = [0, 2, 3]
    assert [s.name for s in many.status][0::2] == ["OK", "OK"]
    assert many.x[good, 0] == pytest.approx(1 / (1 - 2 * k[good, 0]), rel=1e-6)
    if not many.ok[1]:
        assert many.status[1] is Status.NONFINITE
        assert many.t[1] <= 0.4
    # with a stop on the output, the case whose output ends is the only one to fail
    stop = ocp.falls_below("left", -50.0)
    many = ocp.simulate_ensemble(model, ocp.constant(), x0=[1.0], p=k, t_max=2.0, until=stop, method=method)
    assert [s.name for s in many.status] == ["STOP_NOT_REACHED", "NONFINITE", "STOP_NOT_REACHED", "STOP_NOT_REACHED"]
    assert np.isfinite(many.x).all()


def test_an_output_without_a_value_at_the_start():
    model = define(
        "root", lambda x, u, p: {"a": -1.0}, states=[Var("a")], outputs=[Var("b")], out=lambda x, u, p: {"b": ca.sqrt(x.a)}
    )  # fmt: skip
    many = ocp.simulate_ensemble(model, ocp.constant(), x0=[[2.0], [-1.0], [3.0]], until=ocp.falls_below("b", 1.0), t_max=5.0)
    assert [s.name for s in many.status] == ["OK", "OUT_OF_DOMAIN", "OK"]
    assert many.t[[0, 2]] == pytest.approx([1.0, 2.0], abs=1e-10)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"x0": np.ones((0, 4))}, "no cases"),
        ({"p": np.ones((0, 8))}, "no cases"),
        ({"x0": np.ones((3, 4)), "p": np.ones((2, 8))}, "3 rows of x0 beside 2 of p"),
        ({"x0": np.ones((2, 3))}, r"x0: expected shape \(4,\) or \(N, 4\)"),
        ({"p": np.ones((2, 3))}, r"p: expected shape \(8,\) or \(N, 8\)"),
        ({"x0": [[7e3, 0, 9e4, 0], [7e3, math.nan, 9e4, 0]]}, "x0: gamma of case 1 must be a finite number"),
        ({"p": {"mass": 1.0}}, "p: expected real numbers"),
        ({"until": None}, "give a stop condition"),
        ({"t_max": -1.0}, "t_max must be finite and > 0"),
        ({"block": 0}, "block: expected at least one case, got 0"),
    ],
)
def test_bad_calls(arguments, text):
    model = models.entry_planar(CAPSULE)
    with pytest.raises(ModelError, match=text):
        ocp.simulate_ensemble(model, ocp.constant(lift_ratio=0.1), **{"x0": [7e3, -0.02, 9e4, 0.0], "until": STOP, **arguments})


def test_only_end_states_are_kept():
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 2)
    many = ocp.simulate_ensemble(model, ocp.constant(lift_ratio=0.1), x0=x0, p=p, until=STOP)
    with pytest.raises(ModelError, match="'n_x' is not a state; only end states are kept"):
        many["n_x"]
    with pytest.raises(ValueError, match="read-only"):
        many.x[0, 0] = 1.0


def test_samples_are_what_the_law_saw_and_did():
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 3)
    law = laws()[2]
    many = ocp.simulate_ensemble(model, law, x0=x0, p=p, until=STOP, samples=True)
    taken = many.samples
    assert taken is not None
    for i in range(3):
        one = ocp.simulate(model, law, x0=x0[i], p=p[i], until=STOP)
        mine = taken.case == i
        order = np.argsort(taken.t[mine])
        calls = 3.0 * np.arange(int(mine.sum()))
        assert taken.t[mine][order] == pytest.approx(calls, abs=1e-9)
        assert one.t[-1] - calls[-1] <= 3.0
        at = np.array([int(np.argmin(np.abs(one.t - t))) for t in calls])
        assert taken.x[mine][order] == pytest.approx(one.x[at], rel=1e-11, abs=1e-11)
        assert taken.u[mine][order] == pytest.approx(one.u[at], rel=1e-11)
    assert ocp.simulate_ensemble(model, law, x0=x0, p=p, until=STOP).samples is None


def test_a_case_outside_its_ranges_says_which_value():
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 3)
    x0[1, 1] = -1.5
    p[2, model.index("wave_length")] = 10.0
    flown = ocp.simulate_ensemble(model, ocp.constant(lift_ratio=0.15), x0=x0, p=p, until=STOP)
    (first, second) = flown.failures()
    assert first[0] == 1
    assert "gamma = -1.5 rad is outside" in first[1]
    assert second[0] == 2
    assert "wave_length = 10 m is outside" in second[1]


@pytest.mark.parametrize("wrong", [{"until": "h"}, {"law": None}, {"method": "RK4"}, {"model": "entry"}])
def test_arguments_of_the_wrong_kind_are_named(wrong):
    given = {"model": models.entry_planar(CAPSULE), "law": ocp.constant(lift_ratio=0.1), "until": STOP, "method": ocp.RK4(step=1.0)} | wrong
    model, law = given.pop("model"), given.pop("law")
    (name,) = wrong
    for fly in (ocp.simulate, ocp.simulate_ensemble):
        with pytest.raises(ModelError, match=f"simulate: {name}: expected"):
            fly(model, law, x0=[7600.0, -0.025, 9e4, 0.0], **given)


@pytest.mark.parametrize("law", laws(), ids=lambda law: law.name)
@pytest.mark.parametrize("mode", ["accurate", "fast"])
def test_compiled_code_gives_the_same_ends(law, mode):
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 37)
    x0[5, 1], x0[11, 1] = -1.5, 0.3  # outside its range; climbs away
    p[17, model.index("rho_factor")] = 20.0
    options = {"x0": x0, "p": p, "until": ocp.first_of(STOP, ocp.rises_above("h", 4e5)), "t_max": 900.0, "method": ocp.RK4(step=1.0)}
    wanted = ocp.simulate_ensemble(model, law, native="off", **options)
    found = ocp.simulate_ensemble(model, law, native=mode, **options)
    assert found.status == wanted.status
    assert {s.name for s in wanted.status} == {"OK", "OUT_OF_DOMAIN"}
    rel = 1e-12 if mode == "accurate" else 1e-9
    np.testing.assert_allclose(found.t, wanted.t, rtol=rel)
    np.testing.assert_allclose(found.x, wanted.x, rtol=10 * rel, atol=1e-6 * rel)


def test_compiled_code_keeps_failures_apart():
    # the square root of a negative number ends one case; the others fly on
    tank = define(
        "tank", lambda x, u, p: {"level": -p.rate * ca.sqrt(x.level)}, states=[Var("level", valid=(0, 10))], params={Var("rate"): 1.0}
    )
    p = np.array([[1.0], [50.0], [0.5]])
    options = {"x0": np.ones((3, 1)), "p": p, "until": ocp.falls_below("level", 0.25), "t_max": 5.0, "method": ocp.RK4(step=0.1)}
    wanted = ocp.simulate_ensemble(tank, ocp.constant(), native="off", **options)
    found = ocp.simulate_ensemble(tank, ocp.constant(), native="accurate", **options)
    assert found.status == wanted.status
    np.testing.assert_allclose(found.t, wanted.t, rtol=1e-12)


def test_native_modes_that_cannot_be_are_refused():
    model = models.entry_planar(CAPSULE)
    x0, _ = cases(model, 2)
    law = ocp.constant(lift_ratio=0.15)
    for wrong in ({"native": "fast", "samples": True}, {"native": "accurate", "method": ocp.Adaptive()}, {"native": "yes"}):
        with pytest.raises(ModelError, match="native"):
            ocp.simulate_ensemble(model, law, x0=x0, until=STOP, **wrong)


NEEDS_COMPILER = pytest.mark.skipif(not native_available(), reason="no C compiler on this machine")
UNTIL = {
    "state": ocp.falls_below("h", 30e3),
    "output": ocp.falls_below("mach", 12.0),
    "either": ocp.first_of(ocp.falls_below("h", 30e3), ocp.rises_above("load", 2.5)),
}


@pytest.mark.parametrize("native", ["off", pytest.param("accurate", marks=NEEDS_COMPILER)])
def test_the_memory_of_the_law_at_the_end(native):
    """A law that counts its calls and adds their times, in blocks of three cases; h falls from 1 to 0.25 at a rate of its own."""
    rate = Var("rate", valid=(0.1, 9.0))
    model = define("fall", lambda x, u, p: {"h": -p.rate * u.a}, states=[Var("h", "m", 1.0)], inputs=[Var("a")], params={rate: 1.0})
    law = ocp.sampled(lambda t, x, y, z, w: (1, z + ca.vertcat(1, t)), sample=0.1, memory=[5.0, 7.0])
    rates = np.array([0.52, 0.8, 1.3, 20.0, 2.1, 3.3, 0.61])
    seen = []
    flown = ocp.simulate_ensemble(
        model, law, x0=[1.0], p=rates[:, None], until=ocp.falls_below("h", 0.25), t_max=5.0, native=native, block=3, progress=seen.append
    )  # fmt: skip
    calls = np.where(rates < 9, np.ceil(0.75 / rates / 0.1), 0)
    assert flown.ok.tolist() == (rates < 9).tolist()
    assert flown.z == pytest.approx(np.column_stack([5 + calls, 7 + 0.05 * calls * (calls - 1)]), rel=1e-12)
    assert seen == pytest.approx([0.5, 1.0])  # of six cases: one is outside the range of its rate
    for without in (ocp.constant(a=1.0), ocp.sampled(lambda t, x, y, z, w: (1, z), sample=0.1)):
        assert ocp.simulate_ensemble(model, without, x0=[[1.0], [2.0]], t_max=0.1).z.shape == (2, 0)


@NEEDS_COMPILER
@pytest.mark.parametrize("until", UNTIL)
@pytest.mark.parametrize("law", laws(), ids=lambda law: law.name)
def test_stops_are_bit_equal_in_interpreter_and_accurate_mode(law, until):
    model = models.entry_planar(CAPSULE, atmosphere=models.us76_smooth())
    x0, p = cases(model, 29)
    options = {"x0": x0, "p": p, "until": UNTIL[until], "t_max": 900.0, "method": ocp.RK4(step=1.0)}
    wanted = ocp.simulate_ensemble(model, law, native="off", **options)
    found = ocp.simulate_ensemble(model, law, native="accurate", **options)
    fast = ocp.simulate_ensemble(model, law, native="fast", **options)
    assert wanted.ok.sum() > 20
    assert found.status == wanted.status == fast.status
    assert np.array_equal(found.t, wanted.t)
    assert np.array_equal(found.x, wanted.x)
    np.testing.assert_allclose(fast.t, wanted.t, rtol=1e-9)
    np.testing.assert_allclose(fast.x, wanted.x, rtol=1e-9, atol=1e-9)


@NEEDS_COMPILER
@pytest.mark.parametrize("mode", ["accurate", "fast"])
def test_stops_do_not_depend_on_the_cases_beside(mode):
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 75)
    options = {"until": STOP, "t_max": 900.0, "method": ocp.RK8(step=20.0), "native": mode}
    law = ocp.constant(lift_ratio=0.15)
    whole = ocp.simulate_ensemble(model, law, x0=x0, p=p, **options)
    for size in (1, 7, 32):
        parts = [ocp.simulate_ensemble(model, law, x0=x0[i : i + size], p=p[i : i + size], **options) for i in range(0, 75, size)]
        assert np.array_equal(np.concatenate([part.x for part in parts]), whole.x)
        assert np.array_equal(np.concatenate([part.t for part in parts]), whole.t)
    order = np.random.default_rng(3).permutation(75)
    assert np.array_equal(ocp.simulate_ensemble(model, law, x0=x0[order], p=p[order], **options).x, whole.x[order])


@pytest.mark.parametrize("native", ["off", pytest.param("fast", marks=NEEDS_COMPILER)])
def test_the_stop_is_met_where_it_is_said(native):
    """Long steps: one more integration of the last part with short steps ends at the stop altitude."""
    model = models.entry_planar(CAPSULE)
    x0, p = cases(model, 12)
    law = ocp.constant(lift_ratio=0.15)
    many = ocp.simulate_ensemble(model, law, x0=x0, p=p, until=STOP, method=ocp.RK8(step=10.0), native=native)
    assert many.ok.all()
    height = STOP.conditions[0][1]
    assert many["h"] == pytest.approx(np.full(12, height), rel=1e-10)
    for i in range(12):
        one = ocp.simulate(model, law, x0=x0[i], p=p[i], t_max=float(many.t[i]), method=ocp.RK8(step=1.0))
        assert many.x[i] == pytest.approx(one.x[-1], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("native", ["off", pytest.param("accurate", marks=NEEDS_COMPILER)])
def test_a_linear_profile_is_followed_to_the_stop(native):
    """y' = u with u = t: the stop y = 2 is at t = 2, whatever the step, in the middle of a group."""
    model = define("ramp", lambda x, u, p: {"y": u.a}, states=[Var("y")], inputs=[Var("a")])
    for step in (0.3, 0.7, 1.9):
        law = ocp.profile([0.0, 10.0], a=[0.0, 10.0])
        flown = ocp.simulate_ensemble(
            model, law, x0=np.zeros((3, 1)), until=ocp.rises_above("y", 2.0), t_max=9.0, method=ocp.RK4(step=step), native=native
        )  # fmt: skip
        assert flown.t == pytest.approx([2.0] * 3, rel=1e-11)
        one = ocp.simulate(model, law, x0=[0.0], until=ocp.rises_above("y", 2.0), t_max=9.0, method=ocp.RK4(step=step))
        assert one.t[-1] == pytest.approx(2.0, rel=1e-11)
        assert one.u[-1, 0] == pytest.approx(2.0, rel=1e-11)
