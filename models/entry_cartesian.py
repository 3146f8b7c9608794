"""Three-degree-of-freedom entry in planet-fixed Cartesian axes: the flights of `entry_3dof` without trigonometry or poles."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models import units
from models.atmosphere import Atmosphere, exponential
from models.checked import as_finite
from models.core import Array, Model, ModelError, Var, define
from models.entry import ALTITUDE, EARTH, OUTPUTS, Planet, density, dispersion_params, vehicle_params
from models.vehicles import Vehicle
from models.wind import Wind

STATES = (
    *(Var(name, "m", 6e6, (-1e8, 1e8), f"position {name}") for name in "xyz"),
    *(Var(name, "m/s", 7000.0, (-20e3, 20e3), f"velocity along {axis}") for name, axis in zip("uvw", "xyz", strict=True)),
)
PLACE = (
    ALTITUDE,
    Var("lon", "rad", 1.0, text="longitude"),
    Var("lat", "rad", 1.0, text="geocentric latitude"),
    Var("V", "m/s", 7000.0, text="speed"),
    Var("gamma", "rad", 0.1, text="flight-path angle"),
    Var("psi", "rad", 1.0, text="heading"),
)


def entry_cartesian(vehicle: Vehicle, *, atmosphere: Atmosphere | None = None, planet: Planet = EARTH, wind: Wind | None = None) -> Model:
    """Entry over a rotating, oblate planet in planet-fixed axes (z along the spin, x through longitude zero); the input is the bank angle.

    r' = v;  v' = -D v_a/V_a + L [cos(bank) n + sin(bank) (v_a x n)/V_a] + g(r) - 2 w x v - w x (w x r),
    v_a = v less the wind, n the unit normal of v_a that lies in the plane of r and v_a and points up.

    The same flights as :func:`models.entry.entry_3dof`, with the same parameters and sign of the bank angle, at about half the cost: no
    sine or cosine of a state is needed, and the states run smoothly over the poles and through any heading.

    Parameters
    ----------
    vehicle, atmosphere, planet, wind : as in :func:`models.entry.entry_3dof`

    Returns
    -------
    Model
        States x, y, z, u, v, w; input bank; outputs h, lon, lat, V, gamma, psi (the states of `entry_3dof`, angles in (-pi, pi])
        and the outputs of `entry_3dof`.

    Notes
    -----
    Source: Vinh, Busemann & Culp, Hypersonic and Planetary Entry Flight Mechanics, ch. 2, in vectors; gravity is the gradient of
    :func:`models.gravity.potential`.  Limits: V > 0, |gamma| < 90 deg; with wind also off the poles.
    """
    air = atmosphere or exponential()

    def flow(x: Any, p: Any) -> SimpleNamespace:
        r2 = x.x**2 + x.y**2 + x.z**2
        distance = ca.sqrt(r2)
        h = distance - planet.radius
        a = _airspeed(x, h, wind)
        V2 = a[0] ** 2 + a[1] ** 2 + a[2] ** 2
        V = ca.sqrt(V2)
        climb = x.x * a[0] + x.y * a[1] + x.z * a[2]
        rho, mach = density(h, p, air), V / air.sound_speed(h)
        half = 0.5 * p.area / p.mass  # of parameters alone, and so computed once for all stages of a step
        per_speed = rho * V
        return SimpleNamespace(
            a=a, r2=r2, distance=distance, h=h, V=V, V2=V2, climb=climb, rho=rho, mach=mach,
            drag=p.CD_factor * half * vehicle.cd(mach) * per_speed,
            lift=p.CL_factor * half / planet.radius * vehicle.cl(mach) * per_speed,  # over the radius
        )  # fmt: skip

    def rhs(x: Any, u: Any, p: Any) -> dict[str, Any]:
        f = flow(x, p)
        a = f.a
        across = ca.sqrt(f.r2 * f.V2 - f.climb**2)  # |r x v_a|
        # the only division: R/|r| and R/|r x v_a| follow from it (of a plain inverse CasADi would make divisions again)
        inverse = planet.radius / (f.distance * across)
        plane, polar = _gravity(x.z * (1 / planet.radius), inverse * across, planet)
        lift = f.lift * (inverse * f.distance)
        up, right = lift * ca.cos(u.bank), lift * ca.sin(u.bank) * f.V
        # n = (V_a^2 r - (r . v_a) v_a)/(V_a |r x v_a|); v_a x n = V_a (v_a x r)/|r x v_a|
        along, outward = f.drag + up * f.climb, up * f.V2
        spin = planet.rotation
        return {
            "x": x.u,
            "y": x.v,
            "z": x.w,
            "u": (outward + plane + spin**2) * x.x - along * a[0] + right * (a[1] * x.z - a[2] * x.y) + 2 * spin * x.v,
            "v": (outward + plane + spin**2) * x.y - along * a[1] + right * (a[2] * x.x - a[0] * x.z) - 2 * spin * x.u,
            "w": (outward + polar) * x.z - along * a[2] + right * (a[0] * x.y - a[1] * x.x),
        }

    def out(x: Any, u: Any, p: Any) -> dict[str, Any]:
        f = flow(x, p)
        drag, lift = f.drag * f.V, f.lift * f.V * planet.radius
        place, level = _place(x, f.distance)
        return place | {
            "h": f.h,
            "n_x": -drag / units.G0,
            "load": ca.sqrt(drag**2 + lift**2) / units.G0,
            "hdot": (x.x * x.u + x.y * x.v + x.z * x.w) / f.distance,
            "sdot": planet.radius * level / f.distance,
            "qbar": 0.5 * f.rho * f.V2,
            "mach": f.mach,
            "rho": f.rho,
        }

    return define(
        "entry_cartesian", rhs, states=STATES, inputs=(Var("bank", "rad", 1.0, (-4 * math.pi, 4 * math.pi), "bank angle"),),
        params=vehicle_params(vehicle) | dispersion_params(), outputs=(*PLACE, *OUTPUTS), out=out,
        source=f"Vinh et al., ch. 2, in planet-fixed axes; {vehicle.name}; {air.name} atmosphere",
    )  # fmt: skip


def _place(x: Any, distance: ca.SX) -> tuple[dict[str, ca.SX], ca.SX]:
    """Longitude, latitude, speed, path angle and heading by name, and the horizontal speed, m/s."""
    around = x.x * x.v - x.y * x.u  # of r x v the component along the axis
    level = ca.sqrt((x.y * x.w - x.z * x.v) ** 2 + (x.z * x.u - x.x * x.w) ** 2 + around**2) / distance
    axis2 = x.x**2 + x.y**2
    angles = {
        "lon": ca.atan2(x.y, x.x),
        "lat": ca.atan2(x.z, ca.sqrt(axis2)),
        "V": ca.sqrt(x.u**2 + x.v**2 + x.w**2),
        "gamma": ca.atan2((x.x * x.u + x.y * x.v + x.z * x.w) / distance, level),
        "psi": ca.atan2(around * distance, x.w * axis2 - x.z * (x.x * x.u + x.y * x.v)),
    }
    return angles, level


def _airspeed(x: Any, h: ca.SX, wind: Wind | None) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Velocity relative to the air, m/s."""
    if wind is None:
        return x.u, x.v, x.w
    axis2 = x.x**2 + x.y**2
    axis, distance = ca.sqrt(axis2), ca.sqrt(axis2 + x.z**2)
    east, north = wind.east(h) / axis, wind.north(h) / distance
    southward = north * x.z / axis
    return x.u + east * x.y + southward * x.x, x.v - east * x.x + southward * x.y, x.w - north * axis


