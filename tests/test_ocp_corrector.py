"""Landing laws: geometry of the target, estimators, the Gauss-Newton step, closed loops with and without compiled code, footprint."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from models import native
from models.core import ModelError, Status, evaluate
from models.entry_cartesian import to_cartesian
from models.entry_truth import Servo, entry_onboard, entry_truth
from models.units import DEG
from models.vehicles import from_ratios
from ocp.corrector import OneReversal, one_reversal_law
from ocp.corrector_modern import SeveralReversals, ramp, several_reversals_law
from ocp.corrector_newton import Bounds, corrected
from ocp.corrector_onboard import ESTIMATED, Estimators
from ocp.landing import fly, great_circle, target
from ocp.landing_footprint import nearest
from ocp.landing_optimal import best_profile
from ocp.methods import RK4
from ocp.predictor import Path, prediction
from ocp.simulate import simulate
from ocp.stops import falls_below

VEHICLE = from_ratios("N2", ballistic_coefficient=450.0, lift_to_drag=0.3)
ONBOARD, TRUTH = entry_onboard(VEHICLE), entry_truth(VEHICLE)
RADIUS = 6371e3 + 10e3
ENTRY = np.array([100e3, 108 * DEG, 17 * DEG, 7650.0, -1.6 * DEG, 8 * DEG])
STEEP = ENTRY + np.array([0, 0, 0, 0, -0.6 * DEG, 0])
X0 = to_cartesian(ENTRY)
LAT, LON = 39.180093295935 * DEG, 112.300634384988 * DEG
PLACE = 6371e3 * np.array([np.cos(LAT) * np.cos(LON), np.cos(LAT) * np.sin(LON), np.sin(LAT)])
TARGET = target(X0[:3], PLACE, radius=6371e3)
compiled = pytest.mark.skipif(not native.native_available(), reason="no compiler: minutes")


def start(count):
    return np.tile(np.concatenate([X0, [45 * DEG, 0.0, 0.0, 0.0]]), (count, 1)), np.tile(TRUTH.p0, (count, 1))


def test_miss_is_told_along_and_to_the_right_of_the_great_circle():
    assert TARGET.miss(PLACE * 1.01) == pytest.approx([0.0, 0.0], abs=1e-6)
    toward = X0[:3] / np.linalg.norm(X0[:3])
    on_the_way = PLACE / 6371e3 + 1e-3 * toward  # nearer to the entry: short
    along, cross = TARGET.miss(on_the_way)
    assert along < -1e3
    assert cross == pytest.approx(0.0, abs=1e-6)
    # flying north, east is to the right
    east = TARGET.miss(PLACE + np.array([-np.sin(LON), np.cos(LON), 0.0]) * 1e4)
    assert east[1] > 9e3
    r = PLACE + np.array([3e4, -2e4, 5e4])
    symbol = ca.SX.sym("r", 3)
    assert np.asarray(ca.Function("m", [symbol], [TARGET.expression(symbol)])(r)).ravel() == pytest.approx(TARGET.miss(r), rel=1e-12)
    assert TARGET.miss(TARGET.point(np.array([[12e3, -7e3]])) * 6371e3)[0] == pytest.approx([12e3, -7e3], rel=1e-5)
    assert great_circle(X0[:3], PLACE, radius=6371e3) == pytest.approx(2501302.83, rel=1e-8)


def test_a_target_under_the_entry_has_no_direction():
    with pytest.raises(ModelError, match="under the entry"):
        target(X0[:3], 2 * X0[:3], radius=6371e3)


def estimated(estimators, steps, truth, *, bank=0.7, sample=1.0, h=40e3, V=3000.0, gamma=-0.1):
    """Estimates after steps at one state, fed with the forces of a model on board with other parameters."""
    nav = to_cartesian([h, 1.9, 0.5, V, gamma, 0.2])
    first = ONBOARD.index("force_x")
    force = ONBOARD.y(nav, [bank], truth)[first : first + 3]
    memory = {name: ca.SX.sym(name) for name in ESTIMATED}
    new = estimators.step(ONBOARD, sample, ca.SX(ca.DM(nav)), ca.SX(ca.DM(force)), ca.SX(bank), memory)
    step = ca.Function("step", [ca.vertcat(*memory.values())], [ca.vertcat(*[new[n] for n in memory])])
    values = ca.DM(list(ESTIMATED.values()))
    for _ in range(steps):
        values = step(values)
    return dict(zip(ESTIMATED, np.asarray(values).ravel(), strict=True))


def test_density_and_lift_are_found_by_a_fading_filter():
    found = estimated(Estimators(density_s=8.0, lift_s=30.0), 5, {"rho_factor": 1.3, "CL_factor": 0.9})
    assert found["rho"] == pytest.approx(1.3 - 0.3 * np.exp(-5 / 8), rel=1e-9)
    assert found["lift"] == pytest.approx(0.9 + 0.1 * np.exp(-5 / 30), rel=1e-9)
    assert found["wind_east"] == 0.0


def test_nothing_is_learned_without_air():
    assert estimated(Estimators(), 50, {"rho_factor": 1.3}, h=99e3) == pytest.approx(ESTIMATED)


def test_wind_is_found_from_the_direction_of_the_force():
    found = estimated(Estimators(wind_s=10.0), 80, {"wind_east": 25.0}, h=14e3, V=260.0, gamma=-0.9)
    assert found["wind_east"] == pytest.approx(25.0, rel=0.1)
    assert abs(found["wind_north"]) < 5.0
    assert found["lift"] == 1.0  # frozen below 26 km, where a cross wind looks like lift
    assert estimated(Estimators(wind_s=None), 80, {"wind_east": 25.0}, h=14e3, V=260.0, gamma=-0.9)["lift"] != 1.0


@pytest.mark.parametrize("seed", range(12))
def test_step_is_the_bounded_least_squares_step(seed):
    """Against scipy's bounded least squares of the same damped linear problem."""
    rng = np.random.default_rng(seed)
    J, miss = rng.normal(size=(2, 2)) * [2e5, 2e3], rng.normal(size=2) * 1e4
    trust, scale = (0.05, 3.0), (0.2, 10.0)
    u0, low, high = np.array([0.6, 200.0]), np.array([0.0, 199.0]), np.array([0.62, 400.0])
    bounds = Bounds(ca.SX(ca.DM(low)), ca.SX(ca.DM(high)), trust, scale)

    def linear(u):
        rest = ca.DM(miss) + ca.DM(J) @ (u - ca.DM(u0))
        return rest, ca.SX(500.0), ca.SX(1.0)

    u, left, _ = corrected(
        ca.SX(ca.DM(u0)), (ca.SX(ca.DM(miss)), ca.SX(500.0), ca.SX(1.0)), ca.SX(ca.DM(J)), linear, bounds, free=ca.SX(1), fractions=(1.0,)
    )
    found = np.array([float(v) for v in ca.vertsplit(ca.evalf(u))])
    a = J * scale
    weight = np.sqrt(1e-3 * (a**2).sum() + 1.0)
    box = np.array([np.maximum(low - u0, -np.array(trust)), np.minimum(high - u0, trust)]) / scale
    best = lsq_linear(np.vstack([a, weight * np.eye(2)]), np.concatenate([-miss, np.zeros(2)]), bounds=box, tol=1e-12).x * scale
    cost = np.linalg.norm(miss + J @ best)
    assert (found >= low - 1e-12).all()
    assert (found <= high + 1e-12).all()
    assert np.linalg.norm(miss + J @ (found - u0)) <= cost * 1.02 + 1.0
    assert np.linalg.norm(np.asarray(ca.evalf(left))) <= np.linalg.norm(miss)


