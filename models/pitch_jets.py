"""The orbiter's aft pitch jets as two effectors: force and moment of all nose-up and of all nose-down jets together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from models.checked import Array, ModelError, frozen
from models.thrusters import orbiter_jets

# Symmetric pairs in the order in which they are taken: the manifolds that feed both directions come first.
_ORDER = {"U": ("2", "4", "1"), "D": ("2", "4", "3")}


@dataclass(frozen=True, slots=True, eq=False)
class PitchJets:
    """Aft jets that fire together, nose up or nose down.

    Attributes
    ----------
    up, down : tuple of str
        Names of the jets.  Plumes go up for nose-up moments.
    force_up, force_down : ndarray, shape (2,)
        Sum of the forces along body x (forward) and z (down), N.
    moment_up, moment_down : float
        Pitching moment about the moment reference, N m; > 0 and < 0.
    flow_up, flow_down : float
        Propellant of all of them, kg/s.
    """

    up: tuple[str, ...]
    down: tuple[str, ...]
    force_up: Array
    force_down: Array
    moment_up: float
    moment_down: float
    flow_up: float
    flow_down: float

    def moments(self, cg_aft: Any = 0.0) -> tuple[Any, Any]:
        """Moments of all nose-up and all nose-down jets about a centre of mass `cg_aft` m behind the reference, N m."""
        return self.moment_up - cg_aft * self.force_up[1], self.moment_down - cg_aft * self.force_down[1]

    def wrench(self, up: Any, down: Any, cg_aft: Any = 0.0) -> tuple[Any, Any, Any]:
        """Force along body x and z (N) and pitching moment (N m) for shares of both groups."""
        x, z = (up * float(a) + down * float(b) for a, b in zip(self.force_up, self.force_down, strict=True))
        at_up, at_down = self.moments(cg_aft)
        return x, z, up * at_up + down * at_down


@lru_cache(maxsize=4)
def pitch_jets(count: int = 6) -> PitchJets:
    """Aft pitch jets: `count` nose-up and as many nose-down ones, in left-right pairs.

    Parameters
    ----------
    count : {2, 4, 6}

    Raises
    ------
    ModelError
        Another number.

    Source: :func:`models.thrusters.orbiter_jets`.
    """
    if isinstance(count, bool) or count not in (2, 4, 6):
        raise ModelError(f"pitch_jets: count must be 2, 4 or 6 jets in each direction, got {count!r}; they fire in left-right pairs")
    found = []
    for plume, order in _ORDER.items():
        jets = orbiter_jets().pick(f"{side}{manifold}{plume}" for manifold in order[: count // 2] for side in "LR")
        wrench = jets.effectiveness().sum(axis=1)  # left and right cancel in Fy, L and N
        found.append((jets.names, frozen(wrench[[0, 2]]), float(wrench[4]), float(jets.flow.sum())))
    up, down = found
    return PitchJets(up[0], down[0], up[1], down[1], up[2], down[2], up[3], down[3])
