"""Atmospheres: the standard's own values, hydrostatics, the gas law, smoothness at the layer edges, continuation outside."""

import csv
import dataclasses
import math
from importlib import resources

import casadi as ca
import numpy as np
import pytest

from models import atmosphere
from models.atmosphere import QUANTITIES, Atmosphere
from models.checked import ModelError, evaluate

R0, G_SEA, R_STAR, M0 = 6356766.0, 9.80665, 8314.32, 28.9644
EDGES_GEOPOTENTIAL = np.array([11e3, 20e3, 32e3, 47e3, 51e3, 71e3])
EDGES = np.append(R0 * EDGES_GEOPOTENTIAL / (R0 - EDGES_GEOPOTENTIAL), 86e3)  # geometric
COLUMNS = {"temperature": "T_K", "pressure": "p_Pa", "density": "rho_kg_m3", "sound_speed": "a_m_s"}


def check_rows() -> list[dict[str, str]]:
    text = (resources.files("models") / "data" / "us76_checks.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(row for row in text.splitlines() if not row.startswith("#")))


ROWS = check_rows()
LAYER_ROWS = [r for r in ROWS if float(r["altitude_m"]) < 86e3]
UPPER_ROWS = [r for r in ROWS if float(r["altitude_m"]) >= 86e3]


@pytest.fixture(scope="module")
def us76() -> Atmosphere:
    return atmosphere.us76()


@pytest.fixture(scope="module")
def smooth() -> Atmosphere:
    return atmosphere.us76_smooth()


def derivatives(function: ca.Function) -> ca.Function:
    """(h,) -> value, first and second derivative of the logarithm."""
    h = ca.SX.sym("h")
    log = ca.log(function(h))
    first = ca.gradient(log, h)
    return ca.Function("d", [h], [ca.vertcat(log, first, ca.gradient(first, h))])


def slope(function: ca.Function, h: np.ndarray) -> np.ndarray:
    s = ca.SX.sym("h")
    return evaluate(ca.Function("s", [s], [ca.densify(ca.gradient(function(s), s))]), np.reshape(h, (-1, 1)))[0][:, 0]


def values(function: ca.Function, h: np.ndarray) -> np.ndarray:
    return evaluate(function, np.reshape(h, (-1, 1)))[0][:, 0]


def misses(found: Atmosphere, rows: list[dict[str, str]]) -> list[str]:
    out = []
    at = found.at([float(r["altitude_m"]) for r in rows])
    for i, row in enumerate(rows):
        for quantity, column in COLUMNS.items():
            if row[column] and abs(at[quantity][i] / float(row[column]) - 1) > float(row["tolerance_rel"]):
                out.append(f"{row['kind']} {row['altitude_m']} m: {quantity} {at[quantity][i]:.8g}, table {row[column]}")
    return out


def test_check_table_is_whole() -> None:
    kinds = [r["kind"] for r in LAYER_ROWS]
    assert (kinds.count("defining"), kinds.count("published"), len(UPPER_ROWS)) == (38, 9, 10)


def test_layers_meet_every_row_of_the_check_table(us76: Atmosphere) -> None:
    assert misses(us76, LAYER_ROWS) == []


def test_upper_table_is_met_at_its_nodes(us76: Atmosphere) -> None:
    # Not an independent check: these rows are the input.  It guards the file, its columns and the join at 86 km.
    assert misses(us76, UPPER_ROWS) == []
    at = us76.at([float(r["altitude_m"]) for r in UPPER_ROWS])
    for quantity in ("density", "pressure", "temperature"):
        printed = np.array([float(r[COLUMNS[quantity]]) for r in UPPER_ROWS])
        assert at[quantity] == pytest.approx(printed, rel=7e-5)
        assert at[quantity][1:] == pytest.approx(printed[1:], rel=1e-12)


def test_smooth_version_meets_the_table_within_its_fit_error(smooth: Atmosphere) -> None:
    widened = [{**r, "tolerance_rel": str(float(r["tolerance_rel"]) + smooth.fit_error)} for r in ROWS]
    assert misses(smooth, widened) == []


def test_fit_error_is_stated_and_true(us76: Atmosphere, smooth: Atmosphere) -> None:
    assert smooth.fit_error < 5e-3
    assert us76.fit_error == 0.0
    h = np.random.default_rng(3).uniform(0, 120e3, 20000)  # off the grid it was measured on
    exact, found = us76.at(h), smooth.at(h)
    worst = max(np.max(np.abs(found[q] / exact[q] - 1)) for q in QUANTITIES)
    assert 0.5 * smooth.fit_error < worst < 1.1 * smooth.fit_error


@pytest.mark.parametrize("h", [300.0, 5e3, 13e3, 26e3, 40e3, 49e3, 60e3, 78e3, 85.9e3])
def test_hydrostatic_equation_below_86_km(us76: Atmosphere, h: float) -> None:
    step = 5.0
    p = values(us76.pressure, h + step * np.array([-2, -1, 1, 2]))
    gravity = G_SEA * (R0 / (R0 + h)) ** 2
    difference = p @ np.array([1, -8, 8, -1]) / 12 / step
    assert difference == pytest.approx(-values(us76.density, h)[0] * gravity, rel=1e-8)


def test_hydrostatic_equation_above_86_km_to_the_digits_printed(us76: Atmosphere) -> None:
    h = np.linspace(87e3, 119e3, 33)
    gravity = G_SEA * (R0 / (R0 + h)) ** 2
    assert slope(us76.pressure, h) == pytest.approx(-values(us76.density, h) * gravity, rel=0.025)


def test_gas_law_below_86_km(us76: Atmosphere) -> None:
    at = us76.at(np.linspace(0, 85.99e3, 500))
    assert at["density"] == pytest.approx(at["pressure"] * M0 / (R_STAR * at["temperature"]), rel=1e-12)
    assert at["sound_speed"] == pytest.approx(np.sqrt(1.4 * R_STAR / M0 * at["temperature"]), rel=1e-12)


def test_molar_mass_above_86_km_falls_as_air_separates(us76: Atmosphere) -> None:
    at = us76.at([86e3, 90e3, 100e3, 110e3, 120e3])
    mass = at["density"] * R_STAR * at["temperature"] / at["pressure"]
    assert mass == pytest.approx([28.95, 28.91, 28.40, 27.27, 26.20], rel=2e-3)  # table of the standard: mean molecular weight


def test_exact_quantities_are_continuous_but_temperature_changes_kind_at_86_km(us76: Atmosphere) -> None:
    for quantity in ("density", "pressure", "sound_speed"):
        before, after = (values(getattr(us76, quantity), EDGES + side) for side in (-1e-6, 1e-6))
        assert after == pytest.approx(before, rel=1e-9)
    below, above = values(us76.temperature, np.array([86e3 - 1e-6, 86e3]))
    assert below - above == pytest.approx(186.946 - 186.87, abs=1e-3)


@pytest.mark.parametrize("edge", [0.0, *EDGES, 120e3])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_smooth_version_is_twice_continuously_differentiable(smooth: Atmosphere, quantity: str, edge: float) -> None:
    function = derivatives(getattr(smooth, quantity))
    before, after = (function(edge + side).full().ravel() for side in (-1e-5, 1e-5))
    # Scale height 6 km and the rounding of a kink over one cell of 200 m set the scales of the derivatives.
    assert np.all(np.abs(after - before) < 1e-6 * np.array([1.0, 1 / 6e3, 1 / (6e3 * 200)]))


def test_exact_version_is_not_smooth(us76: Atmosphere) -> None:
    # The test above can fail: the exact density has a jump of slope at 11 km.
    function = derivatives(us76.density)
    before, after = (function(EDGES[0] + side).full().ravel() for side in (-1e-5, 1e-5))
    assert abs(after[1] - before[1]) > 0.1 / 6e3


@pytest.mark.parametrize("edge", [*EDGES, 91e3, 120e3])
def test_smooth_jacobian_equals_central_differences_at_layer_edges(smooth: Atmosphere, edge: float) -> None:
    step = 0.05
    for offset in (-100.0, 0.0, 30.0):
        h = edge + offset
        low, high = values(smooth.density, np.array([h - step, h + step]))
        assert slope(smooth.density, h)[0] == pytest.approx((high - low) / (2 * step), rel=1e-7)


@pytest.mark.parametrize("edge", [*EDGES, 91e3, 120e3])
def test_exact_jacobian_equals_one_sided_differences_at_layer_edges(us76: Atmosphere, edge: float) -> None:
    for side in (-1.0, 1.0):
        h = edge + side * (1e-3 + np.array([0.0, 1.0, 2.0]))  # off the kink, all on one side
        f = values(us76.density, h)
        difference = (values(us76.density, h[1] + 0.05) - values(us76.density, h[1] - 0.05))[0] / 0.1
        assert slope(us76.density, h[1])[0] == pytest.approx(difference, rel=1e-7)
        assert slope(us76.density, h[0])[0] == pytest.approx(-side * (3 * f[0] - 4 * f[1] + f[2]) / 2, rel=1e-6)


def test_derivatives_are_finite_at_and_beyond_every_edge(us76: Atmosphere, smooth: Atmosphere) -> None:
    h = np.concatenate([EDGES, EDGES - 1e-9, EDGES + 1e-9, [-2e5, -5e3, -1e-9, 0.0, 91e3, 120e3, 120e3 + 1e-9, 4e5, 1e6]])
    for found in (us76, smooth, atmosphere.exponential()):
        for quantity in QUANTITIES:
            function = getattr(found, quantity)
            assert np.all(np.isfinite(slope(function, h)))
            assert np.all(values(function, h) > 0) or found.name == "exponential"


def test_slope_at_the_edges_of_the_domain_is_whole(us76: Atmosphere, smooth: Atmosphere) -> None:
    # A minimum or maximum has half a slope where its arguments meet; the edge must not.
    for found in (us76, smooth):
        for quantity in QUANTITIES:
            function = getattr(found, quantity)
            for edge in (0.0, 120e3):
                left, middle, right = slope(function, edge + np.array([-1e-3, 0.0, 1e-3]))
                assert middle == pytest.approx(left, rel=1e-5)
                assert middle == pytest.approx(right, rel=1e-5)
    low, high = slope(us76.density, np.array([86e3 - 1e-3, 86e3 + 1e-3]))
    at = slope(us76.density, 86e3)[0]
    assert min(abs(at / low - 1), abs(at / high - 1)) < 1e-5


def test_continuation_is_exponential(us76: Atmosphere, smooth: Atmosphere) -> None:
    for found in (us76, smooth):
        for quantity in ("density", "pressure"):
            function = getattr(found, quantity)
            for edge, side in ((0.0, -1.0), (120e3, 1.0)):
                start, rate = values(function, edge)[0], slope(function, edge)[0]
                far = edge + side * 15e3
                assert values(function, far)[0] == pytest.approx(start * math.exp(rate / start * (far - edge)), rel=1e-9)


def test_exponential_is_hydrostatic_ideal_gas() -> None:
    found = atmosphere.exponential(surface_density=1.3, scale_height=7000.0)
    at = found.at([0.0, 7000.0, 70e3])
    assert at["density"] == pytest.approx(1.3 * np.exp([0.0, -1.0, -10.0]), rel=1e-14)
    assert at["density"] == pytest.approx(at["pressure"] * M0 / (R_STAR * at["temperature"]), rel=1e-13)
    assert slope(found.pressure, np.array([20e3]))[0] == pytest.approx(-values(found.density, 20e3)[0] * G_SEA, rel=1e-13)
    assert at["sound_speed"] == pytest.approx(math.sqrt(1.4 * G_SEA * 7000.0), rel=1e-14)
    assert atmosphere.exponential(sound_speed=300.0).at([5e3])["sound_speed"][0] == 300.0


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"surface_density": -1.0}, "surface_density"),
        ({"scale_height": 0.0}, "scale_height"),
        ({"scale_height": math.nan}, "scale_height"),
        ({"sound_speed": -300.0}, "sound_speed"),
    ],
)
def test_exponential_refuses_nonsense(arguments: dict[str, float], name: str) -> None:
    with pytest.raises(ModelError, match=f"exponential: {name} must be finite and > 0"):
        atmosphere.exponential(**arguments)


