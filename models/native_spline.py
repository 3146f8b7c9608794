"""Spline tables for lanes: a CasADi spline read back as polynomials on cells, found by index without a branch."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, PPoly

from models.checked import Array

MOST_CELLS = 4096
_CALL = re.compile(
    r"nd_boor_eval\)?\(\s*[^,]+,\s*1,\s*(casadi_c\d+),\s*(casadi_s\d+),\s*(casadi_s\d+),\s*casadi_s\d+,\s*(casadi_c\d+),\s*1,"
)


@dataclass(frozen=True, slots=True, eq=False)
class CellSpline:
    """A spline of one argument, zero outside its knots, with one polynomial on each cell between two of them.

    Attributes
    ----------
    knots : ndarray, shape (n + 1 + 2 degree,)
        With the repeated ones at both ends.
    weights : ndarray, shape (n + degree,)
        Of the basis splines.
    coefficients : ndarray, shape (n, degree + 1)
        Value = sum_j coefficients[i, j] (x - edge i)^j on cell i.
    """

    knots: Array
    weights: Array
    coefficients: Array

    @property
    def degree(self) -> int:
        """Degree of the polynomials."""
        return self.coefficients.shape[1] - 1

    @property
    def edges(self) -> Array:
        """Edges of the cells, increasing, shape (n + 1,)."""
        return self.knots[self.degree : len(self.knots) - self.degree]

    def values(self, x: Array) -> Array:
        """Values at x (N,) from the polynomials."""
        cell = np.clip(np.searchsorted(self.edges, x, side="right") - 1, 0, len(self.coefficients) - 1)
        d, out = x - self.edges[cell], np.zeros_like(x)
        for j in reversed(range(self.coefficients.shape[1])):
            out = out * d + self.coefficients[cell, j]
        return np.where((x < self.edges[0]) | (x > self.edges[-1]), 0.0, out)

    def code(self, name: str, *, fast: bool) -> str:
        """C code of ``void name(const L *x, L *y)``: the polynomials if `fast`, else the recursion of the interpreter."""
        body = self._polynomial(name) if fast else self._recursion(name)
        tables = [_table(f"{name}_knots", self.knots)]
        tables.append(_table(f"{name}_poly", self.coefficients.ravel()) if fast else _table(f"{name}_weights", self.weights))
        first, last = (literal(float(edge)) for edge in self.edges[[0, -1]])
        return (
            "".join(tables)
            + f"PART void {name}(const L *x, L *y) {{\n  i64 at[LANES]; double v[LANES]; __builtin_memcpy(v, x, sizeof v); (void)v;\n"
            + self._find(name)
            + body
            + f"  *y = lane_choose((*x < {first}) | (*x > {last}), lane_all(0.0), s);\n}}\n"
        )

    def _find(self, name: str) -> str:
        """Cell of each lane in ``at``."""
        cells, edges, edge = len(self.coefficients), self.edges, f"{name}_knots[{self.degree} + "
        steps = np.diff(edges)
        if np.ptp(steps) <= 1e-9 * steps.max():
            scale = float(cells / (edges[-1] - edges[0]))
            return (
                f"  L t = (*x - {literal(float(edges[0]))}) * {literal(scale)};\n"
                f"  t = lane_choose(t > 0.0, t, lane_all(0.0)); t = lane_choose(t < {cells - 1}.0, t, lane_all({cells - 1}.0));\n"
                "  EACH_LANE for (int l = 0; l < LANES; l++) {\n"
                f"    i64 i = (i64)t[l]; i -= (i > 0) & (v[l] < {edge}i]);\n"
                f"    at[l] = i + ((i < {cells - 1}) & (v[l] >= {edge}i + 1]));\n  }}\n"
            )
        find = "  for (int l = 0; l < LANES; l++) at[l] = 0;\n"
        size = 1 << (cells - 1).bit_length()
        while size > 1:
            size //= 2
            find += (
                f"  EACH_LANE for (int l = 0; l < LANES; l++) {{ i64 up = at[l] + {size} < {cells} ? at[l] + {size} : {cells - 1};"
                f" at[l] = v[l] >= {edge}up] ? up : at[l]; }}\n"
            )
        return find

    def _polynomial(self, name: str) -> str:
        width = self.degree + 1
        text = f"  L d = *x - lane_table({name}_knots + {self.degree}, at, 1);\n"
        text += f"  L s = lane_table({name}_poly + {self.degree}, at, {width});\n"
        for j in reversed(range(self.degree)):
            text += f"  s = s * d + lane_table({name}_poly + {j}, at, {width});\n"
        return text

    def _recursion(self, name: str) -> str:
        """De Boor's recursion in the order of the interpreter, without the terms that are zero there."""
        n = self.degree
        text = "".join(f"  L k{i} = lane_table({name}_knots + {i}, at, 1);\n" for i in range(2 * n + 2))
        text += f"  L b{n} = lane_all(1.0), bottom;\n" + "".join(f"  L b{i};\n" for i in range(n))
        for d in range(1, n + 1):
            for i in range(n - d, n + 1):
                terms = []
                if i > n - d:
                    terms.append(f"lane_pick(k{i + d} != k{i}, (*x - k{i}) * b{i} / (k{i + d} - k{i}))")
                if i < n:
                    terms.append(f"lane_pick(k{i + d + 1} != k{i + 1}, (k{i + d + 1} - *x) * b{i + 1} / (k{i + d + 1} - k{i + 1}))")
                text += f"  b{i} = {' + '.join(terms)};\n"
        text += f"  L s = b0 * lane_table({name}_weights, at, 1);\n"
        return text + "".join(f"  s = s + b{i} * lane_table({name}_weights + {i}, at, 1);\n" for i in range(1, n + 1))


