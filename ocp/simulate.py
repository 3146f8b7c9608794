"""Flights of any model under any law: one CasADi function for the whole flight, exact stops, all cases at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, Model, ModelError, Status, Var, as_batch, as_vector, evaluate, frozen
from models.native import Mode
from ocp import flight
from ocp.laws import Law
from ocp.methods import RK4, RK8, Adaptive, Method
from ocp.native_flight import fly_native
from ocp.stops import Stop
from ocp.trajectory import SimulationError, Trajectory

Native = Literal["auto", "off", "accurate", "fast"]
NATIVE_BLOCK = 2**17  # cases that compiled code flies between two reports of progress
NATIVE_FROM = 2000  # cases from which compiling (seconds, once for each model, law and machine) pays


def simulate(
    model: Model,
    law: Law,
    *,
    x0: ArrayLike,
    p: Mapping[str, float] | ArrayLike | None = None,
    until: Stop | None = None,
    t_max: float | None = None,
    method: Method = RK8(step=0.5),  # noqa: B008 (a frozen value)
    throw: bool = True,
) -> Trajectory:
    """Fly a model from x0 under a law to a stop condition or an end time.

    Parameters
    ----------
    model : Model
    law : Law
        ``ocp.constant(...)``, ``ocp.profile(...)``, ``gains.law(...)`` or a user's own ``ocp.sampled(...)``.
    x0 : array_like, shape (nx,)
        Initial state, SI and radians, inside ``Var.valid``.
    p : mapping or array_like, optional
        Parameters by name (others keep their default) or all of them.
    until : Stop, optional
        ``ocp.falls_below("h", 10e3)`` and the like.  Crossings are looked for at the ends of groups of four steps
        (at each sample of a sampled law) and located to 1e-12 of the group by integrating its first part again.
    t_max : float, optional
        End time, s; 3600 when only `until` is given.
    method : RK4, RK8 or Adaptive
    throw : bool
        Raise SimulationError when the flight does not end as asked; otherwise return it with its ``status``.

    Returns
    -------
    Trajectory
        Nodes at every step; a node stands twice where the integration restarted with another step or input.

    Raises
    ------
    ModelError
        Bad shapes, names, values outside ``Var.valid``, a start beyond the stop condition.
    SimulationError
        STOP_NOT_REACHED or NONFINITE, with the trajectory up to the last good state.
    """
    _check_kinds(model, law, until, method)
    end = flight.require_until_or_end(until, t_max)
    start = as_vector("x0", x0, model.states)[None]
    params = as_vector("p", model.parameters(p), model.params)[None]
    engine = flight.prepare(model, law.bind(model), method, end, until)
    values = ", ".join(v.shown(value) for v, value in zip(model.states, start[0], strict=True))
    if until is not None and engine.first_margins(start, params)[0] <= 0:
        raise ModelError(f"simulate: x0 ({values}) is already past the stop condition ({until.text()}); start before it or change it")
    outcome, chunks = flight.fly_to_stop(engine, start, params)
    t, x, u = flight.nodes(engine, start, params, outcome, chunks)
    status = flight.STATUSES[outcome.status[0]]
    y = evaluate(model.out, x, u, params[0], finite=False)[0]
    good = int(np.argmin(np.append(np.isfinite(y).all(axis=1), False)))  # nodes before the first output that is not finite
    if good == 0:
        raise ModelError(f"simulate: an output of {model.name} is not finite at x0 ({values}); start inside the domain of the model")
    if good < len(t):
        t, x, u, y, status = t[:good], x[:good], u[:good], y[:good], Status.NONFINITE
    trajectory = Trajectory(t, x, u, y, params[0], model, status, engine.bound.sample is not None)
    if throw and not status.ok:
        last = ", ".join(v.shown(value) for v, value in zip(model.states, x[-1], strict=True))
        wanted = f"; the stop condition was: {until.text()}" if until else ""
        raise SimulationError(f"simulate: {status.name} at t = {t[-1]:.6g} s with {last}{wanted}. {status.value}", status, trajectory)
    return trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What the law did in an ensemble: case (S,), t (S,) s, x (S, nx) and u (S, nu) at every call of the law."""

    case: np.ndarray
    t: Array
    x: Array
    u: Array


