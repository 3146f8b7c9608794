"""Landing flights: the target and the miss from it, and many closed-loop flights to the stop altitude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, Status, as_batch, as_finite, as_scalar, frozen
from models.native import Mode
from ocp import flight
from ocp.laws import Law
from ocp.methods import RK4
from ocp.simulate import simulate_ensemble
from ocp.stops import falls_below


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A landing point and the axes in which a miss is told.

    Attributes
    ----------
    up, along, right : ndarray, shape (3,)
        Unit vectors at the target in planet-fixed axes: radial; along the great circle from the entry; to its right.
    radius : float
        Sphere on which distances are measured, m.
    """

    up: Array
    along: Array
    right: Array
    radius: float

    def miss(self, r: ArrayLike) -> Array:
        """(downrange, cross-range) m, positive beyond the target and to the right of it, of positions (3,) or (N, 3)."""
        position = as_finite("miss: r", r)
        if position.ndim not in (1, 2) or position.shape[-1] != 3:
            raise ModelError(f"miss: r: expected shape (3,) or (N, 3), got {position.shape}; give planet-fixed positions")
        unit = position / np.linalg.norm(position, axis=-1, keepdims=True)
        along = np.arctan2(unit @ self.along, unit @ self.up)
        return self.radius * np.stack([along, np.arcsin(np.clip(unit @ self.right, -1.0, 1.0))], axis=-1)

    def expression(self, r: ca.SX) -> ca.SX:
        """As :meth:`miss`, symbolically, for one position."""
        unit = r / ca.norm_2(r)
        along = ca.atan2(ca.dot(unit, ca.DM(self.along)), ca.dot(unit, ca.DM(self.up)))
        return self.radius * ca.vertcat(along, ca.asin(ca.dot(unit, ca.DM(self.right))))

    def point(self, miss: ArrayLike) -> Array:
        """Unit vectors (..., 3) of the points with given misses (..., 2), m: the inverse of :meth:`miss`."""
        angle = as_finite("point: miss", miss) / self.radius
        a, c = angle[..., :1], angle[..., 1:]
        return np.cos(c) * (np.cos(a) * self.up + np.sin(a) * self.along) + np.sin(c) * self.right


def target(entry: ArrayLike, landing: ArrayLike, *, radius: float) -> Target:
    """The target over which (or at which) a position `landing` (3,) lies, seen from a position `entry` (3,), m.

    Raises
    ------
    ModelError
        Wrong shapes, or a target under the entry point or opposite to it: it has no direction.
    """
    points = []
    for name, value in (("entry", entry), ("landing", landing)):
        r = as_finite(f"target: {name}", value)
        if r.shape != (3,) or not np.linalg.norm(r) > 0:
            raise ModelError(f"target: {name}: expected a position of shape (3,) off the centre, got {r}; give metres in planet-fixed axes")
        points.append(r / np.linalg.norm(r))
    normal = np.cross(points[0], points[1])
    if np.linalg.norm(normal) < 1e-9:
        raise ModelError("target: the target lies under the entry point or opposite to it; no direction leads to it: move one of them")
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, points[1])
    return Target(frozen(points[1]), frozen(along), frozen(-normal), as_scalar("target: radius", radius))


def great_circle(a: ArrayLike, b: ArrayLike, *, radius: float) -> float:
    """Distance on the sphere between the directions of two positions (3,), m."""
    p, q = as_finite("great_circle: a", a), as_finite("great_circle: b", b)
    return float(radius * np.arctan2(np.linalg.norm(np.cross(p, q)), p @ q))


@dataclass(frozen=True, slots=True, eq=False)
class Guidance:
    """A guidance law with the names of its memory.

    Attributes
    ----------
    law : Law
        Sampled; it reads navigated state and measured force from the outputs of its plant, and commands the bank angle.
    plant : Model
        The model whose outputs it reads.
    memory : tuple of str
        Names of the law's memory, in order.
    target : Target
    """

    law: Law
    plant: Model
    memory: tuple[str, ...]
    target: Target


@dataclass(frozen=True, slots=True, eq=False)
class Landings:
    """Ends of N closed-loop flights.

    Attributes
    ----------
    t : ndarray, shape (N,)
        Flight times, s.
    x : ndarray, shape (N, nx)
        States of the plant at the stop.
    z : ndarray, shape (N, nz)
        Memory of the law at its last call.
    miss : ndarray, shape (N, 2)
        Downrange and cross-range, m.
    status : tuple of Status, length N
    guidance : Guidance
    """

    t: Array
    x: Array
    z: Array
    miss: Array
    status: tuple[Status, ...]
    guidance: Guidance

    @property
    def ok(self) -> np.ndarray:
        """Cases that reached the stop altitude, shape (N,)."""
        return np.array([s.ok for s in self.status], dtype=bool)

    @property
    def distance(self) -> Array:
        """Miss distances, m, shape (N,)."""
        return np.asarray(np.hypot(self.miss[:, 0], self.miss[:, 1]))

    def __getitem__(self, name: str) -> Array:
        """A state of the plant at the stop, or an entry of the law's memory, shape (N,)."""
        if name in self.guidance.memory:
            return self.z[:, self.guidance.memory.index(name)]
        return self.x[:, self.guidance.plant.index(name)]


def fly(
    guidance: Guidance,
    *,
    x0: ArrayLike,
    p: ArrayLike,
    altitude: float,
    step: float = 0.25,
    t_max: float = 1500.0,
    native: Literal["off"] | Mode = "fast",
    progress: Callable[[float], None] | None = None,
) -> Landings:
    """Fly N dispersed cases under a guidance law to an altitude, in compiled code where there is a compiler.

    Parameters
    ----------
    guidance : Guidance
    x0 : array_like, shape (N, nx)
        States of the plant at entry.
    p : array_like, shape (N, np)
        Its parameters.
    altitude : float
        Stop, m.
    step : float
        Longest integration step (RK4), s.
    t_max : float
        Time after which a flight counts as not landed, s.
    native : {"off", "accurate", "fast"}
        As in :func:`ocp.simulate_ensemble`; "off" takes minutes for hundreds of cases.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Landings
        A case that does not land has the status STOP_NOT_REACHED or NONFINITE; the others stand.

    Raises
    ------
    ModelError
        Wrong shapes, or numbers outside ``Var.valid``.
    """
    plant = guidance.plant
    starts = np.atleast_2d(as_batch("x0", x0, plant.states))
    params = np.atleast_2d(as_batch("p", p, plant.params))
    if len(starts) != len(params) or len(starts) == 0:
        raise ModelError(f"fly: {len(starts)} rows of x0 beside {len(params)} of p; give equal numbers, at least one")
    if native not in ("off", "accurate", "fast"):
        raise ModelError(f"fly: native: expected 'off', 'accurate' or 'fast', got {native!r}")
    flown = simulate_ensemble(
        plant, guidance.law, x0=starts, p=params, until=falls_below("h", altitude), t_max=t_max, method=RK4(step=step),
        progress=progress, native=native, block=flight.BLOCK,
    )  # fmt: skip
    return Landings(flown.t, flown.x, flown.z, frozen(guidance.target.miss(flown.x[:, :3])), flown.status, guidance)