def test_numeric_entry_refuses_altitudes_outside_and_bad_shapes(us76: Atmosphere) -> None:
    with pytest.raises(ModelError, match=r"us76: h = 121000 m is outside its domain \[0, 120000\] m"):
        us76.at([10e3, 121e3])
    with pytest.raises(ModelError, match=r"us76: h\[1\]: expected a finite number"):
        us76.at([10e3, math.nan])
    with pytest.raises(ModelError, match=r"expected \(N,\)"):
        us76.at([[1.0, 2.0]])
    with pytest.raises(dataclasses.FrozenInstanceError):
        us76.name = "other"  # type: ignore[misc]


def test_dispersion_multiplies_and_waves() -> None:
    h, f, a, w, phase = (ca.SX.sym(n) for n in ("h", "f", "a", "w", "phase"))
    factor = ca.Function("k", [h, f, a, w, phase], [atmosphere.dispersion(h, factor=f, wave_amplitude=a, wave_length=w, wave_phase=phase)])
    assert float(factor(12e3, 1.3, 0.0, 30e3, 0.4)) == pytest.approx(1.3, rel=1e-15)
    assert float(factor(7.5e3, 1.2, 0.1, 30e3, 0.0)) == pytest.approx(1.2 * 1.1, rel=1e-14)  # a quarter wave up: the crest
    assert float(factor(22.5e3, 1.0, 0.1, 30e3, 0.0)) == pytest.approx(0.9, rel=1e-14)
    assert float(factor(0.0, 1.0, 0.1, 30e3, math.pi / 6)) == pytest.approx(1.05, rel=1e-14)


def test_functions_work_with_mx_map_and_jacobian(smooth: Atmosphere) -> None:
    h = ca.MX.sym("h")
    function = ca.Function("f", [h], [smooth.density(h)], ["h"], ["rho"])
    points = np.array([[-1e3, 11e3, 50e3, 119e3, 130e3]])
    mapped = function.factory("j", ["h"], ["rho", "jac:rho:h"]).map(5)(ca.DM(points))
    assert mapped[0].full().ravel() == pytest.approx(values(smooth.density, points), rel=1e-14)
    assert mapped[1].full().ravel() == pytest.approx(slope(smooth.density, points), rel=1e-13)
