"""Trajectories: values between nodes, doubled nodes, xarray, tables and figures for people, refusals."""

import math

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, Status, Var, define
from ocp.trajectory import Trajectory


def oscillator():
    return define(
        "oscillator", lambda x, u, p: {"a": x.b, "b": -x.a + u.f}, states=[Var("a", "m", text="way"), Var("b", "m/s")],
        inputs=[Var("f", "rad")], outputs=[Var("energy")], out=lambda x, u, p: {"energy": (x.a**2 + x.b**2) / 2},
        params={Var("unused"): 3.0},
    )  # fmt: skip


def exact(t):
    return np.column_stack([np.cos(t), -np.sin(t)])


def circle(n):
    t = np.linspace(0, 2.0, n)
    x = exact(t)
    return Trajectory(t, x, np.zeros((n, 1)), (x**2).sum(axis=1, keepdims=True) / 2, [3.0], oscillator())


def test_interpolation_is_of_fourth_order():
    at = np.linspace(0, 2, 997)
    steps = np.array([11, 21, 41, 81])
    errors = [np.abs(circle(n).at(at).x - exact(at)).max() for n in steps]
    assert np.polyfit(np.log(1 / (steps - 1)), np.log(errors), 1)[0] == pytest.approx(4, abs=0.1)
    assert errors[-1] < 1.1 * (2 / 80) ** 4 / 384


def test_nodes_themselves_and_recomputed_outputs():
    flight = circle(21)
    again = flight.at(flight.t)
    assert again.x == pytest.approx(flight.x, abs=1e-15)
    middle = flight.at(0.123)
    assert middle["energy"] == pytest.approx((middle["a"] ** 2 + middle["b"] ** 2) / 2, rel=1e-14)
    assert middle.t.tolist() == [0.123]


def test_jumps_take_the_right_value_and_the_right_rate():
    law = ocp.profile([0.0, 0.7, 1.3], f=[0.0, 2.0, -1.0], kind="previous")
    flight = ocp.simulate(oscillator(), law, x0=[1.0, 0.0], t_max=1.9, method=ocp.RK8(step=0.01))
    at = flight.at([0.0, 0.699999, 0.7, 0.700001, 1.2999, 1.3, 1.9])
    assert at["f"] == pytest.approx([0, 0, 2, 2, 2, -1, -1])
    t = np.linspace(0.7, 1.3, 100, endpoint=False)
    x7 = exact(np.array([0.7]))[0] - [2.0, 0.0]
    wanted = 2.0 + x7[0] * np.cos(t - 0.7) + x7[1] * np.sin(t - 0.7)
    assert flight.at(t)["a"] == pytest.approx(wanted, abs=1e-10)
    # no excursion next to the jump: the interval after it uses the rate after it
    assert np.abs(np.diff(flight.at(np.linspace(0.69, 0.71, 50))["b"], 2)).max() < 1e-3


def test_a_flight_that_ends_on_a_doubled_node():
    x = exact(np.array([0.0, 0.5, 0.5]))
    flight = Trajectory([0.0, 0.5, 0.5], x, [[0.0], [0.0], [1.0]], np.zeros((3, 1)), [3.0], oscillator())
    assert flight.at(0.5)["a"] == pytest.approx([math.cos(0.5)], abs=1e-12)


def test_held_inputs_stay_held_between_nodes():
    flight = ocp.simulate(oscillator(), ocp.sampled(lambda t, x, y, z, w: (t, z), sample=0.5), x0=[1.0, 0.0], t_max=2.0)
    assert flight.hold
    assert flight.at([0.0, 0.25, 0.499, 0.5, 0.75, 1.9])["f"] == pytest.approx([0.0, 0.0, 0.0, 0.5, 0.5, 1.5])
    t = np.linspace(0.5, 0.9999, 30)
    a, b = flight.x[np.searchsorted(flight.t, 0.5)]
    assert flight.at(t)["a"] == pytest.approx(0.5 + (a - 0.5) * np.cos(t - 0.5) + b * np.sin(t - 0.5), abs=2e-4)
    assert flight.at(t)["b"] == pytest.approx(-(a - 0.5) * np.sin(t - 0.5) + b * np.cos(t - 0.5), abs=2e-4)


def test_inputs_that_run_linearly_keep_the_accuracy():
    """a'' + a = 3 t from (1, 0): a = 3 t + cos t - 3 sin t."""
    flight = ocp.simulate(oscillator(), ocp.profile([0.0, 3.0], f=[0.0, 9.0]), x0=[1.0, 0.0], t_max=2.0, method=ocp.RK8(step=0.05))
    t = np.linspace(0, 2, 333)
    at = flight.at(t)
    assert at["f"] == pytest.approx(3 * t, abs=1e-13)
    assert at["b"] == pytest.approx(3 - np.sin(t) - 3 * np.cos(t), abs=1e-7)


