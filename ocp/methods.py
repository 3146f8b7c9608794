"""Integration methods as values, and the integration of one group of steps as a CasADi function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np
from scipy.integrate import DOP853

from models.core import Model, ModelError, as_scalar


@dataclass(frozen=True, slots=True)
class RK4:
    """Classical fixed-step Runge-Kutta method of order 4; `step` in s is the longest step taken."""

    step: float = 0.5
    order: ClassVar[int] = 4

    def __post_init__(self) -> None:
        _check_step("RK4", self.step)


@dataclass(frozen=True, slots=True)
class RK8:
    """Fixed-step Runge-Kutta method of order 8 (12 stages of Dormand and Prince); `step` in s is the longest step taken."""

    step: float = 0.5
    order: ClassVar[int] = 8

    def __post_init__(self) -> None:
        _check_step("RK8", self.step)


@dataclass(frozen=True, slots=True)
class Adaptive:
    """CVODES with error control on states scaled by ``Var.nominal``; `step` in s is the spacing of the stored nodes."""

    step: float = 5.0
    rtol: float = 1e-11
    atol: float = 1e-13

    def __post_init__(self) -> None:
        _check_step("Adaptive", self.step)
        for name, value in (("rtol", self.rtol), ("atol", self.atol)):
            if not 0 < as_scalar(f"Adaptive: {name}", value) < 1:
                raise ModelError(f"Adaptive: {name} must lie in (0, 1), got {value}")


Method = RK4 | RK8 | Adaptive


def _check_step(name: str, step: float) -> None:
    if as_scalar(f"{name}: step", step) <= 0:
        raise ModelError(f"{name}: step must be finite and > 0 s, got {step}")


Input = Callable[[ca.SX, ca.SX], ca.SX]
Tableau = tuple[np.ndarray, np.ndarray, np.ndarray]


def group_of_steps(model: Model, method: Method, n: int, law_input: tuple[list[ca.SX], Input]) -> ca.Function:
    """Integrate one group of `n` equal steps over a time H.

    Parameters
    ----------
    law_input : (symbols, input)
        Extra symbols of the input, and ``input(sigma, x) -> u`` with sigma in [0, 1] the fraction of the group.

    Returns
    -------
    casadi.Function
        (x, H, p, *symbols) -> (X (nx, n), U (nu, n)): states at the ends of the steps, inputs there.
    """
    symbols, control = law_input
    x, H, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("H"), ca.SX.sym("p", len(model.params))

    def rate(sigma: ca.SX, state: ca.SX) -> ca.SX:
        return model.rhs(state, control(sigma, state), p)

    name, arguments = f"{model.name}_group", [x, H, p, *symbols]
    if isinstance(method, Adaptive):
        return _adaptive_group(model, method, n, name, arguments, rate, control)
    a, b, c = butcher(method)
    columns, inputs, state = [], [], x
    for k in range(n):
        state = runge_kutta(rate, state, H / n, ca.SX(k) / n, 1 / n, (a, b, c))
        columns.append(state)
        inputs.append(control(ca.SX(k + 1) / n, state))
    return ca.Function(name, arguments, [ca.horzcat(*columns), ca.horzcat(*inputs)])


def butcher(method: RK4 | RK8) -> Tableau:
    """Butcher coefficients (a, b, c) of an explicit method."""
    if isinstance(method, RK4):
        a = np.zeros((4, 4))
        a[1, 0] = a[2, 1] = 0.5
        a[3, 2] = 1.0
        return a, np.array([1, 2, 2, 1]) / 6, np.array([0, 0.5, 0.5, 1])
    return DOP853.A, DOP853.B, DOP853.C


def runge_kutta(rate: Callable[[ca.SX, ca.SX], ca.SX], x: ca.SX, h: ca.SX, sigma: ca.SX, d_sigma: float, tableau: Tableau) -> ca.SX:
    """One explicit step x -> x + h sum b_i k_i, k_i = rate(sigma + c_i d_sigma, x + h sum a_ij k_j)."""
    a, b, c = tableau
    stages: list[ca.SX] = []
    for i in range(len(b)):
        point = x
        for j, k in enumerate(stages):
            if a[i, j] != 0:
                point = point + (h * a[i, j]) * k
        stages.append(rate(sigma + c[i] * d_sigma, point))
    for weight, k in zip(b, stages, strict=True):
        if weight != 0:
            x = x + (h * weight) * k
    return x


def _adaptive_group(
    model: Model, method: Adaptive, n: int, name: str, arguments: list[ca.SX], rate: Callable[[ca.SX, ca.SX], ca.SX], control: Input
) -> ca.Function:
    # time runs over sigma in [0, 1] so that H stays an ordinary parameter, and states are scaled: CVODES has one atol for all
    scale = ca.DM([v.nominal for v in model.states])
    z, sigma = ca.SX.sym("z", len(model.states)), ca.SX.sym("sigma")
    parameters = ca.vertcat(*arguments[1:])
    dae = {"x": z, "p": parameters, "t": sigma, "ode": arguments[1] * rate(sigma, z * scale) / scale}
    grid = [k / n for k in range(1, n + 1)]
    options = {"reltol": method.rtol, "abstol": method.atol, "max_num_steps": 100000}
    flow = ca.integrator(f"{name}_cvodes", "cvodes", dae, 0.0, grid, options)
    outer = [ca.MX.sym(f"a{i}", a.numel()) for i, a in enumerate(arguments)]
    result = flow(x0=outer[0] / scale, p=ca.vertcat(*outer[1:]))["xf"]
    states = ca.repmat(ca.MX(scale), 1, n) * result
    u_of = ca.Function(f"{name}_input", [sigma, z, *arguments[1:]], [control(sigma, z)])
    inputs = ca.horzcat(*[u_of(grid[k], states[:, k], *outer[1:]) for k in range(n)])
    return ca.Function(name, outer, [states, inputs])
