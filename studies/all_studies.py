"""All studies in the order of the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from models.checked import ModelError
from studies.result import StudyResult

FULL_FACTOR = 10


@dataclass(frozen=True, slots=True, eq=False)
class Order:
    """What is asked of every study: the scenario, the number of dispersed cases in a set, and who is told of the progress."""

    scenario: Any
    cases: int
    full: bool
    progress: Callable[..., None] | None


def _at_most(cases: int, order: Order) -> int:
    """Cases of a study whose flights are costly: no more than `cases` unless everything is asked for."""
    return order.cases if order.full else min(order.cases, cases)


# Module (imported only when it is run) and its call; a new study is one more line.
STUDIES: tuple[tuple[str, Callable[[Any, Order], StudyResult]], ...] = (
    ("studies.gains", lambda study, order: study.run(order.scenario, dispersions=order.cases, progress=order.progress).result()),
    ("studies.modulators", lambda study, order: study.run(progress=order.progress).result()),
    ("studies.jetloop", lambda study, order: study.run(loops=100_000 if order.full else 10_000, progress=order.progress).result()),
    ("studies.blend", lambda study, order: study.run(singles=True, cases=order.cases).result()),
    ("studies.allocation_report", lambda study, order: study.result(flights=max(2, order.cases))),
    ("studies.landing", lambda study, order: study.run(cases=_at_most(300, order), progress=order.progress).result()),
)


def run_all(scenario: object, *, full: bool = False, cases: int = 500, progress: Callable[..., None] | None = None) -> list[StudyResult]:
    """Run every study.

    Parameters
    ----------
    scenario : Scenario
    full : bool
        Ten times the cases.
    cases : int
        Dispersed cases in each set, >= 1.
    progress : callable, optional
        Handed to each study.

    Returns
    -------
    list of StudyResult
        In the order of ``STUDIES``.

    Raises
    ------
    ModelError
        From `cases` or from a study.
    """
    if isinstance(cases, bool) or not isinstance(cases, int) or cases < 1:
        raise ModelError(f"run_all: cases must be an integer >= 1, got {cases!r}")
    order = Order(scenario=scenario, cases=cases * FULL_FACTOR if full else cases, full=full, progress=progress)
    return [_run(module, call, order) for module, call in STUDIES]


def _run(module: str, call: Callable[[Any, Order], StudyResult], order: Order) -> StudyResult:
    result = call(import_module(module), order)
    if not isinstance(result, StudyResult):
        raise ModelError(
            f"{module}: expected a StudyResult, got {type(result).__name__}; every study hands over studies.result.StudyResult"
        )
    return result
