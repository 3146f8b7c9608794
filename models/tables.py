"""Smooth table lookup with a declared domain: cubic splines through the nodes of a line or a grid.

CasADi's own spline tables answer 0 outside their grid; here the argument is held inside, and what happens
outside is part of the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from models.checked import Array, ModelError, as_finite, evaluate, frozen

Outside = Literal["clamp", "linear", "raise"]
Ends = Literal["not-a-knot", "natural", "flat"]

_SCIPY_ENDS = {"not-a-knot": "not-a-knot", "natural": "natural", "flat": "clamped"}
_FEWEST_NODES = {"not-a-knot": 4, "natural": 2, "flat": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Values at the nodes of a line or of a rectangular grid, joined by a twice continuously differentiable cubic spline.

    Attributes
    ----------
    name : str
        Identifier; prefixes the generated function and stands in every message.
    axes : tuple of ndarray, each shape (n_i,)
        Nodes of one or two arguments, strictly increasing.
    values : ndarray, shape (n_0,) or (n_0, n_1)
    outside : {"clamp", "linear", "raise"}
        Beyond the first or last node: hold the edge value (slope zero); continue along the edge tangent (one argument
        only); or refuse.  Symbols cannot be refused: a table that raises for numbers clamps for symbols.
    ends : {"not-a-knot", "natural", "flat"}
        End condition: highest accuracy; second derivative zero (with "linear" the table is C2 everywhere); slope zero
        (with "clamp" it is C1 everywhere).  Flat is along each edge's own normal.
    function : casadi.Function
        (x,) -> value, or (x, y) -> value; scalars; generated code prefixed ``table_``.

    Raises
    ------
    ModelError
        Nodes that do not increase, too few nodes, values of another shape, NaN, an unknown option.
    """

    name: str
    axes: tuple[Array, ...]
    values: Array
    outside: Outside = "clamp"
    ends: Ends = "not-a-knot"
    function: ca.Function = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ModelError(f"table: name {self.name!r} is not an identifier; it prefixes generated C functions")
        self._check_option("outside", self.outside, get_args(Outside))
        self._check_option("ends", self.ends, get_args(Ends))
        if len(self.axes) not in (1, 2):
            raise ModelError(f"table {self.name}: expected one or two axes of nodes, got {len(self.axes)}")
        if self.outside == "linear" and len(self.axes) != 1:
            raise ModelError(f"table {self.name}: outside='linear' is for one argument; use 'clamp' or 'raise' on a grid")
        axes = tuple(frozen(_nodes(f"table {self.name}: axis {i}", axis, self.ends)) for i, axis in enumerate(self.axes))
        values = frozen(as_finite(f"table {self.name}: values", self.values))
        if values.shape != tuple(a.size for a in axes):
            raise ModelError(
                f"table {self.name}: values have shape {values.shape}, the nodes need {tuple(a.size for a in axes)};"
                " give one value for each node, first argument first"
            )
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "function", _lookup(self.name, axes, values, self.outside, self.ends))

    @property
    def domain(self) -> tuple[tuple[float, float], ...]:
        """(low, high) of each argument."""
        return tuple((float(a[0]), float(a[-1])) for a in self.axes)

    def __call__(self, x: Any, y: Any = None) -> Any:
        """Value at one point of symbols (scalar SX or MX), or at every point of broadcast arrays of numbers.

        Returns
        -------
        casadi.SX, casadi.MX or ndarray of the broadcast shape

        Raises
        ------
        ModelError
            A missing or extra argument, a symbol that is not a scalar, NaN, or with outside="raise" a number beyond the nodes.
        """
        arguments = self._arguments(x, y)
        if any(isinstance(a, (ca.SX, ca.MX)) for a in arguments):
            for i, a in enumerate(arguments):
                if getattr(a, "shape", (1, 1)) not in ((1, 1), ()):
                    raise ModelError(f"table {self.name}: argument {i} has shape {a.shape}; give scalars, or use table.function.map(n)")
            return self.function(*arguments)
        return self._numbers(self.function, arguments)[..., 0]

    def slope(self, x: ArrayLike, y: ArrayLike | None = None) -> Array:
        """Partial derivatives at broadcast arrays of numbers: the broadcast shape with one more axis, of length 1 or 2.

        At an edge node it is the slope from inside; outside it is the slope of what the table does there.
        """
        symbols = [ca.SX.sym(f"x{i}") for i in range(len(self.axes))]
        gradient = ca.gradient(self.function(*symbols), ca.vertcat(*symbols))
        return self._numbers(ca.Function(f"{self.function.name()}_slope", symbols, [ca.densify(gradient)]), self._arguments(x, y))

    def _arguments(self, x: Any, y: Any) -> list[Any]:
        arguments = [x] if y is None else [x, y]
        if len(arguments) != len(self.axes):
            raise ModelError(f"table {self.name}: expected {len(self.axes)} arguments, got {len(arguments)}; give one for each axis")
        return arguments

    def _numbers(self, function: ca.Function, arguments: Sequence[Any]) -> Array:
        points = [as_finite(f"table {self.name}: argument {i}", a) for i, a in enumerate(arguments)]
        if self.outside == "raise":
            for i, (point, (low, high)) in enumerate(zip(points, self.domain, strict=True)):
                beyond = point[(point < low) | (point > high)]
                if beyond.size:
                    raise ModelError(
                        f"table {self.name}: argument {i} = {beyond.flat[0]:.8g} is outside its domain [{low:.8g}, {high:.8g}];"
                        " correct the value or its unit, or extend the table"
                    )
        try:
            full = np.broadcast_arrays(*points)
        except ValueError:
            raise ModelError(f"table {self.name}: arguments of shapes {[p.shape for p in points]} cannot be broadcast together") from None
        return evaluate(function, *(f.reshape(-1, 1) for f in full))[0].reshape(*full[0].shape, -1)

    def _check_option(self, option: str, value: str, known: tuple[str, ...]) -> None:
        if value not in known:
            raise ModelError(f"table {self.name}: {option} must be one of {', '.join(known)}; got {value!r}")


