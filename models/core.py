"""Symbolic models as frozen values: states, inputs, parameters and outputs by name, equations as CasADi functions."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import (
    Array,
    ModelError,
    Status,
    Var,
    as_batch,
    as_finite,
    as_scalar,
    as_vector,
    evaluate,
    frozen,
    unknown_name,
)
from models.drawing import html_table, new_figure

__all__ = [
    "Array",
    "Model",
    "ModelError",
    "Status",
    "Var",
    "as_batch",
    "as_finite",
    "as_scalar",
    "as_vector",
    "define",
    "evaluate",
    "frozen",
    "unknown_name",
]


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A continuous-time model xdot = rhs(x, u, p), y = out(x, u, p) as a frozen value.

    Attributes
    ----------
    name : str
    states, inputs, params, outputs : tuple of Var
    rhs : casadi.Function
        (x (nx,), u (nu,), p (np,)) -> xdot (nx,).
    out : casadi.Function
        (x, u, p) -> y (ny,).
    p0 : ndarray, shape (np,)
        Default parameters.
    source : str
        Where the equations come from.
    """

    name: str
    states: tuple[Var, ...]
    inputs: tuple[Var, ...]
    params: tuple[Var, ...]
    outputs: tuple[Var, ...]
    rhs: ca.Function
    out: ca.Function
    p0: Array
    source: str = ""

    def __post_init__(self) -> None:
        groups = {"states": self.states, "inputs": self.inputs, "params": self.params, "outputs": self.outputs}
        for group, variables in groups.items():
            names = [v.name for v in variables]
            twice = sorted({n for n in names if names.count(n) > 1})
            if twice:
                raise ModelError(f"{self.name}: {group}: name {twice[0]!r} is declared twice; names must be unique")
        if not self.states:
            raise ModelError(f"{self.name}: a model needs at least one state")
        owner: dict[str, str] = {}
        for group, variables in groups.items():
            for var in variables:
                if owner.setdefault(var.name, group) != group:
                    raise ModelError(f"{self.name}: {var.name!r} names one of {owner[var.name]} and one of {group}; rename one of them")
        wanted = (len(self.states), len(self.inputs), len(self.params))
        for function, n_out in ((self.rhs, len(self.states)), (self.out, len(self.outputs))):
            found = tuple(function.size1_in(i) for i in range(function.n_in()))
            if found != wanted or any(function.size2_in(i) > 1 for i in range(3)):
                raise ModelError(f"{self.name}: {function.name()} takes inputs of sizes {found}, declared are (x, u, p) = {wanted} columns")
            if function.n_out() != 1 or function.size1_out(0) != n_out or function.size2_out(0) > 1:
                shapes = [function.size_out(i) for i in range(function.n_out())]
                raise ModelError(f"{self.name}: {function.name()} returns {shapes}, declared is one column of {n_out} values")
        object.__setattr__(self, "p0", frozen(as_vector("p0", self.p0, self.params)))

    def index(self, name: str) -> int:
        """Position of a state, input, parameter or output in its own vector."""
        for variables in (self.states, self.inputs, self.outputs, self.params):
            for i, var in enumerate(variables):
                if var.name == name:
                    return i
        known = [v.name for group in (self.states, self.inputs, self.outputs, self.params) for v in group]
        raise ModelError(unknown_name(self.name, name, known))

    def parameters(self, changes: Mapping[str, float] | ArrayLike | None = None) -> Array:
        """Checked parameter vector: defaults, with `changes` by name, or a full vector (np,), or a batch (N, np)."""
        if changes is None:
            return self.p0
        if not isinstance(changes, Mapping):
            return as_batch("p", changes, self.params)
        p = self.p0.copy()
        names = [v.name for v in self.params]
        for name, value in changes.items():
            if name not in names:
                raise ModelError(unknown_name(f"{self.name}: p", name, names))
            p[names.index(name)] = as_scalar(f"p: {name}", value)
        return as_vector("p", p, self.params)

    def state(self, **values: float) -> Array:
        """State vector from names; every state must be given."""
        names = [v.name for v in self.states]
        for name in values:
            if name not in names:
                raise ModelError(unknown_name(f"{self.name}: state", name, names))
        missing = [n for n in names if n not in values]
        if missing:
            raise ModelError(f"{self.name}: state: missing {', '.join(missing)}; give every one of {' '.join(names)}")
        return as_vector("x", [as_scalar(f"state: {n}", values[n]) for n in names], self.states)

    def with_params(self, **changes: float) -> Model:
        """The same model with other default parameters."""
        return replace(self, p0=self.parameters(changes))

    def xdot(self, x: ArrayLike, u: ArrayLike, p: Mapping[str, float] | ArrayLike | None = None) -> Array:
        """State derivative, shape (nx,) or (N, nx), of checked arguments."""
        return evaluate(self.rhs, *self._arguments(x, u, p))[0]

    def y(self, x: ArrayLike, u: ArrayLike, p: Mapping[str, float] | ArrayLike | None = None) -> Array:
        """Outputs, shape (ny,) or (N, ny), of checked arguments."""
        return evaluate(self.out, *self._arguments(x, u, p))[0]

    def _arguments(self, x: ArrayLike, u: ArrayLike, p: Mapping[str, float] | ArrayLike | None) -> tuple[Array, Array, Array]:
        return as_batch("x", x, self.states), as_batch("u", u, self.inputs), self.parameters(p)

    def __repr__(self) -> str:
        names = [" ".join(v.name for v in group) for group in (self.states, self.inputs, self.outputs, self.params)]
        return f"Model({self.name}: states [{names[0]}], inputs [{names[1]}], outputs [{names[2]}], parameters [{names[3]}])"

    def _repr_html_(self) -> str:
        rows: list[tuple[str | float, ...]] = []
        groups = (("state", self.states), ("input", self.inputs), ("parameter", self.params), ("output", self.outputs))
        for kind, variables in groups:
            for i, var in enumerate(variables):
                rows.append((kind, var.name, var.text, var.unit, float(self.p0[i]) if kind == "parameter" else ""))
        title = f"<b>{html.escape(self.name)}</b> <small>{html.escape(self.source)}</small>"
        return f"<div>{title}{html_table(('kind', 'name', 'meaning', 'unit', 'default'), rows)}</div>"

    def plot(self) -> Any:
        """Structure of the model: which derivative depends on which state and input.  Returns a matplotlib Figure."""
        blocks = [ca.DM(self.rhs.jac_sparsity(0, i), 1).full() for i in (0, 1)]
        pattern = np.hstack(blocks) != 0
        columns = [v.name for v in self.states + self.inputs]
        figure = new_figure(1.2 + 0.5 * len(columns), 1.0 + 0.4 * len(self.states))
        axes = figure.add_subplot()
        axes.imshow(pattern, cmap="Blues", vmin=0, vmax=1.6, aspect="auto")
        axes.axvline(len(self.states) - 0.5, color="0.3", linewidth=1)
        axes.set_xticks(range(len(columns)), columns)
        axes.set_yticks(range(len(self.states)), [f"d{v.name}/dt" for v in self.states])
        axes.set_title(f"{self.name}: what depends on what")
        return figure


