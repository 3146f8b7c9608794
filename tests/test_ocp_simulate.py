"""Single flights: ends, failures, memory of what went wrong, adaptive path, and sampled laws on exact solutions."""

import math

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, Status, Var, define

HEIGHT, SPEED = Var("h", "m", 100.0, (-1e4, 1e4)), Var("v", "m/s", 10.0, (-1e4, 1e4))


def ballistic():
    return define("ballistic", lambda x, u, p: {"h": x.v, "v": -10.0}, states=[HEIGHT, SPEED])


def tank():
    """Level of a draining tank, h = (1 - t/2)^2 for h(0) = 1; empty at t = 2, no solution after."""
    return define(
        "tank", lambda x, u, p: {"level": -ca.sqrt(x.level)}, states=[Var("level", "m")], outputs=[Var("flow")],
        out=lambda x, u, p: {"flow": ca.sqrt(x.level - 0.25)},
    )  # fmt: skip


def double_integrator():
    return define("double", lambda x, u, p: {"q": x.w, "w": u.a}, states=[Var("q"), Var("w")], inputs=[Var("a")])


METHODS = [ocp.RK4(step=0.05), ocp.RK8(step=0.25), ocp.Adaptive(step=0.25)]


@pytest.mark.parametrize("method", METHODS)
def test_ballistic_arc_ends_at_its_analytic_time(method):
    """h = 30 t - 5 t^2 + 1 falls through 0.5 m: a polynomial, exact for every method."""
    flight = ocp.simulate(ballistic(), ocp.constant(), x0=[1.0, 30.0], until=ocp.falls_below("h", 0.5), method=method)
    exact = (30 + math.sqrt(900 + 10)) / 10
    assert flight.t[-1] == pytest.approx(exact, abs=1e-9 if isinstance(method, ocp.Adaptive) else 1e-10)
    assert flight["h"][-1] == pytest.approx(0.5, rel=1e-9)
    assert flight["h"] == pytest.approx(1 + 30 * flight.t - 5 * flight.t**2, abs=1e-8)
    assert flight.status is Status.OK
    assert not flight.hold


def test_end_time_alone_and_with_a_stop():
    flight = ocp.simulate(ballistic(), ocp.constant(), x0=[1.0, 30.0], t_max=2.3)
    assert flight.t[-1] == 2.3
    assert flight["h"][-1] == pytest.approx(1 + 30 * 2.3 - 5 * 2.3**2, rel=1e-13)
    earlier = ocp.simulate(ballistic(), ocp.constant(), x0=[1.0, 30.0], t_max=2.3, until=ocp.rises_above("h", 26.0))
    assert earlier.t[-1] == pytest.approx(1.0, abs=1e-10)


def test_an_unreachable_stop_carries_the_flight():
    with pytest.raises(ocp.SimulationError, match=r"STOP_NOT_REACHED at t = 2 s with h = .* falls below -100") as error:
        ocp.simulate(ballistic(), ocp.constant(), x0=[1.0, 30.0], t_max=2.0, until=ocp.falls_below("h", -100.0))
    assert error.value.status is Status.STOP_NOT_REACHED
    assert error.value.trajectory.t[-1] == 2.0
    quiet = ocp.simulate(ballistic(), ocp.constant(), x0=[1.0, 30.0], t_max=2.0, until=ocp.falls_below("h", -100.0), throw=False)
    assert quiet.status is Status.STOP_NOT_REACHED
    assert quiet.x[-1] == pytest.approx([41.0, 10.0])


def test_a_capsule_that_skips_out_is_told_so():
    model = models.entry_planar(models.from_ratios("skip", ballistic_coefficient=450.0, lift_to_drag=0.5))
    with pytest.raises(ocp.SimulationError, match=r"STOP_NOT_REACHED.*h = ") as error:
        ocp.simulate(
            model, ocp.constant(lift_ratio=0.5), x0=[10800.0, -0.09, 1e5, 0.0], until=ocp.falls_below("h", 1e4), t_max=900.0
        )  # fmt: skip
    assert error.value.trajectory["h"][-1] > 1e5


