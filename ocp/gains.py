"""Feedback gains on time nodes with their certificate: u = u0 - k - K (x - x0)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from models.checked import Array, ModelError, Var, as_finite, frozen
from models.drawing import html_table, new_figure

if TYPE_CHECKING:
    from ocp.laws import Law
    from ocp.sweep_flow import Dense


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """Proof that a gain solves its Riccati equation.

    Attributes
    ----------
    riccati_residual : float
        Algebraic equation: relative residual.  Differential equation: per-interval defect against an independent
        integration at half the step.  Both in the coordinates in which the largest S_ii over time is one.
    min_eig_S : float
        Smallest eigenvalue of S over all nodes in those coordinates; >= 0 up to rounding.
    cond_S : float
        Largest condition number over the nodes of S scaled to unit diagonal; infinite where S is singular.
    spectral_abscissa : float or None
        Time-invariant problems only: largest real part of the closed-loop eigenvalues, 1/s (for a sampled loop the
        logarithm of the largest magnitude, per step).  None for time-varying gains: a frozen loop may be unstable
        and the gain right.
    local_residual : float or None
        Differential equation: largest defect of an interval in the coordinates in which S at its begin has unit diagonal
        (None elsewhere), so that it sees a small S after a heavy terminal weight too.  It bounds K: a change of S_ij by
        e sqrt(S_ii S_jj) changes K_aj by at most e sum_i |R^-1 B^T|_ai sqrt(S_ii S_jj), and the Riccati equation never
        enlarges a relative error of S on its way back, so that e at a node is at most the sum of these defects over the
        later steps (times the condition number of S scaled to unit diagonal, in the worst direction).
    """

    riccati_residual: float
    min_eig_S: float
    cond_S: float
    spectral_abscissa: float | None = None
    local_residual: float | None = None


UNCERTIFIED = Certificate(np.inf, -np.inf, np.inf)  # nothing is proven


@dataclass(frozen=True, slots=True, eq=False)
class GainSample:
    """Gains at chosen times: t (M,), K (M, nu, nx), k (M, nu), x0 (M, nx), u0 (M, nu)."""

    t: Array
    K: Array
    k: Array
    x0: Array
    u0: Array


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Feedback law u = u0 - k - K (x - x0) on time nodes.

    Attributes
    ----------
    t : ndarray, shape (N,)
        Node times, s; N = 1 for time-invariant gains.  A time stored twice is a jump.
    K : ndarray, shape (N, nu, nx)
        Feedback gain, unit of the input over unit of the state.
    k : ndarray, shape (N, nu)
        Feedforward from the defect of the reference; zero if the reference flies by itself.
    S : ndarray, shape (N, nx, nx)
        Riccati solution; the cost to go is (x - x0)^T S (x - x0).
    x0, u0 : ndarray, shapes (N, nx), (N, nu)
        Reference.
    certificate : Certificate
        ``UNCERTIFIED`` only where the caller asked for gains without proof.
    states, inputs : tuple of Var
        Names, units and scales; empty for plain matrices.
    dense : Dense, optional
        K and k between the nodes, from the sweep that made them.  Leave it out with gains of another origin; it is dropped
        where t, K or k are not those of the sweep.
    """

    t: Array
    K: Array
    k: Array
    S: Array
    x0: Array
    u0: Array
    certificate: Certificate
    states: tuple[Var, ...] = ()
    inputs: tuple[Var, ...] = ()
    dense: Dense | None = None

    def __post_init__(self) -> None:
        for name in ("t", "K", "k", "S", "x0", "u0"):
            object.__setattr__(self, name, frozen(as_finite(f"Gains: {name}", getattr(self, name))))
        if self.t.ndim != 1 or len(self.t) == 0 or self.K.ndim != 3:
            raise ModelError(f"Gains: expected t (N,) and K (N, nu, nx) with N >= 1, got {self.t.shape} and {self.K.shape}")
        if (np.diff(self.t) < 0).any():
            raise ModelError("Gains: t must not decrease; sort the nodes by time")
        n, (nu, nx) = len(self.t), self.K.shape[1:]
        wanted = {"K": (n, nu, nx), "k": (n, nu), "S": (n, nx, nx), "x0": (n, nx), "u0": (n, nu)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ModelError(f"Gains: {name}: expected shape {shape}, got {getattr(self, name).shape}; time axis first")
        for name, size in (("states", nx), ("inputs", nu)):
            if len(getattr(self, name)) not in (0, size):
                raise ModelError(f"Gains: {name}: expected {size} variables or none, got {len(getattr(self, name))}")
        if self.dense is not None and not self.dense.made(self.t, self.K, self.k):
            object.__setattr__(self, "dense", None)

    def at(self, t: ArrayLike) -> GainSample:
        """Gains and reference at any times.

        Parameters
        ----------
        t : array_like, shape (M,) or scalar
            Times, s.

        Returns
        -------
        GainSample
            K and k of :func:`ocp.tvlqr` from its sweep, as accurate between the nodes as on them; everything else by a cubic
            spline over each smooth stretch.  At a jump the value after it; before the first and after the last node
            the first and last value.

        Raises
        ------
        ModelError
            `t` is not finite or has more than one axis.
        """
        times = np.atleast_1d(as_finite("t", t))
        if times.ndim != 1:
            raise ModelError(f"t: expected shape (M,), got {times.shape}")
        n, (nu, nx) = len(self.t), self.K.shape[1:]
        if self.dense is not None:
            x0, u0 = np.split(_interpolate(self.t, np.hstack([self.x0, self.u0]), times), [nx], axis=1)
            K, k = self.dense.at(np.clip(times, self.t[0], self.t[-1]))
        else:
            table = np.hstack([self.K.reshape(n, -1), self.k, self.x0, self.u0])
            K, k, x0, u0 = np.split(_interpolate(self.t, table, times), np.cumsum([nu * nx, nu, nx]), axis=1)
        return GainSample(*(frozen(v) for v in (times, K.reshape(-1, nu, nx), k, x0, u0)))

    def law(self, *, sample: float | None = None, limits: tuple[ArrayLike, ArrayLike] | None = None) -> Law:
        """The sampled law u = u0(t) - k(t) - K(t) (x - x0(t)) for ``ocp.simulate``.

        Parameters
        ----------
        sample : float, optional
            Time between commands, s; default the first interval of the nodes.  Must be given for time-invariant gains.
        limits : (low, high), optional
            Bounds on u, scalars or shape (nu,).

        Raises
        ------
        ModelError
            No period can be derived, or low > high.
        """
        from ocp.laws import sampled  # the laws know the simulator's model types; the gains do not need them

        steps = np.diff(self.t)
        if sample is None and not (steps > 0).any():
            raise ModelError("law: time-invariant gains have no period of their own; give sample= in seconds")
        period = float(steps[steps > 0][0]) if sample is None else sample
        nu, nx = self.K.shape[1:]
        low, high = (np.full(nu, -np.inf), np.full(nu, np.inf)) if limits is None else (
            np.broadcast_to(as_finite(f"limits: {n}", v), (nu,)) for n, v in zip(("low", "high"), limits, strict=True)
        )  # fmt: skip
        if (low > high).any():
            raise ModelError(f"limits: low {low} exceeds high {high}; exchange them")

        def signals(start: Array, _end: Array) -> Array:
            now = self.at(start)
            return np.hstack([now.u0 - now.k, now.x0, now.K.reshape(len(start), -1)])

        def step(_t: ca.SX, x: ca.SX, _y: ca.SX, z: ca.SX, w: ca.SX) -> tuple[ca.SX, ca.SX]:
            gain = ca.reshape(w[nu + nx :], nx, nu).T
            u = w[:nu] - ca.mtimes(gain, x - w[nu : nu + nx])
            return ca.fmin(ca.fmax(u, ca.DM(low)), ca.DM(high)), z

        return sampled(step, sample=period, signals=signals, n_signals=nu + nx + nu * nx, name="gains")

    def _labels(self) -> tuple[list[str], list[str]]:
        nu, nx = self.K.shape[1:]
        rows = [f"{v.name} [{v.unit}]" for v in self.inputs] or [f"u{i + 1}" for i in range(nu)]
        columns = [f"{v.name} [{v.unit}]" for v in self.states] or [f"x{i + 1}" for i in range(nx)]
        return rows, columns

    def __repr__(self) -> str:
        span = "time-invariant" if len(self.t) == 1 else f"{len(self.t)} nodes, {self.t[0]:.6g} to {self.t[-1]:.6g} s"
        return f"Gains(K {self.K.shape[1:]}, {span}, {self.certificate})"

    def _repr_html_(self) -> str:
        rows, columns = self._labels()
        c = self.certificate
        span = "time-invariant" if len(self.t) == 1 else f"{len(self.t)} nodes, {self.t[0]:.6g} to {self.t[-1]:.6g} s"
        facts = f"Riccati residual {c.riccati_residual:.2g}, smallest scaled eigenvalue of S {c.min_eig_S:.2g}, condition {c.cond_S:.2g}"
        if c.spectral_abscissa is not None:
            facts += f", spectral abscissa {c.spectral_abscissa:.4g}"
        head = ("input", "state", *(("K",) if len(self.t) == 1 else ("first", "mean", "last")))
        body: list[tuple[str | float, ...]] = []
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                values = self.K[:, i, j]
                shown = [values[0]] if len(self.t) == 1 else [values[0], self._mean(values), values[-1]]
                body.append((row, column, *shown))
        return f"<div><b>Gains</b> u = u0 - k - K (x - x0), {span}<br><small>{facts}</small>{html_table(head, body)}</div>"

    def _mean(self, values: Array) -> float:
        duration = self.t[-1] - self.t[0]
        return float(np.trapezoid(values, self.t) / duration) if duration > 0 else float(values.mean())

    def plot(self) -> Any:
        """One small panel for each K_ij against time, with units.  Returns a matplotlib Figure."""
        nu, nx = self.K.shape[1:]
        figure = new_figure(2.6 * nx + 0.4, 2.1 * nu + 0.5)
        axes = figure.subplots(nu, nx, sharex=True, squeeze=False)
        for i in range(nu):
            for j in range(nx):
                panel = axes[i, j]
                style = {"marker": "o", "linestyle": "none"} if len(self.t) == 1 else {"linewidth": 1.2}
                panel.plot(self.t, self.K[:, i, j], color="C0", **style)
                panel.set_title(self._panel_title(i, j), fontsize=9)
                panel.ticklabel_format(axis="y", scilimits=(-2, 3))
                panel.tick_params(labelsize=8)
                panel.grid(True, linewidth=0.4, alpha=0.5)
        for panel in axes[-1]:
            panel.set_xlabel("t [s]", fontsize=9)
        return figure

    def _panel_title(self, i: int, j: int) -> str:
        if not (self.states and self.inputs):
            return f"K[{i}, {j}]"
        state, control = self.states[j], self.inputs[i]
        if state.unit == control.unit:
            unit = "1"
        elif state.unit == "1":
            unit = control.unit
        else:
            unit = f"{control.unit}/({state.unit})" if "/" in state.unit else f"{control.unit}/{state.unit}"
        return f"{control.name} per {state.name} [{unit}]"


def _interpolate(nodes: Array, table: Array, times: Array) -> Array:
    """Rows of `table` (N, columns) at `times` (M,); stretches end where a node time is stored twice."""
    out = np.empty((len(times), table.shape[1]))
    held = np.clip(times, nodes[0], nodes[-1])
    edges = np.flatnonzero(np.diff(nodes) == 0) + 1
    starts, ends = np.concatenate([[0], edges]), np.concatenate([edges, [len(nodes)]])
    stretch = np.searchsorted(nodes[starts[1:]], held, side="right")
    for index in np.unique(stretch):
        first, last, inside = starts[index], ends[index], stretch == index
        if last - first == 1:
            out[inside] = table[first]
        else:
            out[inside] = CubicSpline(nodes[first:last], table[first:last])(held[inside])
    return out
