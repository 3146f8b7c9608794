"""Hand-over of pitch control from reaction jets to the elevon as the dynamic pressure rises (blending logic of paper 000, equation 20)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, as_scalar

INPUTS = ("demand", "qbar", "trim", "slope", "up", "down", "previous")
OUTPUTS = ("elevon", "duty", "k_blend")


@dataclass(frozen=True, slots=True, eq=False)
class Handover:
    """Parameters of the logic.

    Attributes
    ----------
    q1, q2 : float
        Dynamic pressure at which the elevon begins to take part and at which it has its full authority, Pa.
    lower, upper : float
        Limits of the whole elevon command (trim and control term), rad; they contain zero.
    floor : float
        Smallest |demand| that the jets' share is computed with, rad.
    rcs_inhibit_above_q2 : bool
        No jets above q2.  The literal equation 20 (False) can fire them there for demands below the floor.
    """

    q1: float = 1000.0
    q2: float = 2500.0
    lower: float = math.radians(-33.0)
    upper: float = math.radians(18.0)
    floor: float = math.radians(0.5)
    rcs_inhibit_above_q2: bool = True

    def __post_init__(self) -> None:
        for name in ("q1", "q2", "lower", "upper", "floor"):
            object.__setattr__(self, name, as_scalar(f"Handover: {name}", getattr(self, name)))
        if not 0 <= self.q1 < self.q2:
            raise ModelError(f"Handover: q1 {self.q1} and q2 {self.q2} Pa: expected 0 <= q1 < q2")
        if not self.lower <= 0 <= self.upper or self.lower == self.upper:
            raise ModelError(f"Handover: lower {self.lower} and upper {self.upper} rad must contain zero")
        if self.floor <= 0:
            raise ModelError(f"Handover: floor must be > 0 rad, got {self.floor}")


class Share(NamedTuple):
    """What :func:`share` returns, each a scalar expression.

    elevon: control term of the elevon (without the trim), rad.  k_blend: part of the demanded moment that the jets take, 0 to 1.
    """

    elevon: ca.SX
    k_blend: ca.SX


def authority(qbar: ca.SX, *, q1: float, q2: float) -> ca.SX:
    """Share k_de of the elevon's limits that is open: 0 below q1, 1 above q2, linear between (equation 20, second line)."""
    return ca.fmin(ca.fmax((qbar - q1) / (q2 - q1), 0.0), 1.0)


def limits(qbar: ca.SX, trim: ca.SX, *, handover: Handover) -> tuple[ca.SX, ca.SX]:
    """Limits of the elevon's control term at dynamic pressure qbar (Pa) and trim (rad): rad, rad.

    Equation 20 opens k_de [lower, upper]; the trim may leave less than that before the stops.  A trim beyond a stop
    leaves nothing, so zero always lies inside.
    """
    k = authority(qbar, q1=handover.q1, q2=handover.q2)
    low = ca.fmin(ca.fmax(k * handover.lower, handover.lower - trim), 0.0)
    high = ca.fmax(ca.fmin(k * handover.upper, handover.upper - trim), 0.0)
    return low, high


def share(demand: ca.SX, qbar: ca.SX, trim: ca.SX, *, handover: Handover) -> Share:
    """Equation 20.

    k_de limits the control term: p1 = demand inside k_de [lower, upper]; |p2| = max(|demand|, floor); k_blend = 1 - |p1/p2|.

    Parameters
    ----------
    demand : SX, scalar
        Demanded control term of the elevon (proportional and rate terms, without the trim), rad.
    qbar : SX, scalar
        Dynamic pressure, Pa.
    trim : SX, scalar
        Elevon's trim, rad.
    handover : Handover

    Notes
    -----
    The jets get k_blend times the demanded *moment*.  Below the floor both together deliver too much, by |p1| (1 - |demand|/floor),
    at most a quarter of the floor.

    Source: paper 000, equation 20 and figure 9.
    """
    low, high = limits(qbar, trim, handover=handover)
    p1 = ca.fmin(ca.fmax(demand, low), high)
    p2 = ca.fmax(ca.fabs(demand), handover.floor)
    k_blend = ca.fmin(ca.fmax(1.0 - ca.fabs(p1) / p2, 0.0), 1.0)
    if handover.rcs_inhibit_above_q2:
        k_blend = ca.if_else(qbar > handover.q2, 0.0, k_blend)
    return Share(p1, k_blend)


def duty_of(moment: ca.SX, up: ca.SX, down: ca.SX) -> ca.SX:
    """Signed duty of the pitch jets for a moment, N m: up > 0 and down < 0 are the moments of all nose-up and nose-down jets."""
    return ca.if_else(moment > 0, moment / up, -moment / down)


def paper(handover: Handover | None = None, *, name: str = "blend_paper") -> ca.Function:
    """The paper's logic as an allocator for the pitch loop.

    All allocators of the pitch loop have these inputs and outputs, scalars each, so that one can stand for another
    (:func:`allocation.qp.blend` is the same task as a quadratic program):

    demand (rad of elevon control term), qbar (Pa), trim (rad), slope = dM/d delta_e (N m/rad, at the present command), up > 0 and
    down < 0 (moments of all nose-up and nose-down jets, N m), previous (the elevon's control term one sample ago, rad; unused here)
    -> elevon (control term, rad), duty (of the jets, nose up positive; not limited to 1: the modulator does that), k_blend.
    """
    values = handover or Handover()
    symbols = [ca.SX.sym(n) for n in INPUTS]
    demand, qbar, trim, slope, up, down, _previous = symbols
    part = share(demand, qbar, trim, handover=values)
    duty = duty_of(part.k_blend * (slope * demand), up, down)
    return ca.Function(name, symbols, [part.elevon, duty, part.k_blend], list(INPUTS), list(OUTPUTS))


def limits_arrays(qbar: Array, trim: Array, *, handover: Handover) -> tuple[Array, Array]:
    """:func:`limits` for NumPy arrays that broadcast."""
    h = handover
    k = np.minimum(np.maximum((qbar - h.q1) / (h.q2 - h.q1), 0.0), 1.0)
    return np.minimum(np.maximum(k * h.lower, h.lower - trim), 0.0), np.maximum(np.minimum(k * h.upper, h.upper - trim), 0.0)


def share_arrays(demand: ArrayLike, qbar: ArrayLike, trim: ArrayLike, *, handover: Handover | None = None) -> tuple[Array, Array]:
    """:func:`share` for NumPy arrays that broadcast: (elevon, k_blend), bit for bit the numbers of the CasADi function.

    Raises
    ------
    ModelError
        An argument that is not finite.
    """
    h = handover or Handover()
    p, q, t = np.broadcast_arrays(*(as_finite(f"blending: {n}", v) for n, v in zip(INPUTS, (demand, qbar, trim), strict=False)))
    low, high = limits_arrays(q, t, handover=h)
    p1 = np.minimum(np.maximum(p, low), high)
    k_blend = np.minimum(np.maximum(1.0 - np.abs(p1) / np.maximum(np.abs(p), h.floor), 0.0), 1.0)
    if h.rcs_inhibit_above_q2:
        k_blend = np.where(q > h.q2, 0.0, k_blend)
    return p1, k_blend
