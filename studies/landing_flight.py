"""Landing flights of a scenario: the open-loop reference, its sensitivities, one guided flight, dispersed sets, reachability."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

import ocp
from models.atmosphere import Atmosphere, exponential, us76_smooth
from models.core import Array, Model, ModelError, Status, evaluate, frozen
from models.entry import EARTH, Planet
from models.entry_cartesian import STATES, to_cartesian
from models.entry_truth import Servo, entry_onboard, entry_truth
from models.units import DEG, OMEGA_EARTH
from models.vehicles import Vehicle, from_ratios
from ocp.corrector import OneReversal, one_reversal_law
from ocp.corrector_modern import SeveralReversals, several_reversals_law
from ocp.corrector_onboard import Estimators
from ocp.landing import Guidance, Landings, Target, fly, great_circle, target
from ocp.landing_footprint import REACHED, nearest
from ocp.predictor import Path, prediction
from ocp.trajectory import Trajectory
from studies.landing_scenario import LandingScenario

CENTRAL = Planet(rotation=OMEGA_EARTH)
# half-widths: path angle deg, speed m/s, azimuth deg, density bias, density wave, CD and CL each, zonal wind m/s
SETS: Mapping[str, tuple[float, ...]] = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "density": (0.0, 0.0, 0.0, 0.20, 0.10, 0.0, 0.0),
    "small": (0.03, 5.0, 0.02, 0.10, 0.05, 0.03, 0.0),
    "medium": (0.05, 10.0, 0.05, 0.20, 0.10, 0.05, 20.0),
    "hard": (0.1, 10.0, 0.05, 0.30, 0.15, 0.10, 40.0),
}
LONGEST = 1200.0  # s, of the reference when its derivatives are taken
WAVE_LENGTHS = (20e3, 45e3)  # m, of the density wave


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What a scenario describes, as models: built once and shared by all flights, so that compiled code is reused.

    Attributes
    ----------
    reference : Model
        Central field, ideal bank response.
    reachable : Model
        Oblate field, the air that is flown through: for the question what any law could reach.
    onboard, truth : Model
    servo : Servo
    target : Target
    entry : ndarray, shape (6,)
        h, lon, lat, V, gamma, psi of the reference.
    radius : float
        Stop, m from the centre.
    """

    reference: Model
    reachable: Model
    onboard: Model
    truth: Model
    servo: Servo
    target: Target
    entry: Array
    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class Cases:
    """Dispersed cases: states of the truth (N, nx) and its parameters (N, np)."""

    x0: Array
    p: Array


def setting(scenario: LandingScenario) -> Setting:
    """Models of a scenario."""
    s = scenario
    planet, air = _planet(s), _air(s)
    vehicle = _vehicle(s)
    flown = us76_smooth() if s.truth.atmosphere == "us76_smooth" else air
    servo = Servo(rate=s.actuator.rate_deg_s * DEG, acceleration=s.actuator.acceleration_deg_s2 * DEG)
    r = s.reference
    entry = np.array([
        r.altitude_m, r.longitude_deg * DEG, r.latitude_deg * DEG, r.speed_m_s, r.path_angle_deg * DEG, r.azimuth_deg * DEG,
    ])  # fmt: skip
    lon, lat = s.target.longitude_deg * DEG, s.target.latitude_deg * DEG
    place = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]) * EARTH.radius
    return Setting(
        entry_onboard(vehicle, atmosphere=air, planet=CENTRAL), entry_onboard(vehicle, atmosphere=flown, planet=EARTH),
        entry_onboard(vehicle, atmosphere=air, planet=planet), entry_truth(vehicle, atmosphere=flown, planet=EARTH, servo=servo), servo,
        target(to_cartesian(entry)[:3], place, radius=EARTH.radius), frozen(entry), EARTH.radius + r.stop_altitude_m,
    )  # fmt: skip


