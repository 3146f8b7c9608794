"""Entry in Cartesian axes against the spherical model, gravity's potential, an invariant and its own Jacobian."""

import math

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models import gravity, wind
from models.core import ModelError
from models.entry_cartesian import PLACE

MU, W, J2, RE = 3.986004418e14, 7.292115e-5, 1.08262668e-3, 6378137.0
CAPSULE = models.Vehicle("capsule", 2900.0, 3.8, 0.35, 1.34)
STONE = models.Vehicle("stone", 1e7, 1e-9, 0.3, 1.0)
BREEZE = wind.from_table([0.0, 2e4, 5e4, 8e4, 1e5], [20.0, 60.0, -40.0, 30.0, 30.0], [-5.0, 10.0, 50.0, -30.0, -30.0])
STARTS = ([8e4, 0.4, 0.7, 7400.0, -0.02, 0.9], [9e4, -1.0, -0.5, 7600.0, -0.025, 4.0])
SETTINGS = {
    "Earth": {},
    "sphere": {"planet": models.SPHERE},
    "wind and tables": {"wind": BREEZE, "atmosphere": models.us76_smooth()},
    "another planet": {"planet": models.Planet(mu=4.28e13, radius=3.39e6, rotation=7.1e-5, J2=1.96e-3, equatorial_radius=3.396e6)},
}


def speeds(start, planet):
    return [start[0], *start[1:3], start[3] * math.sqrt(planet.mu / planet.radius / 6.26e7), *start[4:]]


@pytest.mark.parametrize("bank", [0.8, -1.2])
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("setting", SETTINGS)
def test_flights_are_those_of_the_spherical_model(setting, start, bank):
    options = SETTINGS[setting]
    planet = options.get("planet", models.EARTH)
    x0 = speeds(start, planet)
    p = {"rho_factor": 1.2, "CL_factor": 0.9, "CD_factor": 1.1, "wave_amplitude": 0.05, "wave_phase": 0.4, "mass": 2500.0}
    one, other = models.entry_3dof(CAPSULE, **options), models.entry_cartesian(CAPSULE, **options)
    law, until = ocp.constant(bank=bank), ocp.falls_below("h", 25e3)
    polar = ocp.simulate(one, law, x0=x0, p=p, until=until, method=ocp.RK8(step=2.0))
    flat = ocp.simulate(other, law, x0=models.to_cartesian(x0, planet=planet), p=p, until=until, method=ocp.RK8(step=2.0))
    assert flat.t[-1] == pytest.approx(polar.t[-1], rel=1e-9)
    back = models.to_spherical(flat.x, planet=planet)
    for i, var in enumerate(one.states):
        turns = 2 * math.pi if var.unit == "rad" else math.inf
        gap = back[:, i] - polar.x[:, i]
        gap = gap if math.isinf(turns) else (gap + math.pi) % turns - math.pi
        assert np.abs(gap).max() < 1e-9 * np.abs(polar.x[:, i]).max(), var.name
        assert flat[var.name] == pytest.approx(back[:, i], rel=1e-11, abs=1e-11 * var.nominal), var.name
    for var in one.outputs:
        assert np.abs(flat[var.name] - polar[var.name]).max() < 1e-9 * np.abs(polar[var.name]).max(), var.name


def test_gravity_is_the_gradient_of_the_potential():
    r = ca.SX.sym("r", 3)
    exact = ca.Function("g", [r], [gravity.acceleration(r, mu=MU, J2=J2, radius=RE)])
    model = models.entry_cartesian(STONE, planet=models.Planet(J2=J2))  # no rotation, hardly any air
    for place in ([5e6, -3e6, 4e6], [1e5, 2e5, -6.6e6], [-4e6, 5.1e6, 10.0]):
        found = model.xdot([*place, 0.1, 3000.0, 0.2], [0.3], {"rho_factor": 0.05})[3:]
        assert found == pytest.approx(np.asarray(exact(place)).ravel(), rel=1e-10, abs=1e-10)


