"""Table lookup: value and slope at nodes, between them, at the edges and outside; CasADi's silent zeros; bad input."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest

from models import tables
from models.checked import ModelError

X = np.array([0.0, 0.4, 1.0, 1.3, 2.1, 3.0])


def cubic(x: np.ndarray) -> np.ndarray:
    return 2 - 3 * x + 0.7 * x**2 - 0.4 * x**3


def cubic_slope(x: np.ndarray) -> np.ndarray:
    return -3 + 1.4 * x - 1.2 * x**2


@pytest.mark.parametrize("x", [0.0, 0.2, 0.4, 0.77, 1.3, 2.9, 3.0])
def test_line_reproduces_a_cubic_exactly_with_its_slope(x: float) -> None:
    table = tables.line("t", X, values=cubic(X))  # not-a-knot splines contain every cubic
    assert table([x]) == pytest.approx([cubic(x)], rel=1e-13)
    assert table.slope([x])[0] == pytest.approx([cubic_slope(x)], rel=1e-12)


def test_line_converges_with_fourth_order() -> None:
    sizes = np.array([17, 33, 65, 129])
    fine = np.linspace(0.0, np.pi, 3001)
    errors = []
    for n in sizes:
        nodes = np.linspace(0.0, np.pi, n)  # natural ends are true of a half wave, so the ends do not cloud the order
        errors.append(np.max(np.abs(tables.line("t", nodes, values=np.sin(nodes), ends="natural")(fine) - np.sin(fine))))
    order = -np.polyfit(np.log(sizes - 1), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.1)


def test_clamp_holds_the_edge_value_with_slope_zero() -> None:
    table = tables.line("t", X, values=cubic(X))
    assert table([-1e6, -1e-9, 3.0 + 1e-9, 1e6]) == pytest.approx(cubic(np.array([0.0, 0.0, 3.0, 3.0])), rel=1e-13)
    assert np.all(table.slope([-1e6, -1e-9, 3.0 + 1e-9, 1e6]) == 0.0)


def test_flat_ends_make_a_clamped_table_smooth_at_its_edges() -> None:
    table = tables.line("t", X, values=cubic(X), ends="flat")
    assert table(X) == pytest.approx(cubic(X), rel=1e-13)
    assert table.slope([0.0, 3.0]) == pytest.approx(0.0, abs=1e-12 * np.max(np.abs(cubic_slope(X))))


def test_linear_continues_along_the_tangent() -> None:
    table = tables.line("t", X, values=cubic(X), outside="linear")
    assert table([-2.0, 5.0]) == pytest.approx([cubic(0.0) - 2 * cubic_slope(0.0), cubic(3.0) + 2 * cubic_slope(3.0)], rel=1e-12)
    slopes = table.slope([-2.0, -1e-9, 0.0, 3.0, 3.0 + 1e-9, 5.0])[:, 0]
    assert slopes == pytest.approx(cubic_slope(np.array([0.0, 0.0, 0.0, 3.0, 3.0, 3.0])), rel=1e-12)


def test_natural_ends_with_linear_outside_have_no_jump_of_curvature() -> None:
    table = tables.line("t", X, values=np.exp(X), outside="linear", ends="natural")
    x = ca.SX.sym("x")
    curvature = ca.Function("c", [x], [ca.hessian(table(x), x)[0]])
    inside = float(curvature(1.0))
    for edge in (0.0, 3.0):
        jump = float(curvature(edge + 1e-9)) - float(curvature(edge - 1e-9))
        assert abs(jump) < 1e-7 * abs(inside)


def test_raise_names_table_value_and_domain_but_symbols_clamp() -> None:
    table = tables.line("drag", X, values=cubic(X), outside="raise")
    with pytest.raises(ModelError, match=r"table drag: argument 0 = 3\.5 is outside its domain \[0, 3\]"):
        table([1.0, 3.5])
    with pytest.raises(ModelError, match="drag"):
        table.slope(-0.1)
    x = ca.MX.sym("x")
    assert float(ca.Function("f", [x], [table(x)])(3.5)) == pytest.approx(cubic(3.0), rel=1e-13)


def bicubic(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return cubic(x) * (1 + y - 0.3 * y**3) + x * y**2


Y = np.array([-1.0, -0.2, 0.5, 0.9, 2.0])


def grid_table(**options: str) -> tables.Table:
    values = bicubic(X[:, None], Y[None, :])
    return tables.grid("g", X, Y, values=values, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("point", [(0.4, 0.5), (0.21, -0.71), (2.5, 0.0), (0.0, 0.3), (3.0, 2.0), (1.3, -1.0)])
def test_grid_reproduces_a_bicubic_with_both_slopes(point: tuple[float, float]) -> None:
    x, y = point
    table = grid_table()
    slope_x = cubic_slope(x) * (1 + y - 0.3 * y**3) + y**2
    slope_y = cubic(x) * (1 - 0.9 * y**2) + 2 * x * y
    assert table(x, y) == pytest.approx(bicubic(x, y), rel=1e-12)
    assert table.slope(x, y) == pytest.approx([slope_x, slope_y], rel=1e-11)


def test_grid_clamps_each_argument_on_its_own() -> None:
    table = grid_table()
    assert table(9.0, 0.3) == pytest.approx(bicubic(3.0, 0.3), rel=1e-12)
    slope = table.slope(9.0, 0.3)
    assert slope[0] == 0.0
    assert slope[1] == pytest.approx(cubic(3.0) * (1 - 0.9 * 0.09) + 2 * 3.0 * 0.3, rel=1e-11)
    with pytest.raises(ModelError, match=r"argument 1 = -1\.5 is outside its domain \[-1, 2\]"):
        grid_table(outside="raise")(1.0, -1.5)


def test_grid_broadcasts() -> None:
    x, y = np.linspace(0, 3, 7), np.linspace(-1, 2, 5)
    assert grid_table()(x[:, None], y[None, :]) == pytest.approx(bicubic(x[:, None], y[None, :]), rel=1e-11)
    assert grid_table().slope(x[:, None], y[None, :]).shape == (7, 5, 2)


@pytest.mark.parametrize("symbol", [ca.SX.sym, ca.MX.sym], ids=["SX", "MX"])
def test_symbols_numbers_jacobian_and_map_agree(symbol: Callable[[str], ca.SX]) -> None:
    table = tables.line("t", X, values=np.exp(X), outside="linear", ends="natural")
    x = symbol("x")
    expression = table(2 * x + 0.1) ** 2
    function = ca.Function("f", [x], [expression, ca.jacobian(expression, x)], ["x"], ["value", "slope"])
    points = np.array([-0.4, -0.05, 0.15, 0.7, 1.45, 2.0])  # 2 x + 0.1: outside, edge, inside, edge, outside
    value, slope = (r.full().ravel() for r in function.map(points.size)(ca.DM(points).T))
    assert value == pytest.approx(table(2 * points + 0.1) ** 2, rel=1e-13)
    step = 1e-6
    differences = (table(2 * (points + step) + 0.1) ** 2 - table(2 * (points - step) + 0.1) ** 2) / (2 * step)
    assert slope == pytest.approx(differences, rel=1e-8)
    factory = function.factory("j", ["x"], ["jac:value:x"])
    assert factory.map(points.size)(ca.DM(points).T).full().ravel() == pytest.approx(slope, rel=1e-13)


def test_symbols_of_a_grid() -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("f", [x, y], [grid_table()(x, y)])
    assert float(function(0.6, 1.1)) == pytest.approx(bicubic(0.6, 1.1), rel=1e-12)
    with pytest.raises(ModelError, match="argument 0 has shape"):
        grid_table()(ca.SX.sym("v", 3), y)


@pytest.mark.parametrize("edge", [1.3, 2.1])
def test_spline_is_twice_continuously_differentiable_at_nodes(edge: float) -> None:
    x = ca.SX.sym("x")
    expression = tables.line("t", X, values=np.exp(-X))(x)
    derivatives = ca.Function("d", [x], [ca.vertcat(expression, ca.gradient(expression, x), ca.hessian(expression, x)[0])])
    before, after = (derivatives(edge + side).full().ravel() for side in (-1e-10, 1e-10))
    assert after == pytest.approx(before, rel=1e-8)


@pytest.mark.parametrize(
    ("x", "values", "message"),
    [
        ([0, 1, 1, 2], [1, 2, 3, 4], r"node 1 = 1 is followed by 1"),
        ([0, 2, 1, 3], [1, 2, 3, 4], r"node 1 = 2 is followed by 1"),
        ([0, 1, 2, 3], [1, np.nan, 3, 4], r"table t: values\[1\]: expected a finite number, got nan"),
        ([0, 1, np.inf, 3], [1, 2, 3, 4], r"axis 0\[2\]: expected a finite number"),
        ([0, 1, 2, 3], [1, 2, 3], r"values have shape \(3,\), the nodes need \(4,\)"),
        ([0, 1, 2], [1, 2, 3], r"n >= 4"),
        ([[0, 1, 2, 3]], [1, 2, 3, 4], r"expected shape \(n,\)"),
    ],
)
def test_bad_tables_are_refused(x: list, values: list, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        tables.line("t", x, values=values)


def test_bad_options_and_arguments_are_refused() -> None:
    with pytest.raises(ModelError, match=r"outside must be one of clamp, linear, raise; got 'zero'"):
        tables.line("t", X, values=X, outside="zero")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="ends must be one of"):
        tables.line("t", X, values=X, ends="free")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="outside='linear' is for one argument"):
        grid_table(outside="linear")
    with pytest.raises(ModelError, match="not an identifier"):
        tables.line("my table", X, values=X)
    with pytest.raises(ModelError, match="expected 1 arguments, got 2"):
        tables.line("t", X, values=X)(0.1, 0.2)
    with pytest.raises(ModelError, match="expected 2 arguments, got 1"):
        grid_table()(0.1)
    with pytest.raises(ModelError, match="expected a finite number, got nan"):
        tables.line("t", X, values=X)([0.1, np.nan])
    with pytest.raises(ModelError, match="cannot be broadcast"):
        grid_table()([0.1, 0.2], [0.1, 0.2, 0.3])


def test_table_is_frozen() -> None:
    values = X.copy()
    table = tables.line("t", X, values=values)
    values[0] = 99.0
    assert table.values[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        table.values[0] = 1.0
    with pytest.raises(AttributeError):
        table.name = "other"  # type: ignore[misc]
    assert table.domain == ((0.0, 3.0),)
