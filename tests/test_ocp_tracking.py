"""The single function of reference flight and gains, against the node-by-node synthesis, scipy and its own derivatives."""

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models import ModelError, Var, define
from studies.scenario import Scenario
from studies.synthesis import certified, weights

MEASURED = ("n_x", "hdot", "s", "sdot")


@pytest.fixture(scope="module")
def n1():
    return certified(Scenario.default())


def relative(found, wanted):
    return float((np.abs(found - wanted).max(axis=0) / np.abs(wanted).max(axis=0)).max())


@pytest.mark.parametrize("measured", [None, MEASURED])
def test_same_flight_and_gains_as_node_by_node(n1, measured):
    Q, R, F = weights(Scenario.default())
    model, reference = n1.reference.model, n1.reference
    if measured is None:
        scale = np.array([500.0, 0.1, 2e3, 1e4])
        Q, F = np.diag(scale**-2), np.diag((scale / 3) ** -2)
        wanted = ocp.tvlqr(ocp.linearize(reference), Q=Q, R=R, Qf=F)
    else:
        wanted = n1.guidance
    track = ocp.tracker(model, until=ocp.falls_below("h", 10e3), steps=96, search=4.0, measured=measured)
    found = track(reference.x[0], reference.u[0], Q=Q, R=R, Qf=F)
    assert found.t[-1] == pytest.approx(reference.t[-1], rel=1e-12)
    inside = wanted.at(found.t[1:-1])
    assert relative(found.K[1:-1, 0], inside.K[:, 0]) < 1e-6
    some = slice(10, -10, 50)  # S by its own coordinates, node by node
    near = np.searchsorted(wanted.t, found.t[some])
    scale = 1 / np.sqrt(np.diagonal(wanted.S[near], axis1=1, axis2=2).max(axis=0))
    again = track(reference.x[0], reference.u[0], Q=Q, R=R, Qf=F)
    cost = np.einsum("nij,i,j->nij", again.S[some] - wanted.S[near], scale, scale)
    assert np.abs(cost).max() < 0.05  # the nodes lie up to a quarter of a second apart
    np.testing.assert_array_equal(again.K, found.K)
    assert relative(found.x0[1:-1], inside.x0) < 1e-7
    # the end itself, in closed form
    np.testing.assert_allclose(found.K[-1], wanted.K[-1], rtol=1e-8, atol=1e-12 * np.abs(wanted.K[-1]).max())
    assert found.certificate.riccati_residual < 5e-8
    assert found.certificate.min_eig_S > 0
    assert [v.name for v in found.states] == list(measured or [v.name for v in model.states])


def test_certificate_sees_a_coarse_sweep_and_can_be_left_out(n1):
    Q, R, F = weights(Scenario.default())
    make = {"until": ocp.falls_below("h", 10e3), "measured": MEASURED}
    start = (n1.reference.x[0], n1.reference.u[0])
    coarse = ocp.tracker(n1.reference.model, steps=24, **make)
    with pytest.raises(ModelError, match="no certificate: the Riccati defect"):
        coarse(*start, Q=Q, R=R, Qf=F)
    assert coarse(*start, Q=Q, R=R, Qf=F, certify=False).certificate.riccati_residual == np.inf
    residuals = [ocp.tracker(n1.reference.model, steps=n, **make)(*start, Q=Q, R=R, Qf=F).certificate.riccati_residual for n in (60, 120)]
    assert residuals[1] < residuals[0] / 50


def test_a_flight_that_is_not_resolved_is_refused(n1):
    Q, R, F = weights(Scenario.default())
    track = ocp.tracker(n1.reference.model, until=ocp.falls_below("h", 10e3), measured=MEASURED, search=30.0)
    for certify in (True, False):
        with pytest.raises(ModelError, match="not resolved"):
            track(n1.reference.x[0], n1.reference.u[0], Q=Q, R=R, Qf=F, certify=certify)


