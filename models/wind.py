"""Horizontal wind tabulated against altitude."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, evaluate
from models.tables import Table, line


@dataclass(frozen=True, slots=True, eq=False)
class Wind:
    """Horizontal wind as two smooth functions of altitude; the direction named is the one the air moves to.

    Attributes
    ----------
    name : str
    east, north : casadi.Function
        (h,) m -> component, m/s; positive eastward and northward (a west wind has east > 0).
    domain : tuple of float
        Altitudes covered by the data, m.  Outside, the wind of the nearest edge is held.
    source : str
    """

    name: str
    east: ca.Function
    north: ca.Function
    domain: tuple[float, float]
    source: str = ""

    def at(self, h: ArrayLike) -> Array:
        """East and north components, m/s, at altitudes `h` (N,) m, also outside the domain: shape (N, 2)."""
        altitude = np.atleast_1d(as_finite("wind: h", h))
        if altitude.ndim != 1:
            raise ModelError(f"wind: h has shape {altitude.shape}, expected (N,); flatten it")
        return np.hstack([evaluate(f, altitude[:, None])[0] for f in (self.east, self.north)])


def calm() -> Wind:
    """No wind at any altitude."""
    h = ca.SX.sym("h")
    east, north = (ca.Function(f"calm_{n}", [h], [ca.SX(ca.DM(0.0))], ["h"], [n]) for n in ("east", "north"))
    return Wind(name="calm", east=east, north=north, domain=(-np.inf, np.inf), source="still air, by definition")


def from_table(h: ArrayLike, east: ArrayLike, north: ArrayLike | None = None, *, name: str = "wind", source: str = "") -> Wind:
    """Wind through tabulated values: cubic splines, level at both ends, held outside (slope continuous everywhere).

    Parameters
    ----------
    h : array_like, shape (n,)
        Altitudes, m, strictly increasing, n >= 2.
    east, north : array_like, shape (n,)
        Components, m/s, positive eastward and northward; `north` is zero if left out.
    name : str
        Identifier; prefixes the generated functions.
    source : str
        Where the numbers come from.

    Raises
    ------
    ModelError
        Altitudes that do not increase, unequal lengths, NaN, or a component of more than 500 m/s.
    """
    components = {"east": east, "north": np.zeros(np.shape(east)) if north is None else north}
    tables: dict[str, Table] = {}
    for component, values in components.items():
        speeds = as_finite(f"{name}: {component}", values)
        if speeds.size and np.max(np.abs(speeds)) > 500.0:
            raise ModelError(
                f"{name}: {component} reaches {speeds.flat[np.argmax(np.abs(speeds))]:.6g} m/s, expected at most 500;"
                " check the unit and the order of the columns (h, east, north)"
            )
        tables[component] = line(f"{name}_{component}", h, values=speeds, outside="clamp", ends="flat")
    domain = tables["east"].domain[0]
    return Wind(name=name, east=tables["east"].function, north=tables["north"].function, domain=domain, source=source)
