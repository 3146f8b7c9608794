"""The scenario of a study: one checked YAML file, the same for the command line and for Python.

A file holds only the keys it changes; every other key keeps the value of reference N1. The unit stands in the name of each key.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import ConfigDict, Field

from studies.scenario_document import ScenarioDocument
from studies.scenario_sections import Atmosphere, Campaign, Dispersions, Guidance, Numerics, Planet, Reference, Vehicle, Weights
from studies.scenario_text import ScenarioError

if TYPE_CHECKING:
    from studies.gains import GainsStudy

__all__ = ["Scenario", "ScenarioError"]


class Scenario(ScenarioDocument):
    """Vehicle, environment, reference flight, weights, guidance, dispersions and numerics of a study. Frozen.

    Examples
    --------
    >>> Scenario.default().edit({"vehicle.lift_to_drag": 0.3}).vehicle.lift_to_drag
    0.3
    """

    model_config = ConfigDict(title="Scenario of an entry guidance study", hide_input_in_errors=False)
    COMMAND: ClassVar[str] = "gains"
    SUBJECT: ClassVar[str] = "an entry guidance study"

    vehicle: Vehicle = Field(default=Vehicle(), description="the capsule: a point mass with constant lift and drag coefficients")
    planet: Planet = Field(default=Planet(), description="a spherical planet without rotation")
    atmosphere: Atmosphere = Field(default=Atmosphere(), description="density against altitude")
    reference: Reference = Field(default=Reference(), description="the reference flight: entry state, constant bank angle and end")
    weights: Weights = Field(
        default=Weights(), description="quadratic cost, each weight by its scale; the matrix is diag(1/scale^2); order n_x, hdot, s, sdot"
    )
    guidance: Guidance = Field(default=Guidance(), description="how the gains are flown")
    dispersions: Dispersions = Field(default=Dispersions(), description="dispersed closed-loop flights")
    numerics: Numerics = Field(default=Numerics(), description="accuracy")
    campaign: Campaign = Field(default=Campaign(), description="a campaign of many dispersed flights (reentry campaign)")

    @classmethod
    def default(cls) -> Scenario:
        """Reference N1, which meets the printed gains of Tang & Zhao 2000 (paper 003)."""
        return cls()

    def remarks(self) -> list[str]:
        """Values that are accepted but look unintended, each as one sentence; usually empty."""
        notes = []
        bank = self.reference.bank_deg
        if 0.0 < bank < math.pi:
            notes.append(f"reference.bank_deg = {bank:g} is taken in degrees; if it is meant in radians write {math.degrees(bank):.4g}")
        return notes

    def run(
        self, *, dispersions: int = 0, at: Sequence[float] | None = None, progress: Callable[[str, float], None] | None = None
    ) -> GainsStudy:
        """Synthesize the gains of this scenario, and fly `dispersions` dispersed cases of each set; see :func:`studies.gains.run`."""
        from studies import gains

        return gains.run(self, dispersions=dispersions, at=at, progress=progress)

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """JSON schema (draft 2020-12) for editors."""
        schema = Scenario.model_json_schema()
        # each dispersion set has its own defaults, so that no key of it must be given
        schema["$defs"]["DispersionSet"].pop("required", None)
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