def line(name: str, x: ArrayLike, *, values: ArrayLike, outside: Outside = "clamp", ends: Ends = "not-a-knot") -> Table:
    """Table of one argument: nodes `x` (n,), `values` (n,).  See :class:`Table`."""
    return Table(name=name, axes=(np.asarray(x),), values=np.asarray(values), outside=outside, ends=ends)


def grid(name: str, x: ArrayLike, y: ArrayLike, *, values: ArrayLike, outside: Outside = "clamp", ends: Ends = "not-a-knot") -> Table:
    """Table of two arguments: nodes `x` (n,) and `y` (m,), `values` (n, m).  See :class:`Table`."""
    return Table(name=name, axes=(np.asarray(x), np.asarray(y)), values=np.asarray(values), outside=outside, ends=ends)


def _nodes(what: str, axis: ArrayLike, ends: Ends) -> Array:
    nodes = as_finite(what, axis)
    fewest = _FEWEST_NODES[ends]
    if nodes.ndim != 1 or nodes.size < fewest:
        raise ModelError(f"{what}: expected shape (n,) with n >= {fewest} for ends={ends!r}, got {nodes.shape}; give more nodes")
    down = np.flatnonzero(np.diff(nodes) <= 0)
    if down.size:
        i = int(down[0])
        raise ModelError(
            f"{what}: nodes must increase strictly, but node {i} = {nodes[i]:.8g} is followed by {nodes[i + 1]:.8g};"
            " sort the table and remove repeated nodes"
        )
    return nodes


def _lookup(name: str, axes: Sequence[Array], values: Array, outside: Outside, ends: Ends) -> ca.Function:
    """The lookup as a function of scalars, safe for any finite argument."""
    knots, coefficients = [], values
    for i, axis in enumerate(axes):
        fitted = make_interp_spline(axis, coefficients, k=3, axis=i, bc_type=_SCIPY_ENDS[ends])
        knots.append(fitted.t.tolist())
        coefficients = np.moveaxis(fitted.c, 0, i)
    # never_inline: without it a spline node cannot be called with SX; binary search keeps the cost independent of the nodes
    options: dict[str, Any] = {"never_inline": True, "lookup_mode": ["binary"] * len(axes)}
    spline = ca.Function.bspline(f"spline_{name}", knots, coefficients.ravel(order="F").tolist(), [3] * len(axes), 1, options)
    symbols = [ca.SX.sym(n) for n, _ in zip("xy", axes, strict=False)]
    if outside == "linear":
        # At an edge both terms have half their slope, which makes the whole: the cheaper fmin and fmax serve here.
        not_above = ca.fmin(symbols[0], axes[0][-1])
        held = ca.fmax(not_above, axes[0][0])
        first, last = (float(spline.jacobian()(end, 0)) for end in (axes[0][0], axes[0][-1]))
        value = spline(held) + last * (symbols[0] - not_above) + first * (not_above - held)
    else:
        value = spline(ca.vertcat(*(at_least(at_most(s, float(a[-1])), float(a[0])) for s, a in zip(symbols, axes, strict=True))))
    return ca.Function(f"table_{name}", symbols, [value], [s.name() for s in symbols], ["value"])


def at_most(x: ca.SX, high: float) -> ca.SX:
    """Lesser of `x` and `high` with slope 1 where they meet: fmin has 1/2 there, which would halve the slope at an edge."""
    return ca.if_else(x <= high, x, high)


def at_least(x: ca.SX, low: float) -> ca.SX:
    """Greater of `x` and `low` with slope 1 where they meet."""
    return ca.if_else(x >= low, x, low)
