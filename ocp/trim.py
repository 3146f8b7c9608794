"""Operating points: the states and inputs for which chosen rates vanish."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, Status, as_finite, as_vector, evaluate, frozen, unknown_name
from ocp.linearize import jacobians


@dataclass(frozen=True, slots=True, eq=False)
class OperatingPoint:
    """A trim solution.

    Attributes
    ----------
    x, u, p : ndarray, shapes (nx,), (nu,), (np,)
    residual : float
        Largest |rate - target| over the scale of the rate (``Var.nominal`` of its state per second).
    iterations : int
    status : Status
    """

    x: Array
    u: Array
    p: Array
    residual: float
    iterations: int
    status: Status


def trim(
    model: Model,
    *,
    x: ArrayLike,
    u: ArrayLike,
    free: Sequence[str],
    rates: Mapping[str, float] | Sequence[str],
    p: Mapping[str, float] | ArrayLike | None = None,
    tolerance: float = 1e-11,
    throw: bool = True,
) -> OperatingPoint:
    """Find the values of the `free` states and inputs at which the named rates take their targets.

    Damped Newton iteration on the exact Jacobian; a non-square problem is solved in the least-squares, least-change sense.

    Parameters
    ----------
    x, u : array_like, shapes (nx,), (nu,)
        The given values, and the guesses of the free ones; SI and radians.
    free : sequence of str
        Names of states and inputs that may move.
    rates : sequence of str, or mapping of str to float
        States whose derivative must vanish, or must equal the target, 1/s times the unit of the state.
    tolerance : float
        On the scaled residual.
    throw : bool
        Raise when the tolerance is not met, otherwise return the point with its status.

    Raises
    ------
    ModelError
        Unknown names, nothing to solve, a Jacobian without rank (SINGULAR), a least residual that is not zero
        (INFEASIBLE), no convergence (MAX_ITERATIONS), a solution outside ``Var.valid`` (OUT_OF_DOMAIN).
    """
    targets = dict(rates) if isinstance(rates, Mapping) else dict.fromkeys(rates, 0.0)
    states, inputs = [v.name for v in model.states], [v.name for v in model.inputs]
    for name in targets:
        if name not in states:
            raise ModelError(unknown_name("trim: rates", name, states))
    for name in free:
        if name not in states + inputs:
            raise ModelError(unknown_name("trim: free", name, states + inputs))
    if not targets or not free or len(set(free)) < len(free):
        raise ModelError(
            f"trim: give at least one rate to meet and one free state or input, each once; got {list(targets)} and {list(free)}"
        )
    rows = [states.index(n) for n in targets]
    columns = [(states + inputs).index(n) for n in free]
    goal = as_finite("trim: rates", list(targets.values()))
    scale_f = np.array([model.states[i].nominal for i in rows])
    scale_z = np.array([(model.states + model.inputs)[i].nominal for i in columns])
    params = as_vector("p", model.parameters(p), model.params)
    z = np.concatenate([as_vector("x", x, model.states), as_vector("u", u, model.inputs)])

    def residual(point: Array) -> tuple[Array, Array]:
        f, A, B, _, _ = evaluate(jacobians(model), point[: len(states)], point[len(states) :], params)
        full = np.hstack([A.reshape(len(states), -1), B.reshape(len(states), -1)])
        return (f[rows] - goal) / scale_f, full[np.ix_(rows, columns)] * scale_z / scale_f[:, None]

    z, f, iterations, status = _newton(residual, z, columns, scale_z, tolerance)
    if status.ok and _outside(model, z):
        status = Status.OUT_OF_DOMAIN
    point = OperatingPoint(frozen(z[: len(states)]), frozen(z[len(states) :]), frozen(params), float(np.abs(f).max()), iterations, status)
    if throw and not status.ok:
        worst = list(targets)[int(np.abs(f).argmax())]
        raise ModelError(
            f"trim: {status.name}: worst rate d{worst}/dt with scaled residual {point.residual:.3g} (allowed {tolerance:g})"
            f" after {iterations} iterations{_outside(model, z)}. {status.value}"
        )
    return point


def _newton(
    residual: Callable[[Array], tuple[Array, Array]], z: Array, columns: list[int], scale_z: Array, tolerance: float
) -> tuple[Array, Array, int, Status]:
    """Damped Gauss-Newton iteration from z: the last point, its scaled residual, the number of steps, the status."""
    f, jacobian = residual(z)
    steepest = np.linalg.norm(jacobian)
    for iteration in range(60):
        if np.abs(f).max() <= tolerance:
            return z, f, iteration, Status.OK
        step, _, rank, _ = np.linalg.lstsq(jacobian, -f, rcond=1e-13)
        if rank < min(jacobian.shape):
            return z, f, iteration, Status.SINGULAR
        for damping in 0.5 ** np.arange(40):
            trial = z.copy()
            trial[columns] += damping * step * scale_z
            try:
                f_trial, j_trial = residual(trial)
            except ModelError:  # the step left the domain of the model
                continue
            if np.linalg.norm(f_trial) < np.linalg.norm(f):
                z, f, jacobian = trial, f_trial, j_trial
                break
        else:
            break
        steepest = max(steepest, np.linalg.norm(jacobian))
    if np.abs(f).max() <= tolerance:
        return z, f, iteration + 1, Status.OK
    # the residual can fall no further where its slope, compared with the steepest seen, has vanished
    slope = np.linalg.norm(jacobian.T @ f) / (steepest * np.linalg.norm(f))
    return z, f, iteration + 1, Status.INFEASIBLE if slope < 1e-4 else Status.MAX_ITERATIONS


def _outside(model: Model, z: Array) -> str:
    for var, value in zip(model.states + model.inputs, z, strict=True):
        if not var.valid[0] <= value <= var.valid[1]:
            return f"; {var.name} = {value:.6g} lies outside [{var.valid[0]:.6g}, {var.valid[1]:.6g}]"
    return ""
