"""What guidance learns in flight: density, lift over drag and wind, from the measured specific force."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from models import units
from models.core import Model, ModelError, as_scalar

ESTIMATED = {"rho": 1.0, "lift": 1.0, "wind_east": 0.0, "wind_north": 0.0}  # memory of the estimators and where it starts
RANGE = (0.2, 5.0)  # of the density and lift factors
STRONGEST = 100.0  # m/s, of the wind on board
ANGLE_NOISE, WIND_PRIOR = 0.02, 150.0  # rad of the force direction; m/s: together they keep unobservable winds at rest


@dataclass(frozen=True, slots=True)
class Estimators:
    """Fading filters of the ratios of measured to expected forces, and of the wind.

    Attributes
    ----------
    density_s, lift_s : float
        Time constants of the density factor (measured over expected drag) and of the lift-to-drag factor, s.
    wind_s : float or None
        Time constant of the wind, s; None leaves the wind at zero and the lift estimate on to the end.
    gate_g : float
        Drag below which nothing is learned, g0.
    wind_below : float
        Altitude, m: below it the direction of the force tells the wind and no more the lift, which a cross wind would falsify.
    """

    density_s: float = 8.0
    lift_s: float = 30.0
    wind_s: float | None = 10.0
    gate_g: float = 0.05
    wind_below: float = 26e3

    def __post_init__(self) -> None:
        for name in ("density_s", "lift_s", "wind_s", "gate_g", "wind_below"):
            value = getattr(self, name)
            if value is not None and as_scalar(f"Estimators: {name}", value) <= 0:
                raise ModelError(f"Estimators: {name} must be finite and > 0, got {value}")

    def step(self, onboard: Model, sample: float, nav: ca.SX, force: ca.SX, bank: ca.SX, memory: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
        """New estimates from the navigated state (6,), the measured specific force (3,) and the bank angle.

        D = -f . e along the air velocity, L = f . l along the expected lift; factors D/D0 and (L/D)/(L0/D0), each through a
        first-order filter.
        """
        plain = parameters(onboard, {**ESTIMATED, "wind_east": memory["wind_east"], "wind_north": memory["wind_north"]})
        expected = _force(onboard, nav, bank, plain)
        along = _air_velocity(onboard, nav, bank, plain)
        drag0 = -ca.dot(expected, along)
        lift0 = expected + drag0 * along
        size0 = ca.norm_2(lift0)
        drag = -ca.dot(force, along)
        lift = ca.dot(force, lift0) / size0
        sensed = drag > self.gate_g * units.G0
        aloft = ca.norm_2(nav[:3]) - units.R_MEAN_EARTH > self.wind_below if self.wind_s is not None else ca.SX(1)
        # a vehicle without air has no ratios: the guards only keep numbers finite where nothing is learned
        ratio = (lift / ca.fmax(drag, 1e-9)) / (size0 / ca.fmax(drag0, 1e-12))
        new = {
            "rho": _faded(memory["rho"], drag / ca.fmax(drag0, 1e-12), sample / self.density_s, sensed, RANGE),
            "lift": _faded(memory["lift"], ratio, sample / self.lift_s, ca.logic_and(sensed, aloft), RANGE),
            "wind_east": memory["wind_east"],
            "wind_north": memory["wind_north"],
        }
        if self.wind_s is not None:
            change = _wind_change(onboard, nav, force, bank, memory, new["lift"])
            gain = 1 - math.exp(-sample / self.wind_s)
            low = ca.logic_and(sensed, ca.logic_not(aloft))
            for i, name in enumerate(("wind_east", "wind_north")):
                new[name] = ca.if_else(low, _clipped(memory[name] + gain * change[i], -STRONGEST, STRONGEST), memory[name])
        return new


def parameters(onboard: Model, estimates: Mapping[str, Any]) -> ca.SX:
    """Parameters of the model on board with the estimates in place."""
    p = ca.SX(ca.DM(onboard.p0))
    for name, parameter in (("rho", "rho_factor"), ("lift", "CL_factor"), ("wind_east", "wind_east"), ("wind_north", "wind_north")):
        p[onboard.index(parameter)] = estimates[name]
    return p


def _force(onboard: Model, nav: ca.SX, bank: ca.SX, p: ca.SX) -> ca.SX:
    first = onboard.index("force_x")
    return onboard.out(nav, bank, p)[first : first + 3]


def _air_velocity(onboard: Model, nav: ca.SX, bank: ca.SX, p: ca.SX) -> ca.SX:
    """Unit vector along the air-relative velocity: against the force of a vehicle without lift."""
    q = ca.SX(p)
    q[onboard.index("CL_factor")] = 0
    drag = _force(onboard, nav, bank, q)
    return -drag / ca.norm_2(drag)


def _wind_change(onboard: Model, nav: ca.SX, force: ca.SX, bank: ca.SX, memory: Mapping[str, ca.SX], lift: ca.SX) -> ca.SX:
    """Gauss-Newton step (2,) m/s of the level wind that turns the expected force into the direction of the measured one."""
    wind, state, angle, factor = ca.SX.sym("wind", 2), ca.SX.sym("nav", 6), ca.SX.sym("bank"), ca.SX.sym("lift")
    f = _force(onboard, state, angle, parameters(onboard, {"rho": 1.0, "lift": factor, "wind_east": wind[0], "wind_north": wind[1]}))
    direction = f / ca.norm_2(f)
    both = ca.Function("direction", [wind, state, angle, factor], [direction, ca.jacobian(direction, wind)])
    expected, J = both.call([ca.vertcat(memory["wind_east"], memory["wind_north"]), nav, bank, lift])
    H = J.T @ J + ca.SX.eye(2) * (ANGLE_NOISE / WIND_PRIOR) ** 2
    g = J.T @ (force / ca.fmax(ca.norm_2(force), 1e-9) - expected)
    return ca.vertcat(H[1, 1] * g[0] - H[0, 1] * g[1], H[0, 0] * g[1] - H[1, 0] * g[0]) / (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])


def _faded(old: ca.SX, value: ca.SX, ratio: float, learn: ca.SX, limits: tuple[float, float]) -> ca.SX:
    return ca.if_else(learn, _clipped(old + (1 - math.exp(-ratio)) * (value - old), *limits), old)


def _clipped(value: ca.SX, low: Any, high: Any) -> ca.SX:
    return ca.fmax(low, ca.fmin(high, value))
