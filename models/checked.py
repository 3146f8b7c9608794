"""The one checked numeric entry: variables with ranges, statuses, and calls of CasADi functions with NumPy arrays.

CasADi broadcasts scalars, transposes rows, maps over matrices and fills missing inputs with zeros, all in silence.
Nothing in this workbench calls a ``casadi.Function`` with numbers except through :func:`evaluate`.
"""

from __future__ import annotations

import difflib
import keyword
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class ModelError(ValueError):
    """A value, shape or name that a model cannot accept; the text says what, where, what was expected and what to do."""


class Status(Enum):
    """Outcome of a computation; the value is a sentence: what it means and what to try."""

    OK = "The computation met its tolerances."
    MAX_ITERATIONS = "The iteration limit was reached before the tolerance; start nearer to the solution or allow more iterations."
    INFEASIBLE = "No point satisfies the constraints; relax a bound or remove a requirement."
    SINGULAR = "A matrix that must be inverted is singular here; leave the singular point or scale the problem."
    NOT_STABILIZABLE = (
        "An unstable or undamped mode cannot be reached by the input; add an actuator, or weight that mode out of the problem."
    )
    OUT_OF_DOMAIN = "A value lies outside the declared range of its variable or table; correct its unit or sign, or extend the data."
    NONFINITE = "A NaN or infinity appeared; look for a division by zero or an overflow near the last finite state."
    STOP_NOT_REACHED = "The flight ended before its stop condition was met; allow more time, or change the start so that it is met."
    OUTSIDE_FOOTPRINT = "The target cannot be reached from here; the nearest reachable point is returned."
    UNDECIDED = "The proof could not be completed at this precision; move the parameters slightly off the border."

    @property
    def ok(self) -> bool:
        """True for ``Status.OK`` only."""
        return self is Status.OK


@dataclass(frozen=True, slots=True, eq=False)
class Var:
    """One named scalar of a model: the only source of names, units, scales and plot labels.

    Attributes
    ----------
    name : str
        Python identifier.
    unit : str
        SI unit as printed on axes, "1" when dimensionless, "rad" for angles.
    nominal : float
        Typical magnitude, > 0; the scale of the variable.
    valid : tuple of float
        Closed interval outside which a value *given by a user* (initial state, input, parameter) is refused.
        A flight may leave it; it guards against wrong units and signs.
    text : str
        Label for people.
    """

    name: str
    unit: str = "1"
    nominal: float = 1.0
    valid: tuple[float, float] = (-math.inf, math.inf)
    text: str = ""

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.isidentifier() and not keyword.iskeyword(self.name)):
            raise ModelError(f"Var: name {self.name!r} is not a Python identifier; use letters, digits and underscores")
        if as_scalar(f"Var {self.name}: nominal", self.nominal) <= 0:
            raise ModelError(f"Var {self.name}: nominal must be finite and > 0, got {self.nominal}")
        if len(self.valid) != 2 or not self.valid[0] < self.valid[1]:
            raise ModelError(f"Var {self.name}: valid must be (low, high) with low < high, got {self.valid}")

    @property
    def label(self) -> str:
        """Axis label: text (or name) and unit."""
        return f"{self.text or self.name} [{self.unit}]"

    def shown(self, value: float) -> str:
        """``name = value unit`` for messages."""
        return f"{self.name} = {value:.6g}" + ("" if self.unit == "1" else f" {self.unit}")


