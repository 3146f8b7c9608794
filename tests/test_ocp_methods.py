"""Integration methods: order by regression on an exact solution, kinks, the adaptive path, refusals."""

import math

import casadi as ca
import numpy as np
import pytest

import ocp
from models.core import ModelError, Var, define


def tangent():
    """Nonlinear, with an exact solution: q' = w q, w' = -(1 + w^2) gives w = tan(c - t), q = cos(c - t)/cos(c)."""
    return define("tangent", lambda x, u, p: {"q": x.w * x.q, "w": -(1 + x.w**2)}, states=[Var("q"), Var("w")])


def error(method):
    flight = ocp.simulate(tangent(), ocp.constant(), x0=[1.0, math.tan(1.2)], t_max=2.4, method=method)
    exact = np.column_stack([np.cos(1.2 - flight.t) / math.cos(1.2), np.tan(1.2 - flight.t)])
    return np.abs(flight.x - exact).max()


@pytest.mark.parametrize(("method", "steps"), [(ocp.RK4, [160, 200, 320, 400, 640, 800]), (ocp.RK8, [48, 56, 64, 72, 80])])
def test_declared_order_by_regression(method, steps):
    """The ranges are the asymptotic ones: below them higher terms show, above them rounding does."""
    h = 2.4 / np.array(steps)
    errors = [error(method(step=v)) for v in h]
    assert min(errors) > 1e-13
    slope = np.polyfit(np.log(h), np.log(errors), 1)[0]
    assert slope == pytest.approx(method.order, abs=0.1)


def test_order_belongs_to_the_method():
    assert (ocp.RK4().order, ocp.RK8().order) == (4, 8)
    with pytest.raises(TypeError):
        ocp.RK4(step=0.5, order=7)
    assert ocp.RK4(step=0.5) == ocp.RK4(step=0.5)
    assert ocp.RK4(step=0.5) != ocp.RK8(step=0.5)


def test_adaptive_against_the_exact_solution():
    assert error(ocp.Adaptive(step=0.4)) < 3e-8
    assert error(ocp.Adaptive(step=0.4, rtol=1e-5, atol=1e-7)) > 1e-5  # the tolerance is used


def test_adaptive_on_a_stiff_problem():
    """x' = -1e5 (x - cos t): an explicit method of step 0.1 would overflow."""
    model = define("stiff", lambda x, u, p: {"x": -1e5 * (x.x - ca.cos(x.c)), "c": 1.0}, states=[Var("x"), Var("c")])
    flight = ocp.simulate(model, ocp.constant(), x0=[1.0, 0.0], t_max=2.0, method=ocp.Adaptive(step=0.1))
    assert flight["x"][-1] == pytest.approx(math.cos(2.0) + 1e-5 * math.sin(2.0), abs=1e-8)


class Driven:
    """x' = -x + u with u running through kinks and jumps: exact solution by the integrating factor, piece by piece."""

    model = define("driven", lambda x, u, p: {"x": -x.x + u.a}, states=[Var("x")], inputs=[Var("a")])
    t = np.array([0.0, 0.313, 0.777, 1.501, 2.0])
    a = np.array([0.0, 3.0, -2.0, 5.0, 1.0])

    @classmethod
    def exact(cls, kind):
        x = 0.5
        for k in range(len(cls.t) - 1):
            h = cls.t[k + 1] - cls.t[k]
            slope = (cls.a[k + 1] - cls.a[k]) / h if kind == "linear" else 0.0
            x = (x - cls.a[k] + slope) * math.exp(-h) + cls.a[k] + slope * h - slope
        return x

    @classmethod
    def flown(cls, kind, method):
        return ocp.simulate(cls.model, ocp.profile(cls.t, a=cls.a, kind=kind), x0=[0.5], t_max=2.0, method=method)["x"][-1]


@pytest.mark.parametrize("kind", ["linear", "previous"])
def test_restarts_at_kinks_keep_the_order(kind):
    h = 2.0 / np.array([40, 56, 80, 112, 160])
    errors = [abs(Driven.flown(kind, ocp.RK4(step=v)) - Driven.exact(kind)) for v in h]
    assert np.polyfit(np.log(h), np.log(errors), 1)[0] == pytest.approx(4, abs=0.35)  # whole steps do not divide the pieces alike
    assert abs(Driven.flown(kind, ocp.RK8(step=0.02)) - Driven.exact(kind)) < 1e-13
    assert abs(Driven.flown(kind, ocp.Adaptive(step=0.1)) - Driven.exact(kind)) < 1e-9


def test_without_restarts_the_order_would_be_lost():
    """The same input read from a sampled table every 4 steps of the same size steps over the kinks and is first order there."""

    def held(start, end):
        return np.interp(0.5 * (start + end), Driven.t, Driven.a)[:, None]

    def flown(step):
        law = ocp.sampled(lambda t, x, y, z, w: (w, z), sample=4 * step, signals=held, n_signals=1)
        return ocp.simulate(Driven.model, law, x0=[0.5], t_max=2.0, method=ocp.RK8(step=step))["x"][-1]

    assert abs(flown(0.02) - Driven.exact("linear")) > 1e-5


@pytest.mark.parametrize(
    ("method", "arguments", "text"),
    [
        (ocp.RK4, {"step": 0.0}, "RK4: step must be finite and > 0 s, got 0"),
        (ocp.RK8, {"step": -1.0}, "RK8: step must"),
        (ocp.RK8, {"step": math.nan}, "RK8: step: expected a finite"),
        (ocp.RK4, {"step": "1"}, "RK4: step: expected real numbers"),
        (ocp.Adaptive, {"step": math.inf}, "Adaptive: step"),
        (ocp.Adaptive, {"rtol": 0.0}, r"rtol must lie in \(0, 1\), got 0"),
        (ocp.Adaptive, {"atol": 2.0}, "atol must lie"),
    ],
)
def test_bad_methods(method, arguments, text):
    with pytest.raises(ModelError, match=text):
        method(**arguments)
