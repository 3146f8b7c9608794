"""A flown trajectory as a frozen value: named columns, values between the nodes, figures, xarray."""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, Status, as_finite, evaluate, frozen, unknown_name
from models.drawing import html_table, new_figure


class SimulationError(ModelError):
    """A flight that did not end as asked; carries ``status`` and the ``trajectory`` up to the last good state."""

    def __init__(self, text: str, status: Status, trajectory: Trajectory) -> None:
        super().__init__(text)
        self.status = status
        self.trajectory = trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """States, inputs and outputs of one flight at its integration nodes.

    Attributes
    ----------
    t : ndarray, shape (N,)
        Time, s, not decreasing; a time stands twice where the input jumps (left and right value).
    x, u, y : ndarray, shapes (N, nx), (N, nu), (N, ny)
    p : ndarray, shape (np,)
    model : Model
    status : Status
    hold : bool
        True when ``u[k]`` is held from ``t[k]`` to ``t[k+1]`` (sampled law), False when it runs linearly between nodes.
    """

    t: Array
    x: Array
    u: Array
    y: Array
    p: Array
    model: Model
    status: Status = Status.OK
    hold: bool = False

    def __post_init__(self) -> None:
        for name in ("t", "x", "u", "y", "p"):
            object.__setattr__(self, name, frozen(as_finite(f"Trajectory: {name}", getattr(self, name))))
        n, model = self.t.shape[0] if self.t.ndim else 0, self.model
        wanted = {
            "t": (n,),
            "x": (n, len(model.states)),
            "u": (n, len(model.inputs)),
            "y": (n, len(model.outputs)),
            "p": (len(model.params),),
        }
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ModelError(f"Trajectory: {name}: expected shape {shape}, got {getattr(self, name).shape}; time axis first")
        if n == 0 or (np.diff(self.t) < 0).any():
            raise ModelError("Trajectory: t must hold at least one node and must not decrease; sort the nodes by time")

    def __getitem__(self, name: str) -> Array:
        """Column of a state, input or output by name, shape (N,); ``"t"`` is the time."""
        if name == "t":
            return self.t
        groups = ((self.model.states, self.x), (self.model.inputs, self.u), (self.model.outputs, self.y))
        for variables, values in groups:
            for i, var in enumerate(variables):
                if var.name == name:
                    return values[:, i]
        raise ModelError(unknown_name("trajectory", name, [v.name for variables, _ in groups for v in variables]))

    def at(self, t: ArrayLike) -> Trajectory:
        """The flight at other times, shape (M,), inside [t[0], t[-1]].

        States by the cubic Hermite polynomial through the nodes and the model's rates (error h^4/384 of the fourth
        derivative), inputs linear or held, outputs recomputed.

        Raises
        ------
        ModelError
            A time outside the flight.
        """
        times = np.atleast_1d(as_finite("at: t", t))
        if times.ndim != 1 or (np.diff(times) < 0).any():
            raise ModelError(f"at: expected times of shape (M,) that do not decrease, got shape {times.shape}; flatten and sort them")
        if times.size == 0 or times.min() < self.t[0] or times.max() > self.t[-1]:
            raise ModelError(f"at: times must lie in [{self.t[0]:.9g}, {self.t[-1]:.9g}] s, got {times!r}")
        if len(self.t) == 1:
            left = np.zeros(len(times), dtype=int)
            x, u = self.x[left], self.u[left]
        else:
            left = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
            # at the very end of a flight that closes with a doubled node, step back to an interval that has a length
            left = np.where(self.t[left + 1] > self.t[left], left, left - 1)
            h = self.t[left + 1] - self.t[left]
            sigma = ((times - self.t[left]) / h)[:, None]
            rate = evaluate(self.model.rhs, self.x, self.u, self.p)[0]
            end_input = self.u[left] if self.hold else self.u[left + 1]
            end_rate = evaluate(self.model.rhs, self.x[left + 1], end_input, self.p)[0]
            x = _hermite(sigma, h[:, None], self.x[left], self.x[left + 1], rate[left], end_rate)
            u = self.u[left] + (0 if self.hold else sigma) * (self.u[left + 1] - self.u[left])
        y = evaluate(self.model.out, x, u, self.p)[0]
        return Trajectory(times, x, u, y, self.p, self.model, self.status, self.hold)

    def to_xarray(self) -> Any:
        """``xarray.Dataset`` with one variable for each state, input and output, units in the attributes."""
        import xarray as xr

        model = self.model
        data = {}
        for variables in (model.states, model.inputs, model.outputs):
            for var in variables:
                data[var.name] = ("t", self[var.name], {"units": var.unit, "long_name": var.text or var.name})
        parameters = {v.name: float(value) for v, value in zip(model.params, self.p, strict=True)}
        return xr.Dataset(data, {"t": ("t", self.t, {"units": "s"})}, {"model": model.name, "status": self.status.name, **parameters})

    def __repr__(self) -> str:
        return f"Trajectory({self.model.name}: {len(self.t)} nodes, {self.t[0]:.6g} to {self.t[-1]:.6g} s, {self.status.name})"

    def _repr_html_(self) -> str:
        rows: list[tuple[str | float, ...]] = []
        for variables, values in ((self.model.states, self.x), (self.model.inputs, self.u), (self.model.outputs, self.y)):
            for i, var in enumerate(variables):
                column = values[:, i]
                rows.append((var.label, column[0], column[-1], column.min(), column.max()))
        title = f"<b>{html.escape(self.model.name)}</b>: {len(self.t)} nodes, {self.t[0]:.6g} to {self.t[-1]:.6g} s, {self.status.name}"
        return f"<div>{title}{html_table(('', 'first', 'last', 'least', 'greatest'), rows)}</div>"

    def plot(self, names: tuple[str, ...] | None = None) -> Any:
        """Small panels of the named columns (default: all states and inputs) against time; a matplotlib Figure."""
        known = {v.name: v for v in (*self.model.states, *self.model.inputs, *self.model.outputs)}
        chosen = names or tuple(v.name for v in (*self.model.states, *self.model.inputs))
        columns = 2 if len(chosen) > 1 else 1
        rows = -(-len(chosen) // columns)
        figure = new_figure(4.2 * columns, 2.0 * rows + 0.4)
        for i, name in enumerate(chosen):
            axes = figure.add_subplot(rows, columns, i + 1)
            values = self[name]
            unit = known[name].unit if name in known else "s"
            if unit == "rad":
                values, unit = np.degrees(values), "deg"
            axes.plot(self.t, values, drawstyle="steps-post" if self.hold and name in {v.name for v in self.model.inputs} else "default")
            axes.set_xlabel("time [s]")
            axes.set_ylabel(f"{known[name].text or name} [{unit}]" if name in known else "t [s]")
            axes.grid(alpha=0.3)
        return figure


def _hermite(sigma: Array, h: Array, x0: Array, x1: Array, v0: Array, v1: Array) -> Array:
    s2, s3 = sigma**2, sigma**3
    return x0 * (1 - 3 * s2 + 2 * s3) + x1 * (3 * s2 - 2 * s3) + h * (v0 * (sigma - 2 * s2 + s3) + v1 * (s3 - s2))
