"""Laws: profiles as exact inputs, doubled nodes at jumps and kinks, refusals, one step outside a flight."""

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, Var, define
from ocp import laws


def integrator():
    """q' = a, w' = q: a linear profile makes q quadratic and w cubic between the points."""
    return define("chain", lambda x, u, p: {"q": u.a, "w": x.q}, states=[Var("q"), Var("w")], inputs=[Var("a", valid=(-50.0, 50.0))])


T, A = np.array([0.0, 0.37, 1.0, 1.61]), np.array([1.0, -2.0, 4.0, 0.5])


def exact(kind, times):
    """q and w of the profile by its own polynomials."""
    out, state, edges = [], np.zeros(2), np.append(T, 1e9)
    starts = []
    for k in range(len(T)):
        starts.append(state)
        h = min(edges[k + 1], 10.0) - T[k]
        slope = (A[k + 1] - A[k]) / h if kind == "linear" and k + 1 < len(T) else 0.0
        state = state + np.array([A[k] * h + slope * h**2 / 2, state[0] * h + A[k] * h**2 / 2 + slope * h**3 / 6])
    for t in times:
        k = max(np.searchsorted(T, t, side="right") - 1, 0)
        h = t - T[k]
        slope = (A[k + 1] - A[k]) / (T[k + 1] - T[k]) if kind == "linear" and k + 1 < len(T) else 0.0
        q, w = starts[k]
        out.append([q + A[k] * h + slope * h**2 / 2, w + q * h + A[k] * h**2 / 2 + slope * h**3 / 6])
    return np.array(out)


@pytest.mark.parametrize("kind", ["linear", "previous"])
@pytest.mark.parametrize("method", [ocp.RK4(step=0.1), ocp.RK8(step=0.13), ocp.Adaptive(step=0.1)])
def test_profiles_are_flown_exactly(kind, method):
    flight = ocp.simulate(integrator(), ocp.profile(T, a=A, kind=kind), x0=[0.0, 0.0], t_max=2.2, method=method)
    tolerance = 1e-9 if isinstance(method, ocp.Adaptive) else 1e-13
    assert flight.x == pytest.approx(exact(kind, flight.t), abs=tolerance)


@pytest.mark.parametrize("kind", ["linear", "previous"])
def test_nodes_stand_twice_exactly_at_the_points(kind):
    flight = ocp.simulate(integrator(), ocp.profile(T, a=A, kind=kind), x0=[0.0, 0.0], t_max=2.2, method=ocp.RK4(step=0.1))
    doubled = flight.t[1:][np.diff(flight.t) == 0]
    kept = [t for t in doubled if np.isclose(t, T).any()]
    assert kept == pytest.approx(T[1:])
    assert len(doubled) == 4  # and once where the last steps are shorter
    left = np.flatnonzero(np.isclose(flight.t, 0.37))
    assert len(left) == 2
    values = flight["a"][left]
    assert values == pytest.approx([-2.0, -2.0] if kind == "linear" else [1.0, -2.0])
    assert flight.t[0] == 0
    assert flight["a"][-1] == 0.5
    # groups of four equal intervals on every stretch
    for stretch in np.split(np.diff(flight.t), np.flatnonzero(np.diff(flight.t) == 0)):
        steps = stretch[stretch > 0]
        assert len(steps) % 4 == 0
        assert np.ptp(steps) < 1e-12


def test_a_smooth_profile_has_no_doubled_nodes_but_its_points():
    """Rounding of the interpolation must not look like a jump."""
    for start, end in np.random.default_rng(1).uniform(-3, 3, (20, 2)):
        law = ocp.profile([0.0, 7.0], a=[start, end])
        for method in (ocp.RK4(step=0.4375), ocp.Adaptive(step=0.4375, rtol=1e-6, atol=1e-8)):
            flight = ocp.simulate(integrator(), law, x0=[0.0, 0.0], t_max=7.0, method=method)
            assert (np.diff(flight.t) > 0).all()


def test_held_outside_the_points():
    flight = ocp.simulate(integrator(), ocp.profile([0.5, 1.0], a=[2.0, 3.0]), x0=[0.0, 0.0], t_max=2.0, method=ocp.RK4(step=0.1))
    assert flight["q"][-1] == pytest.approx(0.5 * 2.0 + 0.5 * 2.5 + 3.0, rel=1e-13)
    one = ocp.simulate(integrator(), ocp.profile([0.7], a=[2.0]), x0=[0.0, 0.0], t_max=2.0, method=ocp.RK4(step=0.1))
    assert one["q"][-1] == pytest.approx(4.0, rel=1e-13)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"t": [0.0, 0.0], "a": [1.0, 2.0]}, "increasing times"),
        ({"t": [1.0, 0.0], "a": [1.0, 2.0]}, "increasing times"),
        ({"t": [], "a": []}, "non-empty list"),
        ({"t": [[0.0, 1.0]], "a": [1.0, 2.0]}, "increasing times"),
        ({"t": [0.0, 1.0], "a": [1.0]}, r"profile: a: expected shape \(2,\) as t, got \(1,\)"),
        ({"t": [0.0, 1.0], "a": [1.0, np.nan]}, r"profile: a\[1\]: expected a finite"),
        ({"t": [0.0, 1.0], "a": [1.0, 2.0], "kind": "cubic"}, "expected 'linear' or 'previous', got 'cubic'"),
        ({"t": [0.0, 1.0], "b": [1.0, 2.0]}, "input: unknown name 'b'"),
        ({"t": [0.0, 1.0]}, "input: missing a"),
        ({"t": [0.0, 1.0], "a": [1.0, 90.0]}, "u: a = 90 is outside"),
    ],
)
def test_bad_profiles(arguments, text):
    with pytest.raises(ModelError, match=text):
        ocp.simulate(integrator(), ocp.profile(arguments.pop("t"), **arguments), x0=[0.0, 0.0], t_max=1.0)


