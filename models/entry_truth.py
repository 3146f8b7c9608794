"""Entry flown by landing guidance: what the computer on board assumes, and the dispersed truth with a bank servo and sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca

from models import units
from models.atmosphere import Atmosphere
from models.core import Model, ModelError, Var, as_scalar, define
from models.entry import EARTH, Planet
from models.entry_cartesian import STATES, entry_cartesian
from models.vehicles import Vehicle

WIND_TOP = 24e3  # m: the dispersed wind blows below
MACH_TURN, MACH_WIDTH = 4.0, 2.0  # where and over what range of Mach number the lift of the truth departs from a constant
NOISE_WAVES = (0.011, 0.013, 0.017)  # rad/m: phases of the sensor noise run with the position, many radians between two samples

_ANGLE = (-4 * math.pi, 4 * math.pi)
NAVIGATION = tuple(Var(f"nav_{v.name}", v.unit, v.nominal, text=f"navigated {v.text}") for v in STATES)
SUTTON_GRAVES = 1.7415e-4  # kg^0.5/m, air
HEAT = Var("heat", "W/m2", 1e6, text="stagnation-point heating rate")
FORCE = tuple(Var(f"force_{axis}", "m/s2", 10.0, text=f"specific force along {axis}") for axis in "xyz")


@dataclass(frozen=True, slots=True)
class Servo:
    """Response of the bank angle: second order, with limits of rate and acceleration.

    bank'' = clip(damping (rate_c - bank'), +-acceleration),
    rate_c = sign(e) min(rate, stiffness |e|, sqrt(1.6 acceleration |e|)), e = command - bank.

    Attributes
    ----------
    rate : float
        rad/s.
    acceleration : float
        rad/s2.
    stiffness, damping : float
        1/s; they rule small angles.
    """

    rate: float = 20 * units.DEG
    acceleration: float = 10 * units.DEG
    stiffness: float = 1.0
    damping: float = 4.0

    def __post_init__(self) -> None:
        for name in ("rate", "acceleration", "stiffness", "damping"):
            if as_scalar(f"Servo: {name}", getattr(self, name)) <= 0:
                raise ModelError(f"Servo: {name} must be finite and > 0, got {getattr(self, name)}; give it in SI units and radians")

    def bank_acceleration(self, bank: ca.SX, bank_rate: ca.SX, command: ca.SX) -> ca.SX:
        """bank'' in rad/s2 towards a command, rad."""
        error = command - bank
        size = ca.fabs(error)
        # the root has an infinite slope at zero, where the linear branch is the smaller one: a floor keeps derivatives finite
        braking = ca.sqrt(1.6 * self.acceleration * ca.fmax(size, 1e-6))
        wanted = ca.sign(error) * ca.fmin(ca.fmin(self.rate, self.stiffness * size), braking)
        return ca.fmax(-self.acceleration, ca.fmin(self.acceleration, self.damping * (wanted - bank_rate)))


def entry_onboard(vehicle: Vehicle, *, atmosphere: Atmosphere | None = None, planet: Planet = EARTH) -> Model:
    """The model that guidance predicts with: :func:`models.entry_cartesian.entry_cartesian` with a level wind that may be estimated.

    Parameters
    ----------
    vehicle, atmosphere, planet : as in :func:`models.entry.entry_3dof`
        What is assumed on board; a planet without J2 is the central field.

    Returns
    -------
    Model
        States x, y, z, u, v, w; input bank; parameters those of `entry_cartesian`, wind_east and wind_north (m/s, the same at every
        altitude) and nose_radius; outputs h, load, heat and the specific force.

    Notes
    -----
    heat = 1.7415e-4 sqrt(rho/nose_radius) V^3 is the stagnation-point heating rate of Sutton & Graves, NASA TR R-376, 1971, for
    the air of the Earth.
    """
    calm = entry_cartesian(vehicle, atmosphere=atmosphere, planet=planet)

    def rhs(x: Any, u: Any, p: Any) -> dict[str, Any]:
        state, wind = _state(x), level_wind(x, p.wind_east, p.wind_north)
        return dict(zip((v.name for v in STATES), ca.vertsplit(_flow(calm, planet, state, wind, u.bank, _given(calm, p))), strict=True))

    def out(x: Any, u: Any, p: Any) -> dict[str, Any]:
        state, wind, given = _state(x), level_wind(x, p.wind_east, p.wind_north), _given(calm, p)
        y = calm.out(_in_air(state, wind), u.bank, given)
        heat = SUTTON_GRAVES * ca.sqrt(y[calm.index("rho")] / p.nose_radius) * y[calm.index("V")] ** 3
        force = specific_force(calm, state, wind, u.bank, given)
        return {
            "h": y[calm.index("h")], "load": y[calm.index("load")], "heat": heat,
            **dict(zip((v.name for v in FORCE), ca.vertsplit(force), strict=True)),
        }  # fmt: skip

    nose = {Var("nose_radius", "m", 1.0, (1e-3, 100.0), "nose radius"): vehicle.nose_radius or 1.0}
    winds = {Var(f"wind_{side}", "m/s", 20.0, (-500.0, 500.0), f"{side} wind"): 0.0 for side in ("east", "north")}
    return define(
        "entry_onboard", rhs, states=STATES, inputs=calm.inputs, params=_defaults(calm) | winds | nose,
        outputs=(*(v for v in calm.outputs if v.name in ("h", "load")), HEAT, *FORCE), out=out, source=calm.source,
    )  # fmt: skip


def entry_truth(vehicle: Vehicle, *, atmosphere: Atmosphere | None = None, planet: Planet = EARTH, servo: Servo = Servo()) -> Model:
    """The flight itself: dispersed air, wind and coefficients, a bank servo, and what navigation and accelerometers tell.

    The zonal wind is wind_speed sin(pi min(h/24 km, 1)).  The lift is CL_factor [1 + mach_lift (1 + tanh((4 - Mach)/2))/2] times
    the vehicle's.  The sensors measure position, velocity and specific force with a constant error each and, for the force, a
    noise of zero mean whose phases run with the position.

    Parameters
    ----------
    vehicle, atmosphere, planet : as in :func:`models.entry.entry_3dof`
    servo : Servo

    Returns
    -------
    Model
        States x, y, z, u, v, w, bank, bank_rate, travel (rad that the bank angle has run through), peak (g0, greatest load); input
        bank_command; parameters those of `entry_cartesian` and the dispersions; outputs h, load, the navigated state, the measured force.
    """
    calm = entry_cartesian(vehicle, atmosphere=atmosphere, planet=planet)

    def air(x: Any, p: Any) -> tuple[Any, Any, Any]:
        """(state, wind, parameters of the calm model), the bank angle apart."""
        state = _state(x)
        h = ca.norm_2(state[:3]) - planet.radius
        wind = level_wind(x, p.wind_speed * ca.sin(math.pi * ca.fmin(ca.fmax(h, 0) / WIND_TOP, 1)), 0)
        given = _given(calm, p)
        mach = calm.out(_in_air(state, wind), 0, given)[calm.index("mach")]
        lift = p.CL_factor * (1 + 0.5 * p.mach_lift * (1 + ca.tanh((MACH_TURN - mach) / MACH_WIDTH)))
        return state, wind, _replaced(calm, given, CL_factor=lift)

    def rhs(x: Any, u: Any, p: Any) -> dict[str, Any]:
        state, wind, given = air(x, p)
        load = calm.out(_in_air(state, wind), x.bank, given)[calm.index("load")]
        motion = _flow(calm, planet, state, wind, x.bank + p.bank_error, given)
        return dict(zip((v.name for v in STATES), ca.vertsplit(motion), strict=True)) | {
            "bank": x.bank_rate,
            "bank_rate": servo.bank_acceleration(x.bank, x.bank_rate, u.bank_command),
            "travel": ca.fabs(x.bank_rate),
            "peak": 5 * ca.fmax(load - x.peak, 0),  # follows the load upwards within 0.2 s and stays: at its top it misses nothing
        }

    def out(x: Any, u: Any, p: Any) -> dict[str, Any]:
        state, wind, given = air(x, p)
        y = calm.out(_in_air(state, wind), x.bank, given)
        force = specific_force(calm, state, wind, x.bank + p.bank_error, given)
        error = ca.vertcat(*[getattr(p, f"nav_{v.name}_error") for v in STATES])
        noise = ca.vertcat(*[ca.sin(k * (x.x + x.y + 2 * x.z) + (i + 1) * p.noise_phase) for i, k in enumerate(NOISE_WAVES)])
        bias = ca.vertcat(p.force_bias_x, p.force_bias_y, p.force_bias_z)
        told = force + bias + math.sqrt(2) * p.force_noise * noise
        names = [v.name for v in (*NAVIGATION, *FORCE)]
        return {"h": y[calm.index("h")], "load": y[calm.index("load")]} | dict(
            zip(names, ca.vertsplit(ca.vertcat(state + error, told)), strict=True)
        )

    states = (
        *STATES, Var("bank", "rad", 1.0, _ANGLE, "bank angle"), Var("bank_rate", "rad/s", 0.3, (-10.0, 10.0), "bank rate"),
        Var("travel", "rad", 10.0, (0.0, 1e4), "bank travel"), Var("peak", "g0", 1.0, (0.0, 1e3), "greatest load"),
    )  # fmt: skip
    return define(
        "entry_truth", rhs, states=states, inputs=(Var("bank_command", "rad", 1.0, _ANGLE, "commanded bank angle"),),
        params=_defaults(calm) | _errors(),
        outputs=(*(v for v in calm.outputs if v.name in ("h", "load")), *NAVIGATION, *FORCE), out=out, source=calm.source,
    )  # fmt: skip


def level_wind(x: Any, east: Any, north: Any) -> ca.SX:
    """Velocity (3,) of a level wind in planet-fixed axes, m/s, at the position of `x`; off the poles."""
    axis = ca.sqrt(x.x**2 + x.y**2)
    distance = ca.sqrt(x.x**2 + x.y**2 + x.z**2)
    return ca.vertcat(
        -east * x.y / axis - north * x.x * x.z / (axis * distance),
        east * x.x / axis - north * x.y * x.z / (axis * distance),
        north * axis / distance,
    )


def specific_force(calm: Model, state: ca.SX, wind: ca.SX, bank: Any, p: ca.SX) -> ca.SX:
    """Aerodynamic force per mass (3,), m/s2: the acceleration with air less that without."""
    in_air = _in_air(state, wind)
    return calm.rhs(in_air, bank, p)[3:] - calm.rhs(in_air, bank, _replaced(calm, p, rho_factor=0))[3:]


def _flow(calm: Model, planet: Planet, state: ca.SX, wind: ca.SX, bank: Any, p: ca.SX) -> ca.SX:
    """x' in wind from the equations in calm air: only the Coriolis term knows the velocity over ground, all else that through the air."""
    w = planet.rotation
    turned = ca.vertcat(-w * wind[1], w * wind[0], 0)  # spin x wind
    return ca.vertcat(state[3:], calm.rhs(_in_air(state, wind), bank, p)[3:] - 2 * turned)


def _state(x: Any) -> ca.SX:
    return ca.vertcat(*[getattr(x, v.name) for v in STATES])


def _in_air(state: ca.SX, wind: ca.SX) -> ca.SX:
    return ca.vertcat(state[:3], state[3:] - wind)


def _given(calm: Model, p: Any) -> ca.SX:
    return ca.vertcat(*[getattr(p, v.name) for v in calm.params])


def _defaults(calm: Model) -> dict[Var, float]:
    return dict(zip(calm.params, calm.p0.tolist(), strict=True))


def _replaced(calm: Model, p: ca.SX, **changes: Any) -> ca.SX:
    return ca.vertcat(*[changes.get(v.name, p[i]) for i, v in enumerate(calm.params)])


def _errors() -> dict[Var, float]:
    """Dispersions and sensor errors that the calm model does not have; none by default."""
    variables = [
        Var("wind_speed", "m/s", 20.0, (-300.0, 300.0), "greatest zonal wind, eastward"),
        Var("mach_lift", "1", 0.1, (-0.9, 5.0), "change of lift at low Mach number"),
        Var("bank_error", "rad", 0.02, (-0.5, 0.5), "error of the bank angle"),
        *(Var(f"nav_{v.name}_error", v.unit, 100.0, (-1e6, 1e6), f"navigation error of {v.text}") for v in STATES),
        *(Var(f"force_bias_{axis}", "m/s2", 0.01, (-10.0, 10.0), f"accelerometer bias along {axis}") for axis in "xyz"),
        Var("force_noise", "m/s2", 0.01, (0.0, 10.0), "accelerometer noise, standard deviation"),
        Var("noise_phase", "rad", 1.0, (-1e4, 1e4), "phase of the noise"),
    ]
    return dict.fromkeys(variables, 0.0)
