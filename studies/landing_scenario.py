"""Scenario of a landing study: reference N2, its target, the dispersions, the sensors, the bank servo and the guidance law."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import ConfigDict, Field

from studies.scenario_document import ScenarioDocument
from studies.scenario_sections import Atmosphere, Real, Section, real_key

SetName = Literal["none", "density", "small", "medium", "hard"]
LawName = Literal["paper", "modern"]


class Vehicle(Section):
    """The capsule as a point mass."""

    name: str = Field(default="N2", min_length=1, max_length=80, description="name of vehicle and flight, for headings")
    lift_to_drag: Real = real_key(0.30, "lift over drag, CL/CD", 0.01, 4.0)
    ballistic_coefficient_kg_m2: Real = real_key(450.0, "mass/(CD area)", 1.0, 1e5, remedy="in kg/m2: 1 lb/ft2 is 4.8824 kg/m2")
    nose_radius_m: Real = real_key(1.0, "nose radius, for the heating rate", 1e-3, 100.0)


class Reference(Section):
    """The reference flight: entry, bank profile with one reversal, end."""

    altitude_m: Real = real_key(100000.0, "altitude at entry", 20e3, 200e3, remedy="in metres: 100 km is 100000")
    latitude_deg: Real = real_key(17.0, "geocentric latitude at entry", -85.0, 85.0)
    longitude_deg: Real = real_key(108.0, "longitude at entry", -360.0, 360.0)
    azimuth_deg: Real = real_key(8.0, "heading at entry, from north, clockwise", -360.0, 360.0)
    speed_m_s: Real = real_key(7650.0, "speed at entry, planet-relative", 1000.0, 15000.0, remedy="in m/s: 7.65 km/s is 7650")
    path_angle_deg: Real = real_key(
        -1.6, "flight-path angle at entry, negative downwards", -30.0, -0.1, remedy="in degrees, negative downwards"
    )
    bank_deg: Real = real_key(45.0, "bank angle before and, with the other sign, after the reversal", 1.0, 179.0, remedy="in degrees")
    reversal_at_s: Real = real_key(260.0, "middle of the reversal, t_n", 0.0, 5000.0)
    reversal_s: Real = real_key(30.0, "duration of the reversal", 0.1, 1000.0)
    stop_altitude_m: Real = real_key(10000.0, "altitude at which the flight ends", 0.0, 90e3, remedy="in metres: 10 km is 10000")


class Landing(Section):
    """The landing point asked for; the defaults are where reference N2 lands."""

    latitude_deg: Real = real_key(39.180093295935, "geocentric latitude", -89.0, 89.0)
    longitude_deg: Real = real_key(112.300634384988, "longitude", -360.0, 360.0)


class Truth(Section):
    """Errors that all flights share, besides the dispersions."""

    density_factor: Real = real_key(1.0, "density over the model's", 0.05, 20.0)
    drag_factor: Real = real_key(1.0, "drag coefficient over the vehicle's", 0.05, 20.0)
    lift_factor: Real = real_key(1.0, "lift coefficient over the vehicle's", -20.0, 20.0)
    mach_lift: Real = real_key(0.0, "relative change of lift from high to low Mach number (middle at Mach 4)", -0.9, 5.0)
    atmosphere: Literal["onboard", "us76_smooth"] = Field(
        default="onboard", description="air that is flown through: as assumed on board (section atmosphere), or us76_smooth"
    )


class Sensors(Section):
    """Standard deviations of the errors of navigation, accelerometers and bank angle; constant in a flight but for the noise."""

    position_m: Real = real_key(0.0, "position, each axis", 0.0, 1e5)
    velocity_m_s: Real = real_key(0.0, "velocity, each axis", 0.0, 1e3)
    force_bias_m_s2: Real = real_key(0.0, "accelerometer bias, each axis", 0.0, 10.0)
    force_noise_m_s2: Real = real_key(0.0, "accelerometer noise, each axis", 0.0, 10.0)
    bank_deg: Real = real_key(0.0, "bank angle", 0.0, 5.0)


class Actuator(Section):
    """Response of the bank angle."""

    rate_deg_s: Real = real_key(20.0, "limit of the bank rate", 0.5, 360.0)
    acceleration_deg_s2: Real = real_key(10.0, "limit of the bank acceleration", 0.5, 360.0)


class LandingGuidance(Section):
    """The guidance law."""

    law: LawName = Field(
        default="modern", description="paper: one reversal, two unknowns every 10 s (paper 004); modern: several reversals, Gauss-Newton"
    )
    gravity: Literal["oblate", "central"] = Field(
        default="oblate", description="field of the prediction; the paper's is central and leaves a bias of 0.2 km"
    )
    reversals: int = Field(default=4, strict=True, ge=0, le=8, description="modern: reversals kept in the plan")
    kappa: Real = real_key(0.55, "modern: share of the remaining time between two reversals", 0.05, 0.95)
    reserve_deg: Real = real_key(55.0, "modern: bank angle to which the plan runs before the end", 5.0, 120.0)
    load_limit_g: Real = real_key(100.0, "modern: load that the plan should not exceed (100: none)", 1.0, 100.0)
    heat_limit_w_m2: Real = real_key(1e9, "modern: heating rate that the plan should not exceed (1e9: none)", 1e3, 1e9)


class LandingDispersions(Section):
    """Dispersed flights."""

    set: SetName = Field(default="hard", description="none, density, small, medium or hard")
    scale: Real = real_key(1.0, "factor on all half-widths of the set", 0.0, 3.0)
    seed: int = Field(default=19980402, strict=True, ge=0, le=2**53, description="seed of the random draws")


class LandingNumerics(Section):
    """Accuracy of the flights."""

    step_s: Real = real_key(0.25, "integration step of the truth; the bank servo needs half a second", 0.01, 0.5)


class LandingScenario(ScenarioDocument):
    """Everything of a landing study. Frozen.

    Examples
    --------
    >>> LandingScenario().edit({"guidance.law": "paper"}).guidance.law
    'paper'
    """

    model_config = ConfigDict(title="Scenario of a landing study", hide_input_in_errors=False)
    COMMAND: ClassVar[str] = "land"
    SUBJECT: ClassVar[str] = "a landing study"
    EMPTY_IS_DEFAULT: ClassVar[bool] = True

    vehicle: Vehicle = Field(default=Vehicle(), description="the capsule: a point mass with constant lift and drag coefficients")
    atmosphere: Atmosphere = Field(default=Atmosphere(), description="density against altitude, as assumed on board")
    reference: Reference = Field(default=Reference(), description="the reference flight: entry, bank profile with one reversal, end")
    target: Landing = Field(default=Landing(), description="the landing point asked for; by default that of reference N2")
    truth: Truth = Field(default=Truth(), description="errors that all flights share, besides the dispersions")
    sensors: Sensors = Field(default=Sensors(), description="errors of navigation, accelerometers and bank angle (standard deviations)")
    actuator: Actuator = Field(default=Actuator(), description="response of the bank angle: second order with limits")
    guidance: LandingGuidance = Field(default=LandingGuidance(), description="the guidance law")
    dispersions: LandingDispersions = Field(default=LandingDispersions(), description="dispersed flights")
    numerics: LandingNumerics = Field(default=LandingNumerics(), description="accuracy of the flights")
