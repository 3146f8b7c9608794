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
    from studies.blend import BlendStudy, Figures
    from studies.result import Table

COMPARED = (
    ("rms_deg", "error rms [deg]"), ("max_deg", "largest error [deg]"), ("pulses", "pulses [1]"), ("propellant_kg", "propellant [kg]"),
    ("travel_deg", "elevon travel [deg]"), ("pulses_above_q2", "pulses above q2 [1]"),
)  # fmt: skip
CONFIDENCE = 0.95
ENOUGH = 2  # flights: one alone has no spread, so no interval


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
    return METHODS[_known(method)](handover or blending.Handover())


def _known(method: str) -> str:
    if not isinstance(method, str):
        raise ModelError(f"blend: method: expected one of {', '.join(METHODS)}, got {method!r}; give a name")
    if method not in METHODS:
        raise ModelError(unknown_name("blend: method", method, METHODS))
    return method


@dataclass(frozen=True, slots=True, eq=False)
class MethodComparison:
    """The same dispersed flights under several methods.

    Attributes
    ----------
    found : mapping of str to Figures
        Arrays over the flights, by method.
    kept : ndarray of bool
        Flights finite, in authority and inside the tables under every method; the statistics are of these.
    """

    found: Mapping[str, Figures]
    kept: np.ndarray

    def interval(self, method: str, quantity: str) -> tuple[float, float]:
        """Mean and half-width of its confidence interval (Student's t, level ``CONFIDENCE``) over the flights kept.

        Raises
        ------
        ModelError
            Fewer than two flights are kept.
        """
        return _interval(self._kept(method, quantity))

    def difference(self, method: str, other: str, quantity: str) -> tuple[float, float]:
        """As :meth:`interval`, of the difference flight by flight: narrower, since both meet the same dispersions."""
        return _interval(self._kept(method, quantity) - self._kept(other, quantity))

    def _kept(self, method: str, quantity: str) -> np.ndarray:
        return np.asarray(getattr(self.found[method], quantity), dtype=float)[self.kept]

    @property
    def remark(self) -> str:
        """Why there are no intervals; empty where there are."""
        n = int(self.kept.sum())
        return "" if n >= ENOUGH else _too_few(n)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able result; where fewer than two flights are kept, the intervals are missing and "remark" says why."""
        first, *others = self.found
        quantities = [] if self.remark else [name for name, _ in COMPARED]

        def named(value: tuple[float, float]) -> dict[str, float]:
            return {"mean": value[0], "half_width": value[1]}

        data = {
            "cases": len(self.kept), "kept": int(self.kept.sum()), "confidence": CONFIDENCE,
            "methods": {method: {name: named(self.interval(method, name)) for name in quantities} for method in self.found},
            "differences": {
                "from": first,
                "methods": {method: {name: named(self.difference(method, first, name)) for name in quantities} for method in others},
            },
        }  # fmt: skip
        return data | ({"remark": self.remark} if self.remark else {})

    def tables(self) -> list[Table]:
        """Means and differences; none where fewer than two flights are kept."""
        return [] if self.remark else [self.table(), self.differences()]

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
            f"{what} with {100 * CONFIDENCE:g} % confidence intervals over {int(self.kept.sum())} of {len(self.kept)} flights,"
            " those in authority and inside the tables under every method.",
        )  # fmt: skip


def _interval(values: np.ndarray) -> tuple[float, float]:
    n = len(values)
    if n < ENOUGH:
        raise ModelError(_too_few(n))
    return float(values.mean()), float(stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE) * values.std(ddof=1) / math.sqrt(n))


def _too_few(n: int) -> str:
    flights = "1 flight is" if n == 1 else f"{n} flights are"
    return (
        f"compare: {flights} finite, in authority and inside the tables under every method, expected at least two for an interval;"
        " fly more dispersions, or change the vehicle less"
    )


def of_studies(studies: Mapping[str, BlendStudy]) -> MethodComparison:
    """Compare studies of the same random dispersions, one for each method.

    Parameters
    ----------
    studies : mapping of str to BlendStudy
        By method; flown with equal `cases`, `seed`, `changes`, `jets`, q1 and q2.

    Raises
    ------
    ModelError
        No study, one without random dispersions, studies of flights that differ.
    """
    if not studies:
        raise ModelError("compare: no study is given, expected at least one, by method; fly some with studies.blend.run")
    found = {}
    for method, study in studies.items():
        if study.ensemble is None:
            raise ModelError(f"compare: {method} has no random dispersions; fly it with cases of at least 2")
        found[method] = study.ensemble
    first, *others = studies
    wanted = _flown(studies[first])
    for method in others:
        for what, value in _flown(studies[method]).items():
            if value != wanted[what]:
                raise ModelError(
                    f"compare: {method} and {first} differ in {what}: found {value} and {wanted[what]}, expected equal ones;"
                    " fly all methods with the same cases, seed, changes, jets and hand-over"
                )
    kept = np.ones(np.size(found[first].rms_deg), dtype=bool)
    for method, ensemble in found.items():
        kept &= ~np.asarray(ensemble.out_of_authority | ensemble.outside_tables)
        kept[list(studies[method].failed)] = False
    return MethodComparison(found, kept)


def _flown(study: BlendStudy) -> dict[str, Any]:
    """What must be equal for flight i of one study to be flight i of another."""
    settings = study.loop.settings
    flights = 0 if study.ensemble is None else np.size(study.ensemble.rms_deg)
    return {
        "the number of flights": flights, "seed": study.seed, "changes": dict(study.changes), "jets": study.jets,
        "q1": settings.q1, "q2": settings.q2,
    }  # fmt: skip


def compare(
    methods: Sequence[str] = ("paper", "qp", "pinv"), *, cases: int = 200, seed: int = 2012, jets: int = 6,
    handover: blending.Handover | None = None, changes: Mapping[str, float] | None = None,
) -> MethodComparison:  # fmt: skip
    """Fly the same random dispersions under several allocation methods, all inside compiled loops.

    Parameters
    ----------
    methods : sequence of str
        Names of ``METHODS``; one that is named twice is flown once.
    cases : int
        Flights, >= 2.
    seed : int
    jets : {2, 4, 6}
    handover : Handover, optional
    changes : mapping, optional
        Of the flown vehicle and its start, as :func:`studies.blend.run` takes them.

    Raises
    ------
    ModelError
        An unknown method, fewer than two flights, a changed value outside its range.
    """
    from studies.blend import run

    if isinstance(cases, bool) or not isinstance(cases, int) or cases < 2:
        raise ModelError(f"compare: cases: expected a whole number of at least 2, got {cases!r}")
    settings: dict[str, Any] = {"cases": cases, "seed": seed, "jets": jets, "handover": handover, "changes": changes}
    return of_studies({method: run(method=method, **settings) for method in dict.fromkeys([_known(m) for m in methods])})