@pytest.mark.parametrize("method", [ocp.RK4(step=0.05), ocp.RK8(step=0.05), ocp.Adaptive(step=0.05)])
def test_dynamics_that_end_keep_the_last_good_state(method):
    with pytest.raises(ocp.SimulationError, match=r"NONFINITE at t = .* with a = [0-9.]+\. A NaN") as error:
        ocp.simulate(
            define("gap", lambda x, u, p: {"a": 1 + 1e-9 * ca.log(1 - x.a)}, states=[Var("a")]),
            ocp.constant(), x0=[0.0], t_max=4.0, method=method,
        )  # fmt: skip
    flight = error.value.trajectory
    assert flight.status is Status.NONFINITE
    assert np.isfinite(flight.x).all()
    assert 0.5 < flight["a"][-1] < 1 + 1e-8
    assert flight["a"] == pytest.approx(flight.t, abs=1e-8)


@pytest.mark.parametrize(("method", "accuracy"), [(ocp.RK4(step=0.1), 5e-3), (ocp.RK8(step=0.1), 1e-5), (ocp.Adaptive(step=0.1), 1e-9)])
def test_a_stop_just_before_the_dynamics_end_is_found(method, accuracy):
    """The group of steps that contains the stop runs into sqrt of a negative level, where even the steps before lose accuracy."""
    model = define("drain", lambda x, u, p: {"level": -ca.sqrt(x.level)}, states=[Var("level", "m")])
    flight = ocp.simulate(model, ocp.constant(), x0=[1.0], until=ocp.falls_below("level", 1e-3), t_max=10.0, method=method)
    assert flight.t[-1] == pytest.approx(2 - 2 * math.sqrt(1e-3), abs=accuracy)
    assert flight["level"][-1] == pytest.approx(1e-3, rel=1e-9)


def test_an_output_that_ends_before_the_state_ends_the_flight():
    """flow = sqrt(level - 1/4) is not a number after t = 1."""
    flight = ocp.simulate(tank(), ocp.constant(), x0=[1.0], t_max=1.8, method=ocp.RK8(step=0.05), throw=False)
    assert flight.status is Status.NONFINITE
    assert flight.t[-1] == pytest.approx(1.0, abs=0.06)
    assert np.isfinite(flight.y).all()
    with pytest.raises(ModelError, match=r"output of tank is not finite at x0 \(level = 0.1 m\)"):
        ocp.simulate(tank(), ocp.constant(), x0=[0.1], t_max=1.0)
    stop = ocp.falls_below("flow", 0.1)
    found = ocp.simulate(tank(), ocp.constant(), x0=[1.0], until=stop, method=ocp.RK8(step=0.25), t_max=1.9)
    assert found.t[-1] == pytest.approx(2 - 2 * math.sqrt(0.26), abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"x0": [1.0]}, r"x0: expected shape \(2,\) for \[h v\], got \(1,\)"),
        ({"x0": [1.0, math.nan]}, "x0: v must be a finite number"),
        ({"x0": [2e4, 1.0]}, "x0: h = 20000 m is outside"),
        ({"x0": [[1.0, 2.0]]}, r"x0: expected shape \(2,\)"),
        ({"p": {"mass": 1.0}}, "unknown name 'mass'"),
        ({"p": [1.0]}, "p: expected shape"),
        ({"t_max": 0.0}, "t_max must be finite and > 0 s, got 0"),
        ({"t_max": math.nan}, "t_max: expected a finite number"),
        ({"t_max": "5"}, "t_max: expected real numbers"),
        ({"t_max": 1e12}, "shorter time or a longer step"),
        ({"t_max": None}, "give a stop condition"),
        ({"until": ocp.falls_below("h", 5.0)}, r"x0 \(h = 1 m, v = 30 m/s\) is already past the stop condition \(h falls below 5\)"),
        ({"until": ocp.falls_below("hh", 5.0)}, "stop condition: unknown name 'hh'; did you mean 'h'"),
    ],
)
def test_bad_calls(changes, text):
    arguments = {"x0": [1.0, 30.0], "t_max": 1.0} | changes
    with pytest.raises(ModelError, match=text):
        ocp.simulate(ballistic(), ocp.constant(), **arguments)
    assert ocp.simulate(ballistic(), ocp.constant(), x0=[1.0, 30.0], t_max=1.0)["h"][-1] == pytest.approx(26.0)


# --- sampled laws -------------------------------------------------------------------------------------------------


