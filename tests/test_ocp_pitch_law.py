"""Pitch law: short period from the Jacobians, gains against an independent Riccati solution, schedule, reference, trim."""

import math

import casadi as ca
import numpy as np
import pytest
import scipy.linalg as sla

import ocp
from models import ModelError
from models.core import Var, define
from models.shuttle import orbiter_longitudinal
from ocp.pitch_law import PitchWeights, acceleration, pitch_gains, rate_reference, short_period, trim_rate

DEG = math.pi / 180
WEIGHTS = PitchWeights(alpha=1.5 * DEG, rate=2.0 * DEG, integral=4.0 * DEG, acceleration=1.5 * DEG)


def glider():
    """A linear short period: gamma' = z (theta - gamma), q' = a (theta - gamma) + b q + v, theta' = q."""
    params = {Var("z"): 0.05, Var("a"): -0.8, Var("b"): -0.1}
    return define(
        "glider",
        lambda x, u, p: {"gamma": p.z * (x.theta - x.gamma), "theta": x.q, "q": p.a * (x.theta - x.gamma) + p.b * x.q + u.v},
        states=(Var("gamma", "rad"), Var("theta", "rad"), Var("q", "rad/s")), inputs=(Var("v", "rad/s2"),), params=params,
    )  # fmt: skip


def points(n):
    model = glider()
    return ocp.linearize(model, x=np.zeros((n, 3)), u=np.zeros((n, 1)))


def test_short_period_of_a_linear_glider():
    np.testing.assert_allclose(short_period(points(2)), np.tile([[-0.05, 1.0], [-0.8, -0.1]], (2, 1, 1)), rtol=1e-14)


def test_short_period_of_the_orbiter_against_differences():
    model = orbiter_longitudinal()
    x = np.array([1500.0, -0.1, 42e3, 0.0, 0.4, 0.01, -0.15, -0.2])
    u = np.zeros(4)
    found = short_period(ocp.linearize(model, x=x, u=u))[0]
    step = np.zeros(8)
    step[4] = 1e-6
    change = (model.xdot(x + step, u) - model.xdot(x - step, u)) / 2e-6
    assert found[0, 0] == pytest.approx(-change[1], rel=1e-6)
    assert found[1, 0] == pytest.approx(change[5], rel=1e-6)
    assert found[0, 0] < 0 < found[0, 1]


@pytest.fixture(scope="module")
def gains():
    qbar, mach = np.array([500.0, 5e3, 1e4]), np.array([6.0, 4.0, 3.0])
    lin = points(3)
    return pitch_gains(lin, mach=mach, qbar=qbar, weights=WEIGHTS, grid_mach=[3.0, 4.0, 5.0, 6.0], grid_qbar=[10.0, 100.0, 1e3, 1e4, 2e4])


def test_gains_against_an_independent_riccati_solution(gains):
    Q = np.diag([1 / (1.5 * DEG) ** 2, 1 / (2 * DEG) ** 2, 1 / (4 * DEG) ** 2])
    R = np.array([[1 / (1.5 * DEG) ** 2]])
    for i, mach in enumerate(gains.mach):
        for j, level in enumerate(gains.log_qbar):
            share = np.exp(level) / np.interp(mach, [3.0, 4.0, 6.0], [1e4, 5e3, 500.0])
            if mach == 5.0:  # between the points of the flight the quotients are interpolated, not qbar
                share = np.exp(level) * 0.5 * (1 / 5e3 + 1 / 500)
            A = np.array([[-0.05 * share, 1.0, 0.0], [-0.8 * share, -0.1 * share, 0.0], [1.0, 0.0, 0.0]])
            B = np.array([[0.0], [1.0], [0.0]])
            S = sla.solve_continuous_are(A, B, Q, R)
            np.testing.assert_allclose(gains.K[i, j], np.linalg.solve(R, B.T @ S)[0], rtol=1e-7)
            assert np.linalg.eigvals(A - B @ gains.K[i, j][None]).real.max() < 0
    assert gains.riccati_residual < 1e-12
    assert gains.abscissa < 0


