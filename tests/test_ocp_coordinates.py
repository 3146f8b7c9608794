"""Linear systems in measured coordinates: the map, its rate, the same deviation both ways, refusals."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import models
import ocp
from models.core import ModelError, Var, define

GUIDANCE = ("n_x", "hdot", "s", "sdot")
N1 = models.from_ratios("n1", ballistic_coefficient=450.0, lift_to_drag=0.25)


@pytest.fixture(scope="module")
def flight():
    law = ocp.profile([0.0, 200.0, 600.0], lift_ratio=[0.2, 0.15, 0.2])
    return ocp.simulate(models.entry_planar(N1), law, x0=[7800.0, math.radians(-1.36), 1e5, 0.0], until=ocp.falls_below("h", 2e4))


def test_map_against_central_differences(flight):
    to, model = ocp.coordinates(flight, GUIDANCE), flight.model
    outputs = [v.name for v in model.outputs]
    for k in (200, 700):
        for j, step in enumerate((1e-2, 1e-7, 1e-1, 1.0)):
            dx = np.eye(4)[j] * step

            def measured(x, k=k):
                y = model.y(x, flight.u[k], flight.p)
                return np.array([x[3] if n == "s" else y[outputs.index(n)] for n in GUIDANCE])

            column = (measured(flight.x[k] + dx) - measured(flight.x[k] - dx)) / (2 * step)
            assert to.M[k, :, j] == pytest.approx(column, rel=1e-6, abs=1e-9)
    assert to.y0[200] == pytest.approx([flight[n][200] for n in GUIDANCE])
    assert [v.name for v in to.variables] == list(GUIDANCE)


def test_rate_of_the_map_is_its_time_derivative(flight):
    to = ocp.coordinates(flight, GUIDANCE)
    one = flight.t < 200.0  # a stretch with one smooth input
    slopes = CubicSpline(flight.t[one], to.M[one])(flight.t[one], 1)
    inner = slice(10, -10)
    scale = np.abs(to.Mdot[one]).max(axis=0) + 1e-300
    assert (np.abs(slopes[inner] - to.Mdot[one][inner]) / scale).max() < 1e-6
    assert (np.abs(to.Mdot[one]).max(axis=0) > 0).sum() >= 6  # the map does move


def test_the_same_deviation_in_both_coordinates(flight):
    lin, to = ocp.linearize(flight), ocp.coordinates(flight, GUIDANCE)
    moved = ocp.transform(lin, to)
    window = (flight.t >= 30.0) & (flight.t < 200.0)
    t = flight.t[window]

    def propagate(system, start, push):
        A, B = CubicSpline(t, system.A[window]), CubicSpline(t, system.B[window])
        size = np.abs(start) + 1e-3
        flow = solve_ivp(
            lambda s, z: (A(s) @ (z * size) + B(s) @ push) / size, (t[0], t[-1]), start / size, method="DOP853", rtol=1e-10, atol=1e-10
        )
        return flow.y[:, -1] * size

    push, dx = np.array([0.01]), np.array([3.0, 1e-4, 50.0, 10.0])
    first, last = np.flatnonzero(window)[[0, -1]]
    in_states = to.M[last] @ propagate(lin, dx, push)
    in_measured = propagate(moved, to.M[first] @ dx, push)
    assert in_measured == pytest.approx(in_states, rel=1e-6)
    # without the rate of the map it would be another system
    wrong = to.M @ lin.A @ np.linalg.inv(to.M)
    assert np.abs(wrong - moved.A)[window].max() > 1e-3 * np.abs(moved.A[window]).max()
    assert moved.x0 == pytest.approx(to.y0)
    assert moved.C @ to.M == pytest.approx(lin.C, rel=1e-8, abs=1e-8)


def test_states_as_coordinates_change_nothing(flight):
    lin = ocp.linearize(flight, xdot=np.zeros(4))
    same = ocp.transform(lin, ocp.coordinates(flight, ("V", "gamma", "h", "s")))
    for name in ("A", "B", "C", "D", "c"):
        assert np.array_equal(getattr(same, name), getattr(lin, name)), name
    swapped = ocp.transform(lin, ocp.coordinates(flight, ("h", "V", "s", "gamma")))
    order = [2, 0, 3, 1]
    assert swapped.A == pytest.approx(lin.A[:, order][:, :, order])
    assert swapped.c == pytest.approx(lin.c[:, order])


def test_condition_is_that_of_the_scaled_map(flight):
    to = ocp.coordinates(flight, GUIDANCE)
    k = 500
    sx = np.array([v.nominal for v in flight.model.states])
    sy = np.array([v.nominal for v in to.variables])
    assert to.condition[k] == pytest.approx(np.linalg.cond(np.diag(1 / sy) @ to.M[k] @ np.diag(sx)), rel=1e-9)
    assert to.condition[0] > to.condition[k]  # thin air: drag says little


def test_refusals(flight):
    with pytest.raises(ModelError, match="expected 4 names, one for each state, got 3"):
        ocp.coordinates(flight, GUIDANCE[:3])
    with pytest.raises(ModelError, match="did you mean 'hdot'"):
        ocp.coordinates(flight, ("n_x", "hdott", "s", "sdot"))
    with pytest.raises(ModelError, match=r"SINGULAR at t = .* start later"):
        ocp.coordinates(flight, ("V", "V", "h", "s"))
    with pytest.raises(ModelError, match="SINGULAR at t = 0 s"):  # dynamic pressure twice: as pressure and as drag
        ocp.coordinates(flight, ("n_x", "qbar", "h", "s"))
    felt = define("felt", lambda x, u, p: {"a": u.f}, states=[Var("a")], inputs=[Var("f")], outputs=[Var("y")],
                  out=lambda x, u, p: {"y": x.a + u.f})  # fmt: skip
    with pytest.raises(ModelError, match="depends on the input"):
        ocp.coordinates(ocp.simulate(felt, ocp.constant(f=1.0), x0=[0.0], t_max=1.0), ("y",))
    shorter = flight.at(flight.t[:50])
    with pytest.raises(ModelError, match=r"50 .* not on the same times"):
        ocp.transform(ocp.linearize(flight), ocp.coordinates(shorter, GUIDANCE))
