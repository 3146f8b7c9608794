"""The benchmark problem in Drake: a symbolic vector system and FiniteHorizonLinearQuadraticRegulator."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks._entry import SCALE, Array, Problem, flight_rate


def system(p: Problem) -> Any:
    """The scaled flight as a SymbolicVectorSystem: no Python runs while Drake integrates or differentiates it."""
    from pydrake.symbolic import Variable, cos, exp, sin
    from pydrake.systems.primitives import SymbolicVectorSystem

    z, u = [Variable(name) for name in ("V", "gamma", "h", "s")], Variable("u")
    V, gamma, h = (symbol * float(scale) for symbol, scale in zip(z[:3], SCALE, strict=False))
    r = p.radius + h
    g = p.mu / (r * r)
    drag = p.per_mass * p.density0 * exp(-h / p.height) * V * V
    rate = [
        (-drag - g * sin(gamma)) / SCALE[0],
        (u * drag / V + (V / r - g / V) * cos(gamma)) / SCALE[1],
        V * sin(gamma) / SCALE[2],
        p.radius * V * cos(gamma) / r / SCALE[3],
    ]
    return SymbolicVectorSystem(state=z, input=[u], dynamics=rate, output=z)


def nominal(p: Problem, t: Array, z: Array) -> tuple[Any, Any]:
    """Reference as Drake trajectories: cubic Hermite through nodes t (N,), z (N, 4), and the constant input."""
    from pydrake.trajectories import PiecewisePolynomial

    rate = flight_rate(p)
    slopes = np.array([rate(0.0, row) for row in z])
    x0 = PiecewisePolynomial.CubicHermite(t, z.T, slopes.T)
    return x0, PiecewisePolynomial.ZeroOrderHold([0.0, float(t[-1])], [[p.u, p.u]])


def gains(
    p: Problem, plant: Any, reference: tuple[Any, Any], times: Array, *, integrator: str, accuracy: float, max_step: float
) -> tuple[Array, Array]:
    """(times, K (N, 4)) of the unscaled states at `times`; the reference is given."""
    from pydrake.systems.analysis import SimulatorConfig
    from pydrake.systems.controllers import FiniteHorizonLinearQuadraticRegulator, FiniteHorizonLinearQuadraticRegulatorOptions

    q, r, qf = p.scaled_weights
    options: Any = FiniteHorizonLinearQuadraticRegulatorOptions()
    options.x0, options.u0 = reference
    options.Qf = np.diag(qf)
    options.simulator_config = SimulatorConfig(
        integration_scheme=integrator, max_step_size=max_step, accuracy=accuracy, use_error_control=True
    )
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, [p.u])
    result = FiniteHorizonLinearQuadraticRegulator(plant, context, 0.0, float(times[-1]), np.diag(q), np.array([[r]]), options)
    return times, np.array([result.K.value(float(t))[0] for t in times]) / SCALE