def test_of_equal_mach_numbers_the_largest_qbar_counts():
    lin = points(3)
    grids = {"weights": WEIGHTS, "grid_mach": [3.0, 4.0, 5.0, 6.0], "grid_qbar": [10.0, 100.0, 1e3, 1e4]}
    wanted = pitch_gains(points(2), mach=[6.0, 3.0], qbar=[5e3, 1e4], **grids)
    for pressures in ([500.0, 5e3, 1e4], [5e3, 500.0, 1e4]):
        np.testing.assert_array_equal(pitch_gains(lin, mach=[6.0, 6.0, 3.0], qbar=pressures, **grids).K, wanted.K)


def test_gains_in_thin_air_are_those_of_a_double_integrator():
    weights = PitchWeights(alpha=1.0, rate=1.0, integral=1e6, acceleration=1.0)
    found = pitch_gains(
        points(1), mach=[5.0], qbar=[1e6], weights=weights, grid_mach=[4.0, 5.0, 6.0, 7.0], grid_qbar=[1e-3, 1e-2, 0.1, 1.0]
    )
    # K = [1, sqrt(3)] of the double integrator for Q = I, R = 1
    np.testing.assert_allclose(found.K[..., 0], 1.0, atol=1e-5)
    np.testing.assert_allclose(found.K[..., 1], math.sqrt(3.0), atol=1e-5)


def test_schedule_meets_its_nodes_and_is_held(gains):
    at = np.exp(gains.log_qbar[2])
    for i, value in enumerate(gains.at(4.0, at)):
        assert value == pytest.approx(gains.K[1, 2, i], rel=1e-9)
    for i, value in enumerate(gains.at(9.0, 1e6)):
        assert value == pytest.approx(gains.K[-1, -1, i], rel=1e-9)
    mach, qbar = ca.SX.sym("mach"), ca.SX.sym("qbar")
    function = ca.Function("K", [mach, qbar], [ca.vertcat(*gains.at(mach, qbar))])
    assert np.isfinite(function(4.0, 0.0).full()).all()


def test_rate_reference_keeps_alpha_on_its_command():
    model = orbiter_longitudinal()
    x = np.array([1900.0, -0.07, 51e3, 0.0, 0.5, 0.0, -0.1, -0.2])
    u = np.zeros(4)
    gamma_dot = model.xdot(x, u)[1]
    x[5] = rate_reference(0.02, gamma_dot, x[0], x[1], 6371e3 + x[2])
    rates = model.xdot(x, u)
    assert rates[4] - rates[1] == pytest.approx(0.02, rel=1e-9)


def test_signs_of_demand_and_trim():
    assert acceleration(0.01, 0.0, 1.5, 2.0) == pytest.approx(-0.015)  # nose too high: pitch down
    assert acceleration(0.0, 0.01, 1.5, 2.0) == pytest.approx(-0.02)
    e, qbar = ca.SX.sym("e"), ca.SX.sym("qbar")
    speed = ca.Function("speed", [e, qbar], [trim_rate(e, 0.4, qbar=qbar, slope=-400.0 * qbar, inertia=9e6, above=300.0, floor=1000.0)])
    assert float(speed(0.01, 299.0)) == 0.0
    assert float(speed(0.01, 2000.0)) == pytest.approx(0.4 * 0.01 * 9e6 / (400 * 2000))  # down elevon lowers the nose
    assert float(speed(0.01, 400.0)) == pytest.approx(0.4 * 0.01 * 9e6 / (400 * 1000))
    assert float(speed(-0.01, 2000.0)) < 0


def test_refusals():
    with pytest.raises(ModelError, match="integral"):
        PitchWeights(alpha=1.0, rate=1.0, integral=0.0, acceleration=1.0)
    with pytest.raises(ModelError, match="one value for each"):
        pitch_gains(points(2), mach=[5.0], qbar=[1e3, 1e3], weights=WEIGHTS, grid_mach=[3.0, 4.0], grid_qbar=[1.0, 2.0])
    with pytest.raises(ModelError, match="no model"):
        short_period(ocp.Linearization.from_matrices(np.eye(2), np.ones((2, 1))))