def test_a_free_step_solves_the_damped_normal_equations():
    J, miss, scale = np.array([[-7e5, 4e2], [9e4, 1.1e3]]), np.array([2e4, -1e4]), (0.2, 10.0)
    bounds = Bounds(ca.SX([-9, -9e3]), ca.SX([9, 9e3]), (9.0, 9e3), scale)

    def anything(u):
        return ca.SX.zeros(2), ca.SX(500.0), ca.SX(1.0)

    base = (ca.SX(ca.DM(miss)), ca.SX(500.0), ca.SX(1.0))
    u, _, _ = corrected(ca.SX.zeros(2), base, ca.SX(ca.DM(J)), anything, bounds, free=ca.SX(1), fractions=(1.0,))
    a = J * scale
    wanted = np.linalg.solve(a.T @ a + (1e-3 * (a**2).sum() + 1.0) * np.eye(2), -a.T @ miss) * scale
    assert [float(v) for v in ca.vertsplit(ca.evalf(u))] == pytest.approx(wanted, rel=1e-10)


def test_a_step_that_makes_it_worse_is_not_taken():
    def worse(u):
        return ca.SX(ca.DM([5e4, 0.0])), ca.SX(500.0), ca.SX(1.0)

    base = (ca.SX(ca.DM([1e3, 1e3])), ca.SX(510.0), ca.SX(1.0))
    bounds = Bounds(ca.SX([0, 0]), ca.SX([3, 500]), (0.3, 40.0), (0.2, 10.0))
    u, miss, t_f = corrected(ca.SX([1, 200]), base, ca.SX.eye(2) * 1e4, worse, bounds, free=ca.SX(1), fractions=(1.0, 0.5))
    assert [float(v) for v in ca.vertsplit(ca.evalf(u))] == [1.0, 200.0]
    assert float(ca.evalf(t_f)) == 510.0
    assert float(ca.evalf(miss)[0]) == 1e3


