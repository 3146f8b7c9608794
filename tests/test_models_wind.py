"""Wind: nodes, edges, smoothness, sign of the components, bad tables."""

import casadi as ca
import numpy as np
import pytest

from models import wind
from models.checked import ModelError

H = np.array([0.0, 10e3, 25e3, 60e3, 90e3])
EAST = np.array([3.0, 28.0, 5.0, 60.0, -12.0])
NORTH = np.array([1.0, -4.0, 2.0, 9.0, 0.5])


def test_calm_is_zero_everywhere() -> None:
    still = wind.calm()
    assert np.all(still.at([-1e3, 0.0, 1e6]) == 0.0)
    h = ca.SX.sym("h")
    assert (still.east(h) + h).shape == (1, 1)


def test_table_passes_through_its_values_and_is_held_outside() -> None:
    found = wind.from_table(H, EAST, NORTH)
    assert found.at(H) == pytest.approx(np.column_stack([EAST, NORTH]), rel=1e-12)
    assert found.at([-5e3, 200e3]) == pytest.approx(np.array([[3.0, 1.0], [-12.0, 0.5]]), rel=1e-12)
    assert found.domain == (0.0, 90e3)


def test_north_is_zero_when_left_out() -> None:
    assert np.all(wind.from_table(H, EAST).at([5e3, 70e3])[:, 1] == 0.0)


@pytest.mark.parametrize("edge", [0.0, 25e3, 90e3])
def test_slope_is_continuous_at_nodes_and_edges(edge: float) -> None:
    h = ca.SX.sym("h")
    slope = ca.Function("s", [h], [ca.gradient(wind.from_table(H, EAST, NORTH).east(h), h)])
    before, at, after = (float(slope(edge + side)) for side in (-1e-3, 0.0, 1e-3))
    scale = np.max(np.abs(np.diff(EAST) / np.diff(H)))
    assert abs(after - before) < 1e-6 * scale
    assert abs(at - before) < 1e-6 * scale


def test_derivative_equals_central_differences() -> None:
    table = wind.from_table(H, EAST, NORTH)
    h = ca.SX.sym("h")
    slope = ca.Function("s", [h], [ca.gradient(table.north(h), h)])
    for altitude in (4e3, 33e3, 88e3):
        low, high = table.at([altitude - 1.0, altitude + 1.0])[:, 1]
        assert float(slope(altitude)) == pytest.approx((high - low) / 2, rel=1e-6)


@pytest.mark.parametrize(
    ("h", "east", "north", "message"),
    [
        (H[::-1], EAST, NORTH, "must increase strictly"),
        (H, EAST[:-1], NORTH, r"wind_east: values have shape \(4,\)"),
        (H, EAST, np.where(H == 25e3, np.nan, NORTH), r"wind: north\[2\]: expected a finite number, got nan"),
        (EAST, H, NORTH, r"east reaches 90000 m/s.*order of the columns"),
        ([1.0], [2.0], [3.0], "give more nodes"),
    ],
)
def test_bad_tables_are_refused(h: np.ndarray, east: np.ndarray, north: np.ndarray, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        wind.from_table(h, east, north)


def test_bad_altitudes_are_refused() -> None:
    with pytest.raises(ModelError, match=r"expected \(N,\)"):
        wind.calm().at([[1.0, 2.0]])
    with pytest.raises(ModelError, match="finite"):
        wind.calm().at([np.nan])
