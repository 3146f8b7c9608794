"""The problem of the gain benchmarks, and its equations written by hand in plain floats, as a user without a symbolic tool would.

Reference N1 flown from 100 km to 10 km; states [V gamma h s] divided by SCALE, so that every tool works on numbers near one.
Planar entry, exponential air: Tang & Zhao 2000 (paper 003), eqs 2-3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import models
from studies.scenario import Scenario

Array = NDArray[np.float64]
Rate = Callable[[float, Any], list[float]]

SCALE = np.array([7000.0, 0.1, 5e4, 1e6])
TERMINAL = (500.0, math.radians(2.0), 250.0, 200.0)  # m/s, rad, m, m: the weight is diag(1/scale^2)
STATE = (2000.0, math.radians(6.0), 2000.0, 7500.0)
CONTROL = 0.06
SPACING = 4.0  # s between the times at which gains are delivered and compared
STOP = 10e3  # m
UPPER = np.triu_indices(4)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Reference N1 with constant diagonal weights in its own states.

    Attributes
    ----------
    x0 : ndarray, shape (4,)
        Initial [V gamma h s], SI and radians.
    u : float
        Constant vertical lift ratio.
    density0, height, per_mass, mu, radius : float
        Surface density kg/m3, scale height m, S CD/(2 m) in m2/kg, gravity m3/s2, planet radius m.
    Q, R, Qf : ndarray
        Weights of the unscaled states and of the input.
    """

    x0: Array
    u: float
    density0: float
    height: float
    per_mass: float
    mu: float
    radius: float
    Q: Array
    R: Array
    Qf: Array

    @property
    def scaled_weights(self) -> tuple[Array, float, Array]:
        """(Q, R, Qf) for states divided by SCALE: diagonals (4,), scalar, (4,)."""
        return np.diag(self.Q) * SCALE**2, float(self.R[0, 0]), np.diag(self.Qf) * SCALE**2


def problem(scenario: Scenario | None = None) -> Problem:
    """The default scenario's reference and the benchmark's weights."""
    s = scenario or Scenario.default()
    u = s.vehicle.lift_to_drag * math.cos(math.radians(s.reference.bank_deg))
    x0 = np.array([s.reference.speed_m_s, math.radians(s.reference.path_angle_deg), s.reference.altitude_m, 0.0])
    return Problem(
        x0, u, s.atmosphere.surface_density_kg_m3, s.atmosphere.scale_height_m, 0.5 / s.vehicle.ballistic_coefficient_kg_m2,
        s.planet.gravitational_parameter_m3_s2, s.planet.radius_m,
        np.diag(1 / np.square(STATE)), np.array([[1 / CONTROL**2]]), np.diag(1 / np.square(TERMINAL)),
    )  # fmt: skip


def model_of(scenario: Scenario | None = None) -> models.Model:
    """The workbench's model of the same flight."""
    s = scenario or Scenario.default()
    vehicle = models.from_ratios(
        s.vehicle.name, ballistic_coefficient=s.vehicle.ballistic_coefficient_kg_m2, lift_to_drag=s.vehicle.lift_to_drag
    )  # fmt: skip
    air = models.exponential(surface_density=s.atmosphere.surface_density_kg_m3, scale_height=s.atmosphere.scale_height_m)
    planet = models.Planet(mu=s.planet.gravitational_parameter_m3_s2, radius=s.planet.radius_m)
    return models.entry_planar(vehicle, atmosphere=air, planet=planet)


def flight_rate(p: Problem) -> Rate:
    """z' of the scaled flight alone."""
    u, rho0, height, per_mass, mu, radius = p.u, p.density0, p.height, p.per_mass, p.mu, p.radius
    sV, sg, sh, ss = SCALE.tolist()
    exp, sin, cos = math.exp, math.sin, math.cos

    def rate(_t: float, z: Any) -> list[float]:
        V, gamma, h = z[0] * sV, z[1] * sg, z[2] * sh
        r = radius + h
        g = mu / (r * r)
        drag = per_mass * rho0 * exp(-h / height) * V * V
        sine, cosine = sin(gamma), cos(gamma)
        return [
            (-drag - g * sine) / sV,
            (u * drag / V + (V / r - g / V) * cosine) / sg,
            V * sine / sh,
            radius * V * cosine / r / ss,
        ]

    return rate