def test_a_single_node():
    flight = Trajectory([1.0], [[1.0, 0.0]], [[0.5]], [[0.5]], [3.0], oscillator())
    assert flight.at([1.0, 1.0]).x.shape == (2, 2)
    with pytest.raises(ModelError, match=r"\[1, 1\]"):
        flight.at(2.0)


@pytest.mark.parametrize("times", [[-0.1], [2.01], [], [math.nan], [[0.0, 1.0]], [1.0, 0.5], ["1"]])
def test_bad_times(times):
    with pytest.raises(ModelError, match="at: "):
        circle(5).at(times)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"t": [0.0, 1.0, 0.5]}, "must not decrease"),
        ({"t": [[0.0], [1.0], [2.0]]}, r"t: expected shape \(3,\)"),
        ({"t": 1.0}, r"t: expected shape \(0,\)"),
        ({"x": np.zeros((3, 3))}, r"x: expected shape \(3, 2\), got \(3, 3\)"),
        ({"x": np.zeros((2, 3))}, r"x: expected shape \(3, 2\), got \(2, 3\)"),
        ({"u": np.zeros(3)}, r"u: expected shape \(3, 1\)"),
        ({"y": np.full((3, 1), np.nan)}, "y"),
        ({"p": []}, r"p: expected shape \(1,\)"),
    ],
)
def test_bad_trajectories(change, text):
    good = {"t": [0.0, 1.0, 2.0], "x": np.zeros((3, 2)), "u": np.zeros((3, 1)), "y": np.zeros((3, 1)), "p": [3.0], "model": oscillator()}
    with pytest.raises(ModelError, match=f"Trajectory: .*{text}"):
        Trajectory(**{**good, **change})
    with pytest.raises(ModelError, match="at least one node"):
        Trajectory([], np.zeros((0, 2)), np.zeros((0, 1)), np.zeros((0, 1)), [3.0], oscillator())


def test_names_and_read_only():
    flight = circle(5)
    assert np.array_equal(flight["t"], flight.t)
    with pytest.raises(ModelError, match="did you mean 'energy'"):
        flight["enrgy"]
    with pytest.raises(ValueError, match="read-only"):
        flight["a"][0] = 1.0


def test_xarray_has_units_and_provenance():
    flight = ocp.simulate(oscillator(), ocp.profile([0.0, 0.5], f=[0.0, 1.0], kind="previous"), x0=[1.0, 0.0], t_max=1.0)
    data = flight.to_xarray()
    assert data["a"].attrs == {"units": "m", "long_name": "way"}
    assert data["t"].attrs["units"] == "s"
    assert set(data.data_vars) == {"a", "b", "f", "energy"}
    assert (data.attrs["model"], data.attrs["status"], data.attrs["unused"]) == ("oscillator", "OK", 3.0)
    assert np.array_equal(data["energy"].values, flight["energy"])
    assert data.sizes["t"] == len(flight.t)  # the doubled node is kept


def test_the_table_for_people_escapes_its_text():
    model = define("m", lambda x, u, p: {"a": -x.a}, states=[Var("a", "<m>", text="<script>x</script>")])
    page = ocp.simulate(model, ocp.constant(), x0=[1.0], t_max=1.0)._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert "0 to 1 s, OK" in page
    assert f"{math.exp(-1):.5g}" in page


def test_figures():
    from matplotlib.figure import Figure

    flight = circle(21)
    figure = flight.plot()
    assert isinstance(figure, Figure)
    assert [axes.get_ylabel() for axes in figure.axes] == ["way [m]", "b [m/s]", "f [deg]"]
    assert figure.axes[0].lines[0].get_ydata() == pytest.approx(flight["a"])
    assert len(flight.plot(("energy",)).axes) == 1
    with pytest.raises(ModelError, match="unknown name"):
        flight.plot(("nothing",))
    held = ocp.simulate(oscillator(), ocp.sampled(lambda t, x, y, z, w: (ca.SX(math.radians(5)), z), sample=0.5), x0=[1.0, 0.0], t_max=1.0)
    line = held.plot(("f",)).axes[0].lines[0]
    assert line.get_drawstyle() == "steps-post"
    assert line.get_ydata() == pytest.approx(np.full(len(held.t), 5.0))


def test_status_travels_with_interpolated_flights():
    model = models.entry_planar(models.SOYUZ)
    flight = ocp.simulate(
        model, ocp.constant(lift_ratio=0.1), x0=[7600, -0.02, 9e4, 0], until=ocp.falls_below("h", 1e4), t_max=50.0, throw=False
    )
    assert flight.at([1.0, 2.0]).status is Status.STOP_NOT_REACHED
