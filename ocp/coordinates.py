"""Linear systems in the coordinates of measured outputs: the map M = dy/dx, its rate, and what it does to A and B."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from models.core import Array, Model, ModelError, Var, evaluate, frozen, unknown_name
from ocp.linearize import Linearization
from ocp.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """The map from states to as many measured quantities along a trajectory: dy = M dx.

    Attributes
    ----------
    variables : tuple of Var, length n
    t : ndarray, shape (N,)
    y0 : ndarray, shape (N, n)
        Values on the reference.
    M, Mdot : ndarray, shape (N, n, n)
        Jacobian, and its total time derivative along the reference, 1/s.
    condition : ndarray, shape (N,)
        Condition number of M with rows and columns scaled by the nominal values.
    """

    variables: tuple[Var, ...]
    t: Array
    y0: Array
    M: Array
    Mdot: Array
    condition: Array

    def __post_init__(self) -> None:
        for name in ("t", "y0", "M", "Mdot", "condition"):
            object.__setattr__(self, name, frozen(getattr(self, name)))


@lru_cache(maxsize=32)
def map_function(model: Model, names: tuple[str, ...]) -> ca.Function:
    """(x, u, p) -> (y, M, Mdot) of the named states and outputs."""
    x, u, p = (ca.SX.sym(n, model.rhs.size1_in(i)) for i, n in enumerate("xup"))
    y, states = model.out(x, u, p), [v.name for v in model.states]
    outputs = [v.name for v in model.outputs]
    for name in names:
        if name not in states + outputs:
            raise ModelError(unknown_name("coordinates", name, states + outputs))
    chosen = ca.vertcat(*[x[states.index(n)] if n in states else y[outputs.index(n)] for n in names])
    by_input = ca.jacobian(chosen, u)
    if by_input.nnz() and not by_input.is_zero():
        raise ModelError(f"coordinates {names}: a quantity depends on the input; choose quantities that follow from the state alone")
    m = ca.densify(ca.jacobian(chosen, x))
    # total derivative along the flight: every element of M moves with x at the rate f(x, u, p)
    m_rate = ca.reshape(ca.jtimes(ca.vec(m), x, model.rhs(x, u, p)), m.shape)
    return ca.Function(f"{model.name}_coordinates", [x, u, p], [chosen, m, ca.densify(m_rate)], ["x", "u", "p"], ["y", "M", "Mdot"])


def coordinates(trajectory: Trajectory, names: Sequence[str]) -> Coordinates:
    """Map from the states of a trajectory's model to the named states and outputs (one name for each state).

    Raises
    ------
    ModelError
        Unknown names, a number of names other than nx, a quantity that depends on the input, or a map that is singular
        at a node (SINGULAR: two of the quantities move together there).
    """
    model = trajectory.model
    if len(names) != len(model.states):
        raise ModelError(f"coordinates: expected {len(model.states)} names, one for each state, got {len(names)}: {tuple(names)}")
    y, m, m_rate = evaluate(map_function(model, tuple(names)), trajectory.x, trajectory.u, trajectory.p)
    known = {v.name: v for v in (*model.outputs, *model.states)}
    variables = tuple(known[n] for n in names)
    scale_y, scale_x = np.array([v.nominal for v in variables]), np.array([v.nominal for v in model.states])
    condition = np.linalg.cond(m * scale_x / scale_y[:, None])
    if not np.isfinite(condition).all() or condition.max() > 1e14:
        at = trajectory.t[int(np.argmax(np.nan_to_num(condition, nan=np.inf)))]
        raise ModelError(f"coordinates {tuple(names)}: SINGULAR at t = {at:.6g} s: the quantities do not determine the state; start later")
    return Coordinates(variables, trajectory.t, y, m, m_rate, condition)


def transform(lin: Linearization, to: Coordinates) -> Linearization:
    """The linearization for X = M dx:  X' = (Mdot + M A) M^-1 X + M B du + M c.

    Raises
    ------
    ModelError
        The two are not on the same nodes.
    """
    if lin.t.shape != to.t.shape or (lin.t != to.t).any():
        raise ModelError(f"transform: linearization with {len(lin.t)} nodes and coordinates with {len(to.t)} are not on the same times")
    inverse = np.linalg.inv(to.M)
    return Linearization(
        lin.t, to.y0, lin.u0, (to.Mdot + to.M @ lin.A) @ inverse, to.M @ lin.B, lin.C @ inverse, lin.D,
        np.einsum("nij,nj->ni", to.M, lin.c), None, to.variables, lin.inputs,
    )  # fmt: skip