def joint_rate(p: Problem) -> Rate:
    """[z, P]' with hand-written Jacobians; P is the upper triangle of S, row by row (10 values).

    No array is made inside: this is the fastest form in the interpreter.  Zeros of A and B are used
    (B has one entry, nothing depends on s).
    """
    u, rho0, height, per_mass, mu, radius = p.u, p.density0, p.height, p.per_mass, p.mu, p.radius
    sV, sg, sh, ss = SCALE.tolist()
    q, r_weight, _ = p.scaled_weights
    q0, q1, q2, q3 = q.tolist()
    exp, sin, cos = math.exp, math.sin, math.cos

    def rate(_t: float, y: Any) -> list[float]:
        z0, z1, z2, _, p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = y.tolist()
        V, gamma, h = z0 * sV, z1 * sg, z2 * sh
        r = radius + h
        g = mu / (r * r)
        per_V = per_mass * rho0 * exp(-h / height) * V  # drag/V
        drag = per_V * V
        sine, cosine = sin(gamma), cos(gamma)
        lift = u * per_V
        balance = V / r - g / V
        ground = radius * cosine / r
        a00, a01, a02 = -2 * per_V, -g * cosine * sg / sV, (drag / height + 2 * g * sine / r) * sh / sV
        a10 = (lift / V + (1 / r + g / (V * V)) * cosine) * sV / sg
        a11 = -balance * sine
        a12 = (-lift / height + (2 * g / V - V / r) / r * cosine) * sh / sg
        a20, a21 = sine * sV / sh, V * cosine * sg / sh
        a30, a31, a32 = ground * sV / ss, -radius * V * sine / r * sg / ss, -ground * V / r * sh / ss
        b = per_V / sg  # the only entry of B
        w = b * b / r_weight
        w1, w2, w3 = w * p11, w * p12, w * p13
        # columns of P A
        c00, c01, c02 = p00 * a00 + p01 * a10 + p02 * a20 + p03 * a30, p00 * a01 + p01 * a11 + p02 * a21 + p03 * a31, \
            p00 * a02 + p01 * a12 + p03 * a32  # fmt: skip
        c10, c11, c12 = p01 * a00 + p11 * a10 + p12 * a20 + p13 * a30, p01 * a01 + p11 * a11 + p12 * a21 + p13 * a31, \
            p01 * a02 + p11 * a12 + p13 * a32  # fmt: skip
        c20, c21, c22 = p02 * a00 + p12 * a10 + p22 * a20 + p23 * a30, p02 * a01 + p12 * a11 + p22 * a21 + p23 * a31, \
            p02 * a02 + p12 * a12 + p23 * a32  # fmt: skip
        c30, c31, c32 = p03 * a00 + p13 * a10 + p23 * a20 + p33 * a30, p03 * a01 + p13 * a11 + p23 * a21 + p33 * a31, \
            p03 * a02 + p13 * a12 + p33 * a32  # fmt: skip
        return [
            (-drag - g * sine) / sV, (lift + balance * cosine) / sg, V * sine / sh, ground * V / ss,
            w * p01 * p01 - 2 * c00 - q0, p01 * w1 - c01 - c10, p01 * w2 - c02 - c20, p01 * w3 - c30,
            p11 * w1 - 2 * c11 - q1, p11 * w2 - c12 - c21, p11 * w3 - c31,
            p12 * w2 - 2 * c22 - q2, p12 * w3 - c32, p13 * w3 - q3,
        ]  # fmt: skip

    return rate


