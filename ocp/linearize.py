"""Exact linearization of a model at a point or along a trajectory, from the symbolic Jacobians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, Var, as_batch, as_finite, evaluate, frozen
from ocp.trajectory import Trajectory

FIELDS = ("t", "x0", "u0", "A", "B", "C", "D", "c")


@dataclass(frozen=True, slots=True, eq=False)
class Linearization:
    """Deviations dx' = A dx + B du + c, dy = C dx + D du about (x0, u0); a point is N = 1.

    Attributes
    ----------
    t : ndarray, shape (N,)
        Time of each node, s.
    x0, u0 : ndarray, shapes (N, nx), (N, nu)
    A, B, C, D : ndarray, shapes (N, nx, nx), (N, nx, nu), (N, ny, nx), (N, ny, nu)
    c : ndarray, shape (N, nx)
        Defect f(x0, u0) - x0dot: zero along a flight and at an equilibrium.
    model : Model or None
        None for plain matrices and for transformed coordinates.
    states, inputs : tuple of Var
        Names and scales; those of the model where there is one, empty for plain matrices.
    """

    t: Array
    x0: Array
    u0: Array
    A: Array
    B: Array
    C: Array
    D: Array
    c: Array
    model: Model | None = None
    states: tuple[Var, ...] = ()
    inputs: tuple[Var, ...] = ()

    def __post_init__(self) -> None:
        if self.model is not None:
            object.__setattr__(self, "states", self.model.states)
            object.__setattr__(self, "inputs", self.model.inputs)
        for name in FIELDS:
            object.__setattr__(self, name, frozen(as_finite(f"Linearization: {name}", getattr(self, name))))
        n, nx, nu, ny = len(self.t), *self.x0.shape[-1:], *self.u0.shape[-1:], self.C.shape[1]
        wanted = {
            "t": (n,), "x0": (n, nx), "u0": (n, nu), "A": (n, nx, nx), "B": (n, nx, nu),
            "C": (n, ny, nx), "D": (n, ny, nu), "c": (n, nx),
        }  # fmt: skip
        if n == 0:
            raise ModelError("Linearization: t is empty; give at least one node")
        for name, shape in wanted.items():
            found = getattr(self, name).shape
            if found != shape:
                raise ModelError(f"Linearization: {name}: expected shape {shape}, got {found}; node axis first")
        if (np.diff(self.t) < 0).any():
            raise ModelError("Linearization: t must not decrease; sort the nodes by time")

    def __repr__(self) -> str:
        n, nx, nu = self.B.shape
        where = f"{n} nodes, {self.t[0]:.6g} to {self.t[-1]:.6g} s" if n > 1 else "a point"
        return f"Linearization({nx} states, {nu} inputs, {self.C.shape[1]} outputs, {where})"

    @staticmethod
    def from_matrices(A: ArrayLike, B: ArrayLike, *, C: ArrayLike | None = None, D: ArrayLike | None = None) -> Linearization:
        """A time-invariant linear system as a point linearization about the origin (C = identity when absent)."""
        a = np.atleast_2d(as_finite("A", A))
        b = np.atleast_2d(as_finite("B", B))
        if a.shape[0] != a.shape[1]:
            raise ModelError(f"A: expected a square matrix, got shape {a.shape}")
        if b.shape[0] != a.shape[0]:
            raise ModelError(f"B: expected {a.shape[0]} rows as in A, got shape {b.shape}")
        cm = np.eye(len(a)) if C is None else np.atleast_2d(as_finite("C", C))
        dm = np.zeros((len(cm), b.shape[1])) if D is None else np.atleast_2d(as_finite("D", D))
        zeros = np.zeros((1, len(a)))
        return Linearization(np.zeros(1), zeros, np.zeros((1, b.shape[1])), a[None], b[None], cm[None], dm[None], zeros)

    def to_control(self, node: int = 0) -> Any:
        """``control.StateSpace`` of one node (python-control, optional)."""
        try:
            import control
        except ImportError:
            raise ModelError("to_control: the package 'control' is not installed; pip install control") from None
        names: dict[str, Any] = {}
        if self.model is not None:
            names = {
                "states": [v.name for v in self.model.states],
                "inputs": [v.name for v in self.model.inputs],
                "outputs": [v.name for v in self.model.outputs],
            }
        return control.ss(self.A[node], self.B[node], self.C[node], self.D[node], **names)


@lru_cache(maxsize=64)
def jacobians(model: Model) -> ca.Function:
    """(x, u, p) -> (f, A, B, C, D): right-hand side and dense exact Jacobians."""
    x, u, p = (ca.SX.sym(n, model.rhs.size1_in(i)) for i, n in enumerate("xup"))
    f, y = model.rhs(x, u, p), model.out(x, u, p)
    matrices = [ca.densify(ca.jacobian(e, v)) for e in (f, y) for v in (x, u)]
    return ca.Function(f"{model.name}_jacobians", [x, u, p], [f, *matrices], ["x", "u", "p"], ["f", "A", "B", "C", "D"])


def linearize(
    what: Model | Trajectory,
    *,
    x: ArrayLike | None = None,
    u: ArrayLike | None = None,
    p: Mapping[str, float] | ArrayLike | None = None,
    xdot: ArrayLike | None = None,
) -> Linearization:
    """Linearize a model at a point, or along a trajectory at all its nodes.

    Parameters
    ----------
    what : Model or Trajectory
        With a Model give `x` (nx,), `u` (nu,) and, if not the defaults, `p`; with a Trajectory give none of them.
    xdot : array_like, shape (nx,) or (N, nx), optional
        Rate of the reference itself.  Default: zero at a point (so that ``c`` is its imbalance), the model's own
        rate along a trajectory (so that ``c`` is zero).

    Returns
    -------
    Linearization

    Raises
    ------
    ModelError
        Missing or superfluous arguments, wrong shapes, a trajectory flown with a sampled law (its input jumps at every
        sample, so that a continuous linearization has no midpoint), a Jacobian that is not finite.
    """
    if isinstance(what, Trajectory):
        if any(v is not None for v in (x, u, p)):
            raise ModelError("linearize: x, u and p come from the trajectory; give none of them")
        if what.hold:
            raise ModelError(
                "linearize: this trajectory was flown with a sampled law; fly the reference with a continuous law,"
                " or linearize single points of it"
            )
        model, t, xs, us, ps = what.model, what.t, what.x, what.u, what.p
    else:
        if x is None or u is None:
            raise ModelError("linearize: a model needs the point: give x and u")
        model = what
        xs = np.atleast_2d(as_batch("x", x, model.states))
        us = np.atleast_2d(as_batch("u", u, model.inputs))
        t, ps = np.zeros(len(xs)), model.parameters(p)
    # Optimal-control formulas integrate these nodes: the flight may have left Var.valid, which guards user input only.
    f, A, B, C, D = evaluate(jacobians(model), xs, us, ps)
    n, nx, nu, ny = len(t), xs.shape[1], us.shape[1], len(model.outputs)  # single columns come back without their axis
    A, B, C, D = A.reshape(n, nx, nx), B.reshape(n, nx, nu), C.reshape(n, ny, nx), D.reshape(n, ny, nu)
    if xdot is None:
        defect = np.zeros_like(f) if isinstance(what, Trajectory) else f
    else:
        rate = as_finite("xdot", xdot)
        if rate.shape not in (f.shape, f.shape[1:]):
            raise ModelError(f"linearize: xdot: expected shape {f.shape}, got {rate.shape}; one rate for each node")
        defect = f - rate
    return Linearization(t, xs, us, A, B, C, D, defect, model)
