"""Symbolic models of entry vehicles, their environment, and their jets with modulators and limit cycles (CasADi)."""

from models.atmosphere import Atmosphere, exponential, us76, us76_smooth
from models.core import Model, ModelError, Status, Var, define
from models.entry import EARTH, SPHERE, Planet, entry_3dof, entry_planar
from models.entry_cartesian import entry_cartesian, to_cartesian, to_spherical
from models.vehicles import APOLLO, SHENZHOU, SOYUZ, Vehicle, from_ratios, vehicle
from models.wind import Wind

__all__ = [
    "APOLLO",
    "EARTH",
    "SHENZHOU",
    "SOYUZ",
    "SPHERE",
    "Atmosphere",
    "Model",
    "ModelError",
    "Planet",
    "Status",
    "Var",
    "Vehicle",
    "Wind",
    "define",
    "entry_3dof",
    "entry_cartesian",
    "entry_planar",
    "exponential",
    "from_ratios",
    "to_cartesian",
    "to_spherical",
    "us76",
    "us76_smooth",
    "vehicle",
]