Expressions = Mapping[str, Any]


def define(
    name: str,
    rhs: Callable[[Any, Any, Any], Expressions],
    *,
    states: Sequence[Var],
    inputs: Sequence[Var] = (),
    params: Mapping[Var, float] | None = None,
    outputs: Sequence[Var] = (),
    out: Callable[[Any, Any, Any], Expressions] | None = None,
    source: str = "",
) -> Model:
    """Build a Model from plain CasADi expressions.

    Parameters
    ----------
    name : str
        Identifier; prefixes the generated functions.
    rhs : callable
        ``rhs(x, u, p) -> {state name: derivative}``; ``x.V``, ``u.bank``, ``p.mass`` are scalar ``casadi.SX`` symbols.
    states, inputs, outputs : sequence of Var
    params : mapping of Var to float
        Parameters with their defaults.
    out : callable, optional
        ``out(x, u, p) -> {output name: expression}``.
    source : str
        Document and equation.

    Raises
    ------
    ModelError
        A missing or unknown name, a non-scalar or non-symbolic expression, a default outside its range.
    """
    if not (isinstance(name, str) and ca.Function.check_name(f"{name}_rhs")):  # CasADi takes no leading or double underscore
        raise ModelError(
            f"define: model name {name!r} prefixes generated C functions; use letters, digits and single underscores, a letter first"
        )
    params = dict(params or {})
    default = as_vector(f"{name}: params", list(params.values()), tuple(params))
    symbols, views = [], []
    for variables in (tuple(states), tuple(inputs), tuple(params)):
        scalars = [ca.SX.sym(v.name) for v in variables]
        symbols.append(ca.vertcat(*scalars) if scalars else ca.SX(0, 1))
        views.append(_Symbols(**{v.name: s for v, s in zip(variables, scalars, strict=True)}))
    if outputs and out is None:
        raise ModelError(f"{name}: outputs are declared but no `out` function is given")
    derivative = _collect(f"{name}: rhs", rhs(*views), tuple(states), symbols)
    output = _collect(f"{name}: out", out(*views) if out else {}, tuple(outputs), symbols)
    keys = ["x", "u", "p"]
    return Model(
        name=name, states=tuple(states), inputs=tuple(inputs), params=tuple(params), outputs=tuple(outputs),
        rhs=ca.Function(f"{name}_rhs", symbols, [derivative], keys, ["xdot"]),
        out=ca.Function(f"{name}_out", symbols, [output], keys, ["y"]),
        p0=default, source=source,
    )  # fmt: skip


class _Symbols(SimpleNamespace):
    """Scalars by name; a name that was not declared is answered with the nearest one."""

    def __getattr__(self, name: str) -> Any:
        raise ModelError(unknown_name("define", name, vars(self)))


def _collect(what: str, expressions: Expressions, variables: tuple[Var, ...], symbols: list[ca.SX]) -> ca.SX:
    names = [v.name for v in variables]
    if not isinstance(expressions, Mapping):
        raise ModelError(f"{what}: expected {{name: expression}}, got {type(expressions).__name__}; return one entry for each of {names}")
    for name in expressions:
        if name not in names:
            raise ModelError(unknown_name(what, name, names))
    missing = [n for n in names if n not in expressions]
    if missing:
        raise ModelError(f"{what}: no expression for {', '.join(missing)}; return one for every declared name")
    column = []
    for name in names:
        try:
            expression = ca.SX(expressions[name])
        except (NotImplementedError, TypeError):
            found = type(expressions[name]).__name__
            raise ModelError(f"{what}: {name} is {found}, expected a scalar casadi.SX expression or a number") from None
        if expression.shape != (1, 1):
            raise ModelError(f"{what}: {name} has shape {expression.shape}, expected a scalar")
        declared = {s.element_hash() for group in symbols for s in ca.symvar(group)}
        free = [s.name() for s in ca.symvar(expression) if s.element_hash() not in declared]
        if free:
            raise ModelError(
                f"{what}: {name} uses the symbol {free[0]!r}, which is not one of the model; declare it as a parameter or input"
            )
        column.append(ca.densify(expression))
    return ca.vertcat(*column) if column else ca.SX(0, 1)
