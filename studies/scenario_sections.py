"""Sections of a scenario: every key with its default (reference N1), unit, range and meaning.

Source: Tang & Zhao 2000 (paper 003) for weights, printed gains and dispersions. The paper does not identify its vehicle and
flight; reference N1 was found by a search so that the computed gains meet the printed ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

Real = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Scale = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1e-9, le=1e9)]
Four = tuple[Scale, Scale, Scale, Scale]


def real_key(default: Any, text: str, low: float, high: float, *, remedy: str = "") -> Any:
    """A number with its closed range; `remedy` is the hint of an error message, usually about the unit."""
    return Field(default=default, ge=low, le=high, description=text, json_schema_extra={"remedy": remedy} if remedy else None)


def _half_width(text: str, high: float, *, remedy: str = "") -> Any:
    """As :func:`real_key` without a default: each dispersion set has its own."""
    return Field(ge=0.0, le=high, description=text, json_schema_extra={"remedy": remedy} if remedy else None)


class Section(BaseModel):
    """One mapping of a scenario file: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", revalidate_instances="always")


class Vehicle(Section):
    """The capsule as a point mass with constant lift and drag coefficients."""

    name: str = Field(default="N1", min_length=1, max_length=80, description="name of vehicle and flight, for headings")
    lift_to_drag: Real = real_key(0.25, "largest lift over drag, CL/CD", 0.01, 4.0)
    ballistic_coefficient_kg_m2: Real = real_key(450.0, "mass/(CD area)", 1.0, 1e5, remedy="in kg/m2: 1 lb/ft2 is 4.8824 kg/m2")

    @field_validator("name")
    @classmethod
    def _printable(cls, value: str) -> str:
        if not value.isprintable():
            raise PydanticCustomError("cross", "{found}", {"found": "control characters found, expected printable text"})
        return value


class Planet(Section):
    """A spherical planet that does not rotate."""

    gravitational_parameter_m3_s2: Real = real_key(
        3.986004418e14, "gravitational parameter", 1e9, 1e18, remedy="in m3/s2: 1 km3/s2 is 1e9 m3/s2"
    )
    radius_m: Real = real_key(6371000.0, "radius", 1e5, 1e8, remedy="in metres: 6371 km is 6371000")


class Atmosphere(Section):
    """Density against altitude."""

    model: Literal["exponential", "us76_smooth"] = Field(
        default="exponential", description="exponential (with the two keys below), or us76_smooth (US Standard Atmosphere 1976, smoothed)"
    )
    surface_density_kg_m3: Real = real_key(1.225, "exponential: density at altitude 0", 1e-9, 1e3)
    scale_height_m: Real = real_key(
        7110.0, "exponential: altitude over which density falls by e", 500.0, 1e5, remedy="in metres: 7.11 km is 7110"
    )

    @model_validator(mode="after")
    def _no_idle_keys(self) -> Atmosphere:
        if self.model == "us76_smooth":
            for key in ("surface_density_kg_m3", "scale_height_m"):
                value, default = getattr(self, key), type(self).model_fields[key].default
                if value != default:
                    text = f"found {value!r}, but it has no effect with model: us76_smooth; remove the key or choose model: exponential"
                    raise PydanticCustomError("cross", "{found}", {"found": text, "key": key})
        return self


class Reference(Section):
    """The reference flight: entry state, constant bank angle and end."""

    bank_deg: Real = real_key(
        45.0, "constant bank angle (magnitude)", 0.0, 180.0, remedy="in degrees, as a magnitude: the planar flight has no side"
    )
    altitude_m: Real = real_key(100000.0, "altitude at entry", 20e3, 200e3, remedy="in metres: 100 km is 100000")
    speed_m_s: Real = real_key(7800.0, "speed at entry, planet-relative", 1000.0, 15000.0, remedy="in m/s: 7.8 km/s is 7800")
    path_angle_deg: Real = real_key(
        -1.36, "flight-path angle at entry, negative downwards", -30.0, -0.1, remedy="in degrees, negative downwards: -0.0237 rad is -1.36"
    )
    stop_altitude_m: Real = real_key(10000.0, "altitude at which the flight ends", 0.0, 150e3, remedy="in metres: 10 km is 10000")
    t_max_s: Real = real_key(3000.0, "time after which a flight counts as skipped out", 10.0, 1e5)

    @model_validator(mode="after")
    def _stop_below_entry(self) -> Reference:
        stop = self.stop_altitude_m
        text = ""
        if stop >= self.altitude_m:
            text = f"found {stop!r}, expected less than reference.altitude_m = {self.altitude_m!r}; lower the end or raise the entry"
        elif 0.0 < stop < 200.0:
            text = f"found {stop!r}, which looks like kilometres; write {stop * 1e3:.10g} for {stop:g} km, or 0 for the ground"
        if text:
            raise PydanticCustomError("cross", "{found}", {"found": text, "key": "stop_altitude_m"})
        return self


