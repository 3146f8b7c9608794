"""Linearizations: exact along a flight, the defect, the pattern of the nodes, degenerate models, refusals."""

import math

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, Var, define
from ocp.linearize import Linearization

CAPSULE = models.Vehicle("capsule", 2900.0, 3.8, 0.35, 1.34)


@pytest.fixture(scope="module")
def flight():
    law = ocp.profile([0.0, 130.3, 131.0, 260.0], lift_ratio=[0.25, 0.25, 0.1, 0.2])
    return ocp.simulate(
        models.entry_planar(CAPSULE), law, x0=[7600.0, -0.025, 9e4, 0.0], p={"rho_factor": 1.2}, until=ocp.falls_below("h", 1e4)
    )


def test_exact_against_central_differences_along_a_flight(flight):
    lin, model = ocp.linearize(flight), flight.model
    scale = np.array([v.nominal for v in model.states + model.inputs])
    for k in range(3, len(flight.t), 97):
        z = np.concatenate([flight.x[k], flight.u[k]])

        def both(point):
            return np.concatenate([model.xdot(point[:4], point[4:], flight.p), model.y(point[:4], point[4:], flight.p)])

        exact = np.block([[lin.A[k], lin.B[k]], [lin.C[k], lin.D[k]]])
        for j in range(5):
            step = np.eye(5)[j] * 1e-5 * scale[j]
            difference = (both(z + step) - both(z - step)) / (2e-5 * scale[j])
            size = np.abs(both(z)) / scale[j] + np.abs(difference)
            assert (np.abs(exact[:, j] - difference) <= 2e-7 * size + 1e-14).all()


def test_the_fundamental_matrix_predicts_a_neighbouring_flight(flight):
    """dx' = A dx integrated over the nodes against the difference of two flights: second order in the deviation."""
    from scipy.integrate import solve_ivp

    lin = ocp.linearize(flight)
    keep = np.append(np.diff(flight.t) > 0, True)

    def rate(t, dx):
        at = [np.interp(t, lin.t[keep], lin.A[keep][:, i, j]) for i in range(4) for j in range(4)]
        return np.reshape(at, (4, 4)) @ dx

    dx0 = np.array([1.0, 1e-5, 20.0, 0.0])
    end = 300.0
    predicted = solve_ivp(rate, (0, end), dx0, rtol=1e-9, atol=1e-9, max_step=1.0).y[:, -1]
    law = ocp.profile([0.0, 130.3, 131.0, 260.0], lift_ratio=[0.25, 0.25, 0.1, 0.2])
    flown = [
        ocp.simulate(flight.model, law, x0=flight.x[0] + s * dx0, p=flight.p, t_max=end).x[-1] for s in (0.5, -0.5)
    ]  # fmt: skip
    assert predicted == pytest.approx(flown[0] - flown[1], rel=2e-3)


def test_nodes_come_in_fours_of_equal_intervals(flight):
    lin = ocp.linearize(flight)
    steps = np.diff(lin.t)
    doubled = np.flatnonzero(steps == 0)
    assert lin.t[doubled] == pytest.approx([130.3, 131.0, 260.0, lin.t[doubled[-1]]])
    for stretch in np.split(steps, doubled):
        stretch = stretch[stretch > 0]
        assert len(stretch) % 4 == 0
        assert np.ptp(stretch) < 1e-9
    # what is stored twice is the left and the right value: the kink of u leaves u alone, a jump of u changes B
    jumped = ocp.simulate(
        flight.model, ocp.profile([0.0, 100.0], lift_ratio=[0.2, 0.1], kind="previous"), x0=flight.x[0], t_max=200.0
    )  # fmt: skip
    k = int(np.flatnonzero(np.diff(jumped.t) == 0)[0])
    assert (jumped.t[k], jumped["lift_ratio"][k], jumped["lift_ratio"][k + 1]) == pytest.approx((100.0, 0.2, 0.1))
    assert np.array_equal(jumped.x[k], jumped.x[k + 1])


def test_the_defect_is_what_the_reference_does_not_explain(flight):
    assert not ocp.linearize(flight).c.any()
    model, rate = flight.model, flight.model.xdot(flight.x, flight.u, flight.p)
    assert np.abs(ocp.linearize(flight, xdot=rate).c).max() == 0
    shifted = ocp.linearize(flight, xdot=rate - [1.0, 2.0, 3.0, 4.0]).c
    assert shifted == pytest.approx(np.tile([1.0, 2.0, 3.0, 4.0], (len(flight.t), 1)), rel=1e-9)
    point = ocp.linearize(model, x=flight.x[5], u=flight.u[5], p=flight.p)
    assert point.c[0] == pytest.approx(rate[5], rel=1e-14)  # a point: its imbalance
    assert ocp.linearize(model, x=flight.x[5], u=flight.u[5], p=flight.p, xdot=rate[5]).c == pytest.approx(np.zeros((1, 4)))


