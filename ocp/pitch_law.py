"""Gain-scheduled pitch law of an entry vehicle: LQI gains from the symbolic Jacobians along a flight, scheduled with Mach and qbar.

The law acts on e = alpha - alpha_cmd and on the rate error; its output is a pitch acceleration, which an allocator shares out.  With the
elevon itself as the input the gains would vanish where the air is thin.  The integral acts on the elevon's trim only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, ModelError, as_finite, as_scalar, frozen
from models.tables import Table, grid
from ocp.linearize import Linearization
from ocp.lqr import lqi

GAINS = ("K_alpha", "K_q", "K_integral")


@dataclass(frozen=True, slots=True, eq=False)
class PitchWeights:
    """Weights of the pitch law as the errors that weigh as much as one `acceleration`.

    Attributes
    ----------
    alpha : float
        rad.
    rate : float
        rad/s.
    integral : float
        Of the integral of the error, rad s.
    acceleration : float
        rad/s2.
    """

    alpha: float
    rate: float
    integral: float
    acceleration: float

    def __post_init__(self) -> None:
        for name in ("alpha", "rate", "integral", "acceleration"):
            value = as_scalar(f"PitchWeights: {name}", getattr(self, name))
            if value <= 0:
                raise ModelError(f"PitchWeights: {name} must be > 0, got {value}; it is the error that weighs as much as the others")


@dataclass(frozen=True, slots=True, eq=False)
class PitchGains:
    """Gains on a grid of Mach number and dynamic pressure.

    v = -K_alpha e_alpha - K_q e_q (pitch acceleration, rad/s2); the trim moves so that -K_integral * integral(e_alpha) is added.

    Attributes
    ----------
    mach, log_qbar : ndarray, shapes (m,), (n,)
        Grid; natural logarithm of qbar in Pa.
    K : ndarray, shape (m, n, 3)
        In the order of ``GAINS``.
    A : ndarray, shape (m, n, 2, 2)
        Short-period matrices that the gains are for: d/dt of (alpha error, rate error).
    riccati_residual : float
        Largest of the grid.
    abscissa : float
        Largest spectral abscissa of the closed loops of the grid, 1/s: negative.
    """

    mach: Array
    log_qbar: Array
    K: Array
    A: Array
    riccati_residual: float
    abscissa: float

    def tables(self) -> tuple[Table, ...]:
        """The three gains as smooth tables of (mach, log qbar), held at the edges."""
        return tuple(grid(f"pitch_{name}", self.mach, self.log_qbar, values=self.K[:, :, i]) for i, name in enumerate(GAINS))

    def at(self, mach: Any, qbar: Any) -> tuple[Any, ...]:
        """Gains at a Mach number and a dynamic pressure (Pa), symbols or numbers."""
        level = ca.log(ca.fmax(qbar, 1e-6)) if isinstance(qbar, (ca.SX, ca.MX)) else np.log(np.maximum(as_finite("qbar", qbar), 1e-6))
        return tuple(table(mach, level) for table in self.tables())


def short_period(lin: Linearization, *, angle: str = "theta", path: str = "gamma", rate: str = "q") -> Array:
    """Short-period matrices (N, 2, 2) of (alpha, q) at frozen speed and altitude, from the Jacobians of a longitudinal model.

    alpha' = q - gamma' + ...: [[-d gamma'/d theta, 1], [d q'/d theta, d q'/d q]].
    """
    if lin.model is None:
        raise ModelError("short_period: the linearization has no model; use linearize(model, x=..., u=...)")
    i, g, r = (lin.model.index(name) for name in (angle, path, rate))
    one = np.ones(len(lin.t))
    return np.stack([np.stack([-lin.A[:, g, i], one], -1), np.stack([lin.A[:, r, i], lin.A[:, r, r]], -1)], -2)


def pitch_gains(
    lin: Linearization, *, mach: ArrayLike, qbar: ArrayLike, weights: PitchWeights, grid_mach: ArrayLike, grid_qbar: ArrayLike
) -> PitchGains:
    """LQI gains over a grid of Mach and qbar from the Jacobians along a flight.

    Along the flight every element of the short-period matrix divided by qbar is taken as a function of Mach number alone (it is one for
    a given schedule of angle of attack), and multiplied by the qbar of the grid.

    Parameters
    ----------
    lin : Linearization
        Of a longitudinal model at N points of the flight.
    mach, qbar : array_like, shape (N,)
        Along the flight.  Of points of the very same Mach number the one of the largest qbar counts.
    weights : PitchWeights
    grid_mach, grid_qbar : array_like, shapes (m,), (n,)
        Grid of the schedule, Pa, increasing; Mach numbers outside the flight take the values of its ends.

    Raises
    ------
    ModelError
        Shapes that do not agree.
    NotStabilizable
        From :func:`ocp.lqr.lqi`.
    """
    along, pressure = as_finite("pitch_gains: mach", mach), as_finite("pitch_gains: qbar", qbar)
    if along.shape != lin.t.shape or pressure.shape != lin.t.shape or (pressure <= 0).any():
        raise ModelError(
            f"pitch_gains: mach {along.shape} and qbar {pressure.shape} (> 0) must have one value for each of {len(lin.t)} points"
        )
    A = short_period(lin)
    normal = A / pressure[:, None, None]
    numbers, pressures = as_finite("pitch_gains: grid_mach", grid_mach), as_finite("pitch_gains: grid_qbar", grid_qbar)
    order = np.lexsort((pressure, along))
    order = order[np.append(np.diff(along[order]) > 0, True)]
    Q = np.diag([1 / weights.alpha**2, 1 / weights.rate**2, 1 / weights.integral**2])
    R = np.array([[1 / weights.acceleration**2]])
    shape = (len(numbers), len(pressures))
    matrices, gains = np.empty((*shape, 2, 2)), np.empty((*shape, 3))
    residual, abscissa = 0.0, -np.inf
    for i, number in enumerate(numbers):
        scaled = np.array([[np.interp(number, along[order], normal[order, r, c]) for c in range(2)] for r in range(2)])
        for j, level in enumerate(pressures):
            matrices[i, j] = scaled * level
            matrices[i, j, 0, 1] = 1.0
            found = lqi(matrices[i, j], np.array([[0.0], [1.0]]), C=np.array([[1.0, 0.0]]), Q=Q, R=R)
            gains[i, j] = found.K[0, 0]
            residual = max(residual, float(found.certificate.riccati_residual))
            abscissa = max(abscissa, float(np.linalg.eigvals(_closed(matrices[i, j], gains[i, j])).real.max()))
    return PitchGains(frozen(numbers), frozen(np.log(pressures)), frozen(gains), frozen(matrices), residual, abscissa)


def _closed(A: Array, K: Array) -> Array:
    """Closed loop of (alpha error, rate error, integral)."""
    return np.array([[A[0, 0], A[0, 1], 0.0], [A[1, 0] - K[0], A[1, 1] - K[1], -K[2]], [1.0, 0.0, 0.0]])


def rate_reference(command_rate: Any, gamma_dot: Any, V: Any, gamma: Any, radius: Any) -> Any:
    """Pitch rate at which alpha follows its command: command rate + gamma rate - V cos(gamma)/r, rad/s."""
    return command_rate + gamma_dot - V * ca.cos(gamma) / radius


def acceleration(e_alpha: Any, e_q: Any, K_alpha: Any, K_q: Any) -> Any:
    """Demanded pitch acceleration of proportional and rate terms, rad/s2."""
    return -K_alpha * e_alpha - K_q * e_q


def trim_rate(e_alpha: Any, K_integral: Any, *, qbar: Any, slope: Any, inertia: float, above: float, floor: float) -> Any:
    """Rate of the elevon's trim, rad/s: -K_integral e inertia/slope, with the slope's qbar floored; zero below `above`.

    Parameters
    ----------
    e_alpha : SX
        rad.
    K_integral : SX
        1/s3.
    qbar : SX
        Pa.
    slope : SX
        dM/d delta_e at this qbar, N m/rad, not zero.
    inertia : float
        kg m2.
    above, floor : float
        Dynamic pressure from which the integral works, and the least one that the slope is taken at, Pa.
    """
    floored = slope * ca.fmax(qbar, floor) / ca.fmax(qbar, 1e-6)
    return ca.if_else(qbar > above, -K_integral * e_alpha * inertia / floored, 0.0)
