"""Entry vehicles as frozen parameter sets, read from ``models/data/capsules.yaml`` with the source of every number."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from types import MappingProxyType
from typing import Any

import casadi as ca
from ruamel.yaml import YAML

from models.core import ModelError, as_scalar, unknown_name

Coefficient = float | Callable[[ca.SX], ca.SX]


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """Point-mass vehicle flown at trim.

    Attributes
    ----------
    name : str
    mass : float
        kg.
    area : float
        Aerodynamic reference area, m2.
    CL, CD : float or callable
        Trim coefficients: constants, or functions of Mach number on ``casadi.SX`` (such as ``models.tables.Table``).
    nose_radius : float or None
        m.
    entry : mapping
        Published entry conditions in SI and radians: h, V, gamma and, where known, lat, lon, psi.
    source : str
    """

    name: str
    mass: float
    area: float
    CL: Coefficient
    CD: Coefficient
    nose_radius: float | None = None
    entry: Mapping[str, float] = field(default_factory=dict)
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("mass", "area", "nose_radius", "CL", "CD"):
            value = getattr(self, name)
            if (name == "nose_radius" and value is None) or (name in ("CL", "CD") and callable(value)):
                continue
            number = as_scalar(f"Vehicle {self.name}: {name}", value)
            if name != "CL" and number <= 0:
                raise ModelError(f"Vehicle {self.name}: {name} must be finite and > 0, got {value}; give it in SI units")
            object.__setattr__(self, name, number)
        object.__setattr__(self, "entry", MappingProxyType(dict(self.entry)))

    def cl(self, mach: ca.SX) -> ca.SX:
        """Lift coefficient at a Mach number."""
        return self.CL(mach) if callable(self.CL) else ca.SX(self.CL)

    def cd(self, mach: ca.SX) -> ca.SX:
        """Drag coefficient at a Mach number."""
        return self.CD(mach) if callable(self.CD) else ca.SX(self.CD)

    @property
    def lift_to_drag(self) -> float:
        """CL/CD of constant coefficients."""
        cl, cd = self._constants("lift_to_drag")
        return cl / cd

    @property
    def ballistic_coefficient(self) -> float:
        """m/(CD area) of a constant drag coefficient, kg/m2."""
        return self.mass / (self._constants("ballistic_coefficient")[1] * self.area)

    def _constants(self, what: str) -> tuple[float, float]:
        if callable(self.CL) or callable(self.CD):
            raise ModelError(f"Vehicle {self.name}: {what} depends on Mach number here; evaluate CL and CD at one Mach number")
        return float(self.CL), float(self.CD)


def from_ratios(name: str, *, ballistic_coefficient: float, lift_to_drag: float) -> Vehicle:
    """A vehicle known only by m/(CD S) in kg/m2 and L/D: unit area and drag coefficient."""
    mass = as_scalar("from_ratios: ballistic_coefficient", ballistic_coefficient)
    if mass <= 0:
        raise ModelError(f"from_ratios: ballistic_coefficient must be finite and > 0 kg/m2, got {ballistic_coefficient}")
    return Vehicle(
        name, mass, 1.0, as_scalar("from_ratios: lift_to_drag", lift_to_drag), 1.0, source="two ratios only; no vehicle identified"
    )


@lru_cache(maxsize=1)
def _records() -> dict[str, Any]:
    text = (resources.files("models") / "data" / "capsules.yaml").read_text(encoding="utf-8")
    records: dict[str, Any] = YAML(typ="safe").load(text)
    return records


def vehicle_names() -> tuple[str, ...]:
    """Names accepted by :func:`vehicle`."""
    return tuple(name for name in _records() if name != "schema")


def vehicle(name: str) -> Vehicle:
    """A vehicle of the data file by name, such as ``"soyuz_ms03"``."""
    if name not in vehicle_names():
        raise ModelError(unknown_name("vehicle", name, vehicle_names()))
    record = _records()[name]
    entry = dict(record["entry"])
    for key in ("gamma", "psi", "lat", "lon"):
        if f"{key}_deg" in entry:
            entry[key] = math.radians(entry.pop(f"{key}_deg"))
    return Vehicle(
        name=name, mass=record["mass_kg"], area=record["area_m2"], CL=record["CL"], CD=record["CD"],
        nose_radius=record.get("nose_radius_m"), entry=entry, source=record["source"],
    )  # fmt: skip


SOYUZ = vehicle("soyuz_ms03")
SHENZHOU = vehicle("shenzhou")
APOLLO = vehicle("apollo10")
