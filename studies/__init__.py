"""Studies of published results, their scenarios and reports, and the command line ``reentry``."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from studies.scenario import Scenario, ScenarioError

__all__ = ["Scenario", "ScenarioError"]

# Name -> module: nothing is imported before it is asked for, so that `reentry --help` answers at once.
_EXPORTS = {"Scenario": "studies.scenario", "ScenarioError": "studies.scenario"}


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'studies' has no attribute {name!r}; known: {', '.join(_EXPORTS)}")
    return getattr(import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_EXPORTS])