def _gravity(z: ca.SX, ratio: ca.SX, planet: Planet) -> tuple[ca.SX, ca.SX]:
    """(a, b) with g = (a x, a y, b z), 1/s2, for z over the planet's radius R and the ratio R/|r|.

    The gradient of :func:`models.gravity.potential`, written out: differentiated by CasADi it holds five divisions more.
    """
    square = ratio**2
    central = -planet.mu / planet.radius**3 * square * ratio
    if planet.J2 == 0:
        return central, central
    oblate, tilt = 1.5 * planet.J2 * (planet.equatorial_radius / planet.radius) ** 2 * square, 5 * z**2 * square
    return central * (1 + oblate * (1 - tilt)), central * (1 + oblate * (3 - tilt))


def to_cartesian(x: ArrayLike, *, planet: Planet = EARTH) -> Array:
    """States of `entry_cartesian` for those of `entry_3dof`.

    Parameters
    ----------
    x : array_like, shape (6,) or (N, 6)
        [h, lon, lat, V, gamma, psi], m, m/s, rad.
    planet : Planet

    Returns
    -------
    ndarray, shape (6,) or (N, 6)
        [x, y, z, u, v, w], m, m/s.

    Raises
    ------
    ModelError
        A wrong shape, or a number that is not finite.
    """
    h, lon, lat, V, gamma, psi = _columns("to_cartesian", x)
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    r = planet.radius + h
    east, north, up = V * np.cos(gamma) * np.sin(psi), V * np.cos(gamma) * np.cos(psi), V * np.sin(gamma)
    outward = up * cp - north * sp
    return np.stack([r * cp * cl, r * cp * sl, r * sp, outward * cl - east * sl, outward * sl + east * cl, north * cp + up * sp], axis=-1)


def to_spherical(x: ArrayLike, *, planet: Planet = EARTH) -> Array:
    """States of `entry_3dof` for those of `entry_cartesian`: the inverse of :func:`to_cartesian`, angles in (-pi, pi].

    Parameters
    ----------
    x : array_like, shape (6,) or (N, 6)
        [x, y, z, u, v, w], m, m/s.
    planet : Planet

    Returns
    -------
    ndarray, shape (6,) or (N, 6)
        [h, lon, lat, V, gamma, psi], m, m/s, rad.
    """
    px, py, pz, u, v, w = _columns("to_spherical", x)
    axis, r = np.hypot(px, py), np.sqrt(px**2 + py**2 + pz**2)
    lon, lat = np.arctan2(py, px), np.arctan2(pz, axis)
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    outward, east = u * cl + v * sl, v * cl - u * sl
    north, up = w * cp - outward * sp, outward * cp + w * sp
    level = np.hypot(east, north)
    return np.stack([r - planet.radius, lon, lat, np.hypot(level, up), np.arctan2(up, level), np.arctan2(east, north)], axis=-1)


def _columns(name: str, x: ArrayLike) -> list[Array]:
    values = as_finite(f"{name}: x", x)
    if values.ndim not in (1, 2) or values.shape[-1] != 6:
        raise ModelError(f"{name}: x: expected shape (6,) or (N, 6), got {values.shape}; give one value for each state")
    return list(np.moveaxis(values, -1, 0))