def test_a_density_wave_needs_steps_and_gets_the_right_gains(n1):
    p = {"wave_amplitude": 0.1, "wave_length": 3e3}
    scale = np.array([500.0, 0.1, 2e3, 1e4])
    call = {"Q": np.diag(scale**-2), "R": [[0.06**-2]], "Qf": np.diag((scale / 3) ** -2), "p": p}
    start, until = (n1.reference.x[0], n1.reference.u[0]), ocp.falls_below("h", 10e3)
    with pytest.raises(ModelError, match=r"not resolved|no certificate"):
        ocp.tracker(n1.reference.model, until=until)(*start, **call)
    found, fine = (ocp.tracker(n1.reference.model, until=until, steps=n, search=s)(*start, **call) for n, s in ((600, 4.0), (1200, 2.0)))
    assert relative(found.K[:, 0], fine.at(found.t).K[:, 0]) < 1e-5
    np.testing.assert_allclose(found.x0[0], start[0], atol=1e-9)


def test_the_default_grid_is_certified_and_right(n1):
    Q, R, F = weights(Scenario.default())
    make = {"until": ocp.falls_below("h", 10e3), "measured": MEASURED}
    start = (n1.reference.x[0], n1.reference.u[0])
    found = ocp.tracker(n1.reference.model, **make)(*start, Q=Q, R=R, Qf=F)
    fine = ocp.tracker(n1.reference.model, steps=480, search=2.0, **make)(*start, Q=Q, R=R, Qf=F)
    wanted = fine.at(found.t).K[:, 0]
    assert relative(found.K[:, 0], wanted) < 1e-6
    assert found.certificate.riccati_residual < 1e-8


def test_double_integrator_stopping_in_time():
    clock, place, speed = Var("clock", "s"), Var("place", "m"), Var("speed", "m/s")
    model = define(
        "cart", lambda x, u, p: {"clock": 1.0, "place": x.speed, "speed": u.force}, states=(clock, place, speed), inputs=(Var("force"),)
    )  # fmt: skip
    track = ocp.tracker(model, until=ocp.rises_above("clock", 30.0), steps=120, search=2.0, t_max=60.0)
    gains = track([0, 0, 1], [0], Q=np.diag([0.0, 1, 1]), R=[[1]], Qf=np.zeros((3, 3)))
    assert gains.t[-1] == pytest.approx(30.0, rel=1e-13)
    root = np.sqrt(3)
    np.testing.assert_allclose(gains.S[0][1:, 1:], [[root, 1], [1, root]], rtol=1e-8)
    np.testing.assert_allclose(gains.K[0, 0, 1:], [1, root], rtol=1e-8)
    np.testing.assert_allclose(gains.x0[:, 1], gains.t, atol=1e-9)


def test_two_inputs_and_a_parameter():
    rng = np.random.default_rng(3)
    A, B = rng.normal(size=(3, 3)) - np.eye(3), rng.normal(size=(3, 2))

    def rhs(x, u, p):
        state, force = ca.vertcat(x.a, x.b, x.c), ca.vertcat(u.f, u.g)
        rate = p.k * ca.mtimes(ca.DM(A), state) + ca.mtimes(ca.DM(B), force)
        return {"a": rate[0], "b": rate[1], "c": rate[2], "t": 1.0}

    model = define(
        "random", rhs, states=tuple(Var(n) for n in "abct"), inputs=(Var("f"), Var("g")), params={Var("k"): 1.0}
    )  # fmt: skip
    track = ocp.tracker(model, until=ocp.rises_above("t", 40.0), steps=400, search=1.0, t_max=50.0)
    Q, R = np.diag([1.0, 2, 3, 0]), np.array([[2.0, 0.3], [0.3, 1]])
    gains = track([0, 0, 0, 0], [0, 0], Q=Q, R=R, Qf=np.zeros((4, 4)), p={"k": 0.5})
    wanted = ocp.care(0.5 * A, B, Q[:3, :3], R).S
    np.testing.assert_allclose(gains.S[0][:3, :3], wanted, rtol=1e-7)
    np.testing.assert_allclose(gains.K[0][:, :3], np.linalg.solve(R, B.T @ wanted), rtol=1e-7, atol=1e-10)