def test_jacobi_constant_is_kept():
    model = models.entry_cartesian(STONE)
    x0 = models.to_cartesian([2e5, 0.3, 0.6, 7300.0, 0.05, 0.7])
    flight = ocp.simulate(model, ocp.constant(bank=0.4), x0=x0, p={"rho_factor": 0.05}, t_max=1500.0)
    place, speed = flight.x[:, :3], np.linalg.norm(flight.x[:, 3:], axis=1)
    r = np.linalg.norm(place, axis=1)
    potential = MU / r * (1 - J2 * (RE / r) ** 2 * (3 * (place[:, 2] / r) ** 2 - 1) / 2)
    jacobi = speed**2 / 2 - potential - W**2 * (place[:, 0] ** 2 + place[:, 1] ** 2) / 2
    assert np.abs(jacobi / jacobi[0] - 1).max() < 1e-10


def test_a_flight_over_the_pole():
    """The great circle of a drag-free flight without rotation passes the pole, where the spherical states end."""
    model = models.entry_cartesian(STONE, planet=models.SPHERE)
    x0 = models.to_cartesian([1e5, 0.2, math.radians(88.0), 7800.0, 0.0, 0.0])
    flight = ocp.simulate(model, ocp.constant(bank=0.0), x0=x0, p={"rho_factor": 0.05}, t_max=100.0)
    assert flight["lat"].max() > math.radians(89.9)
    assert flight["lon"][-1] == pytest.approx(0.2 - math.pi, rel=1e-9)
    momentum = np.cross(flight.x[:, :3], flight.x[:, 3:])
    assert np.abs(momentum - momentum[0]).max() < 1e-10 * np.linalg.norm(momentum[0])


@pytest.mark.parametrize("windy", [False, True])
def test_jacobian_against_central_differences(windy):
    model = models.entry_cartesian(CAPSULE, atmosphere=models.us76_smooth(), wind=BREEZE if windy else None)
    x, u = models.to_cartesian([61.3e3, 0.4, -0.7, 6543.0, -0.023, 2.2]), [0.9]
    lin = ocp.linearize(model, x=x, u=u)
    steps = np.array([5.0] * 3 + [0.5] * 3)
    for i, step in enumerate(steps):
        at = np.eye(6)[i] * step
        slope = (model.xdot(x + at, u) - model.xdot(x - at, u)) / (2 * step)
        assert np.abs(lin.A[0][:, i] - slope).max() < 1e-6 * np.abs(lin.A[0]).max(axis=0)[i]


def test_conversions_are_inverse_and_checked():
    random = np.random.default_rng(7)
    low, high = [-100.0, -3.1, -1.5, 100.0, -1.3, -3.1], [2e5, 3.1, 1.5, 9e3, 1.3, 3.1]
    x = random.uniform(low, high, (50, 6))
    assert models.to_spherical(models.to_cartesian(x)) == pytest.approx(x, rel=1e-9, abs=1e-9)
    assert models.to_cartesian(x[0]) == pytest.approx(models.to_cartesian(x)[0], rel=0)
    east = models.to_cartesian([0.0, 0.0, 0.0, 10.0, 0.0, math.pi / 2])
    assert east == pytest.approx([models.EARTH.radius, 0.0, 0.0, 0.0, 10.0, 0.0], abs=1e-9)
    north_at_90 = models.to_cartesian([0.0, math.pi / 2, 0.0, 10.0, 0.0, 0.0])
    assert north_at_90 == pytest.approx([0.0, models.EARTH.radius, 0.0, 0.0, 0.0, 10.0], abs=1e-9)
    for bad in ([1.0, 2.0], [[0.0] * 5], [0.0, 0.0, math.nan, 1.0, 0.0, 0.0]):
        with pytest.raises(ModelError, match="to_cartesian: x"):
            models.to_cartesian(bad)


def test_a_stop_evaluates_only_what_it_needs():
    model = models.entry_cartesian(CAPSULE, atmosphere=models.us76_smooth())
    x, u, p = ca.SX.sym("x", 6), ca.SX.sym("u"), ca.SX.sym("p", len(model.params))
    margin = ca.Function("margin", [x, u, p], [ocp.falls_below("h", 1e4).expression(model, x, u, p)])
    assert margin.n_instructions() < 40
    assert [v.name for v in PLACE] == ["h", "lon", "lat", "V", "gamma", "psi"]
