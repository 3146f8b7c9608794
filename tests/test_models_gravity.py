"""Gravity: gradient of its potential by central differences, the closed components, the central limit."""

import casadi as ca
import numpy as np
import pytest

from models import gravity, units
from models.checked import ModelError, evaluate

EARTH = {"mu": units.MU_EARTH, "J2": units.J2_EARTH, "radius": units.R_EQUATOR_EARTH}


def position(lat_deg: float, lon_deg: float, distance: float) -> np.ndarray:
    lat, lon = np.radians([lat_deg, lon_deg])
    return distance * np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def functions(**field: float) -> tuple[ca.Function, ca.Function]:
    r = ca.SX.sym("r", 3)
    return ca.Function("U", [r], [gravity.potential(r, **field)]), ca.Function("g", [r], [gravity.acceleration(r, **field)])


PLACES = [(36.0, 25.0), (80.0, -130.0), (-51.0, 77.0)]


@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_acceleration_is_the_gradient_of_the_potential(lat: float, lon: float) -> None:
    U, g = functions(**EARTH)
    r, step = position(lat, lon, 6.45e6), 3e3
    offsets, weights = np.array([-2, -1, 1, 2]), np.array([1, -8, 8, -1]) / 12
    points = r + step * offsets[None, :, None] * np.eye(3)[:, None, :]
    differences = evaluate(U, points.reshape(-1, 3))[0].reshape(3, 4) @ weights / step
    found = evaluate(g, r)[0]
    assert np.max(np.abs(found - differences)) < 1e-9 * np.linalg.norm(found)


@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_components_equal_the_closed_form(lat: float, lon: float) -> None:
    # Vallado, eq. for the J2 perturbation: the bracket of z differs from that of x and y
    r = position(lat, lon, 6.6e6)
    d = np.linalg.norm(r)
    ratio, sin2 = 1.5 * units.J2_EARTH * (units.R_EQUATOR_EARTH / d) ** 2, (r[2] / d) ** 2
    expected = -units.MU_EARTH / d**3 * r * (1 + ratio * (np.array([1, 1, 3]) - 5 * sin2))
    assert evaluate(functions(**EARTH)[1], r)[0] == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_spherical_components_are_the_same_vector(lat: float, lon: float) -> None:
    distance, latitude = ca.SX.sym("d"), ca.SX.sym("lat")
    both = ca.Function("g", [distance, latitude], [ca.vertcat(*gravity.spherical(distance, latitude, **EARTH))])
    radial, north = evaluate(both, np.array([6.5e6]), np.array([np.radians(lat)]))[0]
    g = evaluate(functions(**EARTH)[1], position(lat, lon, 6.5e6))[0]
    la, lo = np.radians([lat, lon])
    up = np.array([np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)])
    to_north = np.array([-np.sin(la) * np.cos(lo), -np.sin(la) * np.sin(lo), np.cos(la)])
    assert radial == pytest.approx(g @ up, rel=1e-13)
    assert north == pytest.approx(g @ to_north, rel=1e-10)
    assert np.sign(north) == -np.sign(lat)


def test_central_limit() -> None:
    r = position(36.0, 25.0, 7e6)
    g = evaluate(functions(mu=units.MU_EARTH, J2=0.0, radius=units.R_EQUATOR_EARTH)[1], r)[0]
    assert g == pytest.approx(-units.MU_EARTH * r / 7e6**3, rel=1e-14)


def test_a_zonal_field_has_no_torque_about_the_axis_and_is_weaker_at_the_equator() -> None:
    g = functions(**EARTH)[1]
    r = position(36.0, 25.0, 6.5e6)
    found = evaluate(g, r)[0]
    assert abs(r[0] * found[1] - r[1] * found[0]) < 1e-15 * np.linalg.norm(r) * np.linalg.norm(found)
    equator, pole = (np.linalg.norm(evaluate(g, position(lat, 25.0, 6.5e6))[0]) for lat in (0.0, 90.0))
    assert equator / pole == pytest.approx((1 + 1.5 * 1.0424e-3) / (1 - 3 * 1.0424e-3), rel=1e-5)  # J2 (radius/6500 km)^2 = 1.0424e-3


def test_argument_may_be_an_expression_and_must_be_a_column_of_three() -> None:
    s = ca.SX.sym("s")
    r = position(36.0, 25.0, 6.5e6)
    along = ca.Function("g", [s], [gravity.acceleration(s * ca.DM(r), **EARTH)])
    assert along(2.0).full().ravel() == pytest.approx(evaluate(functions(**EARTH)[1], 2 * r)[0], rel=1e-14)
    with pytest.raises(ModelError, match=r"r has shape \(1, 3\)"):
        gravity.potential(ca.SX.sym("r", 1, 3), **EARTH)