@dataclass(frozen=True, slots=True, eq=False)
class Ensemble:
    """End states of many flights.

    Attributes
    ----------
    t : ndarray, shape (N,)
        Stop times, s (of the last good state for a failed case).
    x : ndarray, shape (N, nx)
        States there.
    z : ndarray, shape (N, nz)
        Memory of the law after its last call; nz = 0 for a law without one.
    status : tuple of Status, length N
    ok : ndarray of bool, shape (N,)
        Mask of the cases that met their stop condition.
    model : Model
    samples : Samples or None
        Only on request.
    details : mapping of int to str
        What was wrong with cases that were not flown.
    """

    t: Array
    x: Array
    z: Array
    status: tuple[Status, ...]
    ok: np.ndarray
    model: Model
    samples: Samples | None = None
    details: Mapping[int, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Array:
        """Column of a state at the stop, shape (N,)."""
        if name not in {v.name for v in self.model.states}:
            raise ModelError(f"ensemble: {name!r} is not a state; only end states are kept: {[v.name for v in self.model.states]}")
        return self.x[:, self.model.index(name)]

    def failures(self) -> list[tuple[int, str]]:
        """(case number, reason) of the cases that failed."""
        return [(i, f"{s.name}: {self.details.get(i) or s.value}") for i, s in enumerate(self.status) if not s.ok]


def simulate_ensemble(
    model: Model,
    law: Law,
    *,
    x0: ArrayLike,
    p: ArrayLike | None = None,
    until: Stop | None = None,
    t_max: float | None = None,
    method: Method = RK8(step=0.5),  # noqa: B008 (a frozen value)
    progress: Callable[[float], None] | None = None,
    samples: bool = False,
    native: Native = "auto",
    block: int | None = None,
) -> Ensemble:
    """Fly N cases at once; a case that fails carries its reason and the others stand.

    Arguments that are not listed are those of :func:`simulate`.  Under a continuous law crossings are looked for after every step, and only
    the last step is shortened, where `simulate` looks after groups of four and shortens all four: beyond that the two take the same steps,
    so their ends differ by the error of the method in one step.

    Parameters
    ----------
    x0 : array_like, shape (N, nx) or (nx,)
        Initial states; a case outside ``Var.valid`` or past the stop condition gets OUT_OF_DOMAIN and is not flown.
    p : array_like, shape (N, np) or (np,), optional
    progress : callable, optional
        Called with the finished fraction in [0, 1].
    samples : bool
        Keep time, state and input at every call of a sampled law (at every group of four steps of a continuous one, looked at as
        `simulate` does).
    native : {"auto", "off", "accurate", "fast"}
        Compiled code in SIMD lanes on all cores: "accurate" gives the interpreter's numbers to 1e-12, "fast" to 1e-9.  "auto" is
        "accurate" from 2000 cases on, where compiling pays.  Not for samples or the Adaptive method.
    block : int, optional
        Cases flown together: the interpreter's memory grows with it, and compiled code reports progress after each block.  4096 in
        the interpreter and 131072 in compiled code unless given; give less for a law whose calls take long.

    Returns
    -------
    Ensemble
    """
    _check_kinds(model, law, until, method)
    end = flight.require_until_or_end(until, t_max)
    starts = np.atleast_2d(as_batch("x0", x0, model.states, domain=False))
    params = np.atleast_2d(as_batch("p", model.p0 if p is None else p, model.params, domain=False))
    if len(starts) == 0 or len(params) == 0:
        raise ModelError("simulate_ensemble: no cases: x0 or p is empty; give at least one row")
    cases = max(len(starts), len(params))
    if len(starts) not in (1, cases) or len(params) not in (1, cases):
        raise ModelError(f"simulate_ensemble: {len(starts)} rows of x0 beside {len(params)} of p; give equal numbers, or one row")
    starts, params = (a if len(a) == cases else np.repeat(a, cases, axis=0) for a in (starts, params))
    mode = _mode(native, cases, samples=samples, adaptive=isinstance(method, Adaptive))
    if block is None:
        block = flight.BLOCK if mode is None else NATIVE_BLOCK
    if block < 1:
        raise ModelError(f"simulate_ensemble: block: expected at least one case, got {block}")
    engine = flight.prepare(model, law.bind(model), method, end, until, alone=not samples and not isinstance(method, Adaptive))
    t, x, z = np.zeros(cases), starts.copy(), np.repeat(engine.bound.z0[None], cases, axis=0)
    status = np.full(cases, flight.CODE[Status.OUT_OF_DOMAIN])
    kept: list[flight.Record] = []
    outside = ~(_inside(starts, model.states) & _inside(params, model.params))
    inside = np.flatnonzero(~outside)
    for first in range(0, len(inside), block):
        rows = inside[first : first + block]
        # views where all cases fly: copies cost a tenth of the compiled flights
        place: Any = slice(first, first + block) if len(inside) == cases else rows
        report = None if progress is None else _scaled(progress, first / len(inside), len(rows) / len(inside))
        chunks: list[flight.Record] | None = [] if samples else None
        if mode is None:
            outcome, _ = flight.fly_to_stop(engine, starts[place], params[place], progress=report, record=chunks)
        else:
            outcome = fly_native(engine, starts[place], params[place], mode, progress=report)
        kept += [(rows[case], times, states, inputs) for case, times, states, inputs in chunks or ()]
        t[place], x[place], z[place] = outcome.t, engine.split(outcome.c)[0], engine.memory(outcome.c)
        status[place] = outcome.status
    taken = Samples(*(np.concatenate(parts) for parts in zip(*kept, strict=True))) if kept else None
    refused = np.flatnonzero(outside)
    details = {int(i): _outside(starts[i], model.states) or _outside(params[i], model.params) for i in refused}
    words, ok = tuple(map(flight.STATUSES.__getitem__, status.tolist())), status == flight.CODE[Status.OK]
    return Ensemble(frozen(t), frozen(x), frozen(z), words, ok, model, taken, details)


def _mode(native: Native, cases: int, *, samples: bool, adaptive: bool) -> Mode | None:
    """The mode of compiled code, None for the interpreter."""
    if native not in ("auto", "off", "accurate", "fast"):
        raise ModelError(f"simulate_ensemble: native: expected 'auto', 'off', 'accurate' or 'fast', got {native!r}")
    if native in ("accurate", "fast") and (samples or adaptive):
        raise ModelError("simulate_ensemble: native: samples and the Adaptive method need the interpreter; leave native out")
    if native == "off" or samples or adaptive or (native == "auto" and cases < NATIVE_FROM):
        return None
    return "fast" if native == "fast" else "accurate"


def _check_kinds(model: object, law: object, until: object, method: object) -> None:
    """Refuse an argument of the wrong kind by its name, before anything is built."""
    wanted = (
        ("model", model, Model, "a Model, such as models.entry_planar(...)"),
        ("law", law, Law, "a law, such as ocp.constant(...) or gains.law()"),
        ("until", until, (Stop, type(None)), "a stop condition, such as ocp.falls_below('h', 10e3)"),
        ("method", method, (RK4, RK8, Adaptive), "a method, such as ocp.RK8(step=0.5)"),
    )
    for name, value, kind, text in wanted:
        if not isinstance(value, kind):
            raise ModelError(f"simulate: {name}: expected {text}, got {value!r}")


def _outside(values: Array, variables: tuple[Var, ...]) -> str:
    """What is wrong with a case outside its valid ranges."""
    for value, var in zip(values, variables, strict=True):
        if not var.valid[0] <= value <= var.valid[1]:
            return f"{var.shown(value)} is outside [{var.valid[0]:.6g}, {var.valid[1]:.6g}]"
    return ""


def _inside(values: Array, variables: tuple[Var, ...]) -> np.ndarray:
    low = np.array([v.valid[0] for v in variables])
    high = np.array([v.valid[1] for v in variables])
    if (values.min(axis=0) >= low).all() and (values.max(axis=0) <= high).all():
        return np.ones(len(values), dtype=bool)
    return np.asarray(((values >= low) & (values <= high)).all(axis=1))


def _scaled(progress: Callable[[float], None], offset: float, width: float) -> Callable[[float], None]:
    return lambda fraction: progress(offset + width * fraction)
