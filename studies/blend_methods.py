"""Allocation methods inside the pitch loop, and their comparison over the same dispersed flights."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.special import stdtrit

from allocation import blending, qp
from models.checked import ModelError, unknown_name

if TYPE_CHECKING:
    from studies.blend import Figures
    from studies.result import Table

COMPARED = (
    ("rms_deg", "error rms [deg]"), ("max_deg", "largest error [deg]"), ("pulses", "pulses [1]"), ("propellant_kg", "propellant [kg]"),
    ("travel_deg", "elevon travel [deg]"), ("pulses_above_q2", "pulses above q2 [1]"),
)  # fmt: skip
CONFIDENCE = 0.95


def redistributed(handover: blending.Handover | None = None, *, name: str = "blend_pinv") -> ca.Function:
    """Weighted pseudo-inverse with redistribution, with the inputs and outputs of :func:`allocation.blending.paper`.

    Elevon and jets share the demanded moment in proportion to the squares of what they can deliver (least norm in parts of their
    limits, which are those of the hand-over); what one cannot deliver goes to the other.
    """
    h = handover or blending.Handover()
    symbols = [ca.SX.sym(n) for n in blending.INPUTS]
    demand, qbar, trim, slope, up, down, _previous = symbols
    low, high = blending.limits(qbar, trim, handover=h)
    moment = slope * demand
    size, sign = ca.fabs(moment), ca.sign(moment)
    by_elevon = ca.fabs(slope) * ca.if_else(demand < 0, -low, high)
    by_jets = ca.if_else(moment > 0, up, -down)
    if h.rcs_inhibit_above_q2:
        by_jets = ca.if_else(qbar > h.q2, 0.0, by_jets)
    part = by_elevon**2 / ca.fmax(by_elevon**2 + by_jets**2, 1e-300)
    jets = ca.fmin(size - ca.fmin(part * size, by_elevon), by_jets)
    elevon = ca.fmin(size - jets, by_elevon)
    duty = sign * jets / ca.if_else(moment > 0, up, -down)
    share = jets / ca.fmax(size, 1e-300)
    return ca.Function(name, symbols, [sign * elevon / slope, duty, share], list(blending.INPUTS), list(blending.OUTPUTS))


METHODS: Mapping[str, Callable[[blending.Handover], ca.Function]] = {
    "paper": blending.paper,
    "literal": lambda handover: blending.paper(replace(handover, rcs_inhibit_above_q2=False), name="blend_literal"),
    "qp": qp.blend,
    "pinv": redistributed,
}


def allocator(method: str, handover: blending.Handover | None = None) -> ca.Function:
    """Allocator of a method by its name in ``METHODS``.

    Raises
    ------
    ModelError
        An unknown method.
    """
    if method not in METHODS:
        raise ModelError(unknown_name("blend: method", method, METHODS))
    return METHODS[method](handover or blending.Handover())


@dataclass(frozen=True, slots=True, eq=False)
class MethodComparison:
    """The same dispersed flights under several methods.

    Attributes
    ----------
    found : mapping of str to Figures
        Arrays over the flights, by method.
    kept : ndarray of bool
        Flights in authority and inside the tables under every method; the statistics are of these.
    """

    found: Mapping[str, Figures]
    kept: np.ndarray

    def interval(self, method: str, quantity: str) -> tuple[float, float]:
        """Mean and half-width of its 95 % confidence interval (Student's t) over the flights kept."""
        return _interval(self._kept(method, quantity))

    def difference(self, method: str, other: str, quantity: str) -> tuple[float, float]:
        """As :meth:`interval`, of the difference flight by flight: narrower, since both meet the same dispersions."""
        return _interval(self._kept(method, quantity) - self._kept(other, quantity))

    def _kept(self, method: str, quantity: str) -> np.ndarray:
        return np.asarray(getattr(self.found[method], quantity), dtype=float)[self.kept]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able result."""
        first, *others = self.found

        def named(value: tuple[float, float]) -> dict[str, float]:
            return {"mean": value[0], "half_width": value[1]}

        return {
            "cases": len(self.kept), "kept": int(self.kept.sum()), "confidence": CONFIDENCE,
            "methods": {method: {name: named(self.interval(method, name)) for name, _ in COMPARED} for method in self.found},
            f"differences_from_{first}": {
                method: {name: named(self.difference(method, first, name)) for name, _ in COMPARED} for method in others
            },
        }  # fmt: skip

    def table(self) -> Table:
        """One row for each method: means with their confidence intervals."""
        return self._table("Methods over the same dispersed flights", "Means", {m: partial(self.interval, m) for m in self.found})

    def differences(self) -> Table:
        """One row for each method but the first: mean difference from that, flight by flight, with confidence intervals."""
        first, *others = self.found
        rows = {m: partial(self.difference, m, first) for m in others}
        return self._table(f"Differences from {first}, flight by flight", "Mean differences", rows)

    def _table(self, title: str, what: str, rows: Mapping[str, Callable[[str], tuple[float, float]]]) -> Table:
        from studies.result import Table

        def cell(value: tuple[float, float]) -> str:
            return f"{value[0]:.4g} ± {value[1]:.2g}"

        cells = [[method, *(cell(row(name)) for name, _ in COMPARED)] for method, row in rows.items()]
        return Table(
            title, ("method", *(label for _, label in COMPARED)), cells,
            f"{what} with 95 % confidence intervals over {int(self.kept.sum())} of {len(self.kept)} flights,"
            " those in authority under every method.",
        )  # fmt: skip


def _interval(values: np.ndarray) -> tuple[float, float]:
    n = len(values)
    if n < 2:
        raise ModelError(f"compare: {n} flights kept, expected at least two; fly more dispersions")
    return float(values.mean()), float(stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE) * values.std(ddof=1) / math.sqrt(n))


def compare(methods: Sequence[str] = ("paper", "qp", "pinv"), *, cases: int = 200, seed: int = 2012, jets: int = 6) -> MethodComparison:
    """Fly the same random dispersions under several allocation methods, all inside compiled loops.

    Parameters
    ----------
    methods : sequence of str
        Names of ``METHODS``.
    cases : int
        Flights, >= 2.
    seed : int
    jets : {2, 4, 6}

    Raises
    ------
    ModelError
        An unknown method, fewer than two flights.
    """
    from studies.blend import dispersed, figures_of
    from studies.blend_design import START, sts1_loop
    from studies.blend_loop import fly_many

    if isinstance(cases, bool) or not isinstance(cases, int) or cases < 2:
        raise ModelError(f"compare: cases: expected a whole number of at least 2, got {cases!r}")
    x0 = np.array(list(START.values()))
    loops = {method: sts1_loop(method, jets=jets) for method in methods}
    found, sound = {}, np.ones(cases, dtype=bool)
    for method, loop in loops.items():
        ends = fly_many(loop, x0, dispersed(loop, cases, seed=seed))
        sound &= ends["finite"] > 0
        found[method] = figures_of(ends)
        sound &= ~np.asarray(found[method].out_of_authority | found[method].outside_tables)
    return MethodComparison(found, sound)
