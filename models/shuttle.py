"""Space Shuttle orbiter in its plane of symmetry: translation and attitude together, elevon and body-flap servos, pitch jets, wind."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from models import wind as winds
from models.atmosphere import Atmosphere, us76_smooth
from models.core import Model, ModelError, Var, as_scalar, define
from models.entry import SPHERE, Planet
from models.pitch_jets import PitchJets, pitch_jets
from models.shuttle_aero import OrbiterAero, orbiter_aero, orbiter_data
from models.units import DEG, G0
from models.wind import Wind


@dataclass(frozen=True, slots=True, eq=False)
class Servo:
    """First-order servo with limits: delta' = bandwidth (command - delta), at most `rate`; commands are held in [lower, upper].

    Attributes
    ----------
    bandwidth : float
        1/s.
    rate : float
        rad/s.
    lower, upper : float
        Limits of the command, rad.
    """

    bandwidth: float
    rate: float
    lower: float
    upper: float

    def __post_init__(self) -> None:
        for name in ("bandwidth", "rate", "lower", "upper"):
            object.__setattr__(self, name, as_scalar(f"Servo: {name}", getattr(self, name)))
        if self.bandwidth <= 0 or self.rate <= 0 or not self.lower < self.upper:
            raise ModelError(f"Servo: expected bandwidth, rate > 0 and lower < upper, got {self}; SI units and radians")

    def held(self, command: ca.SX) -> ca.SX:
        """The command within its limits, rad."""
        return ca.fmin(ca.fmax(command, self.lower), self.upper)

    def speed(self, command: ca.SX, delta: ca.SX) -> ca.SX:
        """d delta/dt, rad/s."""
        return ca.fmin(ca.fmax(self.bandwidth * (self.held(command) - delta), -self.rate), self.rate)


@dataclass(frozen=True, slots=True, eq=False)
class Orbiter:
    """Reference data of the orbiter; the aerodynamics are a value of their own.

    Attributes
    ----------
    mass : float
        kg.
    Iyy : float
        Pitch inertia, kg m2.
    area, chord : float
        Reference area (m2) and mean chord (m).
    Cmq : float
        Pitch damping on q chord/(2 V), 1/rad (an estimate; it matters little at these speeds).
    elevon, body_flap : Servo
        The body flap's bandwidth is assumed; it moves at its rate limit anyway.
    source : str
    """

    mass: float
    Iyy: float
    area: float
    chord: float
    Cmq: float
    elevon: Servo
    body_flap: Servo
    source: str = ""


def orbiter(*, elevon_bandwidth: float = 20.0) -> Orbiter:
    """The 205,000 lb orbiter of the data file (mass properties of the SCOLE design challenge); the elevon servo's bandwidth is 20 rad/s."""
    data = orbiter_data()
    mass, reference = data["mass_properties"]["scole"], data["reference"]
    elevon, flap = data["actuators"]["elevon"], data["actuators"]["body_flap"]
    low, high = (DEG * v for v in elevon["command_range_deg"])
    return Orbiter(
        mass=mass["mass_kg"], Iyy=mass["Iyy_kg_m2"], area=reference["S_ref_m2"], chord=reference["chord_m"],
        Cmq=data["damping"]["Cmq_per_rad"], elevon=Servo(elevon_bandwidth, DEG * elevon["rate_deg_s"], low, high),
        body_flap=Servo(2.0, DEG * flap["rate_deg_s"], *(DEG * v for v in flap["range_deg"])),
        source="models/data/shuttle_longitudinal.yaml",
    )  # fmt: skip