def literal(value: float) -> str:
    """The exact number in C."""
    if value != value:
        return '__builtin_nan("")'
    if value in (float("inf"), float("-inf")):
        return "__builtin_inf()" if value > 0 else "(-__builtin_inf())"
    return f"({value.hex()})" if str(value)[0] == "-" else value.hex()


def _table(name: str, values: Array) -> str:
    rows = [", ".join(float(v).hex() for v in values[i : i + 8]) for i in range(0, len(values), 8)]
    return f"static const double {name}[{len(values)}] = {{\n  " + ",\n  ".join(rows) + "};\n"


def spline_of(function: ca.Function) -> CellSpline | None:
    """The polynomials of a function that is one CasADi spline of one argument, checked against it; None for any other function."""
    if not function.is_a("MXFunction") or function.n_in() != 1 or function.n_out() != 1:
        return None
    if function.size_in(0) != (1, 1) or function.size_out(0) != (1, 1) or function.nnz_out(0) != 1:
        return None
    operations = [function.instruction_id(k) for k in range(function.n_instructions())]
    if operations != [ca.OP_INPUT, ca.OP_BSPLINE, ca.OP_OUTPUT]:
        return None
    generator = ca.CodeGenerator("spline", {"with_header": False})
    generator.add(function)
    text = generator.dump()
    call = _CALL.search(text)
    if call is None:
        return None
    knots, coefficients = (_numbers(text, call.group(i)) for i in (1, 4))
    degree = int(_numbers(text, call.group(3))[0])
    inner = knots[degree : len(knots) - degree]
    if (np.diff(inner) <= 0).any() or not 1 <= degree <= 5 or len(inner) > MOST_CELLS:
        return None
    pieces = PPoly.from_spline(BSpline(knots, coefficients, degree))
    found = CellSpline(knots, coefficients, np.ascontiguousarray(pieces.c[::-1, degree : len(knots) - degree - 1].T))
    return found if _agrees(found, function) else None


def _agrees(spline: CellSpline, function: ca.Function) -> bool:
    edges = spline.edges
    inside = np.concatenate([a + (b - a) * np.array([0.0, 0.21, 0.5, 0.83]) for a, b in itertools.pairwise(edges)])
    width = edges[-1] - edges[0]
    x = np.concatenate([inside, edges[-1:], edges[[0, -1]] + [-0.1 * width, 0.1 * width]])
    wanted = np.asarray(function.map(len(x))(ca.DM(x).T).full()).ravel()
    return bool(np.abs(spline.values(x) - wanted).max() <= 1e-13 * max(np.abs(wanted).max(), 1e-300))


def _numbers(text: str, name: str) -> Array:
    match = re.search(rf"static const casadi_(?:real|int) {name}\[\d+\] =\s*\{{([^}}]*)\}}", text)
    return np.array([float(v) for v in match.group(1).split(",")]) if match else np.zeros(0)