def matrix_rate(p: Problem, jacobian: Callable[[list[float]], Array]) -> Callable[[float, Array], Array]:
    """[z, P]' as it is usually written: Jacobian (4, 5) of [z, u] from a function, Riccati equation in NumPy matrices."""
    q, r_weight, _ = p.scaled_weights
    Q, of_input, u = np.diag(q), input_rate(p), p.u

    def rate(_t: float, y: Array) -> Array:
        zu = [*y[:4].tolist(), u]
        J = jacobian(zu)
        S = np.empty((4, 4))
        S[UPPER] = y[4:]
        S.T[UPPER] = y[4:]
        product, gain = S @ J[:, :4], S @ J[:, 4]
        out = np.empty(14)
        out[:4] = of_input(zu)
        out[4:] = (np.outer(gain, gain) / r_weight - product - product.T - Q)[UPPER]
        return out

    return rate


def hand_jacobian(p: Problem) -> Callable[[list[float]], Array]:
    """Jacobian (4, 5) of the scaled flight by [z, u], differentiated by hand."""
    rho0, height, per_mass, mu, radius = p.density0, p.height, p.per_mass, p.mu, p.radius
    sV, sg, sh, _ = SCALE.tolist()
    ratio = np.append(SCALE, 1.0) / SCALE[:, None]

    def jacobian(zu: list[float]) -> Array:
        V, gamma, h, u = zu[0] * sV, zu[1] * sg, zu[2] * sh, zu[4]
        r = radius + h
        g = mu / (r * r)
        per_V = per_mass * rho0 * math.exp(-h / height) * V
        sine, cosine = math.sin(gamma), math.cos(gamma)
        rows = (
            (-2 * per_V, -g * cosine, per_V * V / height + 2 * g * sine / r, 0.0, 0.0),
            (u * per_V / V + (1 / r + g / (V * V)) * cosine, (g / V - V / r) * sine,
             -u * per_V / height + (2 * g / V - V / r) / r * cosine, 0.0, per_V),
            (sine, V * cosine, 0.0, 0.0, 0.0),
            (radius * cosine / r, -radius * V * sine / r, -radius * V * cosine / (r * r), 0.0, 0.0),
        )  # fmt: skip
        return np.array(rows) * ratio

    return jacobian


def difference_jacobian(p: Problem, *, central: bool) -> Callable[[list[float]], Array]:
    """As :func:`hand_jacobian` by central or one-sided differences of scaled states."""
    rate = input_rate(p)
    step = 6e-6 if central else 1.5e-8
    shifts = [[(i == j) * step for i in range(5)] for j in range(5)]

    def jacobian(zu: list[float]) -> Array:
        plus = [rate([a + d for a, d in zip(zu, shift, strict=True)]) for shift in shifts]
        if central:
            minus = [rate([a - d for a, d in zip(zu, shift, strict=True)]) for shift in shifts]
            return (np.array(plus) - np.array(minus)).T / (2 * step)
        return (np.array(plus) - np.array(rate(zu))).T / step

    return jacobian


def input_rate(p: Problem) -> Callable[[list[float]], list[float]]:
    """z' for [z, u] (5,): the flight with its input as an argument."""
    rho0, height, per_mass, mu, radius = p.density0, p.height, p.per_mass, p.mu, p.radius
    sV, sg, sh, ss = SCALE.tolist()

    def rate(zu: list[float]) -> list[float]:
        V, gamma, h, u = zu[0] * sV, zu[1] * sg, zu[2] * sh, zu[4]
        r = radius + h
        g = mu / (r * r)
        drag = per_mass * rho0 * math.exp(-h / height) * V * V
        sine, cosine = math.sin(gamma), math.cos(gamma)
        return [
            (-drag - g * sine) / sV,
            (u * drag / V + (V / r - g / V) * cosine) / sg,
            V * sine / sh,
            radius * V * cosine / r / ss,
        ]

    return rate


def gain_of(p: Problem, z: Array, S: Array) -> Array:
    """K (N, 4) of the unscaled states, from scaled states (N, 4) and S (N, 10) as upper triangles: R^-1 B^T S."""
    V, h = z[:, 0] * SCALE[0], z[:, 2] * SCALE[2]
    b = p.per_mass * p.density0 * np.exp(-h / p.height) * V / SCALE[1]
    row = S[:, [1, 4, 5, 6]]  # row of gamma
    return np.asarray(b[:, None] * row / p.scaled_weights[1] / SCALE)