def unknown_name(what: str, name: str, known: Iterable[str]) -> str:
    """Error text for an unknown name, with the nearest known one."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(names) or '(none)'}"
    return f"{what}: unknown name {name!r}; {hint}"


def frozen(values: ArrayLike) -> Array:
    """Read-only float64 copy."""
    out = np.array(values, dtype=np.float64)
    out.flags.writeable = False
    return out


def as_finite(what: str, values: object) -> Array:
    """float64 array of finite numbers, or a ModelError that names `what` and the first bad element."""
    try:
        raw = np.asarray(values)
        if raw.dtype.kind not in "fiu" and raw.size:  # a truth value is a mask in the wrong place, not a number
            raise TypeError
        if np.ma.isMaskedArray(values) and np.ma.getmaskarray(values).any():
            raise TypeError
        out = raw.astype(np.float64)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a symbol of CasADi has no value
        raise ModelError(f"{what}: expected real numbers, got {_shown(values)}; give a list or array of floats") from None
    if not np.isfinite(out).all():  # by all(): a scalar has no index, so a list of bad indices would be empty
        bad = np.argwhere(~np.isfinite(out))
        where = "".join(f"[{i}]" for i in bad[0])
        raise ModelError(f"{what}{where}: expected a finite number, got {out[tuple(bad[0])]}; remove NaN and infinity from the input")
    return out


def _shown(values: object) -> str:
    text = repr(values)
    return text if len(text) < 200 else f"{text[:200]}..."


def as_scalar(what: str, value: object) -> float:
    """One finite real number, or a ModelError that names `what`."""
    out = as_finite(what, value)
    if out.ndim != 0:
        raise ModelError(f"{what}: expected one number, got {_shown(value)} of shape {out.shape}; give a plain float")
    return float(out)


def as_vector(what: str, values: object, variables: Sequence[Var], *, domain: bool = True) -> Array:
    """Check one vector against its variables.

    Parameters
    ----------
    what : str
        Name for messages, such as ``"x0"``.
    values : array_like, shape (n,)
        Numbers in the order and SI units of `variables`.
    variables : sequence of Var, length n
    domain : bool
        Also refuse values outside ``Var.valid``.

    Returns
    -------
    ndarray, shape (n,)
    """
    out = as_finite_named(what, values, [v.name for v in variables])
    if out.shape != (len(variables),):
        raise ModelError(_shape_text(what, variables, out.shape, batch=False))
    if domain:
        check_domain(what, out, variables)
    return out


def as_batch(what: str, values: object, variables: Sequence[Var], *, domain: bool = True) -> Array:
    """As :func:`as_vector`, for shape (n,) or (N, n) with the case or time axis first."""
    names = [v.name for v in variables]
    out = as_finite_named(what, values, names)
    if out.ndim not in (1, 2) or out.shape[-1] != len(names):
        raise ModelError(_shape_text(what, variables, out.shape, batch=True))
    if domain:
        check_domain(what, out, variables)
    return out


def as_finite_named(what: str, values: object, names: Sequence[str]) -> Array:
    """As :func:`as_finite`; the message names the component of the last axis."""
    try:
        return as_finite(what, values)
    except ModelError:
        raw = np.asarray(values)
        if raw.dtype.kind == "f" and raw.ndim and raw.shape[-1] == len(names) and not np.isfinite(raw).all():
            bad = np.argwhere(~np.isfinite(raw))[0]
            case = f" of case {bad[0]}" if raw.ndim == 2 else ""
            found = raw[tuple(bad)]
            raise ModelError(
                f"{what}: {names[bad[-1]]}{case} must be a finite number, got {found}; remove NaN and infinity from the input"
            ) from None
        raise


def check_domain(what: str, values: Array, variables: Sequence[Var]) -> None:
    """Raise ModelError naming the first variable whose value lies outside ``Var.valid``."""
    low = np.array([v.valid[0] for v in variables])
    high = np.array([v.valid[1] for v in variables])
    outside = np.argwhere((values < low) | (values > high))
    if outside.size == 0:
        return
    var = variables[outside[0][-1]]
    value = values[tuple(outside[0])]
    case = f" of case {outside[0][0]}" if values.ndim == 2 else ""
    hint = " (angles are in radians: did you give degrees?)" if var.unit == "rad" else f" (unit {var.unit})"
    raise ModelError(
        f"{what}: {var.shown(value)}{case} is outside its valid range [{var.valid[0]:.6g}, {var.valid[1]:.6g}]; correct the value{hint}"
    )


def _shape_text(what: str, variables: Sequence[Var], shape: tuple[int, ...], *, batch: bool) -> str:
    n = len(variables)
    wanted = f"({n},) or (N, {n})" if batch else f"({n},)"
    return f"{what}: expected shape {wanted} for [{' '.join(v.name for v in variables)}], got {shape}; give one value for each name"


def evaluate(function: ca.Function, *arguments: Array, finite: bool = True) -> tuple[Array, ...]:
    """Call a CasADi function of column vectors with NumPy arrays, all sizes checked, results finite.

    Parameters
    ----------
    function : casadi.Function
        Inputs of shape (n_i, 1); outputs of any dense shape (a, b).
    *arguments : ndarray, shape (n_i,) or (N, n_i)
        One for each input; those with a leading axis share the same N.
    finite : bool
        Refuse results that are not finite; False hands them to a caller that sorts them out case by case.

    Returns
    -------
    tuple of ndarray
        Output of shape (a, 1) -> (a,) or (N, a); (a, b) with b > 1 -> (a, b) or (N, a, b).

    Raises
    ------
    ModelError
        A missing or extra argument, a wrong shape, a non-finite input or result.
    """
    name = function.name()
    values, count = as_arguments(function, arguments)
    n_calls = 1 if count is None else count
    mapped = function if n_calls == 1 else function.map(n_calls)
    full = [_columns(value.T, n_calls) for value in values]
    results = mapped.call([ca.DM(c) for c in full])
    out = []
    for i, result in enumerate(results):
        rows, cols = function.size_out(i)
        dense = np.moveaxis(np.asarray(result.full()).reshape(rows, n_calls, cols), 1, 0)
        if finite and not np.isfinite(dense).all():
            case = int(np.argwhere(~np.isfinite(dense).all(axis=(1, 2)))[0, 0])
            raise ModelError(
                f"{name}: output {function.name_out(i)} is not finite (row {case}); the arguments leave the domain of the model"
            )
        if cols == 1:
            dense = dense[:, :, 0]
        out.append(dense if count is not None else dense[0])
    return tuple(out)


def as_arguments(function: ca.Function, arguments: Sequence[object]) -> tuple[list[Array], int | None]:
    """Arguments of a CasADi function of column vectors, checked.

    Parameters
    ----------
    function : casadi.Function
        Inputs of shape (n_i, 1).
    arguments : sequence of array_like, shape (n_i,) or (N, n_i)
        One for each input; those with a leading axis share the same N.

    Returns
    -------
    values : list of ndarray
        Float64, finite, in the shapes given.
    count : int or None
        N; None if no argument has a leading axis.

    Raises
    ------
    ModelError
        A missing or extra argument, a matrix as input, a wrong shape, a number that is not finite, an empty batch.
    """
    name = function.name()
    if len(arguments) != function.n_in():
        raise ModelError(f"{name}: expected {function.n_in()} arguments {function.name_in()}, got {len(arguments)}; give every one")
    count: int | None = None
    values = []
    for i, argument in enumerate(arguments):
        label = f"{name}: {function.name_in(i)}"
        value = as_finite(label, argument)
        n = function.size1_in(i)
        if function.size2_in(i) > 1:
            raise ModelError(f"{label}: is a matrix {function.size_in(i)}; numbers are passed to columns only: declare a vector")
        if value.ndim not in (1, 2) or value.shape[-1] != n:
            raise ModelError(f"{label}: expected shape ({n},) or (N, {n}), got {value.shape}; time or case axis first")
        if value.ndim == 2:
            if count is not None and value.shape[0] != count:
                raise ModelError(f"{label}: {value.shape[0]} rows beside {count} of an earlier argument; give equal numbers of rows")
            count = value.shape[0]
        values.append(value)
    if count == 0:
        raise ModelError(f"{name}: the batch is empty; give at least one row")
    return values, count


def _columns(value: Array, count: int) -> Array:
    """(n,) or (n, N) -> (n, count)."""
    if value.ndim == 2:
        return value
    return np.repeat(value[:, None], count, axis=1)