@pytest.mark.parametrize("degrees", [5.0, 30.0, 120.0])
def test_ramp_has_the_integral_of_the_fastest_response(degrees):
    """Bang-bang acceleration under the limit of rate, integrated in closed form."""
    servo, angle = Servo(), degrees * DEG
    delay, duration = (float(ca.evalf(v)) for v in ramp(servo, ca.SX(angle)))
    a, w = servo.acceleration, servo.rate
    total = angle / w + w / a if angle > w * w / a else 2 * np.sqrt(angle / a)
    lost = angle * total / 2  # of a response that is symmetric about its middle: the integral of what is still to go
    assert angle * (delay + duration / 2) == pytest.approx(lost, rel=1e-9)


def laws():
    common = {"plant": TRUTH, "radius": RADIUS, "servo": Servo()}
    return {
        "paper": one_reversal_law(ONBOARD, TARGET, **common),
        "modern": several_reversals_law(ONBOARD, TARGET, **common),
    }


LAWS = laws()


@compiled
@pytest.mark.parametrize(("name", "metres", "reversals"), [("paper", 100.0, 1), ("modern", 100.0, 4)])
def test_nominal_flight_lands_at_the_target(name, metres, reversals):
    x0, p = start(1)
    flown = fly(LAWS[name], x0=x0, p=p, altitude=10e3)
    assert flown.status == (Status.OK,)
    assert flown.distance[0] < metres
    assert flown["reversals"][0] == reversals
    assert np.linalg.norm(flown.x[0, :3]) == pytest.approx(RADIUS, abs=1e-3)
    assert flown["peak"][0] < 4.0


@compiled
def test_compiled_and_interpreted_loops_agree():
    x0, p = start(2)
    p[:, TRUTH.index("rho_factor")] = [0.9, 1.1]
    law = one_reversal_law(
        ONBOARD,
        TARGET,
        plant=TRUTH,
        radius=RADIUS,
        servo=Servo(),
        config=OneReversal(steps=16, sample_s=5.0, estimators=Estimators(30.0, 15.0, None)),
    )
    native_, plain = (fly(law, x0=x0, p=p, altitude=10e3, step=0.5, native=n) for n in ("accurate", "off"))
    assert native_.x == pytest.approx(plain.x, rel=1e-9, abs=1e-6)
    assert native_.t == pytest.approx(plain.t, rel=1e-10)


@compiled
def test_estimates_end_at_the_truth():
    x0, p = start(2)
    p[:, TRUTH.index("rho_factor")], p[:, TRUTH.index("CL_factor")] = [1.2, 0.85], [0.95, 1.04]
    flown = fly(LAWS["modern"], x0=x0, p=p, altitude=10e3)
    assert flown["rho"] == pytest.approx([1.2, 0.85], rel=1e-3)
    assert flown["lift"] == pytest.approx([0.95, 1.04], rel=5e-3)
    assert flown.distance.max() < 150.0


@compiled
def test_an_unreachable_target_is_flown_to_as_near_as_can_be():
    x0, p = start(1)
    x0[0, :6] = to_cartesian(STEEP)
    flown = fly(LAWS["modern"], x0=x0, p=p, altitude=10e3)
    reach = nearest(ONBOARD, TARGET, x=x0[0, :6], radius=RADIUS)
    assert reach.status == (Status.OUTSIDE_FOOTPRINT,)
    assert 5e3 < reach.distance[0] <= flown.distance[0] < reach.distance[0] + 1e3


