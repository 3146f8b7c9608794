"""Several allocation methods on one demand history: tracking, propellant, pulses, surface travel, optimality and time, side by side."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from allocation.core import Effectors
from allocation.demand_history import History
from allocation.qp_native import within
from models.checked import Array, ModelError, as_finite, frozen

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Step = Callable[[Effectors, Array, Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Commands of a method for a whole history, and what is known of their optimality.

    Attributes
    ----------
    u : ndarray, shape (N, n)
    kkt : ndarray, shape (N, 3)
        Not a number where the method solves no optimization problem.
    solved : ndarray of bool, shape (N,)
    seconds : float
        Time for all of them.
    """

    u: Array
    kkt: Array
    solved: np.ndarray
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """A named way to answer a history.

    Attributes
    ----------
    name : str
    answer : callable
        ``answer(history) -> Answers``.
    most : int
        Samples that it is asked for; 0: all.  Slow methods get as many, evenly spread, or, where rates limit, in one piece around the
        largest demand.
    """

    name: str
    answer: Callable[[History], Answers]
    most: int = 0


def user_method(name: str, function: Step, *, most: int = 0) -> Method:
    """A user's own allocator: ``function(effectors, demand, previous) -> u``.

    It gets the effectors of the sample with what their rates leave as limits, the demand (m,) and its own command of the sample
    before (n,); whatever it returns is brought inside the limits.
    """

    def answer(history: History) -> Answers:
        return stepwise(history, lambda k, effectors, demand, previous: (function(effectors, demand, previous), None, True), name)

    return Method(name, answer, most)


def stepwise(history: History, step: Callable[[int, Effectors, Array, Array], tuple[Array, Array | None, bool]], name: str) -> Answers:
    """Call ``step(k, effectors, demand, previous) -> (u, kkt or None, solved)`` for one sample after the other."""
    n = len(history.effectors.names)
    first = history.at(0)
    previous = np.clip(0.0, first.lower, first.upper)
    u, kkt, solved, seconds = np.empty((len(history), n)), np.full((len(history), 3), np.nan), np.ones(len(history), dtype=bool), 0.0
    limited = bool(np.isfinite(history.effectors.rate).any())
    for k, demand in enumerate(history.demand):
        now = history.at(k)
        if limited:
            low, high = within(now.lower, now.upper, previous, np.where(np.isinf(now.rate), np.inf, now.rate * history.dt))
            now = replace(now, lower=low, upper=high)
        began = time.perf_counter()
        raw, residuals, solved[k] = step(k, now, demand, previous)
        seconds += time.perf_counter() - began
        value = as_finite(f"{name}: u at sample {k}", raw)
        if value.shape != (n,):
            raise ModelError(f"{name}: returned shape {value.shape} at sample {k}, expected ({n},): one command for each effector")
        u[k] = previous = np.clip(value, now.lower, now.upper)
        if residuals is not None:
            kkt[k] = residuals
    return Answers(u, kkt, solved, seconds)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a method made of a history.

    Attributes
    ----------
    name : str
    samples : ndarray of int
        Which samples it was asked for.
    u, residual : ndarray, shapes (k, n), (k, m)
    rms, worst : float
        Root mean square and largest |residual|, in parts of the largest |demand| on the axis.
    propellant : float
        kg, over the samples asked for.
    pulses : int or None
        Firings, when each jet turns its duty into whole cycles with the smallest error of the sum; None for a part of the samples.
    travel : float or None
        Sum of the moves of the surfaces, rad; None for a part of the samples.
    worst_kkt : float
        Largest KKT residual; not a number for methods that solve no optimization problem.
    unsolved : int
        Samples whose answer the method's own test refused.
    microseconds : float
        Per solve.
    """

    name: str
    samples: np.ndarray
    u: Array
    residual: Array
    rms: float
    worst: float
    propellant: float
    pulses: int | None
    travel: float | None
    worst_kkt: float
    unsolved: int
    microseconds: float


COLUMNS = ("method", "rms error", "worst error", "propellant kg", "pulses", "travel deg", "worst KKT", "unsolved", "us/solve", "samples")


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Outcomes of several methods on one history; shows itself as a table in a notebook.

    Attributes
    ----------
    history : History
    outcomes : tuple of Outcome
        Each on the samples that the method was asked for.
    same : tuple of Outcome
        All on the samples of the method that was asked for the fewest, as a history of their own: these errors and propellants compare.
        The same as `outcomes` if every method got every sample.
    """

    history: History
    outcomes: tuple[Outcome, ...]
    same: tuple[Outcome, ...]

    def __repr__(self) -> str:
        return f"Comparison({', '.join(o.name for o in self.outcomes)}; {self.history!r})"

    def __getitem__(self, name: str) -> Outcome:
        for outcome in self.outcomes:
            if outcome.name == name:
                return outcome
        raise ModelError(f"comparison: no method {name!r}; known: {', '.join(o.name for o in self.outcomes)}")

    def rows(self, *, same: bool = False) -> list[tuple[str | float, ...]]:
        """One row for each method, in the order of :data:`COLUMNS`; "–" where a method has no such number.

        Parameters
        ----------
        same : bool
            Of the outcomes on the same samples.
        """

        def shown(value: float | None) -> str | float:
            return "–" if value is None or value != value else value

        return [
            (o.name, o.rms, o.worst, o.propellant, shown(o.pulses), shown(None if o.travel is None else float(np.degrees(o.travel))),
             shown(o.worst_kkt), o.unsolved, o.microseconds, len(o.samples)) for o in (self.same if same else self.outcomes)
        ]  # fmt: skip

    def _repr_html_(self) -> str:
        from models.drawing import html_table

        text = html_table(COLUMNS, self.rows())
        return text if self.same == self.outcomes else text + html_table(COLUMNS, self.rows(same=True))

    def plot(self, methods: Sequence[str] | None = None) -> Figure:
        """Demand and residual on each axis for some of the methods (all that answered every sample)."""
        from models.drawing import new_figure

        whole = [o for o in self.outcomes if len(o.samples) == len(self.history) and (methods is None or o.name in methods)]
        effectors = self.history.effectors
        axes = effectors.axes
        figure = new_figure(9.0, 2.2 + 2.0 * len(axes) * 2)
        panels = figure.subplots(2 * len(axes), 1, sharex=True, squeeze=False)[:, 0]
        for i, axis in enumerate(axes):
            panels[2 * i].plot(self.history.t, self.history.demand[:, i], "k", lw=1, label="demand")
            panels[2 * i].set_ylabel(effectors.label(f"{axis} demand"))
            for o in whole:
                panels[2 * i + 1].plot(self.history.t, o.residual[:, i], lw=1, label=o.name)
            panels[2 * i + 1].set_ylabel(effectors.label(f"{axis} unmet"))
        panels[-1].set_xlabel("t [s]")
        figure.legend(*panels[1].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize="small")
        return figure


