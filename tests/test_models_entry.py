"""Entry models against independent NumPy equations: published flights, energy, the same flight twice, Coriolis, bank, wind, Jacobians."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import models
import ocp
from models import tables, units, wind
from models.core import ModelError
from ocp.linearize import jacobians

MU, R, W, J2, RE = 3.986004418e14, 6371e3, 7.292115e-5, 1.08262668e-3, 6378137.0
N1 = models.from_ratios("n1", ballistic_coefficient=450.0, lift_to_drag=0.25)
N1_START = [7800.0, math.radians(-1.36), 1e5, 0.0]
N1_LIFT = 0.25 * math.cos(math.pi / 4)
DRAGLESS = models.Vehicle("stone", 1e7, 1e-9, 0.3, 1.0)
CAPSULE = models.Vehicle("capsule", 2900.0, 3.8, 0.35, 1.34)


@pytest.fixture(scope="module")
def n1():
    law = ocp.constant(lift_ratio=N1_LIFT)
    return ocp.simulate(models.entry_planar(N1), law, x0=N1_START, until=ocp.falls_below("h", 10e3))


# --- published and independent numbers ----------------------------------------------------------------------------


def test_reference_flight_has_its_published_numbers(n1):
    assert n1.t[-1] == pytest.approx(547.064, abs=6e-4)
    assert n1["s"][-1] == pytest.approx(2720.77e3, abs=6.0)
    assert -n1["n_x"].min() == pytest.approx(3.3145, abs=6e-5)
    assert n1["load"].max() == pytest.approx(3.4165, abs=6e-5)
    assert n1.t[n1["n_x"].argmin()] == pytest.approx(402.3, abs=0.3)
    assert n1["h"][-1] == pytest.approx(10e3, rel=1e-9)


def test_reference_flight_against_an_independent_integration(n1):
    def rates(_t, x):
        V, gamma, h, _ = x
        r, drag = R + h, 1.225 * math.exp(-h / 7110) * V**2 / 900
        g = MU / r**2
        return [
            -drag - g * math.sin(gamma),
            N1_LIFT * drag / V + (V / r - g / V) * math.cos(gamma),
            V * math.sin(gamma),
            R * V * math.cos(gamma) / r,
        ]

    def ground(_t, x):
        return x[2] - 10e3

    ground.terminal = True
    flow = solve_ivp(rates, (0, 3600), N1_START, method="DOP853", rtol=1e-12, atol=1e-9, events=ground)
    assert n1.t[-1] == pytest.approx(flow.t[-1], rel=1e-9)
    assert n1["s"][-1] == pytest.approx(flow.y[3, -1], rel=1e-9)
    assert n1["V"][-1] == pytest.approx(flow.y[0, -1], rel=1e-8)


@pytest.mark.parametrize(
    ("bank", "time", "range_km", "peak_g"),
    [
        (0, 564.9, 2607, 3.03),
        (30, 525.0, 2440, 3.14),
        (45, 480.4, 2259, 3.27),
        (60, 427.3, 2059, 4.50),
        (75, 374.7, 1883, 6.78),
        (90, 330.1, 1752, 9.92),
    ],
)
def test_soyuz_at_constant_bank(bank, time, range_km, peak_g):
    """Table of an independent computation with the data of the Soyuz capsule: planar, US76, spherical Earth, stop at 10.8 km."""
    soyuz = models.SOYUZ
    ratio = soyuz.lift_to_drag * math.cos(math.radians(bank))
    x0 = [soyuz.entry["V"], soyuz.entry["gamma"], soyuz.entry["h"], 0.0]
    model = models.entry_planar(soyuz, atmosphere=models.us76_smooth())
    flight = ocp.simulate(model, ocp.constant(lift_ratio=ratio), x0=x0, until=ocp.falls_below("h", 10.8e3))
    # the printed digits
    assert flight.t[-1] == pytest.approx(time, abs=0.06)
    assert flight["s"][-1] / 1e3 == pytest.approx(range_km, abs=0.5)
    assert flight["load"].max() == pytest.approx(peak_g, abs=0.006)


# --- invariants ---------------------------------------------------------------------------------------------------


def test_planar_energy_is_kept_without_drag():
    model = models.entry_planar(DRAGLESS)
    x0 = [7600.0, math.radians(4.0), 2e5, 0.0]
    flight = ocp.simulate(model, ocp.constant(lift_ratio=0.3), x0=x0, p={"rho_factor": 0.05}, t_max=1500.0)
    energy = flight["V"] ** 2 / 2 - MU / (R + flight["h"])
    momentum = flight["V"] * np.cos(flight["gamma"]) * (R + flight["h"])
    assert np.abs(energy / energy[0] - 1).max() < 1e-10
    assert np.abs(momentum / momentum[0] - 1).max() < 1e-10
    assert np.ptp(flight["h"]) > 1e5  # the two parts of the energy were exchanged


def test_jacobi_constant_is_kept_on_a_rotating_oblate_planet():
    model = models.entry_3dof(DRAGLESS)
    x0 = [2e5, 0.3, 0.6, 7300.0, 0.05, 0.7]
    flight = ocp.simulate(model, ocp.constant(bank=0.4), x0=x0, p={"rho_factor": 0.05}, t_max=1500.0)
    r, lat = R + flight["h"], flight["lat"]
    potential = MU / r * (1 - J2 * (RE / r) ** 2 * (3 * np.sin(lat) ** 2 - 1) / 2)
    jacobi = flight["V"] ** 2 / 2 - potential - W**2 * (r * np.cos(lat)) ** 2 / 2
    assert np.abs(jacobi / jacobi[0] - 1).max() < 1e-10
    no_j2 = flight["V"] ** 2 / 2 - MU / r - W**2 * (r * np.cos(lat)) ** 2 / 2
    assert np.abs(no_j2 / no_j2[0] - 1).max() > 1e-6  # the invariant is sharp enough to see J2


def test_planar_equals_three_degrees_of_freedom_on_the_equator():
    air = models.us76_smooth()
    bank = math.radians(50)
    t_max = 400.0
    planar = ocp.simulate(
        models.entry_planar(CAPSULE, atmosphere=air),
        ocp.constant(lift_ratio=CAPSULE.lift_to_drag),
        x0=[7700.0, -0.03, 9e4, 0.0],
        t_max=t_max,
    )
    full = models.entry_3dof(CAPSULE, atmosphere=air, planet=models.SPHERE)
    level = ocp.simulate(full, ocp.constant(bank=0.0), x0=[9e4, 0.2, 0.0, 7700.0, -0.03, math.pi / 2], t_max=t_max)
    for name in ("V", "gamma", "h", "n_x", "load", "hdot", "sdot", "qbar", "mach", "rho"):
        assert np.abs(planar[name] - level[name]).max() < 1e-9 * np.abs(planar[name]).max(), name
    assert np.abs(planar["s"] - R * (level["lon"] - 0.2)).max() < 1e-9 * planar["s"].max()
    assert np.abs(level["lat"]).max() < 1e-12
    assert np.abs(level["psi"] - math.pi / 2).max() < 1e-12
    # vertical lift ratio is what stays of banked lift in the vertical plane, at the first instant
    u = CAPSULE.lift_to_drag * math.cos(bank)
    x = planar.model.xdot(planar.x[100], [u])
    x3 = full.xdot(level.x[100], [bank])
    assert x[1] == pytest.approx(x3[4], rel=1e-9)


# --- the rotating equations ---------------------------------------------------------------------------------------


def inertial_flight(x0, bank, t_end, wind_of=None):
    """Position (planet-fixed lon, lat, r) and relative speed after t_end, integrated in inertial Cartesian coordinates."""
    h, lon, lat, V, gamma, psi = x0

    def axes(position):
        up = position / np.linalg.norm(position)
        east = np.cross([0, 0, 1.0], up)
        east /= np.linalg.norm(east)
        return east, np.cross(up, east), up

    def rates(_t, state):
        r, v = state[:3], state[3:]
        d = np.linalg.norm(r)
        zz = 5 * (r[2] / d) ** 2
        gravity = -MU / d**3 * r * (1 + 1.5 * J2 * (RE / d) ** 2 * (np.array([1, 1, 3.0]) - zz))
        relative = v - np.cross([0, 0, W], r)
        if wind_of is not None:
            east, north, _ = axes(r)
            blowing = wind_of(d - R)
            relative = relative - blowing[0] * east - blowing[1] * north
        speed = np.linalg.norm(relative)
        along = relative / speed
        normal = r / d - (r / d @ along) * along
        normal /= np.linalg.norm(normal)
        right = np.cross(along, normal)
        rho = 1.225 * math.exp(-(d - R) / 7110)
        q = 0.5 * rho * speed**2 * CAPSULE.area / CAPSULE.mass
        force = q * (-CAPSULE.CD * along + CAPSULE.CL * (math.cos(bank) * normal + math.sin(bank) * right))
        return np.concatenate([v, gravity + force])

    r0 = (R + h) * np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    east, north, up = axes(r0)
    v0 = V * (math.cos(gamma) * (math.sin(psi) * east + math.cos(psi) * north) + math.sin(gamma) * up) + np.cross([0, 0, W], r0)
    flow = solve_ivp(rates, (0, t_end), np.concatenate([r0, v0]), method="DOP853", rtol=1e-12, atol=1e-7)
    r, v = flow.y[:3, -1], flow.y[3:, -1]
    d = np.linalg.norm(r)
    speed = np.linalg.norm(v - np.cross([0, 0, W], r))
    return d, math.atan2(r[1], r[0]) - W * t_end, math.asin(r[2] / d), speed


@pytest.mark.parametrize(
    ("x0", "bank"),
    [
        ([8e4, 0.4, 0.7, 7400.0, -0.02, 0.9], 0.8),  # northern hemisphere, north-east
        ([9e4, -1.0, -0.5, 7600.0, -0.025, 4.0], -1.2),  # southern hemisphere, south-west
    ],
)
def test_rotation_J2_drag_and_bank_against_inertial_coordinates(x0, bank):
    flight = ocp.simulate(models.entry_3dof(CAPSULE), ocp.constant(bank=bank), x0=x0, t_max=300.0)
    d, lon, lat, speed = inertial_flight(x0, bank, 300.0)
    assert flight["V"][-1] < 0.95 * flight["V"][0]
    assert R + flight["h"][-1] == pytest.approx(d, rel=1e-9)
    assert flight["lon"][-1] == pytest.approx(lon, rel=1e-8)
    assert flight["lat"][-1] == pytest.approx(lat, rel=1e-8)
    assert flight["V"][-1] == pytest.approx(speed, rel=1e-8)


def test_wind_against_inertial_coordinates():
    h, east, north = [0.0, 2e4, 5e4, 8e4, 1e5], [20.0, 60.0, -40.0, 30.0, 30.0], [-5.0, 10.0, 50.0, -30.0, -30.0]
    breeze = wind.from_table(h, east, north)
    splines = [CubicSpline(h, values, bc_type="clamped") for values in (east, north)]
    x0, bank = [8e4, 0.4, 0.7, 7400.0, -0.02, 0.9], 0.8
    flight = ocp.simulate(models.entry_3dof(CAPSULE, wind=breeze), ocp.constant(bank=bank), x0=x0, t_max=300.0)
    d, lon, lat, speed = inertial_flight(x0, bank, 300.0, lambda height: [s(height) for s in splines])
    calm = ocp.simulate(models.entry_3dof(CAPSULE), ocp.constant(bank=bank), x0=x0, t_max=300.0)
    assert abs(calm["lon"][-1] - lon) > 1e-4 * abs(lon)  # the wind is felt
    assert R + flight["h"][-1] == pytest.approx(d, rel=1e-8)
    assert [flight["lon"][-1], flight["lat"][-1], flight["V"][-1]] == pytest.approx([lon, lat, speed], rel=1e-7)


def test_uniform_wind_is_a_change_of_airspeed():
    breeze = wind.from_table([0.0, 1e5], [50.0, 50.0])
    kwargs = {"planet": models.SPHERE}
    windy, calm = models.entry_3dof(CAPSULE, wind=breeze, **kwargs), models.entry_3dof(CAPSULE, **kwargs)
    x, slower = [5e4, 0.1, 0.0, 5000.0, 0.0, math.pi / 2], [5e4, 0.1, 0.0, 4950.0, 0.0, math.pi / 2]
    assert windy.xdot(x, [0.0])[3] == pytest.approx(calm.xdot(slower, [0.0])[3], rel=1e-9)
    for name in ("qbar", "mach", "n_x", "load"):
        i = windy.index(name)
        assert windy.y(x, [0.3])[i] == pytest.approx(calm.y(slower, [0.3])[i], rel=1e-12)
    assert windy.y(x, [0.0])[windy.index("sdot")] == pytest.approx(calm.y(x, [0.0])[calm.index("sdot")], rel=1e-12)


def test_signs_of_coriolis_and_bank():
    model = models.entry_3dof(DRAGLESS)
    north = model.xdot([2e5, 0.0, 0.8, 3000.0, 0.0, 0.0], [0.0])
    still = models.entry_3dof(DRAGLESS, planet=models.SPHERE).xdot([2e5, 0.0, 0.8, 3000.0, 0.0, 0.0], [0.0])
    assert north[5] - still[5] == pytest.approx(2 * W * math.sin(0.8), rel=1e-9)  # northward flight turns to the right (east)
    right = models.entry_3dof(CAPSULE, planet=models.SPHERE).xdot([6e4, 0.0, 0.0, 6000.0, 0.0, math.pi / 2], [0.5])
    assert right[5] > 0  # eastward flight banked right turns south
    left = models.entry_3dof(CAPSULE, planet=models.SPHERE).xdot([6e4, 0.0, 0.0, 6000.0, 0.0, math.pi / 2], [-0.5])
    assert left[5] == pytest.approx(-right[5], rel=1e-12)


# --- aerodynamics and dispersions ---------------------------------------------------------------------------------


def test_coefficients_against_mach_number():
    nodes = np.array([0.5, 1.0, 2.0, 5.0, 10.0, 30.0])
    cl, cd = np.array([0.3, 0.42, 0.40, 0.37, 0.35, 0.34]), np.array([0.9, 1.2, 1.45, 1.38, 1.34, 1.33])
    vehicle = models.Vehicle("tables", 2900.0, 3.8, tables.line("CL", nodes, values=cl), tables.line("CD", nodes, values=cd))
    speed, V, h, bank = 300.0, 2130.0, 35e3, 0.7
    air = models.exponential(sound_speed=speed)
    rho, mach = 1.225 * math.exp(-h / 7110), V / speed
    CL, CD = (float(CubicSpline(nodes, v)(mach)) for v in (cl, cd))
    q = 0.5 * rho * V**2 * 3.8 / 2900.0
    full = models.entry_3dof(vehicle, atmosphere=air, planet=models.SPHERE)
    rate = full.xdot([h, 0.0, 0.0, V, 0.0, math.pi / 2], [bank])
    g, r = MU / (R + h) ** 2, R + h
    assert rate[3] == pytest.approx(-q * CD, rel=1e-12)
    assert rate[4] == pytest.approx(q * CL * math.cos(bank) / V + V / r - g / V, rel=1e-12)
    assert rate[5] == pytest.approx(q * CL * math.sin(bank) / V, rel=1e-12)
    planar = models.entry_planar(vehicle, atmosphere=air)
    flat = planar.xdot([V, 0.0, h, 0.0], [CL / CD * math.cos(bank)])
    assert flat[:2] == pytest.approx(rate[3:5], rel=1e-12)
    assert planar.y([V, 0.0, h, 0.0], [0.1])[planar.index("load")] == pytest.approx(q * math.hypot(CL, CD) / units.G0, rel=1e-12)
    with pytest.raises(ModelError, match="depends on Mach"):
        _ = vehicle.lift_to_drag


def test_dispersions_multiply_what_they_name():
    model = models.entry_planar(CAPSULE)
    x, u = [6500.0, -0.02, 6e4, 1e5], [0.2]
    base, rate = model.y(x, u), model.xdot(x, u)
    g, turn = MU / (R + 6e4) ** 2, (6500.0 / (R + 6e4) - MU / (R + 6e4) ** 2 / 6500.0) * math.cos(-0.02)
    drag, lift = -rate[0] - g * math.sin(-0.02), rate[1] - turn

    def at(**p):
        y, f = model.y(x, u, p), model.xdot(x, u, p)
        return y, -f[0] - g * math.sin(-0.02), f[1] - turn

    i = {n: model.index(n) for n in ("n_x", "load", "rho", "qbar")}
    y, d, lifted = at(rho_factor=1.3)
    assert [d / drag, lifted / lift, y[i["rho"]] / base[i["rho"]], y[i["qbar"]] / base[i["qbar"]]] == pytest.approx([1.3] * 4, rel=1e-12)
    y, d, lifted = at(CD_factor=1.2)
    assert [d / drag, lifted / lift, y[i["n_x"]] / base[i["n_x"]]] == pytest.approx([1.2, 1.0, 1.2], rel=1e-12)
    y, d, lifted = at(CL_factor=0.7)
    assert [d / drag, lifted / lift] == pytest.approx([1.0, 0.7], rel=1e-12)
    ratio = 0.35 / 1.34
    assert y[i["load"]] / base[i["load"]] == pytest.approx(math.sqrt((1 + 0.49 * ratio**2) / (1 + ratio**2)), rel=1e-12)
    _, d, lifted = at(wave_amplitude=0.1, wave_length=2.5e4, wave_phase=0.4)
    wave = 1 + 0.1 * math.sin(2 * math.pi * 6e4 / 2.5e4 + 0.4)
    assert [d / drag, lifted / lift] == pytest.approx([wave] * 2, rel=1e-12)
    _, d, lifted = at(mass=5800.0)
    assert [d / drag, lifted / lift] == pytest.approx([0.5] * 2, rel=1e-12)


# --- Jacobians ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize(
    ("factory", "x", "u"),
    [
        (models.entry_planar, [6543.0, -0.023, 61.3e3, 1.2e5], [0.21]),
        (models.entry_planar, [412.0, -0.9, 17.7e3, 2.2e6], [-0.1]),
        (models.entry_3dof, [61.3e3, 0.4, -0.7, 6543.0, -0.023, 2.2], [0.9]),
        (models.entry_3dof, [17.7e3, -2.1, 0.3, 412.0, -0.9, -1.1], [-2.0]),
    ],
)
def test_jacobians_against_central_differences(factory, x, u, smooth):
    model = factory(CAPSULE, atmosphere=models.us76_smooth() if smooth else models.exponential())
    lin = ocp.linearize(model, x=x, u=u, p={"rho_factor": 1.1, "wave_amplitude": 0.05})
    z, nx = np.concatenate([x, u]), len(x)
    scale = np.array([v.nominal for v in model.states + model.inputs])

    def both(point):
        p = {"rho_factor": 1.1, "wave_amplitude": 0.05}
        return np.concatenate([model.xdot(point[:nx], point[nx:], p), model.y(point[:nx], point[nx:], p)])

    exact = np.block([[lin.A[0], lin.B[0]], [lin.C[0], lin.D[0]]])
    for j in range(len(z)):
        step = 1e-4 * scale[j]
        e = np.eye(len(z))[j]
        coarse = (both(z + 2 * step * e) - both(z - 2 * step * e)) / (4 * step)
        fine = (both(z + step * e) - both(z - step * e)) / (2 * step)
        difference = (4 * fine - coarse) / 3
        size = np.abs(both(z)) / scale[j] + np.abs(difference)
        assert (np.abs(exact[:, j] - difference) <= 1e-8 * size + 1e-15).all(), (j, exact[:, j], difference)
    assert jacobians(model) is jacobians(model)


# --- refusals -----------------------------------------------------------------------------------------------------


def test_planar_refuses_a_rotating_or_oblate_planet():
    with pytest.raises(ModelError, match="use entry_3dof"):
        models.entry_planar(CAPSULE, planet=models.EARTH)


def test_path_angle_in_degrees_is_refused():
    model = models.entry_planar(CAPSULE)
    with pytest.raises(ModelError, match=r"x0: gamma = -1.36 rad .* degrees"):
        ocp.simulate(model, ocp.constant(lift_ratio=0.2), x0=[7800.0, -1.36, 1e5, 0.0], until=ocp.falls_below("h", 1e4))


@pytest.mark.parametrize("bad", [{"mu": -1.0}, {"radius": math.nan}, {"rotation": math.inf}, {"J2": "no"}, {"equatorial_radius": 0}])
def test_bad_planets(bad):
    with pytest.raises(ModelError, match=f"Planet: {next(iter(bad))}"):
        models.Planet(**bad)
