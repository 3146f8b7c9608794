"""Operating points: known equilibria, targets, more and fewer unknowns than rates, and every way to fail."""

import math

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, Status, Var, define

MU, R = 3.986004418e14, 6371e3
CAPSULE = models.Vehicle("capsule", 2900.0, 3.8, 0.35, 1.34)


def pendulum(**valid):
    """Torque-driven pendulum, a'' = -9.81 sin a + torque."""
    return define(
        "pendulum", lambda x, u, p: {"a": x.w, "w": -9.81 * ca.sin(x.a) + u.torque},
        states=[Var("a", "rad", 1.0, (-3.2, 3.2)), Var("w", "rad/s")], inputs=[Var("torque", valid=valid.get("torque", (-20.0, 20.0)))],
    )  # fmt: skip


def test_equilibrium_glide_against_its_formula():
    """gamma' = 0: u = (g/V - V/r) V cos(gamma)/D."""
    model = models.entry_planar(CAPSULE)
    x = [5000.0, -0.01, 6e4, 0.0]
    point = ocp.trim(model, x=x, u=[0.1], free=["lift_ratio"], rates=["gamma"])
    r = R + 6e4
    drag = 0.5 * 1.225 * math.exp(-6e4 / 7110) * 5000.0**2 * 3.8 * 1.34 / 2900.0
    assert point.u[0] == pytest.approx((MU / r**2 / 5000.0 - 5000.0 / r) * 5000.0 * math.cos(-0.01) / drag, rel=1e-12)
    assert point.status is Status.OK
    assert point.residual < 1e-11
    assert np.array_equal(point.x, x)
    assert abs(model.xdot(point.x, point.u)[1]) < 1e-12


def test_a_state_can_be_the_unknown():
    """The altitude of the glide at a given lift: exponential air has a closed form."""
    model = models.entry_planar(CAPSULE)
    point = ocp.trim(model, x=[5000.0, 0.0, 5e4, 0.0], u=[0.2], free=["h"], rates=["gamma"])
    h = point.x[2]
    drag = (MU / (R + h) ** 2 / 5000.0 - 5000.0 / (R + h)) * 5000.0 / 0.2
    rho = drag * 2 * 2900.0 / (5000.0**2 * 3.8 * 1.34)
    assert h == pytest.approx(-7110 * math.log(rho / 1.225), rel=1e-11)


def test_targets_and_parameters():
    model = pendulum()
    point = ocp.trim(model, x=[0.3, 0.0], u=[0.0], free=["torque", "w"], rates={"a": 0.5, "w": -2.0})
    assert point.x[1] == pytest.approx(0.5)
    assert point.u[0] == pytest.approx(9.81 * math.sin(0.3) - 2.0, rel=1e-12)
    heavy = models.entry_planar(CAPSULE)
    x, keywords = [5000.0, 0.0, 6e4, 0.0], {"u": [0.1], "free": ["lift_ratio"], "rates": ["gamma"]}
    thick, thin = ocp.trim(heavy, x=x, p={"rho_factor": 2.0}, **keywords), ocp.trim(heavy, x=x, **keywords)
    assert thick.u[0] == pytest.approx(thin.u[0] / 2, rel=1e-11)
    assert thick.p[heavy.index("rho_factor")] == 2.0
    with pytest.raises(ValueError, match="read-only"):
        thick.p[0] = 1.0


def test_more_unknowns_than_rates_move_least():
    """w' = 0 with a and torque free from (0.2, 0): the step is the least-norm one, so both move."""
    point = ocp.trim(pendulum(), x=[0.2, 0.0], u=[0.0], free=["a", "torque"], rates=["w"])
    assert 9.81 * math.sin(point.x[0]) == pytest.approx(point.u[0], abs=1e-10)
    assert abs(point.x[0]) < 0.2
    assert point.u[0] > 0


