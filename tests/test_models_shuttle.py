"""Orbiter: tables at their nodes, exact derivatives, equations of motion in complex numbers, trim, jets, wind."""

import csv
import math
from importlib import resources

import casadi as ca
import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.interpolate import make_interp_spline

import ocp
from models import ModelError, us76_smooth, wind
from models.checked import evaluate
from models.pitch_jets import pitch_jets
from models.shuttle import Servo, orbiter, orbiter_longitudinal
from models.shuttle_aero import COEFFICIENTS, orbiter_aero, orbiter_data
from models.shuttle_trim import trim_elevon
from ocp.linearize import jacobians

DEG = math.pi / 180
FLAP = -11.7 * DEG


@pytest.fixture(scope="module")
def data():
    return YAML(typ="safe").load((resources.files("models") / "data" / "shuttle_longitudinal.yaml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def breeze():
    return wind.from_table([0.0, 40e3, 80e3], [0.0, 30.0, 55.0], name="breeze")


@pytest.fixture(scope="module")
def model(breeze):
    return orbiter_longitudinal(wind=breeze)


def test_every_node_of_the_basic_body(data):
    table = data["basic"]
    M, A = np.meshgrid(table["mach"], table["alpha_deg"], indexing="ij")
    found = orbiter_aero().at(M, A * DEG)
    for name in COEFFICIENTS:
        wanted = np.array(table[name], dtype=float)
        known = np.isfinite(wanted)
        assert known.sum() == wanted.size - 24
        np.testing.assert_allclose(found[name][known], wanted[known], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(orbiter_aero().covers(M, A * DEG), known)


@pytest.mark.parametrize(("key", "argument"), [("elevon_increment", 2), ("body_flap_increment", 3)])
def test_every_node_of_the_increments(data, key, argument):
    table = data[key]
    M, A, D = np.meshgrid(table["mach"], table["alpha_deg"], table["deflection_deg"], indexing="ij")
    given = [M, A * DEG, 0 * D, 0 * D]
    still = orbiter_aero().at(*given)
    given[argument] = D * DEG
    moved = orbiter_aero().at(*given)
    for name in COEFFICIENTS:
        wanted = np.array(table[f"d{name}"], dtype=float)
        known = np.isfinite(wanted)
        assert known.mean() > 0.9
        np.testing.assert_allclose((moved[name] - still[name])[known], wanted[known], rtol=0, atol=1e-12)


def test_the_independent_grid_file_agrees():
    text = (resources.files("models") / "data" / "shuttle_longitudinal_grid.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    values = np.array([[float(v) for v in row.values()] for row in rows if row["flag"] == "0"])
    found = orbiter_aero().at(values[:, 0], values[:, 1] * DEG, values[:, 2] * DEG)
    for i, name in enumerate(COEFFICIENTS):  # the file has five decimals
        np.testing.assert_allclose(found[name], values[:, 3 + i], rtol=0, atol=1.01e-5)


def basis(knots, x):
    """All quadratic basis splines at a complex x; the interval is chosen by its real part."""
    n = len(knots) - 3
    cell = int(np.clip(np.searchsorted(knots, x.real, side="right") - 1, 2, n - 1))
    values = np.zeros(len(knots) - 1, dtype=complex)
    values[cell] = 1.0
    for k in (1, 2):
        for i in range(len(knots) - 1 - k):
            left, right = knots[i + k] - knots[i], knots[i + k + 1] - knots[i + 1]
            term = (x - knots[i]) / left * values[i] if left > 0 else 0.0
            values[i] = term + ((knots[i + k + 1] - x) / right * values[i + 1] if right > 0 else 0.0)
    return values[:n]


class ComplexTables:
    """The same quadratic splines, evaluated by the textbook recursion in complex numbers."""

    def __init__(self, data):
        def parts(key, names):
            table = data[key]
            axes = [np.array(table["mach"], dtype=float), DEG * np.array(table["alpha_deg"], dtype=float)]
            if "deflection_deg" in table:
                axes.append(DEG * np.array(table["deflection_deg"], dtype=float))
            values = np.stack([np.array(table[n], dtype=float) for n in names], axis=-1)
            five = values[list(table["mach"]).index(5.0)]
            for row in values:
                for j in range(1, len(row)):
                    gap = np.isnan(row[j])
                    row[j][gap] = (row[j - 1] + five[j] - five[j - 1])[gap]
            return axes, values

        self.splines = {}
        for key, names in (
            ("basic", COEFFICIENTS),
            ("elevon_increment", ("dCL", "dCD", "dCm")),
            ("body_flap_increment", ("dCL", "dCD", "dCm")),
        ):
            axes, values = parts(key, names)
            self.splines[key] = (axes, values)

    def __call__(self, mach, alpha, delta_e, delta_bf):
        fine, total = self.splines["basic"]
        flap_axes, flap = self.splines["body_flap_increment"]
        for axis in (0, 1):
            flap = make_interp_spline(flap_axes[axis], flap, k=2, axis=axis)(fine[axis])
        hull = self.value([*fine, flap_axes[2]], total[:, :, None, :] + flap, (mach, alpha, delta_bf))
        return hull, self.value(*self.splines["elevon_increment"], (mach, alpha, delta_e))

    @staticmethod
    def value(axes, values, point):
        out = values
        for i, (axis, x) in enumerate(zip(axes, point, strict=True)):
            fitted = make_interp_spline(axis, values, k=2, axis=i)
            weights = basis(fitted.t, complex(x))
            # interpolate along one axis at a time: coefficients are linear in the values
            transfer = make_interp_spline(axis, np.eye(len(axis)), k=2).c
            out = np.tensordot(weights @ transfer, out, axes=(0, 0))
        return out


@pytest.fixture(scope="module")
def tables(data):
    return ComplexTables(data)


def rhs_by_hand(tables, breeze, x, u, p, h_fixed):
    """The equations of motion in complex numbers; the air is that of a real altitude."""
    V, gamma, _, _, theta, q, de, dbf = x
    body, jets = orbiter(), pitch_jets()
    air = us76_smooth().at([h_fixed])
    rho, a = air["density"][0], air["sound_speed"][0]
    w = p["wind_factor"] * breeze.at([h_fixed])[0, 0]
    ahead, up = V * np.cos(gamma) - w, V * np.sin(gamma)
    speed = np.sqrt(ahead**2 + up**2)
    path = np.arctan(up / ahead)
    alpha, tilt = theta - path, path - gamma
    hull, flaps = tables(speed / a, alpha, de, dbf)
    qbar = 0.5 * p["rho_factor"] * rho * speed**2
    L = qbar * body.area * p["CL_factor"] * (hull[0] + p["elevon_factor"] * flaps[0])
    D = qbar * body.area * p["CD_factor"] * (hull[1] + p["elevon_factor"] * flaps[1])
    Cm = p["Cm_factor"] * hull[2] + p["elevon_factor"] * flaps[2] - 2.0 * q * 12.0579 / (2 * speed)
    N = L * np.cos(alpha) + D * np.sin(alpha)
    M = qbar * body.area * 12.0579 * Cm + p["cg_aft"] * N
    Fx = u[2] * jets.force_up[0] + u[3] * jets.force_down[0]
    Fz = u[2] * jets.force_up[1] + u[3] * jets.force_down[1]
    M = M + u[2] * (jets.moment_up - p["cg_aft"] * jets.force_up[1]) + u[3] * (jets.moment_down - p["cg_aft"] * jets.force_down[1])
    along = -D * np.cos(tilt) - L * np.sin(tilt) + Fx * np.cos(theta - gamma) + Fz * np.sin(theta - gamma)
    normal = L * np.cos(tilt) - D * np.sin(tilt) + Fx * np.sin(theta - gamma) - Fz * np.cos(theta - gamma)
    r, mu = 6371e3 + h_fixed, 3.986004418e14
    turn = V * np.cos(gamma) / r
    return np.array([
        along / 92986.4 - mu / r**2 * np.sin(gamma), normal / (92986.4 * V) - mu / r**2 * np.cos(gamma) / V + turn, V * np.sin(gamma),
        6371e3 * turn, q + turn, M / 9204784, 20.0 * (u[0] - de), 2.0 * (u[1] - dbf),
    ])  # fmt: skip


# Mach 5 and 25 deg at nodes; in the middle of cells (where a quadratic spline has its knots); a shallow and a steep point.
POINTS = [
    (5.0, 25.0, -10.0, -11.7 + 6.7, 0.0), (4.25, 26.25, -12.5, -8.35, -0.05), (6.5, 36.25, -7.5, 2.5, -0.2), (2.75, 13.75, -17.5, 7.5, 0.1),
    (9.0, 41.25, 7.5, 13.15, -0.3),
]  # fmt: skip


@pytest.mark.parametrize("point", POINTS)
def test_equations_and_jacobians_against_complex_step(model, tables, breeze, point):
    mach, alpha, elevon, flap, gamma = point
    h = 46e3
    a, w = us76_smooth().at([h])["sound_speed"][0], 1.3 * breeze.at([h])[0, 0]
    # ground speed for this Mach number under the tail wind
    V = w * math.cos(gamma) + math.sqrt((w * math.cos(gamma)) ** 2 - w**2 + (mach * a) ** 2)
    path = math.atan2(V * math.sin(gamma), V * math.cos(gamma) - w)
    x = np.array([V, gamma, h, 1e5, path + alpha * DEG, 0.011, elevon * DEG, flap * DEG])
    u = np.array([elevon * DEG + 0.001, flap * DEG - 0.002, 0.3, 0.6])
    changes = {
        "Cm_factor": 1.1,
        "elevon_factor": 0.9,
        "CL_factor": 1.05,
        "CD_factor": 0.93,
        "wind_factor": 1.3,
        "cg_aft": 0.04,
        "rho_factor": 0.97,
    }
    p = model.parameters(changes)
    named = dict(zip((v.name for v in model.params), p, strict=True))
    f, A, *_ = evaluate(jacobians(model), x, u, p)
    y = model.y(x, u, p)
    assert y[model.index("mach")] == pytest.approx(mach, rel=1e-12)
    assert y[model.index("alpha")] == pytest.approx(alpha * DEG, rel=1e-12)
    np.testing.assert_allclose(f, rhs_by_hand(tables, breeze, x, u, named, h).real, rtol=1e-9, atol=1e-12)
    for i in (0, 1, 4, 5, 6, 7):  # altitude would need the atmosphere in complex numbers; it has tests of its own
        z = x.astype(complex)
        z[i] += 1e-30j
        wanted = rhs_by_hand(tables, breeze, z, u, named, h).imag / 1e-30
        np.testing.assert_allclose(A[:, i], wanted, rtol=1e-8, atol=1e-10 * np.abs(wanted).max(), err_msg=model.states[i].name)


def test_the_altitude_column_against_differences(model):
    x = np.array([1700.0, -0.08, 47.3e3, 0.0, 0.4, 0.0, -0.14, FLAP])
    u = np.array([-0.14, FLAP, 0.0, 1.0])
    A = evaluate(jacobians(model), x, u, model.p0)[1]
    step = np.zeros(8)
    step[2] = 2.0
    wanted = (model.xdot(x + step, u) - model.xdot(x - step, u)) / 4.0
    np.testing.assert_allclose(A[:, 2], wanted, rtol=1e-5, atol=1e-9 * np.abs(wanted).max())


def test_coefficients_are_continuously_differentiable():
    aero = orbiter_aero()
    x = [ca.SX.sym(n) for n in ("mach", "alpha", "e", "f")]
    C = ca.vertcat(*aero.coefficients(*x))
    slopes = ca.Function("slopes", x, [ca.densify(ca.jacobian(C, ca.vertcat(*x)))])
    rng = np.random.default_rng(3)
    for k, nodes in enumerate((aero.mach, aero.alpha, aero.delta_e, aero.delta_bf)):
        for at in np.concatenate([nodes[1:-1], 0.5 * (nodes[1:] + nodes[:-1])]):
            point = [rng.uniform(low, high) for low, high in aero.domain.values()]
            sides = []
            for shift in (-1e-9, 1e-9):
                point[k] = at + shift * (1 if k else 10)
                sides.append(slopes(*point).full())
            scale = np.abs(sides[0]).max(axis=0)
            assert (np.abs(sides[1] - sides[0]) <= 2e-6 * scale + 1e-7).all(), (k, at)


def test_the_elevon_slope_is_the_derivative():
    aero = orbiter_aero()
    x = [ca.SX.sym(n) for n in ("mach", "alpha", "e")]
    both = ca.Function("both", x, [ca.jacobian(aero.elevon(*x)[2], x[2]), aero.elevon_slope(*x)])
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(2, 20, 200), rng.uniform(0, 0.87, 200), rng.uniform(-0.69, 0.34, 200)])
    automatic, own = evaluate(both, *(points[:, [i]] for i in range(3)))
    np.testing.assert_allclose(own, automatic, rtol=1e-10, atol=1e-12)
    assert own.max() < 0


def test_tables_hold_at_mach_20_and_refuse_numbers_outside():
    aero = orbiter_aero()
    x = [ca.SX.sym(n) for n in ("mach", "alpha", "e", "f")]
    value = ca.Function("value", x, [ca.vertcat(*aero.coefficients(*x))])
    np.testing.assert_array_equal(value(27.0, 0.7, -0.2, 0.0).full(), value(20.0, 0.7, -0.2, 0.0).full())
    with pytest.raises(ModelError, match=r"mach = 1\.5"):
        aero.at(1.5, 0.3)
    with pytest.raises(ModelError, match=r"alpha = 40 .* radians"):
        aero.at(5.0, 40.0)
    assert bool(aero.covers(2.2, 25 * DEG))
    assert not aero.covers(2.2, 35 * DEG)
    assert not aero.covers(2.7, 35 * DEG)  # between a node that reaches 30 deg and one that reaches 45


def test_trim_at_mach_20():
    # -14.3 by straight lines between the printed nodes -15 and -10 deg
    found = trim_elevon(20.0, 40 * DEG)
    assert found.elevon / DEG == pytest.approx(-14.3, abs=0.15)
    lift = orbiter_aero().at(20.0, 40 * DEG, found.elevon)
    assert abs(lift["Cm"]) < 1e-15
    assert found.residual == pytest.approx(0.0, abs=1e-15)
    assert bool(found.trimmed)


def test_trim_is_where_the_model_has_no_moment(model):
    mach, alpha, cg = np.array([3.0, 4.4, 6.0]), np.array([15.0, 23.0, 35.0]) * DEG, 0.05
    found = trim_elevon(mach, alpha, delta_bf=FLAP, cg_aft=cg)
    still = orbiter_longitudinal()
    a = us76_smooth().at([45e3])["sound_speed"][0]
    for i in range(3):
        x = np.array([mach[i] * a, 0.0, 45e3, 0.0, alpha[i], 0.0, found.elevon[i], FLAP])
        p = still.parameters({"cg_aft": cg})
        moment = still.y(x, np.zeros(4), p)[still.index("pitch_moment")]
        qbar = still.y(x, np.zeros(4), p)[still.index("qbar")]
        assert abs(moment) < 1e-10 * qbar * 250 * 12
        step = np.zeros(8)
        step[4] = 1e-5
        up, down = (still.y(x + s * step, np.zeros(4), p)[still.index("pitch_moment")] for s in (1, -1))
        assert found.Cm_alpha[i] == pytest.approx((up - down) / 2e-5 / (qbar * 249.909 * 12.0579), rel=1e-5)


def test_trim_out_of_authority_is_an_answer():
    found = trim_elevon(np.array([3.0, 3.0]), np.array([15.0, 15.0]) * DEG, delta_bf=np.array([FLAP, 22.5 * DEG]))
    assert found.trimmed.tolist() == [True, False]
    assert found.elevon[1] == pytest.approx(-33 * DEG)
    assert found.residual[1] < -0.005
    worse = trim_elevon(3.0, 15 * DEG, delta_bf=FLAP, Cm_factor=1.2, elevon_factor=0.8)
    assert not worse.trimmed


def test_jets_against_the_table():
    table = YAML(typ="safe").load((resources.files("models") / "data" / "shuttle_rcs.yaml").read_text(encoding="utf-8"))["thrusters"]
    for plume, moment, names in (("U", 267e3, "LR"), ("D", -253e3, "LR")):
        chosen = [j for j in table if j["pod"] in names and j["plume"] == plume and j["type"] == "primary"]
        assert len(chosen) == 6
        places = [0.0254 * np.array([1076.7 - x, y, 375.0 - z]) for x, y, z in (j["structural_in"] for j in chosen)]
        torque = sum(np.cross(at, j["direction"]) * j["thrust_N"] for at, j in zip(places, chosen, strict=True))
        jets = pitch_jets(6)
        found = jets.moment_up if plume == "U" else jets.moment_down
        assert found == pytest.approx(torque[1], rel=1e-6)
        assert found == pytest.approx(moment, rel=2e-3)
        assert abs(torque[0]) < 1e-6 * abs(found)  # pairs: no roll
        shifted = sum(np.cross(np.add(at, [0.05, 0, 0]), j["direction"]) * j["thrust_N"] for at, j in zip(places, chosen, strict=True))[1]
        assert jets.moments(0.05)[0 if plume == "U" else 1] == pytest.approx(shifted, rel=1e-6)
    assert pitch_jets(6).flow_up == pytest.approx(6 * 3870 / (289 * 9.80665), rel=1e-12)
    assert len(set(pitch_jets(2).up + pitch_jets(2).down)) == 4
    for count in (0, 3, 8, True):
        with pytest.raises(ModelError, match="count"):
            pitch_jets(count)


def test_wind_and_signs(model):
    x = np.array([2000.0, 0.0, 60e3, 0.0, 5 * DEG, 0.0, 0.0, FLAP])
    u = np.zeros(4)
    head, tail = (model.y(x, u, model.parameters({"wind_factor": f})) for f in (-1.0, 1.0))
    airspeed, qbar = model.index("airspeed"), model.index("qbar")
    w = 0.5 * (head[airspeed] - tail[airspeed])
    assert w == pytest.approx(model.y(x, u, model.p0)[airspeed] * -1 + 2000.0, rel=1e-12)
    assert tail[qbar] < head[qbar]
    dive = x.copy()
    dive[1] = -0.2
    alpha = model.index("alpha")
    assert model.y(dive, u, model.p0)[alpha] > 5 * DEG + 0.2  # a tail wind steepens the path through the air
    down = x.copy()
    down[6] = 5 * DEG
    moment = model.index("pitch_moment")
    assert model.y(down, u, model.p0)[moment] < model.y(x, u, model.p0)[moment]
    aft = model.parameters({"cg_aft": 0.1})
    raised = x.copy()
    raised[4] = 30 * DEG
    assert model.y(raised, u, aft)[moment] > model.y(raised, u, model.p0)[moment]


def test_energy_is_kept_without_air():
    still = orbiter_longitudinal()
    x0 = np.array([3000.0, 0.3, 9e4, 0.0, 0.2, 0.01, 0.0, FLAP])
    law = ocp.constant(delta_e_cmd=0.0, delta_bf_cmd=FLAP, jets_up=0.0, jets_down=0.0)
    flight = ocp.simulate(still, law, x0=x0, p={"rho_factor": 0.01}, t_max=100.0, method=ocp.RK4(step=0.25))
    assert flight["h"].min() > 8.9e4
    energy = 0.5 * flight["V"] ** 2 - 3.986004418e14 / (6371e3 + flight["h"])
    assert np.ptp(energy) / np.abs(energy[0]) < 1e-7
    momentum = (6371e3 + flight["h"]) * flight["V"] * np.cos(flight["gamma"])
    assert np.ptp(momentum) / momentum[0] < 1e-6
    turned = (
        flight["theta"][-1]
        - flight["theta"][0]
        - np.trapezoid(flight["q"] + flight["V"] * np.cos(flight["gamma"]) / (6371e3 + flight["h"]), flight.t)
    )
    assert abs(turned) < 1e-7


def test_servo_limits():
    servo = Servo(20.0, 20 * DEG, -33 * DEG, 18 * DEG)
    command, delta = ca.SX.sym("command"), ca.SX.sym("delta")
    speed = ca.Function("speed", [command, delta], [servo.speed(command, delta)])
    assert float(speed(0.01, 0.0)) == pytest.approx(0.2)
    assert float(speed(1.0, 0.0)) == pytest.approx(20 * DEG)
    assert float(speed(-1.0, 0.0)) == pytest.approx(-20 * DEG)
    assert float(speed(-2.0, -33 * DEG)) == pytest.approx(0.0, abs=1e-15)
    with pytest.raises(ModelError, match="Servo"):
        Servo(20.0, -1.0, -0.5, 0.3)


def test_refused_planets_and_data_reference():
    from models import EARTH

    with pytest.raises(ModelError, match="rotate"):
        orbiter_longitudinal(planet=EARTH)
    assert orbiter().area == orbiter_data()["reference"]["S_ref_m2"]
    assert orbiter().elevon.lower == pytest.approx(-33 * DEG)