@pytest.mark.parametrize(
    ("inputs", "text"),
    [
        ({}, "missing a"),
        ({"b": 1.0}, "unknown name 'b'"),
        ({"a": np.nan}, "u: a must be a finite"),
        ({"a": [1.0, 2.0]}, "u: expected shape"),
        ({"a": "1"}, "u: expected real numbers"),
    ],
)
def test_bad_constants(inputs, text):
    with pytest.raises(ModelError, match=text):
        ocp.simulate(integrator(), ocp.constant(**inputs), x0=[0.0, 0.0], t_max=1.0)


@pytest.mark.parametrize(
    ("step", "options", "text"),
    [
        (lambda t, x, y, z, w: (x[0], z), {"sample": 0.0}, "sample must be > 0 s, got 0"),
        (lambda t, x, y, z, w: (x[0], z), {"sample": np.nan}, "sampled: sample: expected a finite"),
        (lambda t, x, y, z, w: (x[0], z), {"sample": 1.0, "memory": [np.inf]}, "sampled: memory"),
        (lambda t, x, y, z, w: (x, z), {"sample": 1.0}, r"law sampled: step returned u of shape \(2, 1\)"),
        (lambda t, x, y, z, w: (x[0], x), {"sample": 1.0, "memory": [1.0]}, r"z of shape \(2, 1\)"),
        (lambda t, x, y, z, w: x[0], {"sample": 1.0}, "must return two casadi.SX columns"),
        (lambda t, x, y, z, w: (ca.MX.sym("m"), z), {"sample": 1.0}, "must return two casadi.SX columns"),
        (
            lambda t, x, y, z, w: (x[0], z),
            {"sample": 1.0, "n_signals": 2},
            r"signals returned shape \(1, 0\) for 1 times, expected \(1, 2\)",
        ),
        (lambda t, x, y, z, w: (w[0], z), {"sample": 1.0, "n_signals": 1, "signals": lambda a, b: a}, "signals returned shape"),
        (lambda t, x, y, z, w: (w[0], z), {"sample": 1.0, "n_signals": 1, "signals": lambda a, b: a[:, None] * np.nan}, "law: signals"),
    ],
)
def test_bad_sampled_laws(step, options, text):
    with pytest.raises(ModelError, match=text):
        ocp.simulate(integrator(), ocp.sampled(step, **options), x0=[0.0, 0.0], t_max=1.0)


def test_plain_numbers_and_no_memory_are_fine():
    flight = ocp.simulate(integrator(), ocp.sampled(lambda t, x, y, z, w: (2.0, []), sample=0.5), x0=[0.0, 0.0], t_max=1.0)
    assert flight["q"][-1] == pytest.approx(2.0)


def test_tables_of_the_law_are_read_at_the_right_times():
    seen = []

    def signals(start, end):
        seen.append((start, end))
        return np.column_stack([start, end])

    law = ocp.sampled(lambda t, x, y, z, w: (w[0] + 10 * w[1] + 100 * t, z), sample=0.5, signals=signals, n_signals=2)
    model = define("one", lambda x, u, p: {"q": u.a}, states=[Var("q")], inputs=[Var("a")])
    flight = ocp.simulate(model, law, x0=[0.0], t_max=1.25)
    assert flight["a"][np.searchsorted(flight.t, [0.0, 0.5, 1.0], side="right") - 1] == pytest.approx([5.0, 0.5 + 10 + 50, 1 + 12.5 + 100])


def test_one_step_outside_a_flight():
    model = models.entry_planar(models.SOYUZ)
    law = ocp.sampled(lambda t, x, y, z, w: (0.1 + z[0] + 1e-3 * t + 0 * y[0], z + x[1]), sample=2.0, memory=[0.5])
    x = [7e3, -0.02, 8e4, 0.0]
    u, z = laws.call(law, model, t=4.0, x=x)
    assert (u[0], z[0]) == pytest.approx((0.604, 0.48))
    u, z = laws.call(law, model, t=4.0, x=x, z=z)
    assert u[0] == pytest.approx(0.584)
    for arguments, text in (
        ({"t": np.nan, "x": x}, "t: expected a finite"), ({"t": 0.0, "x": x[:3]}, "x: expected shape"),
        ({"t": 0.0, "x": x, "z": [1.0, 2.0]}, "law: z: expected shape"), ({"t": 0.0, "x": x, "z": ["1"]}, "z: expected real numbers"),
    ):  # fmt: skip
        with pytest.raises(ModelError, match=text):
            laws.call(law, model, **arguments)
    with pytest.raises(ModelError, match="is not sampled"):
        laws.call(ocp.constant(lift_ratio=0.1), model, t=0.0, x=x)