STATES = (
    Var("V", "m/s", 2000.0, (100.0, 9e3), "speed over the ground"),
    Var("gamma", "rad", 0.1, (-1.4, 1.4), "flight-path angle"),
    Var("h", "m", 5e4, (0.0, 1.2e5), "altitude"),
    Var("s", "m", 1e5, (-1e8, 1e8), "downrange"),
    Var("theta", "rad", 0.3, (-math.pi, math.pi), "pitch angle above the local horizon"),
    Var("q", "rad/s", 0.02, (-1.0, 1.0), "pitch rate"),
    Var("delta_e", "rad", 0.2, (-0.7, 0.45), "elevon"),
    Var("delta_bf", "rad", 0.2, (-0.21, 0.4), "body flap"),
)
INPUTS = (
    Var("delta_e_cmd", "rad", 0.2, (-4.0, 4.0), "elevon command"),
    Var("delta_bf_cmd", "rad", 0.2, (-4.0, 4.0), "body flap command"),
    Var("jets_up", "1", 1.0, (0.0, 1.0), "share of the nose-up jets firing"),
    Var("jets_down", "1", 1.0, (0.0, 1.0), "share of the nose-down jets firing"),
)
OUTPUTS = (
    Var("mach", "1", 5.0, text="Mach number"),
    Var("qbar", "Pa", 1e3, text="dynamic pressure"),
    Var("alpha", "rad", 0.3, text="angle of attack"),
    Var("airspeed", "m/s", 2000.0),
    Var("load", "1", 1.0, text="aerodynamic load in g0"),
    Var("n_x", "1", 1.0, text="body-axis load forward, in g0"),
    Var("n_z", "1", 1.0, text="body-axis load upward, in g0"),
    Var("gamma_dot", "rad/s", 0.01, text="rate of the flight-path angle"),
    Var("pitch_moment", "N m", 1e5, text="aerodynamic pitching moment about the centre of mass"),
)
FACTORS = ("rho_factor", "CL_factor", "CD_factor", "Cm_factor", "elevon_factor", "wind_factor")