def guidance(scenario: LandingScenario, set_up: Setting) -> Guidance:
    """The guidance law of a scenario."""
    g, r = scenario.guidance, scenario.reference
    common: dict[str, Any] = {"plant": set_up.truth, "radius": set_up.radius, "servo": set_up.servo}
    if g.law == "paper":
        one = OneReversal(base=r.bank_deg * DEG, reversal_at=r.reversal_at_s, reversal_s=r.reversal_s)
        return one_reversal_law(set_up.onboard, set_up.target, config=one, **common)
    several = SeveralReversals(
        reversals=g.reversals, kappa=g.kappa, reserve=g.reserve_deg * DEG,
        load_limit=g.load_limit_g if g.load_limit_g < 100.0 else math.inf,
        heat_limit=g.heat_limit_w_m2 if g.heat_limit_w_m2 < 1e9 else math.inf, estimators=Estimators(),
    )  # fmt: skip
    return several_reversals_law(set_up.onboard, set_up.target, config=several, **common)


def reference_flight(scenario: LandingScenario, set_up: Setting) -> Trajectory:
    """The reference flown open loop: central field, no dispersions, ideal bank response, restarts at the kinks of the bank profile."""
    r = scenario.reference
    half = r.reversal_s / 2
    law = ocp.profile([r.reversal_at_s - half, r.reversal_at_s + half], bank=[r.bank_deg * DEG, -r.bank_deg * DEG])
    stop = ocp.falls_below("h", r.stop_altitude_m)
    return ocp.simulate(set_up.reference, law, x0=to_cartesian(set_up.entry), until=stop, method=ocp.RK8(step=0.25))


def sensitivities(scenario: LandingScenario, set_up: Setting) -> dict[str, float]:
    """Exact derivatives of the landing point at entry to beta (m) and to the reversal time t_n (m/s), at beta = 0."""
    r = scenario.reference
    half, size = r.reversal_s / 2, r.bank_deg * DEG
    m = set_up.reference
    flight = prediction(m, Path(2, 400, order=8), radius=set_up.radius, seeds=2)
    T, B = np.array([r.reversal_at_s - half, r.reversal_at_s + half]), np.array([size, -size])
    seeds = (np.zeros(12), np.array([0.0, 0.0, 1.0, 1.0]), np.array([size, -size, 0.0, 0.0]), np.zeros(2 * len(m.params)))
    out = evaluate(flight, to_cartesian(set_up.entry), np.zeros(1), np.array([LONGEST]), T, B, m.p0, *seeds)
    if out[2][0] != 1.0:
        raise ModelError(f"sensitivities: the reference does not land within {LONGEST:g} s; its landing point has no derivatives")
    position = ca.SX.sym("r", 3)
    slope = ca.Function("slope", [position], [ca.jacobian(set_up.target.expression(position), position)])
    D = evaluate(slope, out[0][:3])[0] @ np.column_stack([out[4][:3], out[4][6:9]])
    return {"dL_dbeta": float(D[0, 0]), "dD_dbeta": float(D[1, 0]), "dL_dtn": float(D[0, 1]), "dD_dtn": float(D[1, 1])}


def told(set_up: Setting, trajectory: Trajectory, *, banks: Array) -> dict[str, float]:
    """Numbers of one flight; `banks` are its bank angles in order of time, rad."""
    end, start = trajectory.x[-1, :3], trajectory.x[0, :3]
    miss = set_up.target.miss(end)
    signs = np.sign(banks[np.abs(banks) > 1 * DEG])
    return {
        "t_f_s": float(trajectory.t[-1]),
        "range_m": great_circle(start, end, radius=set_up.target.radius),
        "peak_load_g": float(trajectory["load"].max()),
        "miss_downrange_m": float(miss[0]),
        "miss_crossrange_m": float(miss[1]),
        "bank_travel_deg": float(np.abs(np.diff(banks)).sum() / DEG),
        "reversals": int((np.diff(signs) != 0).sum()),
    }


def guided_flight(scenario: LandingScenario, set_up: Setting, law: Guidance, case: tuple[Array, Array]) -> Trajectory:
    """One closed-loop flight with all its nodes, of a state and parameters of the truth."""
    stop = ocp.falls_below("h", scenario.reference.stop_altitude_m)
    method = ocp.RK4(step=scenario.numerics.step_s)
    return ocp.simulate(set_up.truth, law.law, x0=case[0], p=case[1], until=stop, t_max=1500.0, method=method, throw=False)


