"""Longitudinal aerodynamics of the Space Shuttle orbiter: smooth CL, CD and Cm through the nodes of its tables.

CL = CL_body(M, alpha, flap) + dCL_elevon(M, alpha, elevon), and so for CD and Cm: two tensor products of quadratic splines, each
with the three coefficients as one vector.  Quadratic splines through the nodes are continuously differentiable and cost a third
of cubic ones, which matters where a closed loop asks for them four times in every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from ruamel.yaml import YAML
from scipy.interpolate import make_interp_spline

from models.checked import Array, ModelError, as_finite, evaluate, frozen
from models.tables import at_least, at_most
from models.units import DEG

COEFFICIENTS = ("CL", "CD", "Cm")
DEGREE = 2
_REFERENCE_MACH = 5.0  # the lowest Mach number whose table reaches 50 deg: where others end, they follow its differences


@dataclass(frozen=True, slots=True, eq=False)
class OrbiterAero:
    """CL, CD and Cm of the orbiter as CasADi functions through the nodes of its tables.

    Cm is positive nose up, about the moment reference; deflections are positive trailing edge down.

    Attributes
    ----------
    mach : ndarray
        Nodes of the body's table, 2 to 20.  From 10 on the source is one table; above 20 it is held.
    alpha : ndarray
        Nodes of the body's table, 0 to 50 deg, rad.
    delta_e, delta_bf : ndarray
        Nodes of elevon and body flap, rad.
    body : casadi.Function
        (mach, alpha, delta_bf) -> (3,): CL, CD, Cm with the elevon at zero.
    elevon : casadi.Function
        (mach, alpha, delta_e) -> (3,): what the elevon adds.
    elevon_slope : casadi.Function
        (mach, alpha, delta_e) -> dCm/d delta_e, 1/rad: the exact derivative of the third row of `elevon`.
    covered_to : ndarray
        Largest angle of attack of the source at each Mach node, rad; beyond it the table follows the differences of Mach 5.
    source : str
    """

    mach: Array
    alpha: Array
    delta_e: Array
    delta_bf: Array
    body: ca.Function
    elevon: ca.Function
    elevon_slope: ca.Function
    covered_to: Array
    source: str

    @property
    def domain(self) -> dict[str, tuple[float, float]]:
        """(low, high) of mach, alpha, delta_e, delta_bf; symbols beyond an edge are held there, numbers are refused by :meth:`at`."""
        axes = {"mach": self.mach, "alpha": self.alpha, "delta_e": self.delta_e, "delta_bf": self.delta_bf}
        return {name: (float(nodes[0]), float(nodes[-1])) for name, nodes in axes.items()}

    def coefficients(self, mach: ca.SX, alpha: ca.SX, delta_e: ca.SX, delta_bf: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """CL, CD, Cm as expressions; angles in rad."""
        total = self.body(mach, alpha, delta_bf) + self.elevon(mach, alpha, delta_e)
        return total[0], total[1], total[2]

    def at(self, mach: ArrayLike, alpha: ArrayLike, delta_e: ArrayLike = 0.0, delta_bf: ArrayLike = 0.0) -> dict[str, Array]:
        """CL, CD, Cm by name at broadcast arrays of numbers (angles in rad).

        Raises
        ------
        ModelError
            NaN, or a value outside the domain.
        """
        values = np.broadcast_arrays(
            *(as_finite(f"orbiter: {n}", v) for n, v in zip(self.domain, (mach, alpha, delta_e, delta_bf), strict=True))
        )
        for (name, (low, high)), value in zip(self.domain.items(), values, strict=True):
            slack = 1e-12 * max(abs(low), abs(high))
            beyond = value[(value < low - slack) | (value > high + slack)]
            if beyond.size:
                hint = "" if name == "mach" else " rad; angles are in radians"
                raise ModelError(
                    f"orbiter: {name} = {beyond.flat[0]:.6g} is outside its table [{low:.6g}, {high:.6g}]{hint}: correct the value"
                )
        symbols = [ca.SX.sym(n) for n in self.domain]
        function = ca.Function("orbiter_coefficients", symbols, [ca.vertcat(*self.coefficients(*symbols))])
        found = evaluate(function, *(v.reshape(-1, 1) for v in values))[0]
        return {name: found[:, i].reshape(values[0].shape) for i, name in enumerate(COEFFICIENTS)}

    def covers(self, mach: ArrayLike, alpha: ArrayLike) -> np.ndarray:
        """True where the source reaches this angle of attack (rad): at both Mach nodes around, or at the one met."""
        number, angle = as_finite("orbiter: mach", mach), as_finite("orbiter: alpha", alpha)
        number = np.clip(number, self.mach[0], self.mach[-1])
        right = np.searchsorted(self.mach, number, side="left")
        left = np.where(self.mach[right] > number, right - 1, right)
        return np.asarray(angle <= np.minimum(self.covered_to[left], self.covered_to[right]) + 1e-12)


@lru_cache(maxsize=1)
def orbiter_data() -> dict[str, Any]:
    """The data file: reference, mass properties, actuators, damping and tables, in its own units."""
    text = (resources.files("models") / "data" / "shuttle_longitudinal.yaml").read_text(encoding="utf-8")
    data: dict[str, Any] = YAML(typ="safe").load(text)
    return data


@lru_cache(maxsize=1)
def orbiter_aero() -> OrbiterAero:
    """Aerodynamics of the orbiter from the data file.

    The nodes are met to rounding: the body's table is the sum of basic body and body flap at the nodes of the basic body.

    Source: tables with the layout of the Aerodynamic Design Data Book, volume 1M, Orbiter Vehicle STS-1, Rockwell SD72-SH-0060-1M, 1980;
    the head of the data file says where they were found and what was repaired.
    """
    data = orbiter_data()
    basic, flap, elevon = data["basic"], data["body_flap_increment"], data["elevon_increment"]
    mach, alpha = np.array(basic["mach"], dtype=float), DEG * np.array(basic["alpha_deg"], dtype=float)
    raw = np.stack([np.array(basic[c], dtype=float) for c in COEFFICIENTS], axis=-1)
    reach = np.array([alpha[np.isfinite(row[:, 0])].max() for row in raw])
    flap_axes, flap_values = _increments(flap)
    elevon_axes, elevon_values = _increments(elevon)
    at_nodes = flap_values  # the flap's increments at the nodes of the basic body
    for axis, nodes in enumerate((mach, alpha)):
        at_nodes = make_interp_spline(flap_axes[axis], at_nodes, k=DEGREE, axis=axis)(nodes)
    body = _continued(raw, mach)[:, :, None, :] + at_nodes
    body_function, _ = _splines("orbiter_body", (mach, alpha, flap_axes[2]), body)
    elevon_function, slope = _splines("orbiter_elevon", elevon_axes, elevon_values)
    return OrbiterAero(
        mach=frozen(mach), alpha=frozen(alpha), delta_e=frozen(elevon_axes[2]), delta_bf=frozen(flap_axes[2]), body=body_function,
        elevon=elevon_function, elevon_slope=slope, covered_to=frozen(reach),
        source="Orbiter Vehicle STS-1 tables in the layout of SD72-SH-0060-1M; see models/data/shuttle_longitudinal.yaml",
    )  # fmt: skip


def _increments(table: dict[str, Any]) -> tuple[tuple[Array, Array, Array], Array]:
    """Axes (mach, alpha rad, deflection rad) and values (n, m, k, 3) of an increment table, without gaps."""
    mach = np.array(table["mach"], dtype=float)
    values = np.stack([np.array(table[f"d{c}"], dtype=float) for c in COEFFICIENTS], axis=-1)
    axes = (mach, DEG * np.array(table["alpha_deg"], dtype=float), DEG * np.array(table["deflection_deg"], dtype=float))
    return axes, _continued(values, mach)


def _continued(values: Array, mach: Array) -> Array:
    """Values (mach, alpha, ...) without gaps: beyond the last angle of the source, the differences between angles at Mach 5."""
    full, like = values.copy(), values[np.flatnonzero(mach == _REFERENCE_MACH)[0]]
    for row in full:
        for j in range(1, len(row)):
            gap = np.isnan(row[j])
            row[j][gap] = (row[j - 1] + like[j] - like[j - 1])[gap]
    return full


def _splines(name: str, axes: Sequence[Array], values: Array) -> tuple[ca.Function, ca.Function]:
    """Tensor-product spline through values (n, m, k, 3), and the slope of its last component in the last argument."""
    knots, coefficients = [], values
    for i, axis in enumerate(axes):
        fitted = make_interp_spline(axis, coefficients, k=DEGREE, axis=i)
        knots.append(fitted.t)
        coefficients = np.moveaxis(fitted.c, 0, i)
    t, C = knots[2], coefficients[..., -1]
    slopes = DEGREE * np.diff(C, axis=2) / (t[DEGREE + 1 : -1] - t[1 : -DEGREE - 1])  # weights of the derivative, one degree lower

    def function(suffix: str, last: Array, weights: Array, degrees: list[int]) -> ca.Function:
        # never_inline: without it a spline node cannot be called with SX; m runs fastest in the weights
        flat = np.moveaxis(weights, -1, 0).ravel(order="F").tolist()
        options: dict[str, Any] = {"never_inline": True, "lookup_mode": ["binary"] * 3}
        grid = [k.tolist() for k in (*knots[:2], last)]
        spline = ca.Function.bspline(f"spline_{name}{suffix}", grid, flat, degrees, weights.shape[-1], options)
        symbols = [ca.SX.sym(n) for n in ("mach", "alpha", "delta")]
        held = [at_least(at_most(s, float(a[-1])), float(a[0])) for s, a in zip(symbols, axes, strict=True)]
        return ca.Function(f"{name}{suffix}", symbols, [spline(ca.vertcat(*held))], [s.name() for s in symbols], ["value"])

    whole = function("", t, coefficients, [DEGREE] * 3)
    return whole, function("_slope", t[1:-1], slopes[..., None], [DEGREE, DEGREE, DEGREE - 1])
