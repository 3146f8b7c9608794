"""Atmospheric entry of a point mass with trimmed aerodynamics: planar, and three degrees of freedom over a rotating planet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from models import gravity, units
from models.atmosphere import Atmosphere, dispersion, exponential
from models.core import Model, ModelError, Var, as_scalar, define
from models.vehicles import Vehicle
from models.wind import Wind


@dataclass(frozen=True, slots=True)
class Planet:
    """A planet for entry models; altitude is measured from the sphere of `radius`.

    Attributes
    ----------
    mu : float
        Gravitational parameter, m3/s2.
    radius : float
        Radius of the reference sphere, m.
    rotation : float
        Spin rate, rad/s.
    J2 : float
        Second zonal harmonic, 0 for a central field.
    equatorial_radius : float
        Radius that belongs to J2, m.
    """

    mu: float = units.MU_EARTH
    radius: float = units.R_MEAN_EARTH
    rotation: float = 0.0
    J2: float = 0.0
    equatorial_radius: float = units.R_EQUATOR_EARTH

    def __post_init__(self) -> None:
        for name in ("mu", "radius", "equatorial_radius"):
            if as_scalar(f"Planet: {name}", getattr(self, name)) <= 0:
                raise ModelError(f"Planet: {name} must be finite and > 0, got {getattr(self, name)}; give it in SI units")
        for name in ("rotation", "J2"):
            as_scalar(f"Planet: {name}", getattr(self, name))


SPHERE = Planet()
EARTH = Planet(rotation=units.OMEGA_EARTH, J2=units.J2_EARTH)

# Steeper than 75 deg a planar entry is a fall; an initial angle beyond it is nearly always degrees taken for radians.
STEEPEST = math.radians(75.0)


def _flight_vars() -> tuple[Var, Var]:
    return (
        Var("V", "m/s", 7000.0, (1.0, 20e3), "speed"),
        Var("gamma", "rad", 0.1, (-STEEPEST, STEEPEST), "flight-path angle"),
    )


ALTITUDE = Var("h", "m", 5e4, (-500.0, 1e6), "altitude")

OUTPUTS = (
    Var("n_x", "g0", 1.0, text="axial load"),
    Var("load", "g0", 1.0, text="aerodynamic load"),
    Var("hdot", "m/s", 100.0, text="altitude rate"),
    Var("sdot", "m/s", 7000.0, text="ground speed"),
    Var("qbar", "Pa", 1e4, text="dynamic pressure"),
    Var("mach", "1", 10.0, text="Mach number"),
    Var("rho", "kg/m3", 1e-3, text="density"),
)


def dispersion_params() -> dict[Var, float]:
    """Parameters shared by all entry models: multiplicative dispersions, neutral by default."""
    return {
        Var("rho_factor", "1", 1.0, (0.05, 20.0), "density factor"): 1.0,
        Var("CD_factor", "1", 1.0, (0.05, 20.0), "drag factor"): 1.0,
        Var("CL_factor", "1", 1.0, (-20.0, 20.0), "lift factor"): 1.0,
        Var("wave_amplitude", "1", 0.1, (-0.9, 0.9), "density wave amplitude"): 0.0,
        Var("wave_length", "m", 3e4, (1e3, 1e6), "density wave length"): 3e4,
        Var("wave_phase", "rad", 1.0, (-50.0, 50.0), "density wave phase"): 0.0,
    }


def density(h: ca.SX, p: Any, atmosphere: Atmosphere) -> ca.SX:
    """rho = table(h) rho_factor (1 + A sin(2 pi h/lambda + phi)), kg/m3."""
    wave = dispersion(
        h, factor=p.rho_factor, wave_amplitude=p.wave_amplitude, wave_length=p.wave_length, wave_phase=p.wave_phase
    )  # fmt: skip
    return atmosphere.density(h) * wave


def entry_planar(vehicle: Vehicle, *, atmosphere: Atmosphere | None = None, planet: Planet = SPHERE) -> Model:
    """Planar entry over a non-rotating planet; the input is the vertical lift ratio u = (CL/CD) cos(bank).

    V' = -D - g sin(gamma);  gamma' = u D/V + (V/r - g/V) cos(gamma);  h' = V sin(gamma);  s' = R V cos(gamma)/r,
    D = rho V^2 S CD/(2 m), g = mu/r^2, r = R + h.  CD_factor multiplies drag, CL_factor the vertical lift u D.

    Parameters
    ----------
    vehicle : Vehicle
        Mass, area, CL and CD (constant, or tables of Mach number).
    atmosphere : Atmosphere, optional
        Default: exponential.
    planet : Planet
        Its rotation and J2 are not used: a planet that has them is refused.

    Returns
    -------
    Model
        States V, gamma, h, s; input lift_ratio; outputs n_x (negative in flight), load, hdot, sdot, qbar, mach, rho.

    Notes
    -----
    Source: Tang & Zhao 2000 (paper 003), eqs 2-3.  Limits: V > 0, |gamma| < 90 deg.  The load assumes the vehicle's whole
    lift, banked or not.
    """
    if planet.rotation != 0 or planet.J2 != 0:
        raise ModelError(
            f"entry_planar: the planar model has no rotation and no J2, got rotation {planet.rotation} and J2 {planet.J2};"
            " use entry_3dof, or Planet(mu=..., radius=...)"
        )
    air = atmosphere or exponential()

    def accelerations(x: Any, p: Any) -> tuple[Any, Any, Any, Any]:
        rho = density(x.h, p, air)
        mach = x.V / air.sound_speed(x.h)
        drag = 0.5 * rho * x.V**2 * p.area * vehicle.cd(mach) / p.mass  # of the nominal vehicle
        return rho, mach, drag, vehicle.cl(mach) / vehicle.cd(mach)

    def rhs(x: Any, u: Any, p: Any) -> dict[str, Any]:
        _, _, drag, _ = accelerations(x, p)
        r = planet.radius + x.h
        g = planet.mu / r**2
        return {
            "V": -p.CD_factor * drag - g * ca.sin(x.gamma),
            "gamma": p.CL_factor * u.lift_ratio * drag / x.V + (x.V / r - g / x.V) * ca.cos(x.gamma),
            "h": x.V * ca.sin(x.gamma),
            "s": planet.radius * x.V * ca.cos(x.gamma) / r,
        }

    def out(x: Any, u: Any, p: Any) -> dict[str, Any]:
        rho, mach, drag, ratio = accelerations(x, p)
        return {
            "n_x": -p.CD_factor * drag / units.G0,
            "load": drag * ca.sqrt(p.CD_factor**2 + (p.CL_factor * ratio) ** 2) / units.G0,
            "hdot": x.V * ca.sin(x.gamma),
            "sdot": planet.radius * x.V * ca.cos(x.gamma) / (planet.radius + x.h),
            "qbar": 0.5 * rho * x.V**2,
            "mach": mach,
            "rho": rho,
        }

    return define(
        "entry_planar", rhs, states=(*_flight_vars(), ALTITUDE, Var("s", "m", 1e6, (-1e8, 1e8), "downrange")),
        inputs=(Var("lift_ratio", "1", 0.3, (-20.0, 20.0), "vertical lift ratio"),),
        params=vehicle_params(vehicle) | dispersion_params(), outputs=OUTPUTS, out=out,
        source=f"Tang & Zhao 2000, eqs 2-3; {vehicle.name}; {air.name} atmosphere",
    )  # fmt: skip


def entry_3dof(vehicle: Vehicle, *, atmosphere: Atmosphere | None = None, planet: Planet = EARTH, wind: Wind | None = None) -> Model:
    """Three-degree-of-freedom entry over a rotating, oblate planet, with wind; the input is the bank angle.

    States are planet-relative: h, lon, lat (geocentric), V, gamma, psi (from north, clockwise).  Axes east, north, up;
    v' = F/m + g - 2 w x v - w x (w x r), drag along the air-relative velocity, lift turned about it by the bank angle,
    positive to the right.

    Parameters
    ----------
    vehicle, atmosphere, planet : as in :func:`entry_planar`
    wind : Wind, optional
        East and north wind against altitude, m/s; calm when absent.

    Returns
    -------
    Model
        States h, lon, lat, V, gamma, psi; input bank; the outputs of :func:`entry_planar`.

    Notes
    -----
    Source: Vinh, Busemann & Culp, Hypersonic and Planetary Entry Flight Mechanics, ch. 2 (central field); the vectors here also
    carry J2 and wind.  Limits: |lat| and |gamma| < 90 deg, altitude over a sphere.
    """
    air = atmosphere or exponential()

    def aerodynamics(x: Any, p: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
        v = velocity(x)
        v_air = v if wind is None else v - ca.vertcat(wind.east(x.h), wind.north(x.h), 0)
        airspeed = ca.norm_2(v_air)
        rho, mach = density(x.h, p, air), airspeed / air.sound_speed(x.h)
        per_mass = 0.5 * rho * airspeed**2 * p.area / p.mass
        return v_air / airspeed, rho, mach, airspeed, p.CD_factor * per_mass * vehicle.cd(mach), p.CL_factor * per_mass * vehicle.cl(mach)

    def rhs(x: Any, u: Any, p: Any) -> dict[str, Any]:
        along, _, _, _, drag, lift = aerodynamics(x, p)
        r = planet.radius + x.h
        v = velocity(x)
        spin = planet.rotation * ca.vertcat(0, ca.cos(x.lat), ca.sin(x.lat))
        force = -drag * along + lift * lift_direction(along, u.bank)
        inertial = -2 * ca.cross(spin, v) - ca.cross(spin, ca.cross(spin, ca.vertcat(0, 0, r)))
        a = force + local_gravity(r, x.lat, planet) + inertial
        tangent, normal, side = flight_axes(x)
        return {
            "h": x.V * ca.sin(x.gamma),
            "lon": x.V * ca.cos(x.gamma) * ca.sin(x.psi) / (r * ca.cos(x.lat)),
            "lat": x.V * ca.cos(x.gamma) * ca.cos(x.psi) / r,
            "V": ca.dot(a, tangent),
            "gamma": ca.dot(a, normal) / x.V + x.V * ca.cos(x.gamma) / r,
            "psi": ca.dot(a, side) / (x.V * ca.cos(x.gamma)) + x.V * ca.cos(x.gamma) * ca.sin(x.psi) * ca.tan(x.lat) / r,
        }

    def out(x: Any, u: Any, p: Any) -> dict[str, Any]:
        _, rho, mach, airspeed, drag, lift = aerodynamics(x, p)
        return {
            "n_x": -drag / units.G0,
            "load": ca.sqrt(drag**2 + lift**2) / units.G0,
            "hdot": x.V * ca.sin(x.gamma),
            "sdot": planet.radius * x.V * ca.cos(x.gamma) / (planet.radius + x.h),
            "qbar": 0.5 * rho * airspeed**2,
            "mach": mach,
            "rho": rho,
        }

    states = (
        ALTITUDE,
        Var("lon", "rad", 1.0, (-4 * math.pi, 4 * math.pi), "longitude"),
        Var("lat", "rad", 1.0, (-1.56, 1.56), "geocentric latitude"),
        *_flight_vars(),
        Var("psi", "rad", 1.0, (-4 * math.pi, 4 * math.pi), "heading"),
    )
    return define(
        "entry_3dof", rhs, states=states, inputs=(Var("bank", "rad", 1.0, (-4 * math.pi, 4 * math.pi), "bank angle"),),
        params=vehicle_params(vehicle) | dispersion_params(), outputs=OUTPUTS, out=out,
        source=f"Vinh et al., ch. 2, in vectors; {vehicle.name}; {air.name} atmosphere",
    )  # fmt: skip


def velocity(x: Any) -> ca.SX:
    """Planet-relative velocity in east, north, up, m/s."""
    return x.V * ca.vertcat(ca.cos(x.gamma) * ca.sin(x.psi), ca.cos(x.gamma) * ca.cos(x.psi), ca.sin(x.gamma))


def flight_axes(x: Any) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Unit vectors of increasing V, gamma and psi in east, north, up."""
    sg, cg, sp, cp = ca.sin(x.gamma), ca.cos(x.gamma), ca.sin(x.psi), ca.cos(x.psi)
    return ca.vertcat(cg * sp, cg * cp, sg), ca.vertcat(-sg * sp, -sg * cp, cg), ca.vertcat(cp, -sp, 0)