class Weights(Section):
    """Weights of the quadratic cost, each by its scale: the matrix is diag(1/scale^2)."""

    terminal: Four = Field(
        default=(0.1, 250.0, 200.0, 500.0), description="scales of the deviation at the end",
        json_schema_extra={"components": ["n_x (g)", "hdot (m/s)", "s (m)", "sdot (m/s)"]},
    )  # fmt: skip
    state: Four = Field(
        default=(0.5, 750.0, 7500.0, 2000.0), description="scales of the deviation in flight",
        json_schema_extra={"components": ["n_x (g)", "hdot (m/s)", "s (m)", "sdot (m/s)"]},
    )  # fmt: skip
    control: Real = real_key(0.06, "scale of the correction of CL/CD cos(bank)", 1e-9, 1e9)

    @field_validator("terminal", "state", mode="before")
    @classmethod
    def _whole_list(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != 4:
            raise PydanticCustomError("shape", "list of four")
        return value


class PaperGains(Section):
    """Constant gains printed in the paper, in its own sign: correction = K1 dn_x + K2 dhdot + K3 ds + K4 dsdot."""

    K1: Real = real_key(-0.62, "gain of axial load (negative in flight), 1/g", -1e3, 1e3)
    K2: Real = real_key(-1.5e-3, "gain of altitude rate, s/m", -1e3, 1e3)
    K3a: Real = real_key(-5.2e-6, "gain of downrange before split_s, 1/m", -1e3, 1e3)
    K3b: Real = real_key(-2.2e-5, "gain of downrange from split_s on, 1/m", -1e3, 1e3)
    K4: Real = real_key(-7.5e-4, "gain of downrange rate, s/m", -1e3, 1e3)


class Guidance(Section):
    """How the gains are flown."""

    sample_s: Real = real_key(1.0, "time between guidance commands", 0.01, 100.0)
    gate_load_g: Real = real_key(0.05, "axial load above which feedback is on", 0.0, 1.0, remedy="in g0")
    split_s: Real = real_key(400.0, "time at which K3 changes from K3a to K3b", 0.0, 1e5)
    paper_gains: PaperGains = Field(default=PaperGains(), description="constants printed in the paper")


_FRACTION = "a fraction: 30 % is 0.30"


class DispersionSet(Section):
    """Half-widths of independent uniform laws."""

    path_angle_deg: Real = _half_width("flight-path angle at entry", 5.0)
    speed_m_s: Real = _half_width("speed at entry", 1000.0)
    density: Real = _half_width("density, fraction", 0.9, remedy=_FRACTION)
    drag: Real = _half_width("drag coefficient, fraction", 0.9, remedy=_FRACTION)
    lift: Real = _half_width("lift coefficient, fraction", 0.9, remedy=_FRACTION)
    wave_amplitude: Real = _half_width("density wave along altitude, fraction (its phase is uniform)", 0.9, remedy=_FRACTION)
    wave_length_m: Real = Field(
        ge=1000.0, le=1e6, description="wave length of that wave (not a half-width)", json_schema_extra={"remedy": "in metres"}
    )


_SMALL = DispersionSet(path_angle_deg=0.05, speed_m_s=10.0, density=0.10, drag=0.05, lift=0.05, wave_amplitude=0.0, wave_length_m=30000.0)
_LARGE = DispersionSet(path_angle_deg=0.1, speed_m_s=10.0, density=0.30, drag=0.10, lift=0.10, wave_amplitude=0.0, wave_length_m=30000.0)
_WAVE = DispersionSet(path_angle_deg=0.1, speed_m_s=10.0, density=0.30, drag=0.10, lift=0.10, wave_amplitude=0.10, wave_length_m=30000.0)


class DispersionSets(Section):
    """The three sets by name; keys left out of a set keep that set's own default."""

    small: DispersionSet = Field(default=_SMALL, description="small dispersions")
    large: DispersionSet = Field(default=_LARGE, description="large dispersions")
    large_wave: DispersionSet = Field(default=_WAVE, description="large dispersions and a density wave")

    @model_validator(mode="before")
    @classmethod
    def _own_defaults(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        filled = dict(value)
        for key, given in value.items():
            if key in cls.model_fields and isinstance(given, dict):
                filled[key] = {**cls.model_fields[key].default.model_dump(), **given}
        return filled

    def items(self) -> Iterator[tuple[str, DispersionSet]]:
        """Pairs of name and set, in order."""
        for key in type(self).model_fields:
            yield key, getattr(self, key)


class Dispersions(Section):
    """Dispersed closed-loop flights."""

    seed: int = Field(default=20000503, strict=True, ge=0, le=2**53, description="seed of the random draws")
    sets: DispersionSets = Field(default=DispersionSets(), description="half-widths of the dispersions")


class Numerics(Section):
    """Accuracy."""

    step_s: Real = real_key(0.5, "integration step", 0.01, 5.0)


_SPREAD = "half-width of a uniform law, standard deviation of a normal one"
Law = Literal["uniform", "normal"]
_LAW: Any = Field(default="uniform", description="uniform, or normal")


class PathAngleLaw(Section):
    """Law of the flight-path angle at entry."""

    law: Law = _LAW
    spread: Real = real_key(_LARGE.path_angle_deg, _SPREAD, 0.0, 5.0, remedy="in degrees")


class SpeedLaw(Section):
    """Law of the speed at entry."""

    law: Law = _LAW
    spread: Real = real_key(_LARGE.speed_m_s, _SPREAD, 0.0, 1000.0, remedy="in m/s")


class DensityLaw(Section):
    """Law of the density, as a fraction of the model's."""

    law: Law = _LAW
    spread: Real = real_key(_LARGE.density, _SPREAD, 0.0, 0.9, remedy=_FRACTION)


class CoefficientLaw(Section):
    """Law of an aerodynamic coefficient, as a fraction of the vehicle's."""

    law: Law = _LAW
    spread: Real = real_key(_LARGE.drag, _SPREAD, 0.0, 0.9, remedy=_FRACTION)


class Distributions(Section):
    """What is dispersed in a campaign, and how; the defaults are those of the set `large`."""

    path_angle_deg: PathAngleLaw = Field(default=PathAngleLaw(), description="flight-path angle at entry, degrees")
    speed_m_s: SpeedLaw = Field(default=SpeedLaw(), description="speed at entry, m/s")
    density: DensityLaw = Field(default=DensityLaw(), description="density, fraction")
    drag: CoefficientLaw = Field(default=CoefficientLaw(), description="drag coefficient, fraction")
    lift: CoefficientLaw = Field(default=CoefficientLaw(), description="lift coefficient, fraction")
    wave_amplitude: Real = real_key(0.0, "density wave along altitude, fraction (its phase is uniform)", 0.0, 0.9, remedy=_FRACTION)
    wave_length_m: Real = real_key(30000.0, "wave length of that wave", 1000.0, 1e6, remedy="in metres")


class Campaign(Section):
    """Many dispersed flights of one study, computed in chunks that survive an interruption."""

    study: Literal["gains"] = Field(default="gains", description="the study whose guidance is flown")
    schedule: Literal["open_loop", "time_varying", "least_squares", "time_mean", "paper", "paper_unsplit"] = Field(
        default="time_varying", description="gain schedule that is flown"
    )
    cases: int = Field(default=10000, strict=True, ge=1, le=10**8, description="number of flights")
    chunk: int = Field(default=1000, strict=True, ge=1, le=10**6, description="flights computed and stored together")
    design: Literal["independent", "latin_hypercube", "sobol"] = Field(
        default="independent", description="independent draws, latin_hypercube, or sobol (scrambled; best with a power of two of cases)"
    )
    seed: int = Field(default=20000503, strict=True, ge=0, le=2**53, description="seed of the draws")
    distributions: Distributions = Field(default=Distributions(), description="laws of the dispersed quantities")
