"""Landing prediction: against scipy in hand-written equations, CVODES, central differences, and its own order of convergence."""

import casadi as ca
import numpy as np
import pytest

from benchmarks import _landing_scipy
from models import native
from models.core import ModelError, evaluate
from models.entry import Planet
from models.entry_cartesian import to_cartesian
from models.entry_truth import entry_onboard
from models.units import DEG, OMEGA_EARTH
from models.vehicles import from_ratios
from ocp.predictor import Path, prediction
from ocp.predictor_adaptive import predict

VEHICLE = from_ratios("N2", ballistic_coefficient=450.0, lift_to_drag=0.3)
MODEL = entry_onboard(VEHICLE, planet=Planet(rotation=OMEGA_EARTH))
RADIUS = 6371e3 + 10e3
X0 = to_cartesian([100e3, 108 * DEG, 17 * DEG, 7650.0, -1.6 * DEG, 8 * DEG])
T, B = np.array([245.0, 275.0]), np.array([45.0, -45.0]) * DEG
NP = len(MODEL.params)
none = np.zeros


def landed(path, *, x=X0, t=0.0, T=T, B=B, p=None, radius=RADIUS, seeds=0, dx=(), dT=(), dB=(), dp=(), peaks=()):
    flight = prediction(MODEL, path, radius=radius, seeds=seeds, peaks=peaks)
    full = [np.asarray(v, dtype=float) if len(v) else none(n * seeds) for v, n in ((dx, 6), (dT, len(T)), (dB, len(B)), (dp, NP))]
    return evaluate(flight, x, np.array([t]), np.array([700.0 - t]), T, B, MODEL.parameters(p), *full)


def test_reference_lands_where_scipy_lands():
    t_f, end = _landing_scipy.fall(X0, T, B, stop=10e3, rtol=1e-12, atol=1e-6)
    out = landed(Path(2, 200, order=8))
    assert t_f == pytest.approx(541.273, rel=2e-6)
    assert out[1][0] == pytest.approx(t_f, abs=1e-5)
    assert np.linalg.norm(out[0][:3] - end[:3]) < 0.01
    assert out[2][0] == 1.0
    assert np.linalg.norm(out[0][:3]) == pytest.approx(RADIUS, abs=1e-6)
    adaptive = predict(MODEL, x=X0, T=T, B=B, radius=RADIUS)
    assert np.linalg.norm(adaptive.x_f[:3] - end[:3]) < 0.1
    assert np.linalg.norm(adaptive.x_f[:3] - out[0][:3]) < 1.0


def test_kinks_are_restart_points():
    """A method that steps over a kink loses its order."""
    true = landed(Path(2, 800, order=8))[0][:3]
    errors = [np.linalg.norm(landed(Path(2, n))[0][:3] - true) for n in (100, 200, 400)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4.0, 4.0], abs=0.15)
    assert errors[0] < 5.0


def test_derivatives_are_differences_of_scipy():
    flight = landed(Path(2, 200, order=8), seeds=2, dT=[0, 0, 1, 1], dB=[*B, 0, 0])

    def point(beta, shift):
        return _landing_scipy.fall(X0, T + shift, B * (1 + beta), stop=10e3, rtol=1e-12, atol=1e-6)[1][:3]

    by_beta = (point(1e-3, 0) - point(-1e-3, 0)) / 2e-3
    by_time = (point(0, 0.2) - point(0, -0.2)) / 0.4
    assert np.abs(flight[4][:3] - by_beta).max() < 1e-5 * np.abs(by_beta).max()
    assert np.abs(flight[4][6:9] - by_time).max() < 1e-5 * np.abs(by_time).max()
    up = flight[0][:3] / RADIUS
    assert abs(up @ flight[4][:3]) < 1e-6 * np.abs(by_beta).max()  # the landing point stays at the stop radius


def test_derivatives_to_state_and_parameters_are_central_differences():
    rng = np.random.default_rng(5)
    dx, dp = rng.normal(size=6) * [100, 100, 100, 1, 1, 1], np.zeros(NP)
    dp[MODEL.index("rho_factor")], dp[MODEL.index("CL_factor")], dp[MODEL.index("wind_east")] = 0.02, -0.03, 5.0
    path = Path(2, 150, order=8)
    out = landed(path, seeds=1, dx=dx, dp=dp)
    e = 1e-2
    ends = [landed(path, x=X0 + s * e * dx, p=MODEL.p0 + s * e * dp) for s in (1, -1)]
    assert out[4][:6] == pytest.approx((ends[0][0] - ends[1][0]) / (2 * e), rel=1e-5, abs=1e-4)
    assert out[5] == pytest.approx((ends[0][1] - ends[1][1]) / (2 * e), rel=1e-5)


def test_event_term_matters():
    """At a fixed time the derivative differs by the motion over the change of the arrival time."""
    out = landed(Path(2, 200, order=8), seeds=1, dB=[*B])
    at_fixed_time = out[4][:3] - out[0][3:] * out[5][0]
    assert np.linalg.norm(at_fixed_time - out[4][:3]) > 1e-2 * np.linalg.norm(out[4][:3])