def lift_direction(along: ca.SX, bank: ca.SX) -> ca.SX:
    """Unit lift vector: upward normal of the air-relative velocity `along`, turned by the bank angle, positive to the right."""
    up = ca.vertcat(0, 0, 1) - along[2] * along
    normal = up / ca.norm_2(up)
    return ca.cos(bank) * normal + ca.sin(bank) * ca.cross(along, normal)


def local_gravity(r: ca.SX, lat: ca.SX, planet: Planet) -> ca.SX:
    """Gravity in east, north, up at geocentric radius and latitude, m/s2; the field is zonal, so longitude 0 serves."""
    sl, cl = ca.sin(lat), ca.cos(lat)
    g = gravity.acceleration(
        ca.vertcat(r * cl, 0, r * sl), mu=planet.mu, J2=planet.J2, radius=planet.equatorial_radius
    )  # fmt: skip
    return ca.vertcat(0, -sl * g[0] + cl * g[2], cl * g[0] + sl * g[2])


def vehicle_params(vehicle: Vehicle) -> dict[Var, float]:
    """Mass and reference area, by default the vehicle's."""
    return {
        Var("mass", "kg", 1e3, (1e-6, 1e7), "mass"): vehicle.mass,
        Var("area", "m2", 1.0, (1e-9, 1e5), "reference area"): vehicle.area,
    }
