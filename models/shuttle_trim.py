"""Trim of the orbiter: elevon for zero pitching moment, static stability and control effectiveness over Mach number and angle of attack."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, as_finite, evaluate
from models.shuttle import Orbiter, orbiter
from models.shuttle_aero import OrbiterAero, orbiter_aero

_BISECTIONS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Trim:
    """Trim at broadcast Mach numbers and angles of attack; every array has their shape.

    Attributes
    ----------
    elevon : ndarray
        rad; the command limit nearest to zero moment where there is no trim.
    residual : ndarray
        Cm left: zero where trimmed, the missing part otherwise.
    trimmed : ndarray of bool
        False: out of authority.
    Cm_alpha, Cm_delta_e : ndarray
        Slopes there at fixed elevon and fixed alpha, 1/rad: static stability (negative is stable) and control effectiveness.
    covered : ndarray of bool
        The source's tables reach this angle of attack.
    """

    elevon: Array
    residual: Array
    trimmed: np.ndarray
    Cm_alpha: Array
    Cm_delta_e: Array
    covered: np.ndarray


def trim_elevon(
    mach: ArrayLike,
    alpha: ArrayLike,
    *,
    delta_bf: ArrayLike = 0.0,
    cg_aft: float = 0.0,
    Cm_factor: float = 1.0,
    elevon_factor: float = 1.0,
    vehicle: Orbiter | None = None,
    aero: OrbiterAero | None = None,
) -> Trim:
    """Elevon that holds Cm = 0 about the centre of mass, all points at once, by bisection between the command limits.

    Parameters
    ----------
    mach, alpha, delta_bf : array_like
        Broadcast together; rad.
    cg_aft : float
        Centre of mass behind the moment reference, m.
    Cm_factor, elevon_factor : float
        Of the moment of body and flap, and of the elevon's increments.

    Raises
    ------
    ModelError
        NaN, or a value outside the tables.
    """
    body, tables = vehicle or orbiter(), aero or orbiter_aero()
    number, angle, flap = np.broadcast_arrays(
        *(as_finite(f"trim: {n}", v) for n, v in zip(("mach", "alpha", "delta_bf"), (mach, alpha, delta_bf), strict=True))
    )
    tables.at(number, angle, 0.0, flap)  # checks the domain
    covered = tables.covers(number, angle)
    moment = _moment(body, tables, cg_aft, Cm_factor, elevon_factor)
    point = [v.reshape(-1, 1).astype(float) for v in (number, angle, flap)]
    low = np.full(number.size, body.elevon.lower)
    high = np.full(number.size, body.elevon.upper)

    def of(elevon: Array) -> tuple[Array, ...]:
        return tuple(out[:, 0] for out in evaluate(moment, *point, elevon[:, None]))

    up, down = of(low)[0], of(high)[0]  # trailing edge up: nose up
    trimmed = (up >= 0) & (down <= 0)
    ends = np.where(np.abs(up) < np.abs(down), low, high)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        positive = of(middle)[0] > 0
        low, high = np.where(positive, middle, low), np.where(positive, high, middle)
    elevon = np.where(trimmed, 0.5 * (low + high), ends)
    Cm, slope, effect = of(elevon)
    shape = number.shape
    return Trim(*(np.asarray(a).reshape(shape) for a in (elevon, Cm, trimmed, slope, effect, covered)))


def _moment(body: Orbiter, tables: OrbiterAero, cg_aft: float, Cm_factor: float, elevon_factor: float) -> ca.Function:
    """(mach, alpha, delta_bf, delta_e) -> Cm about the centre of mass and its slopes in alpha and delta_e."""
    mach, alpha, flap, elevon = (ca.SX.sym(n) for n in ("mach", "alpha", "delta_bf", "delta_e"))
    hull, flaps = tables.body(mach, alpha, flap), tables.elevon(mach, alpha, elevon)
    lift, drag = hull[0] + elevon_factor * flaps[0], hull[1] + elevon_factor * flaps[1]
    normal = lift * ca.cos(alpha) + drag * ca.sin(alpha)
    Cm = Cm_factor * hull[2] + elevon_factor * flaps[2] + cg_aft / body.chord * normal
    slopes = ca.densify(ca.jacobian(Cm, ca.vertcat(alpha, elevon)))
    return ca.Function("orbiter_moment", [mach, alpha, flap, elevon], [Cm, slopes[0], slopes[1]])