def test_adaptive_sensitivities_agree_with_the_fixed_steps():
    seeds = np.eye(2)
    out = landed(Path(2, 200, order=8), seeds=4, dT=np.concatenate([seeds.ravel(), none(4)]), dB=np.concatenate([none(4), seeds.ravel()]))
    fixed = out[4].reshape(4, 6).T
    adaptive = predict(MODEL, x=X0, T=T, B=B, radius=RADIUS)
    assert np.abs(adaptive.by_T - fixed[:, :2]).max() < 1e-6 * np.abs(fixed).max()
    assert np.abs(adaptive.by_B - fixed[:, 2:]).max() < 1e-6 * np.abs(fixed).max()
    dp = np.zeros(NP)
    dp[MODEL.index("rho_factor")] = 1.0
    by_density = landed(Path(2, 200, order=8), seeds=1, dp=dp)[4][:6]
    assert adaptive.by_p[:, MODEL.index("rho_factor")] == pytest.approx(by_density, rel=1e-5)


def test_a_start_inside_or_after_the_profile_agrees_with_the_whole_flight():
    whole = landed(Path(2, 400, order=8))
    for t in (250.0, 300.0):
        state = landed_at(t)
        rest = landed(Path(2, 200, order=8), x=state, t=t)
        assert np.linalg.norm(rest[0][:3] - whole[0][:3]) < 0.05
        assert rest[1][0] == pytest.approx(whole[1][0], abs=1e-4)
        adaptive = predict(MODEL, x=state, t=t, T=T, B=B, radius=RADIUS)
        assert np.linalg.norm(adaptive.x_f[:3] - whole[0][:3]) < 0.5


@pytest.mark.parametrize("t", [250.0, 300.0])
def test_nodes_in_the_past_move_the_landing_only_through_the_bank_angle_that_is_left(t):
    """Against CVODES, which restarts at the nodes ahead only; of all nodes past, only the last bank angle counts."""
    seeds, state = np.eye(2), landed_at(t)
    dT, dB = np.concatenate([seeds.ravel(), none(4)]), np.concatenate([none(4), seeds.ravel()])
    fixed = landed(Path(2, 200, order=8), x=state, t=t, seeds=4, dT=dT, dB=dB)[4].reshape(4, 6).T
    adaptive = predict(MODEL, x=state, t=t, T=T, B=B, radius=RADIUS)
    assert np.abs(adaptive.by_T - fixed[:, :2]).max() < 1e-6 * np.abs(fixed).max()
    assert np.abs(adaptive.by_B - fixed[:, 2:]).max() < 1e-6 * np.abs(fixed).max()


def landed_at(t):
    """State of the reference at time t, by scipy."""
    from scipy.integrate import solve_ivp

    x, begin = X0, 0.0
    for end, bank, slope in ((245.0, B[0], 0.0), (275.0, B[0], (B[1] - B[0]) / 30.0), (900.0, B[1], 0.0)):
        line, stop = (bank, begin, slope), min(end, t)
        if stop > begin:
            x = solve_ivp(_landing_scipy.rate(line), (begin, stop), x, method="DOP853", rtol=1e-12, atol=1e-6).y[:, -1]
        begin = end
    return x


def test_peaks_and_flights_that_do_not_land():
    out = landed(Path(2, 800), peaks=("load", "heat"))
    assert out[3][0] == pytest.approx(3.29764, rel=2e-4)
    assert 5e5 < out[3][1] < 2e6
    skip = to_cartesian([100e3, 1.9, 0.3, 9500.0, 0.5 * DEG, 0.1])
    assert landed(Path(2, 60), x=skip)[2][0] == 0.0


@pytest.mark.skipif(not native.native_available(), reason="no compiler")
def test_compiled_lanes_give_the_numbers_of_the_interpreter():
    flight = prediction(MODEL, Path(2, 60), radius=RADIUS, seeds=1)
    rng = np.random.default_rng(2)
    x = X0 + rng.normal(size=(5, 6)) * [100, 100, 100, 1, 1, 1]
    arguments = (x, none(1), np.array([700.0]), T, B, MODEL.p0, none(6), np.array([1.0, 1.0]), none(2), none(NP))
    compiled, plain = native.compile(flight), evaluate(flight, *arguments)
    assert compiled.backend == "lanes"
    for a, b in zip(compiled(*arguments), plain, strict=True):
        assert a == pytest.approx(b, rel=1e-12, abs=1e-9)


def test_casadi_differentiates_the_prediction_too():
    """What the optimization of bank profiles relies on: derivatives through the nested calls."""
    flight = prediction(MODEL, Path(2, 60), radius=RADIUS)
    bank = ca.MX.sym("bank", 2)
    end = flight(X0, 0, 700.0, T, bank, MODEL.p0, [], [], [], [])[0]
    J = np.asarray(ca.Function("J", [bank], [ca.jacobian(end, bank)])(B).full())
    out = landed(Path(2, 60), seeds=2, dB=np.eye(2).ravel())
    # one differentiates the last Runge-Kutta step, the other takes the equations of motion there
    assert J.T.ravel()[:3] == pytest.approx(out[4][:3], rel=1e-4)


def test_refusals():
    with pytest.raises(ModelError, match="steps"):
        Path(2, 0)
    with pytest.raises(ModelError, match="order"):
        Path(2, 10, order=5)
    with pytest.raises(ModelError, match="radius"):
        prediction(MODEL, Path(2, 10), radius=-1.0)
    with pytest.raises(ModelError, match="seeds"):
        prediction(MODEL, Path(2, 10), radius=RADIUS, seeds=-1)
    with pytest.raises(ModelError, match="laod"):
        prediction(MODEL, Path(2, 10), radius=RADIUS, peaks=("laod",))
    with pytest.raises(ModelError, match="increasing"):
        predict(MODEL, x=X0, T=T[::-1], B=B, radius=RADIUS)
    with pytest.raises(ModelError, match="after the last node"):
        predict(MODEL, x=X0, T=T + 600.0, B=B, radius=RADIUS)
