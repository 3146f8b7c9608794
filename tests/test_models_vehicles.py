"""Vehicles: the numbers of the data file, derived ratios, and refusals."""

import math

import casadi as ca
import pytest

import models
from models.core import ModelError
from models.vehicles import Vehicle, from_ratios, vehicle, vehicle_names


def test_soyuz_has_the_printed_numbers():
    soyuz = models.SOYUZ
    assert (soyuz.mass, soyuz.area, soyuz.CL, soyuz.CD, soyuz.nose_radius) == (2900.0, 3.8, 0.349, 1.341, 2.235)
    assert soyuz.lift_to_drag == pytest.approx(0.2603, abs=5e-5)
    assert soyuz.ballistic_coefficient == pytest.approx(569.1, abs=0.05)
    assert soyuz.entry["gamma"] == pytest.approx(math.radians(-1.5), rel=1e-15)
    assert soyuz.entry["lat"] == pytest.approx(math.radians(34.35), rel=1e-15)
    assert (soyuz.entry["h"], soyuz.entry["V"]) == (99700.0, 7619.0)


def test_apollo_and_shenzhou():
    assert models.APOLLO.lift_to_drag == pytest.approx(0.3247, abs=5e-5)
    assert models.APOLLO.ballistic_coefficient == pytest.approx(364.0, abs=0.05)
    assert models.SHENZHOU.area == pytest.approx(math.pi / 4 * 2.52**2, rel=2e-4)
    assert "estimated" in models.SHENZHOU.source


@pytest.mark.parametrize("name", vehicle_names())
def test_every_vehicle_flies_and_names_its_source(name):
    craft = vehicle(name)
    assert len(craft.source) > 5
    model = models.entry_planar(craft)
    x = [craft.entry["V"], craft.entry["gamma"], craft.entry["h"], 0.0]
    assert model.xdot(x, [0.1])[2] == pytest.approx(craft.entry["V"] * math.sin(craft.entry["gamma"]), rel=1e-12)
    assert not any(key.endswith("_deg") for key in craft.entry)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mass": -2900.0}, "mass must be finite and > 0, got -2900"),
        ({"mass": 0}, "mass must be finite and > 0"),
        ({"mass": math.nan}, "mass: expected a finite number"),
        ({"mass": "2900"}, "mass: expected real numbers, got '2900'"),
        ({"area": math.inf}, "area: expected a finite number"),
        ({"CD": 0.0}, "CD must be finite and > 0"),
        ({"CD": None}, "CD: expected real numbers"),
        ({"CL": math.nan}, "CL: expected a finite number"),
        ({"CL": [0.3, 0.4]}, "CL: expected one number"),
        ({"nose_radius": -1.0}, "nose_radius must be finite and > 0"),
    ],
)
def test_bad_vehicles(change, text):
    good = {"name": "craft", "mass": 2900.0, "area": 3.8, "CL": 0.3, "CD": 1.3}
    with pytest.raises(ModelError, match=f"Vehicle craft: {text}"):
        Vehicle(**{**good, **change})
    assert Vehicle(**{**good, "CL": -0.3}).lift_to_drag < 0


def test_ratios():
    craft = from_ratios("n1", ballistic_coefficient=450.0, lift_to_drag=0.25)
    assert craft.lift_to_drag == 0.25
    assert craft.ballistic_coefficient == 450.0
    for bad in ({"ballistic_coefficient": -1.0, "lift_to_drag": 0.2}, {"ballistic_coefficient": 400.0, "lift_to_drag": math.nan}):
        with pytest.raises(ModelError, match="from_ratios"):
            from_ratios("n1", **bad)


def test_unknown_vehicles_and_the_schema_line():
    with pytest.raises(ModelError, match="did you mean 'soyuz_ms03'"):
        vehicle("soyuz_ms3")
    with pytest.raises(ModelError):
        vehicle("schema")


def test_coefficients_as_functions():
    craft = Vehicle("craft", 1000.0, 2.0, lambda m: 0.1 * m, lambda m: 1 + 0 * m)
    assert float(craft.cl(ca.SX(3.0))) == pytest.approx(0.3)
    assert float(craft.cd(ca.SX(3.0))) == 1.0
    for name in ("lift_to_drag", "ballistic_coefficient"):
        with pytest.raises(ModelError, match=f"{name} depends on Mach number"):
            getattr(craft, name)


def test_a_vehicle_is_frozen_with_its_entry_conditions():
    conditions = {"h": 1e5}
    craft = Vehicle("craft", 1000.0, 2.0, 0.1, 1.0, entry=conditions)
    conditions["h"] = 0.0
    assert craft.entry["h"] == 1e5
    with pytest.raises(TypeError):
        craft.entry["h"] = 2.0
    with pytest.raises(AttributeError):
        craft.mass = 1.0