def feedback(t, x, y, z, w):
    return -0.6 * x[0] - 1.1 * x[1], z


@pytest.mark.parametrize("method", [ocp.RK4(step=0.3), ocp.RK8(step=0.07), ocp.Adaptive(step=0.3)])
@pytest.mark.parametrize("sample", [0.3, 0.5])
def test_held_feedback_is_the_discrete_solution(method, sample):
    """Zero-order hold on a double integrator, x+ = [[1, T], [0, 1]] x + [T^2/2, T] u: exact whatever the step."""
    flight = ocp.simulate(double_integrator(), ocp.sampled(feedback, sample=sample), x0=[1.0, -0.2], t_max=10 * sample, method=method)
    assert flight.hold
    x = np.array([1.0, -0.2])
    tolerance = 1e-9 if isinstance(method, ocp.Adaptive) else 1e-12
    for k in range(10):
        at = np.flatnonzero(np.isclose(flight.t, k * sample))[-1]
        u = -0.6 * x[0] - 1.1 * x[1]
        assert flight.x[at] == pytest.approx(x, abs=tolerance)
        assert flight.u[at, 0] == pytest.approx(u, abs=10 * tolerance)
        x = np.array([x[0] + sample * x[1] + sample**2 / 2 * u, x[1] + sample * u])
    assert flight.x[-1] == pytest.approx(x, abs=tolerance)


def test_memory_and_time_reach_the_law():
    """An integrator z and the clock t: u = z + t, z+ = z + T q; against a loop in plain Python."""

    def step(t, x, y, z, w):
        return z[0] + t, z + 0.25 * x[0]

    flight = ocp.simulate(double_integrator(), ocp.sampled(step, sample=0.25, memory=[0.7]), x0=[1.0, 0.0], t_max=2.6)
    q, v, z, T = 1.0, 0.0, 0.7, 0.25
    for k in range(11):
        dt = min(T, 2.6 - k * T)  # the flight ends within the last period
        u = z + k * T
        z += T * q
        q, v = q + dt * v + dt**2 / 2 * u, v + dt * u
    assert flight.t[-1] == 2.6
    assert flight.x[-1] == pytest.approx([q, v], rel=1e-12)


def test_the_law_reads_outputs_with_the_input_held_so_far():
    model = define(
        "felt", lambda x, u, p: {"q": u.a}, states=[Var("q")], inputs=[Var("a")], outputs=[Var("force")], out=lambda x, u, p: {"force": u.a}
    )
    flight = ocp.simulate(model, ocp.sampled(lambda t, x, y, z, w: (1 + 0.5 * y[0], z), sample=1.0), x0=[0.0], t_max=3.0)
    assert flight["a"][[0, 2, 4]] == pytest.approx([1.0, 1.5, 1.75])
    assert flight["q"][-1] == pytest.approx(1.0 + 1.5 + 1.75, rel=1e-14)


def test_a_stop_between_samples_is_exact():
    stop = ocp.falls_below("q", 0.5)
    flight = ocp.simulate(double_integrator(), ocp.sampled(lambda t, x, y, z, w: (ca.SX(-2.0), z), sample=1.7), x0=[3.0, 1.0], until=stop)
    assert flight.t[-1] == pytest.approx((1 + math.sqrt(1 + 4 * 2.5)) / 2, abs=1e-10)


def test_a_stop_on_an_output_of_the_input_sees_the_first_input():
    model = define(
        "felt", lambda x, u, p: {"q": -u.a * x.q}, states=[Var("q")], inputs=[Var("a")], outputs=[Var("load")],
        out=lambda x, u, p: {"load": u.a * x.q},
    )  # fmt: skip
    for law in (ocp.constant(a=2.0), ocp.sampled(lambda t, x, y, z, w: (ca.SX(2.0), z), sample=0.1)):
        flight = ocp.simulate(model, law, x0=[1.0], until=ocp.falls_below("load", 0.5), t_max=5.0, method=ocp.RK8(step=0.01))
        assert flight.t[-1] == pytest.approx(math.log(4) / 2, abs=1e-10)
    with pytest.raises(ModelError, match="already past"):
        ocp.simulate(model, ocp.constant(a=0.1), x0=[1.0], until=ocp.falls_below("load", 0.5), t_max=5.0)