def compare(history: History, methods: Sequence[Method]) -> Comparison:
    """Run every method on the history.

    Parameters
    ----------
    history : History
    methods : sequence of Method
        See :mod:`allocation.methods` for those that come with the workbench and :func:`user_method` for a user's own.

    Raises
    ------
    ModelError
        No methods, two of one name, commands that are not finite or of a wrong shape.
    """
    names = [method.name for method in methods]
    if not names:
        raise ModelError("compare: got no methods, expected at least one")
    if len(set(names)) != len(names):
        raise ModelError(f"compare: expected methods of different names, got {names}")
    outcomes = tuple(_outcome(history, method, method.most) for method in methods)
    fewest = min(outcomes, key=lambda o: len(o.samples)).samples
    same = tuple(o if len(o.samples) == len(fewest) else _outcome(history, m, len(fewest)) for o, m in zip(outcomes, methods, strict=True))
    return Comparison(history, outcomes, same)


def _outcome(history: History, method: Method, most: int) -> Outcome:
    N = len(history)
    every = most == 0 or most >= N
    rows = np.arange(N) if every else _some(history, most)
    asked = history if every else history.part(rows)
    found = method.answer(asked)
    wrench = np.einsum("kn,mn->km", found.u, asked.effectors.B) if asked.B is None else np.einsum("kn,kmn->km", found.u, asked.B)
    residual = asked.demand - wrench
    scale = np.abs(history.demand).max(axis=0)
    part = residual / np.where(scale > 0, scale, 1.0)
    jets = history.effectors.jets
    known = found.kkt[np.isfinite(found.kkt)]
    return Outcome(
        name=method.name, samples=rows, u=frozen(found.u), residual=frozen(residual), rms=float(np.sqrt((part**2).mean())),
        worst=float(np.abs(part).max()), propellant=float((found.u @ history.effectors.flow).sum() * history.dt),
        pulses=pulses(found.u[:, jets]) if every else None,
        travel=float(np.abs(np.diff(found.u[:, ~jets], axis=0)).sum()) if every else None,
        worst_kkt=float(known.max()) if known.size else float("nan"), unsolved=int((~found.solved).sum()),
        microseconds=1e6 * found.seconds / len(rows),
    )  # fmt: skip


def _some(history: History, most: int) -> np.ndarray:
    N = len(history)
    if np.isinf(history.effectors.rate).all():
        return np.unique(np.linspace(0, N - 1, most).round().astype(int))
    scale = np.abs(history.demand).max(axis=0)
    peak = int(np.argmax(np.abs(history.demand / np.where(scale > 0, scale, 1.0)).max(axis=1)))
    first = min(max(0, peak - most // 2), N - most)
    return np.arange(first, first + most)


def pulses(duty: Array) -> int:
    """Firings of jets (N, j) that run for whole samples, on whenever the sum of the duties rounds up to the next whole sample."""
    if not duty.size:
        return 0
    on = np.diff(np.floor(np.cumsum(np.abs(duty), axis=0) + 0.5), axis=0, prepend=0.0) > 0.5
    return int((on & ~np.vstack([np.zeros((1, on.shape[1]), dtype=bool), on[:-1]])).sum())
