"""Gravity of an oblate planet as the gradient of one potential (planet-fixed axes, z along the spin axis)."""

from __future__ import annotations

import casadi as ca

from models.checked import ModelError


def potential(r: ca.SX, *, mu: float | ca.SX, J2: float | ca.SX, radius: float | ca.SX) -> ca.SX:
    """Gravitational potential U(r), positive.

    U = mu/|r| [1 - J2 (radius/|r|)^2 (3 sin^2(lat) - 1)/2]

    Parameters
    ----------
    r : casadi.SX, shape (3,)
        Position, m.
    mu : float
        Gravitational parameter, m3/s2.
    J2 : float
        Second zonal harmonic, unnormalized; 0 is the central field.
    radius : float
        Equatorial radius that J2 refers to, m.

    Returns
    -------
    casadi.SX
        Scalar, m2/s2.

    Raises
    ------
    ModelError
        `r` is not a column of three.

    Notes
    -----
    Source: Vallado, Fundamentals of Astrodynamics and Applications, ch. 8.  Limits: zonal J2 only; |r| > 0.
    """
    if r.shape != (3, 1):
        raise ModelError(f"gravity: r has shape {r.shape}, expected a column (3, 1); stack x, y, z with casadi.vertcat")
    distance = ca.norm_2(r)
    return _zonal(distance, r[2] / distance, mu, J2, radius)


def acceleration(r: ca.SX, *, mu: float | ca.SX, J2: float | ca.SX, radius: float | ca.SX) -> ca.SX:
    """Gravitational acceleration (3,), m/s2: the gradient of :func:`potential`, whose arguments it takes."""
    position = ca.SX.sym("r", 3)  # a fresh symbol: `r` itself may be an expression, which cannot be differentiated by
    gradient = ca.gradient(potential(position, mu=mu, J2=J2, radius=radius), position)
    return ca.substitute(gradient, position, r)


def spherical(r: ca.SX, lat: ca.SX, *, mu: float | ca.SX, J2: float | ca.SX, radius: float | ca.SX) -> tuple[ca.SX, ca.SX]:
    """Radial (outward) and northward acceleration, m/s2: the gradient of the same potential in distance and latitude.

    g_r = dU/dr,  g_north = (1/r) dU/dlat

    Parameters
    ----------
    r : casadi.SX
        Distance from the centre, m.
    lat : casadi.SX
        Geocentric latitude, rad.
    mu, J2, radius
        As for :func:`potential`.

    Returns
    -------
    tuple of casadi.SX
        (g_r, g_north); g_r is negative; g_north is negative (towards the equator) in the northern hemisphere of an oblate planet.
    """
    distance, latitude = ca.SX.sym("r"), ca.SX.sym("lat")
    U = _zonal(distance, ca.sin(latitude), mu, J2, radius)
    radial = ca.substitute(ca.gradient(U, distance), distance, r)
    north = ca.substitute(ca.gradient(U, latitude) / distance, distance, r)
    return ca.substitute(radial, latitude, lat), ca.substitute(north, latitude, lat)


def _zonal(distance: ca.SX, sin_lat: ca.SX, mu: float | ca.SX, J2: float | ca.SX, radius: float | ca.SX) -> ca.SX:
    return mu / distance * (1 - J2 * (radius / distance) ** 2 * (3 * sin_lat**2 - 1) / 2)
