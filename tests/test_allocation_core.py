"""Effectors and allocations: checks, failures, rates, completion of commands."""

import numpy as np
import pytest

from allocation.core import Effectors, allocation
from models.checked import ModelError, Status


def pitch(**changes):
    given = {"names": ("elevon", "up", "down"), "B": [[-2e6, 2.7e5, -2.5e5]], "lower": [-0.3, 0, 0], "upper": [0.2, 1, 1]} | changes
    return Effectors(**given)


def test_defaults_and_names():
    e = pitch()
    assert e.axes == ("axis1",)
    assert np.isinf(e.rate).all()
    assert not e.jets.any()
    assert pitch(flow=[0, 8, 8]).jets.tolist() == [False, True, True]
    assert e.index("down") == 2
    assert not e.B.flags.writeable


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"B": [[1.0, 2.0]]}, r"B has shape \(1, 2\)"),
        ({"B": [[np.nan, 1.0, 1.0]]}, "finite"),
        ({"lower": [0.5, 0, 0]}, "elevon: lower 0.5 is above upper 0.2"),
        ({"lower": [0, 0]}, r"lower has shape \(2,\)"),
        ({"names": ("a", "a", "b")}, "stands twice"),
        ({"rate": -1.0}, "must be >= 0"),
        ({"rate": np.nan}, "rate"),
        ({"upper": [np.inf, 1, 1]}, "upper"),
        ({"axes": ("L", "M")}, "2 names of axes"),
        ({"flow": [8, 0, 0]}, "elevon: burns propellant and has lower -0.3"),
    ],
)
def test_bad_effectors_are_refused(changes, message):
    with pytest.raises(ModelError, match=message):
        pitch(**changes)


def test_unknown_name_and_demands():
    e = pitch(axes=("M",))
    with pytest.raises(ModelError, match="did you mean 'elevon'"):
        e.index("elevn")
    with pytest.raises(ModelError, match=r"demand: expected shape \(1,\)"):
        e.demands([1.0, 2.0])
    with pytest.raises(ModelError, match="finite"):
        e.demands([np.nan])


def test_failures_hold_effectors_where_they_are():
    e = pitch(lower=[-0.3, 0.1, 0])
    off = e.failed(["up", "down"])
    assert (off.lower[1], off.upper[1]) == (0.1, 0.1)  # the limit nearest to zero
    assert (off.lower[2], off.upper[2]) == (0.0, 0.0)
    jammed = e.failed({"elevon": 0.17})
    assert jammed.lower[0] == jammed.upper[0] == 0.17
    with pytest.raises(ModelError, match="unknown name"):
        e.failed(["rudder"])


@pytest.mark.parametrize("value", [10.0, -0.31, np.nan])
def test_a_surface_cannot_be_jammed_beyond_its_stops(value):
    with pytest.raises(ModelError, match="elevon") as error:
        pitch().failed({"elevon": value})
    if np.isfinite(value):
        assert "expected a value from -0.3 to 0.2; angles are in radians: did you give degrees?" in str(error.value)


def test_a_jet_is_jammed_at_a_duty_and_a_limit_may_be_written_with_few_digits():
    with pytest.raises(ModelError, match=r"up: found 1.5, expected a value from 0 to 1; duty") as error:
        pitch(flow=[0, 8, 8]).failed({"up": 1.5})
    assert "radians" not in str(error.value)
    third = pitch(upper=[1 / 3, 1, 1])
    assert third.failed({"elevon": 0.333334}).upper[0] == 1 / 3
    assert third.failed({"elevon": -0.3}).lower[0] == -0.3


def test_effectors_show_themselves_in_one_line():
    many = Effectors(tuple(f"jet{i}" for i in range(44)), np.ones((3, 44)), 0, 1, axes=("L", "M", "N"), flow=8.0, unit="N m")
    assert repr(many) == "Effectors(44: jet0, jet1, jet2, ...; 44 jets; axes L, M, N in N m)"
    assert repr(pitch()) == "Effectors(3: elevon, up, down; 0 jets; axes axis1)"
    assert many.label("M demand") == "M demand [N m]"
    assert pitch().label("M demand") == "M demand"


def test_reach_within_a_sample():
    e = pitch(rate=[0.5, np.inf, np.inf])
    near = e.within_reach([0.1, 0.0, 1.0], 0.1)
    assert near.lower[0] == pytest.approx(0.05)
    assert near.upper[0] == pytest.approx(0.15)
    assert near.lower[1:].tolist() == [0, 0]
    beyond = e.within_reach([0.5, 0.0, 0.0], 0.1)  # limits have moved: back as fast as it may
    assert beyond.lower[0] == beyond.upper[0] == pytest.approx(0.45)
    for previous, dt in (([0.1], 0.1), ([0.1, 0.2, 0.3], 0.0)):
        with pytest.raises(ModelError, match="within_reach"):
            e.within_reach(previous, dt)


def test_commands_are_completed_and_brought_inside():
    e = pitch()
    v = np.array([1e5])
    found = allocation(e, v, u=np.array([-0.1, 0.5, -0.25]))
    assert found.u.tolist() == [-0.1, 0.5, 0.0]
    assert found.kkt[0] == pytest.approx(0.25)
    assert found.wrench == pytest.approx(e.B @ found.u)
    assert found.wrench + found.residual == pytest.approx(v, rel=1e-15)
    assert found.saturated.tolist() == [False, False, True]
    assert found.ok
    assert found.status is Status.OK
    many = allocation(e, np.tile(v, (3, 1)), u=np.zeros((3, 3)), status=[Status.OK, Status.OK, Status.MAX_ITERATIONS])
    assert not many.ok
    assert many.residual.shape == (3, 1)
    with pytest.raises(ModelError, match="finite"):
        allocation(e, v, u=np.array([np.nan, 0, 0]))
    with pytest.raises(ModelError, match="u has shape"):
        allocation(e, v, u=np.zeros(2))