@compiled
def test_reachable_points_are_reached_and_the_reach_is_the_largest():
    inside = nearest(ONBOARD, TARGET, x=X0, radius=RADIUS, wanted=[[0.0, 0.0], [-200e3, 60e3]])
    assert inside.distance.max() < 1.0
    assert inside.status == (Status.OK, Status.OK)
    far = nearest(ONBOARD, TARGET, x=X0, radius=RADIUS, wanted=[[4e6, 0.0]])
    rng = np.random.default_rng(4)
    flight = prediction(ONBOARD, Path(8, 96), radius=RADIUS)
    bank = rng.uniform(-1.0, 1.0, (200, 8))  # no profile of a random search goes farther than the optimized one
    none = np.zeros(0)
    ends = evaluate(flight, X0, np.zeros(1), np.array([900.0]), far.t, bank, ONBOARD.p0, none, none, none, none)
    assert TARGET.miss(ends[0][:, :3])[:, 0].max() < far.miss[0, 0]
    assert far.miss[0, 0] > 400e3


def test_ipopt_finds_a_profile_to_the_target_and_its_replay_agrees():
    p = ONBOARD.parameters({"rho_factor": 1.2, "CL_factor": 0.93})
    best = best_profile(ONBOARD, TARGET, x=X0, radius=RADIUS, p=p)
    assert best.status is Status.OK
    assert np.hypot(*best.miss) < 1.0
    assert best.replay_error < 1.0
    assert np.abs(best.bank).max() <= np.pi


@compiled
def test_ipopt_and_the_quasi_newton_method_find_the_same_nearest_point():
    x = to_cartesian(STEEP)
    best = best_profile(ONBOARD, TARGET, x=x, radius=RADIUS)
    reach = nearest(ONBOARD, TARGET, x=x, radius=RADIUS)
    assert best.status is Status.OUTSIDE_FOOTPRINT
    assert np.hypot(*best.miss) == pytest.approx(reach.distance[0], rel=2e-3)


@pytest.mark.slow
@compiled
def test_load_limit_is_kept():
    x0, p = start(1)
    limited = several_reversals_law(ONBOARD, TARGET, plant=TRUTH, radius=RADIUS, servo=Servo(), config=SeveralReversals(load_limit=3.1))
    free, held = (fly(law, x0=x0, p=p, altitude=10e3) for law in (LAWS["modern"], limited))
    assert free["peak"][0] > 3.4
    assert held["peak"][0] < 3.15
    assert held.distance[0] < 500.0


@pytest.mark.slow
def test_heat_limit_lowers_the_heating_and_the_flight_still_lands():
    x0, p = start(1)
    peaks = []
    for limit in (np.inf, 1.0e6):
        config = SeveralReversals(heat_limit=limit)
        law = several_reversals_law(ONBOARD, TARGET, plant=TRUTH, radius=RADIUS, servo=Servo(), config=config)
        flown = simulate(TRUTH, law.law, x0=x0[0], p=p[0], until=falls_below("h", 10e3), method=RK4(step=0.25))
        heat = evaluate(ONBOARD.out, flown.x[:, :6], flown.x[:, 6:7], ONBOARD.p0)[0][:, ONBOARD.index("heat")]
        peaks.append(heat.max())
        assert np.hypot(*TARGET.miss(flown.x[-1, :3])) < 500.0
    assert peaks[1] < 0.98 * peaks[0]


def test_refusals():
    with pytest.raises(ModelError, match="kappa"):
        SeveralReversals(kappa=1.0)
    with pytest.raises(ModelError, match="reversals"):
        SeveralReversals(reversals=-1)
    with pytest.raises(ModelError, match="cycle_s"):
        OneReversal(cycle_s=0.0)
    with pytest.raises(ModelError, match="density_s"):
        Estimators(density_s=-1.0)
    with pytest.raises(ModelError, match="lacks"):
        one_reversal_law(ONBOARD, TARGET, plant=ONBOARD, radius=RADIUS, servo=Servo())
    x0, p = start(2)
    with pytest.raises(ModelError, match="rows"):
        fly(LAWS["paper"], x0=x0, p=p[:1], altitude=10e3)
    with pytest.raises(ModelError, match="native"):
        fly(LAWS["paper"], x0=x0, p=p, altitude=10e3, native="gpu")
    with pytest.raises(ModelError, match=r"\(N, 2\)"):
        nearest(ONBOARD, TARGET, x=X0, radius=RADIUS, wanted=[0.0, 0.0])