def test_exact_derivative_with_respect_to_a_parameter(n1):
    # the whole synthesis is one function: its Jacobian is that of flight time and gains
    model, reference = n1.reference.model, n1.reference
    track = ocp.tracker(model, until=ocp.falls_below("h", 10e3), steps=48, t_max=600.0)
    scale = np.array([500.0, 0.1, 2e3, 1e4])
    upper = np.diag(scale**-2)[np.triu_indices(4)]
    values = [reference.x[0], reference.u[0], model.p0, upper, [0.06**2], 100 * upper]
    names = ["x0", "u", "p", "Q", "R_inverse", "Qf"]
    derivative = track.function.factory("derivative", names, ["jac:t_f:p"]).call([ca.DM(v) for v in values])[0].full()[0]
    column, step = model.index("rho_factor"), 1e-4

    def time(change):
        p = model.p0.copy()
        p[column] += change
        flight = ocp.simulate(model, ocp.constant(lift_ratio=reference.u[0, 0]), x0=reference.x[0], p=p, until=ocp.falls_below("h", 10e3))
        return flight.t[-1]

    assert derivative[column] == pytest.approx((time(step) - time(-step)) / (2 * step), rel=1e-6)


def test_a_stop_out_of_reach_and_bad_arguments(n1):
    Q, R, F = weights(Scenario.default())
    model, start = n1.reference.model, (n1.reference.x[0], n1.reference.u[0])
    until = ocp.falls_below("h", 10e3)
    with pytest.raises(ModelError, match="STOP_NOT_REACHED"):
        ocp.tracker(model, until=until, t_max=300.0)(*start, Q=Q, R=R, Qf=F)
    with pytest.raises(ModelError, match="one stop condition"):
        ocp.tracker(model, until=ocp.first_of(until, ocp.rises_above("s", 1e9)))
    with pytest.raises(ModelError, match="steps"):
        ocp.tracker(model, until=until, steps=2)
    with pytest.raises(ModelError, match="'altitude'"):
        ocp.tracker(model, until=ocp.falls_below("altitude", 1e4))
    track = ocp.tracker(model, until=until)
    with pytest.raises(ModelError, match="positive definite"):
        track(*start, Q=Q, R=[[-1.0]], Qf=F)
    with pytest.raises(ModelError, match=r"x0: gamma"):
        track([7800, -1.36, 1e5, 0], start[1], Q=Q, R=R, Qf=F)
    with pytest.raises(ModelError, match="one for each state"):
        ocp.tracker(model, until=until, measured=("n_x", "hdot"))


def test_tabulated_atmosphere():
    model = models.entry_planar(models.SOYUZ, atmosphere=models.us76_smooth())
    x0, u = model.state(V=7619.0, gamma=-0.026, h=99.7e3, s=0.0), [0.18]
    until = ocp.falls_below("h", 10.8e3)
    scale = np.array([500.0, 0.1, 2e3, 1e4])
    Q, R = np.diag(scale**-2), [[0.06**-2]]
    reference = ocp.simulate(model, ocp.constant(lift_ratio=0.18), x0=x0, until=until, method=ocp.RK8(step=0.25))
    found = ocp.tracker(model, until=until, steps=600, search=1.0)(x0, u, Q=Q, R=R, Qf=100 * Q)
    assert found.t[-1] == pytest.approx(reference.t[-1], rel=1e-8)
    wanted = ocp.tvlqr(ocp.linearize(reference), Q=Q, R=R, Qf=100 * Q).at(found.t[1:-1])
    assert relative(found.K[1:-1, 0], wanted.K[:, 0]) < 1e-4
