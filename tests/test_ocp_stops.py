"""Stop conditions: analytic switching times, both directions, outputs, first of several, the search itself."""

import math

import casadi as ca
import numpy as np
import pytest

import ocp
from models.core import ModelError, Var, define
from ocp.stops import CLOSE, FOUND, STATE, TRIAL, narrowing


def clock():
    """a = sin t, c = t."""
    return define(
        "clock", lambda x, u, p: {"a": ca.cos(x.c), "c": 1.0}, states=[Var("a", valid=(-2.0, 2.0)), Var("c", "s")],
        outputs=[Var("square"), Var("big")], out=lambda x, u, p: {"square": x.a**2, "big": 1e6 * x.a},
    )  # fmt: skip


def stop_time(stop, x0=(0.0, 0.0), method=ocp.RK8(step=0.05)):  # noqa: B008 (a frozen value)
    flight = ocp.simulate(clock(), ocp.constant(), x0=x0, until=stop, t_max=20.0, method=method)
    return flight.t[-1]


@pytest.mark.parametrize("method", [ocp.RK8(step=0.05), ocp.RK8(step=0.031), ocp.RK4(step=0.002), ocp.Adaptive(step=0.05)])
@pytest.mark.parametrize(
    ("stop", "exact"),
    [
        (ocp.rises_above("a", 0.5), math.asin(0.5)),
        (ocp.falls_below("a", 0.5), math.pi - math.asin(0.5)),
        (ocp.falls_below("a", 0.0), math.pi),
        (ocp.falls_below("a", -0.9), math.pi + math.asin(0.9)),
        (ocp.rises_above("square", 0.3), math.asin(math.sqrt(0.3))),
        (ocp.rises_above("big", 7e5), math.asin(0.7)),
    ],
)
def test_switching_times_rising_and_falling(stop, exact, method):
    start = (0.0, 0.0) if stop.conditions[0][2] > 0 or stop.conditions[0][1] <= 0 else (math.sin(1.0), 1.0)
    if stop.conditions[0][1] == 0.0:
        start = (math.sin(1.0), 1.0)
    if stop.conditions[0][1] == -0.9:
        start = (0.0, 0.0)
    accuracy = 2e-9 if isinstance(method, ocp.Adaptive) else 1e-10
    assert stop_time(stop, start, method) == pytest.approx(exact - start[1], abs=accuracy)


def test_the_value_is_met_to_one_in_a_billion():
    for stop, name, value in ((ocp.rises_above("a", 1e-6), "a", 1e-6), (ocp.rises_above("big", 123.0), "big", 123.0)):
        flight = ocp.simulate(clock(), ocp.constant(), x0=[0.0, 0.0], until=stop, t_max=20.0, method=ocp.RK8(step=0.05))
        assert flight[name][-1] == pytest.approx(value, rel=1e-9)


def test_first_of_stops_at_the_earlier_whatever_the_order():
    rise, fall, late = ocp.rises_above("a", 0.5), ocp.falls_below("a", -0.1), ocp.rises_above("c", 0.55)
    for pair in (ocp.first_of(rise, fall), ocp.first_of(fall, rise)):
        assert stop_time(pair) == pytest.approx(math.asin(0.5), abs=1e-10)
    # both within one group of steps
    assert stop_time(ocp.first_of(late, rise)) == pytest.approx(math.asin(0.5), abs=1e-10)
    three = ocp.first_of(ocp.first_of(late, rise), ocp.rises_above("c", 0.51))
    assert stop_time(three) == pytest.approx(0.51, abs=1e-12)
    assert three.text() == "c rises above 0.55 or a rises above 0.5 or c rises above 0.51"


def test_a_stop_at_the_edge_of_a_group_of_steps():
    assert stop_time(ocp.rises_above("c", 0.4), method=ocp.RK8(step=0.1)) == pytest.approx(0.4, rel=1e-14)
    assert stop_time(ocp.rises_above("c", 0.4 + 1e-13), method=ocp.RK8(step=0.1)) == pytest.approx(0.4, rel=1e-12)