def test_points_in_a_batch_and_dispersed_parameters(flight):
    many = ocp.linearize(flight.model, x=flight.x[::50], u=flight.u[::50], p={"rho_factor": 1.2})
    along = ocp.linearize(flight)
    assert many.A == pytest.approx(along.A[::50], rel=1e-14)
    thin = ocp.linearize(flight.model, x=flight.x[300], u=flight.u[300])
    assert thin.A[0, 0, 0] / along.A[300, 0, 0] == pytest.approx(1 / 1.2, rel=1e-12)


def test_models_without_outputs_inputs_or_parameters():
    plain = define("plain", lambda x, u, p: {"a": x.b, "b": -ca.sin(x.a)}, states=[Var("a"), Var("b")])
    lin = ocp.linearize(plain, x=[0.3, 0.0], u=[])
    assert lin.A[0] == pytest.approx(np.array([[0, 1], [-math.cos(0.3), 0]]))
    assert (lin.B.shape, lin.C.shape, lin.D.shape) == ((1, 2, 0), (1, 0, 2), (1, 0, 0))
    along = ocp.linearize(ocp.simulate(plain, ocp.constant(), x0=[0.3, 0.0], t_max=1.0))
    assert along.A[-1, 1, 0] == pytest.approx(-math.cos(along.x0[-1, 0]))
    single = define("single", lambda x, u, p: {"a": -2 * x.a + 3 * u.b}, states=[Var("a")], inputs=[Var("b")], outputs=[Var("c")],
                    out=lambda x, u, p: {"c": x.a**2 + u.b})  # fmt: skip
    lin = ocp.linearize(single, x=[[1.0], [2.0]], u=[[0.0], [0.0]])
    assert (lin.A.ravel().tolist(), lin.B.ravel().tolist(), lin.C.ravel().tolist()) == ([-2, -2], [3, 3], [2, 4])
    assert lin.D.shape == (2, 1, 1)


def test_to_python_control(flight):
    control = pytest.importorskip("control")
    lin = ocp.linearize(flight)
    system = lin.to_control(10)
    assert isinstance(system, control.StateSpace)
    assert np.array_equal(system.A, lin.A[10])
    assert system.state_labels == ["V", "gamma", "h", "s"]
    assert system.input_labels == ["lift_ratio"]
    assert system.output_labels[0] == "n_x"
    plain = Linearization.from_matrices([[0, 1], [-2, -3]], [[0], [1]])
    assert plain.to_control().poles() == pytest.approx([-1, -2])


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({}, "give x and u"),
        ({"x": [7e3, -0.02, 8e4, 0.0]}, "give x and u"),
        ({"x": [7e3, -0.02, 8e4], "u": [0.1]}, "x: expected shape"),
        ({"x": [7e3, -0.02, 8e4, np.nan], "u": [0.1]}, "x: s must be a finite"),
        ({"x": [7e3, -1.36, 8e4, 0.0], "u": [0.1]}, "x: gamma = -1.36 rad is outside"),
        ({"x": np.ones((0, 4)), "u": [0.1]}, "rows|empty"),
        ({"x": np.full((3, 4), 1.0), "u": [[0.1], [0.2]]}, "rows"),
        ({"x": [7e3, -0.02, 8e4, 0.0], "u": [0.1], "p": {"mas": 1.0}}, "did you mean 'mass'"),
        ({"x": [7e3, -0.02, 8e4, 0.0], "u": [0.1], "xdot": [1.0]}, "xdot: expected shape"),
    ],
)
def test_bad_points(arguments, text):
    with pytest.raises(ModelError, match=text):
        ocp.linearize(models.entry_planar(CAPSULE), **arguments)


def test_bad_trajectories(flight):
    with pytest.raises(ModelError, match="give none of them"):
        ocp.linearize(flight, x=[1.0, 0.0, 0.0, 0.0])
    held = ocp.simulate(
        flight.model, ocp.sampled(lambda t, x, y, z, w: (0.1 + 0 * t, z), sample=1.0), x0=flight.x[0], t_max=5.0
    )  # fmt: skip
    with pytest.raises(ModelError, match="sampled law"):
        ocp.linearize(held)
    corner = define("corner", lambda x, u, p: {"a": ca.sqrt(x.a)}, states=[Var("a")])
    with pytest.raises(ModelError, match="output A is not finite"):
        ocp.linearize(corner, x=[0.0], u=[])


@pytest.mark.parametrize(
    ("A", "B", "options", "text"),
    [
        ([[1, 2]], [[1]], {}, "A: expected a square matrix"),
        ([[1, 2], [3, 4]], [[1]], {}, "B: expected 2 rows"),
        ([[1, math.nan], [3, 4]], [[1], [1]], {}, r"A\[0\]\[1\]"),
        ([[1, 2], [3, 4]], [[1], [1]], {"C": [[1, 2, 3]]}, "C: expected shape"),
        ([[1, 2], [3, 4]], [[1], [1]], {"D": [[1, 2]]}, "D: expected shape"),
    ],
)
def test_bad_matrices(A, B, options, text):
    with pytest.raises(ModelError, match=text):
        Linearization.from_matrices(A, B, **options)