def draw(scenario: LandingScenario, set_up: Setting, count: int, *, name: str | None = None, seed: int | None = None) -> Cases:
    """Dispersed cases, independent and uniform, of the set of the scenario (or `name`); the first row of "none" is the nominal flight."""
    s = scenario
    rng = np.random.default_rng(s.dispersions.seed if seed is None else seed)
    path, speed, azimuth, bias, wave, coefficient, wind = (s.dispersions.scale * w for w in SETS[name or s.dispersions.set])
    uniform = rng.uniform(-1.0, 1.0, (count, 8))
    entry = np.tile(set_up.entry, (count, 1))
    entry[:, 4] += path * DEG * uniform[:, 0]
    entry[:, 3] += speed * uniform[:, 1]
    entry[:, 5] += azimuth * DEG * uniform[:, 2]
    t = s.truth
    values: dict[str, Any] = {
        "rho_factor": t.density_factor * (1 + bias * uniform[:, 3]),
        "wave_amplitude": wave * uniform[:, 4],
        "wave_length": rng.uniform(*WAVE_LENGTHS, count),
        "wave_phase": rng.uniform(0.0, 2 * np.pi, count),
        "CD_factor": t.drag_factor * (1 + coefficient * uniform[:, 5]),
        "CL_factor": t.lift_factor * (1 + coefficient * uniform[:, 6]),
        "wind_speed": wind * uniform[:, 7],
        "mach_lift": t.mach_lift,
        "noise_phase": rng.uniform(0.0, 2 * np.pi, count),
        "force_noise": s.sensors.force_noise_m_s2,
        "bank_error": s.sensors.bank_deg * DEG * rng.standard_normal(count),
    }
    errors = rng.standard_normal((count, 9))
    sizes = [s.sensors.position_m] * 3 + [s.sensors.velocity_m_s] * 3
    values |= {f"nav_{v.name}_error": size * errors[:, i] for i, (v, size) in enumerate(zip(STATES, sizes, strict=True))}
    values |= {f"force_bias_{axis}": s.sensors.force_bias_m_s2 * errors[:, 6 + i] for i, axis in enumerate("xyz")}
    p = np.tile(set_up.truth.p0, (count, 1))
    for key, value in values.items():
        p[:, set_up.truth.index(key)] = value
    bank = np.tile([s.reference.bank_deg * DEG, 0.0, 0.0, 0.0], (count, 1))
    return Cases(np.hstack([to_cartesian(entry), bank]), p)


def fly_cases(scenario: LandingScenario, set_up: Setting, law: Guidance, cases: Cases, **options: Any) -> Landings:
    """Closed-loop flights of many cases."""
    s = scenario
    return fly(law, x0=cases.x0, p=cases.p, altitude=s.reference.stop_altitude_m, step=s.numerics.step_s, **options)


def reach_of(set_up: Setting, x0: Array, p: Array, *, t_f: float, flown: Array) -> tuple[float, Array, Status]:
    """(distance m, nearest reachable miss (2,) m, status) of a case: what any bank profile could do with its air and coefficients.

    `t_f` s and `flown` (2,) m are when and with what miss it landed: a landing nearer than the search finds is itself the nearest.
    """
    model, truth = set_up.reachable, set_up.truth
    given = model.p0.copy()
    for i, var in enumerate(model.params):
        if var.name in [v.name for v in truth.params]:
            given[i] = p[truth.index(var.name)]
    found = nearest(model, set_up.target, x=x0[:6], radius=set_up.radius, t_f=t_f, p=given)
    distance = float(np.hypot(*flown))
    if distance < found.distance[0]:
        return distance, flown, Status.OK if distance <= REACHED else Status.OUTSIDE_FOOTPRINT
    return float(found.distance[0]), found.miss[0], found.status[0]


def _planet(s: LandingScenario) -> Planet:
    return EARTH if s.guidance.gravity == "oblate" else CENTRAL


def _air(s: LandingScenario) -> Atmosphere:
    a = s.atmosphere
    if a.model == "us76_smooth":
        return us76_smooth()
    return exponential(surface_density=a.surface_density_kg_m3, scale_height=a.scale_height_m)


@lru_cache(maxsize=8)
def _made(ballistic: float, ratio: float, nose: float) -> Vehicle:
    from dataclasses import replace

    return replace(from_ratios("N2", ballistic_coefficient=ballistic, lift_to_drag=ratio), nose_radius=nose)


def _vehicle(s: LandingScenario) -> Vehicle:
    v = s.vehicle
    return _made(v.ballistic_coefficient_kg_m2, v.lift_to_drag, v.nose_radius_m)