def test_the_last_nodes_lead_to_the_stop():
    flight = ocp.simulate(clock(), ocp.constant(), x0=[0.0, 0.0], until=ocp.rises_above("a", 0.7), t_max=20.0, method=ocp.RK8(step=0.05))
    assert flight["a"] == pytest.approx(np.sin(flight.t), abs=1e-12)
    assert flight.t[-1] - flight.t[-5] < 0.2


@pytest.mark.parametrize("value", [math.nan, math.inf, "1", None, [1.0]])
def test_bad_values(value):
    for make in (ocp.falls_below, ocp.rises_above):
        with pytest.raises(ModelError, match=f"{make.__name__} a"):
            make("a", value)


def test_inputs_and_parameters_are_no_stop_conditions():
    with pytest.raises(ModelError, match="unknown name 'b'; known: a, c, square, big"):
        stop_time(ocp.rises_above("b", 1.0))


# --- the search ---------------------------------------------------------------------------------------------------


def zero(margin, slope):
    """Zero of a function in [0, 1] and the evaluations that it took, case by case."""
    first, following = (f.map(6) for f in narrowing())

    def call(function, *arguments):  # NaN may come in
        return np.asarray(function.call([ca.DM(np.reshape(a, (6, -1)).T) for a in arguments])[0].full()).T

    low, high = np.zeros(6), np.ones(6)
    s = call(first, margin(low), slope(low), high, margin(high), slope(high))
    count = np.zeros(len(s), dtype=int)
    while (s[:, STATE] != FOUND).any():
        count += s[:, STATE] != FOUND
        assert count.max() < 220
        x = s[:, TRIAL]
        s = call(following, s, margin(x), slope(x))
        assert np.isfinite(s).all()
    return s[:, TRIAL], count


ROOTS = np.array([1e-9, 0.1, 0.5, 0.9, 1 - 1e-9, 1 / 3])


@pytest.mark.parametrize("exponent", [1, 3, 9, 1 / 3])
def test_crossings_of_hard_functions(exponent):
    def margin(x):
        return np.sign(ROOTS - x) * np.abs(ROOTS - x) ** exponent

    def slope(x):
        return -exponent * np.maximum(np.abs(ROOTS - x), 1e-30) ** (exponent - 1)

    found, count = zero(margin, slope)
    # a flat zero is found where the step to it, by slope and value, is as small as is asked for
    assert np.abs(found - ROOTS).max() <= 10 * CLOSE
    assert count.max() < 130


def test_a_smooth_margin_takes_three_evaluations():
    def margin(x):
        return np.exp(-(0.5 + ROOTS) * x) - np.exp(-(0.5 + ROOTS) * ROOTS)

    found, count = zero(margin, lambda x: -(0.5 + ROOTS) * np.exp(-(0.5 + ROOTS) * x))
    assert found == pytest.approx(ROOTS, abs=CLOSE)
    assert count.max() <= 4


@pytest.mark.parametrize("wrong", [0.0, 5.0, -1e-3, -1e3, -math.inf, math.nan])
def test_slopes_that_mislead_cost_time_only(wrong):
    found, count = zero(lambda x: (ROOTS - x) * (1.5 + np.sin(9 * x)), lambda x: np.full(6, wrong))
    assert found == pytest.approx(ROOTS, abs=5 * CLOSE)
    assert count.max() < 130


def test_a_jump_is_located_and_a_nan_counts_as_beyond():
    for before in (1.0, 1e-3, 1e3):
        for rate in (0.0, -0.1, -1e3):
            found, _ = zero(lambda x, v=before: np.where(x < ROOTS, v, -1.0), lambda x, r=rate: np.full(6, r))
            assert found == pytest.approx(ROOTS, abs=3 * CLOSE)
    found, _ = zero(lambda x: np.where(x < ROOTS + 0.05, ROOTS - x, np.nan), lambda x: np.where(x < ROOTS + 0.05, -1.0, np.nan))
    assert found == pytest.approx(ROOTS, abs=3 * CLOSE)


def test_a_margin_hidden_by_rounding_ends_the_search():
    random = np.random.default_rng(4)
    found, count = zero(lambda x: 1e-3 * (ROOTS - x) + random.normal(0, 1e-12, 6), lambda x: np.full(6, -1e-3))
    assert found == pytest.approx(ROOTS, abs=1e-8)
    assert count.max() < 60