def orbiter_longitudinal(
    vehicle: Orbiter | None = None,
    *,
    aero: OrbiterAero | None = None,
    atmosphere: Atmosphere | None = None,
    wind: Wind | None = None,
    jets: PitchJets | None = None,
    planet: Planet = SPHERE,
) -> Model:
    """Orbiter in the vertical plane of its heading: V, gamma, h, s, theta, q and both servos.

    V' = T_V/m - g sin(gamma);  gamma' = T_n/(m V) + (V/r - g/V) cos(gamma);  h' = V sin(gamma);  s' = R V cos(gamma)/r;
    theta' = q + V cos(gamma)/r;  q' = M/Iyy, with the components of the aerodynamic and jet forces T along and normal to the
    ground-relative velocity.  Air velocity is (V cos(gamma) - w, V sin(gamma)) for a tail wind w; alpha = theta - gamma_air.
    M = qbar S c (Cm + Cmq q c/(2 V_air)) + cg_aft N + jets; the jets' arms follow the centre of mass.

    Parameters
    ----------
    vehicle : Orbiter, optional
    aero : OrbiterAero, optional
    atmosphere : Atmosphere, optional
        US Standard 1976, smooth.
    wind : Wind, optional
        Its east component blows along the heading (90 deg); none if left out.
    jets : PitchJets, optional
        All twelve aft jets.
    planet : Planet
        Non-rotating sphere.

    Returns
    -------
    Model
        Parameters: mass, Iyy, cg_aft (m, centre of mass behind the moment reference), the factors of density, CL, CD, Cm of body
        and flap, elevon increments, and wind (1 nominal), and the shares of the jets that work.

    Raises
    ------
    ModelError
        A rotating or oblate planet, which a planar model cannot follow.

    Source: paper 000, section 3 (case); Vinh et al., ch. 2 (translation); the data file's head for the tables.
    """
    if planet.rotation or planet.J2:
        raise ModelError("orbiter_longitudinal: the planet must not rotate and must have J2 = 0; use Planet() or SPHERE")
    body, tables = vehicle or orbiter(), aero or orbiter_aero()
    air, breeze, thrust = atmosphere or us76_smooth(), wind or winds.calm(), jets or pitch_jets()

    def rhs(x: Any, u: Any, p: Any) -> dict[str, ca.SX]:
        forces = aerodynamics(x, p, air_flow(x, p, air=air, wind=breeze), body=body, aero=tables)
        jet_x, jet_z, jet_moment = thrust.wrench(u.jets_up * p.up_share, u.jets_down * p.down_share, p.cg_aft)
        along, normal = to_path(x, forces.body_x + jet_x, forces.body_z + jet_z)
        radius = planet.radius + x.h
        g, turn = planet.mu / radius**2, x.V * ca.cos(x.gamma) / radius
        return {
            "V": along / p.mass - g * ca.sin(x.gamma),
            "gamma": normal / (p.mass * x.V) - g * ca.cos(x.gamma) / x.V + turn,
            "h": x.V * ca.sin(x.gamma),
            "s": planet.radius * turn,
            "theta": x.q + turn,
            "q": (forces.moment + jet_moment) / p.Iyy,
            "delta_e": body.elevon.speed(u.delta_e_cmd, x.delta_e),
            "delta_bf": body.body_flap.speed(u.delta_bf_cmd, x.delta_bf),
        }

    def out(x: Any, u: Any, p: Any) -> dict[str, ca.SX]:
        now = air_flow(x, p, air=air, wind=breeze)
        forces = aerodynamics(x, p, now, body=body, aero=tables)
        weight = p.mass * G0
        n_x, n_z = forces.body_x / weight, -forces.body_z / weight
        return {
            "mach": now.mach, "qbar": now.qbar, "alpha": now.alpha, "airspeed": now.speed, "load": ca.sqrt(n_x**2 + n_z**2),
            "n_x": n_x, "n_z": n_z, "gamma_dot": rhs(x, u, p)["gamma"], "pitch_moment": forces.moment,
        }  # fmt: skip

    ones = {Var(name, "1", 1.0, (-10.0, 10.0) if name == "wind_factor" else (0.01, 10.0)): 1.0 for name in FACTORS}
    params = {
        Var("mass", "kg", 1e5, (1e4, 2e5), "mass"): body.mass,
        Var("Iyy", "kg m2", 1e7, (1e5, 1e8), "pitch inertia"): body.Iyy,
        Var("cg_aft", "m", 0.05, (-1.0, 1.0), "centre of mass behind the moment reference"): 0.0,
        **ones,
        Var("up_share", "1", 1.0, (0.0, 1.0), "share of the nose-up jets that work"): 1.0,
        Var("down_share", "1", 1.0, (0.0, 1.0), "share of the nose-down jets that work"): 1.0,
    }
    return define(
        "orbiter_longitudinal", rhs, states=STATES, inputs=INPUTS, params=params, outputs=OUTPUTS, out=out,
        source=f"{tables.source}; {air.name} atmosphere; {breeze.name} wind; {len(thrust.up)} + {len(thrust.down)} pitch jets",
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """The air met: speed (m/s), Mach number, dynamic pressure (Pa), angle of attack (rad) with its cosine and sine."""

    speed: ca.SX
    mach: ca.SX
    qbar: ca.SX
    alpha: ca.SX
    cos_alpha: ca.SX
    sin_alpha: ca.SX


def air_flow(x: Any, p: Any, *, air: Atmosphere, wind: Wind) -> Flow:
    """Air velocity seen from the vehicle: ground velocity less the wind along the heading; alpha from its body components."""
    tail = p.wind_factor * wind.east(x.h)
    ahead, up = x.V * ca.cos(x.gamma) - tail, x.V * ca.sin(x.gamma)
    square = ahead**2 + up**2
    speed = ca.sqrt(square)
    ct, st = ca.cos(x.theta), ca.sin(x.theta)
    forward, down = ct * ahead + st * up, st * ahead - ct * up
    qbar = 0.5 * p.rho_factor * air.density(x.h) * square
    return Flow(speed, speed / air.sound_speed(x.h), qbar, ca.atan2(down, forward), forward / speed, down / speed)


@dataclass(frozen=True, slots=True, eq=False)
class Forces:
    """Aerodynamic force along body x (forward) and z (down), N, and pitching moment about the centre of mass, N m."""

    body_x: ca.SX
    body_z: ca.SX
    moment: ca.SX


def aerodynamics(x: Any, p: Any, flow: Flow, *, body: Orbiter, aero: OrbiterAero) -> Forces:
    """Forces and pitching moment about the centre of mass."""
    hull, flaps = aero.body(flow.mach, flow.alpha, x.delta_bf), aero.elevon(flow.mach, flow.alpha, x.delta_e)
    pressure = flow.qbar * body.area
    lift = pressure * p.CL_factor * (hull[0] + p.elevon_factor * flaps[0])
    drag = pressure * p.CD_factor * (hull[1] + p.elevon_factor * flaps[1])
    Cm = p.Cm_factor * hull[2] + p.elevon_factor * flaps[2] + body.Cmq * x.q * body.chord / (2 * flow.speed)
    body_x = lift * flow.sin_alpha - drag * flow.cos_alpha
    body_z = -lift * flow.cos_alpha - drag * flow.sin_alpha
    return Forces(body_x, body_z, pressure * body.chord * Cm - p.cg_aft * body_z)


def to_path(x: Any, body_x: Any, body_z: Any) -> tuple[Any, Any]:
    """Components of a force in body axes along and (upward) normal to the ground-relative velocity."""
    ct, st, cg, sg = ca.cos(x.theta), ca.sin(x.theta), ca.cos(x.gamma), ca.sin(x.gamma)
    ahead, up = body_x * ct + body_z * st, body_x * st - body_z * ct
    return ahead * cg + up * sg, up * cg - ahead * sg