def test_a_double_pendulum_hangs_down():
    def rhs(x, u, p):
        d = x.a - x.b
        m = ca.vertcat(ca.horzcat(2, ca.cos(d)), ca.horzcat(ca.cos(d), 1))
        f = ca.vertcat(-(x.wb**2) * ca.sin(d) - 2 * 9.81 * ca.sin(x.a), x.wa**2 * ca.sin(d) - 9.81 * ca.sin(x.b))
        acceleration = ca.solve(m, f)
        return {"a": x.wa, "b": x.wb, "wa": acceleration[0], "wb": acceleration[1]}

    model = define("double_pendulum", rhs, states=[Var(n, "rad") for n in ("a", "b", "wa", "wb")])
    for guess, rest in (([0.2, -0.1, 0.05, 0.1], [0, 0, 0, 0]), ([3.0, 3.3, 0.1, 0.0], [math.pi, math.pi, 0, 0])):
        point = ocp.trim(model, x=guess, u=[], free=["a", "b", "wa", "wb"], rates=["a", "b", "wa", "wb"])
        assert point.x == pytest.approx(rest, abs=1e-10)
        growth = np.linalg.eigvals(ocp.linearize(model, x=point.x, u=[]).A[0]).real.max()
        assert (growth > 1) == (rest[0] > 1)  # upright is unstable


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        ({"free": ["a"], "u": [15.0], "rates": ["w"]}, Status.INFEASIBLE),  # sin a cannot exceed 1
        ({"free": ["torque"], "rates": {"a": 0.0, "w": 0.0}, "x": [0.2, 0.3]}, Status.INFEASIBLE),  # more rates than unknowns
        ({"free": ["a"], "rates": ["a"], "x": [0.2, 0.5]}, Status.SINGULAR),  # a' = w does not depend on a
        ({"free": ["torque"], "rates": {"w": 15.0}, "x": [1.4, 0.0]}, Status.OUT_OF_DOMAIN),  # 24.7 N m
    ],
)
def test_failures_have_their_status_and_text(arguments, status):
    call = {"x": [0.2, 0.0], "u": [0.0], **arguments}
    point = ocp.trim(pendulum(), **call, throw=False)
    assert point.status is status
    with pytest.raises(ModelError, match=f"trim: {status.name}: worst rate d[aw]/dt with scaled residual"):
        ocp.trim(pendulum(), **call)


def test_the_variable_out_of_its_range_is_named():
    with pytest.raises(ModelError, match=r"torque = 24\.\d+ lies outside \[-20, 20\]"):
        ocp.trim(pendulum(), x=[1.4, 0.0], u=[0.0], free=["torque"], rates={"w": 15.0})


def test_steps_out_of_the_domain_of_the_model_are_shortened():
    """log(a) = -1: from 5 the full Newton step goes to 5 - 5 (log 5 + 1) < 0, where there is no logarithm."""
    model = define("log", lambda x, u, p: {"a": ca.log(x.a) + 1}, states=[Var("a")])
    assert ocp.trim(model, x=[5.0], u=[], free=["a"], rates=["a"]).x[0] == pytest.approx(math.exp(-1), rel=1e-10)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"free": ["torqe"]}, "trim: free: unknown name 'torqe'; did you mean 'torque'"),
        ({"rates": ["v"]}, "trim: rates: unknown name 'v'"),
        ({"free": []}, "at least one rate to meet and one free"),
        ({"rates": []}, "at least one rate to meet and one free"),
        ({"free": ["torque", "torque"]}, "each once"),
        ({"x": [0.2]}, "x: expected shape"),
        ({"x": [0.2, 0.0, 0.0], "u": []}, r"x: expected shape \(2,\) for \[a w\], got \(3,\)"),  # five numbers in all
        ({"x": [0.2, math.nan]}, "x: w must be a finite"),
        ({"x": [200.0, 0.0]}, "a = 200 rad is outside"),
        ({"rates": {"w": math.inf}}, "trim: rates"),
        ({"p": {"mass": 1.0}}, "unknown name 'mass'"),
    ],
)
def test_bad_calls(changes, text):
    with pytest.raises(ModelError, match=text):
        ocp.trim(pendulum(), **({"x": [0.2, 0.0], "u": [0.0], "free": ["torque"], "rates": ["w"]} | changes))
