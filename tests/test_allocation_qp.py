"""Allocation as a quadratic program: equal to equation 20 where it should be, back ends, priorities, failures, histories."""

import numpy as np
import pytest

from allocation import backends, blending, qp
from allocation.core import Effectors
from models import native
from models.checked import ModelError, Status, evaluate
from models.thrusters import orbiter_jets

DEG = np.pi / 180
LITERAL = blending.Handover(rcs_inhibit_above_q2=False)
UP, DOWN = 266761.0, -253326.0


def states(count, seed=2012):
    """Pitch states with |demand| of at least half a degree, inside what the jets can do."""
    rng = np.random.default_rng(seed)
    qbar, trim = rng.uniform(0, 4000, count), rng.uniform(-33, 18, count) * DEG
    demand = np.where(rng.random(count) < 0.5, -1, 1) * np.exp(rng.uniform(np.log(0.5), np.log(40), count)) * DEG
    slope = -np.exp(rng.uniform(np.log(1e4), np.log(1e8), count))
    _, k_blend = blending.share_arrays(demand, qbar, trim, handover=LITERAL)
    moment = k_blend * slope * demand
    reachable = (moment < UP) & (moment > DOWN)
    return tuple(v[reachable] for v in (demand, qbar, trim, slope))


def columns(demand, qbar, trim, slope):
    one = np.ones((len(demand), 1))
    return [demand[:, None], qbar[:, None], trim[:, None], slope[:, None], UP * one, DOWN * one, 0 * one]


@pytest.mark.parametrize(("a", "b"), [(3e-8, 3e-4), (1e-5, 1e-3)])
def test_equals_equation_20_on_random_states(a, b):
    data = states(150_000 if b == 3e-4 else 5000)
    demand, slope = data[0], data[3]
    assert b != 3e-4 or len(demand) > 1e5
    elevon, duty, _ = evaluate(blending.paper(LITERAL), *columns(*data))
    other, jets, share, kkt, solved = evaluate(qp.blend(LITERAL, a=a, b=b), *columns(*data))
    of_demand = np.abs(slope * demand)
    surface = np.abs(slope * (elevon - other)[:, 0]) / of_demand
    reaction = np.abs((duty - jets)[:, 0]) * np.where(duty[:, 0] > 0, UP, -DOWN) / of_demand
    worst = max(surface.max(), reaction.max())
    bound = max((a / b) ** 2 + a**2, b**2)  # closed form; see the documentation
    assert 0.9 * bound < worst < bound * (1 + 1e-6) + 1e-14
    assert b != 3e-4 or worst < 1e-6
    assert solved.min() == 1
    assert kkt.max() < 1e-9
    assert share[:, 0] == pytest.approx(evaluate(blending.paper(LITERAL), *columns(*data))[2][:, 0], abs=2 * bound + 1e-12)


def test_no_jets_above_q2_and_no_more_than_the_jets_can():
    demand, qbar = np.array([0.3, -0.3, 5.0]) * DEG, np.array([2600.0, 2600.0, 500.0])
    _, duty, _, _, solved = evaluate(qp.blend(), *columns(demand, qbar, np.zeros(3), np.array([-1e6, -1e6, -1e8])))
    assert duty[:, 0] == pytest.approx([0, 0, -1])
    assert solved.min() == 1


def test_zero_demand_and_rate_limit():
    zero = evaluate(qp.blend(), *columns(np.zeros(1), np.array([1800.0]), np.zeros(1), np.array([-1e7])))
    assert zero[0] == 0
    assert zero[1] == 0
    limited = qp.blend(rate=0.01)
    args = columns(np.array([0.1]), np.array([2400.0]), np.zeros(1), np.array([-1e6]))
    args[-1] = np.array([[0.03]])
    elevon, duty, share, *_ = evaluate(limited, *args)
    assert elevon[0, 0] == pytest.approx(0.04)
    assert duty[0, 0] * -DOWN == pytest.approx(-1e6 * 0.06, rel=1e-6)
    assert share[0, 0] == pytest.approx(0.6, rel=1e-6)


def test_compiled_blend_is_the_same():
    data = columns(*states(2000, seed=3))
    plain, fast = evaluate(qp.blend(), *data), native.compile(qp.blend())(*data)
    for one, other in zip(plain[:3], fast[:3], strict=True):
        assert other == pytest.approx(one, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("method", backends.available())
def test_back_ends_equal_equation_20(method):
    demand, qbar, trim, slope = (v[: 60 if method in ("osqp", "daqp") else 12] for v in states(400, seed=9))
    limit = 1e-4 if method == "clarabel" else 1e-5  # an interior-point method without a crossover
    elevon, k_blend = blending.share_arrays(demand, qbar, trim, handover=LITERAL)
    solver = None
    for p, q, t, s, e, k in zip(demand, qbar, trim, slope, elevon, k_blend, strict=True):
        open_ = np.clip((q - 1000) / 1500, 0, 1)
        low, high = min(max(open_ * LITERAL.lower, LITERAL.lower - t), 0), max(min(open_ * LITERAL.upper, LITERAL.upper - t), 0)
        B, b = np.array([[s, UP, DOWN]]), np.abs([3e-8 * s, 3e-4 * UP, 3e-4 * DOWN])
        solver = solver or backends.Backend.of(method, B, axis=np.ones(1), effector=b, preferred=np.zeros(3))
        u, _ = solver.solve(np.array([s * p]), lower=np.array([low, 0, 0]), upper=np.array([high, 1, 1]), B=B, effector=b)
        jets = u[1] * UP + u[2] * DOWN
        assert abs(s * (u[0] - e)) < limit * abs(s * p)
        assert abs(jets - k * s * p) < limit * abs(s * p)


def jets(**changes):
    every = orbiter_jets()
    return Effectors(
        every.names, every.effectiveness()[3:], 0 * every.flow, 0 * every.flow + 1, axes=("L", "M", "N"), flow=every.flow, **changes
    )


@pytest.mark.parametrize("method", ["active_set", *backends.available()])
def test_infeasible_demand_returns_limits_and_residual(method):
    e = Effectors(("a", "b"), [[2.0, -1.0]], [-1, -1], [1, 0.5])
    found = qp.allocate(e, [10.0], method=method)
    assert found.u == pytest.approx([1, -1], abs=1e-6)
    assert found.residual == pytest.approx([7], abs=1e-5)
    assert found.saturated.all()
    assert found.method == method
    with pytest.raises(ModelError, match=r"demand\[0\]"):
        qp.allocate(e, [np.nan], method=method)


@pytest.mark.parametrize("method", ["active_set", *backends.available()])
def test_good_answer_after_a_bad_problem(method):
    e = jets()
    W = qp.weights_for(e, ratio=1e-2)
    first = qp.allocate(e, [2e5, 3e5, -1e5], weights=W, method=method)
    solver = None
    if method != "active_set":
        solver = backends.Backend.of(method, e.B, axis=W.axis, effector=W.effector, preferred=W.preferred)
        low, high = e.lower, e.upper
        solver.solve(np.array([1e9, -1e9, 1e9]), lower=low, upper=high)
        with pytest.raises(ModelError):
            solver.solve(np.array([np.nan, 0, 0]), lower=low, upper=high)
        again = solver.solve(np.array([2e5, 3e5, -1e5]), lower=low, upper=high)[0]
    else:
        qp.allocate(e, [1e9, -1e9, 1e9], weights=W)
        again = qp.allocate(e, [2e5, 3e5, -1e5], weights=W).u
    assert W.axis * (e.B @ again) == pytest.approx(W.axis * first.wrench, abs=1e-3)


def test_priorities_decide_who_gives_way():
    e = Effectors(("only",), [[1.0], [1.0]], [-1], [1], axes=("L", "M"))
    demand = [0.8, -0.4]
    assert qp.allocate(e, demand).u == pytest.approx([0.2], abs=1e-6)
    for axis, u in (("L", 0.8), ("M", -0.4)):
        weights = qp.weights_for(e, priority={axis: 1e3})
        assert qp.allocate(e, demand, weights=weights).u == pytest.approx([u], abs=1e-5)
    with pytest.raises(ModelError, match=r"did you mean 'L'|known: L, M"):
        qp.weights_for(e, priority={"l": 2.0})


def test_costs_decide_who_works():
    e = Effectors(("surface", "jet"), [[1e6, 1e5]], [-1, 0], [1, 1], flow=[0, 8])
    assert qp.allocate(e, [5e4]).u == pytest.approx([0.05, 0], abs=1e-4)
    dear = qp.weights_for(e, cost={"surface": 100.0})
    assert qp.allocate(e, [5e4], weights=dear).u == pytest.approx([0, 0.5], abs=1e-3)
    asked = qp.weights_for(e, preferred={"jet": 0.25}, cost={"jet": 1e-3, "surface": 1.0})
    assert qp.allocate(e, [2.5e4], weights=asked).u == pytest.approx([0, 0.25], abs=1e-4)


def test_failed_jets_do_not_fire_and_others_take_over():
    e = jets()
    demand = [0.0, 3e5, 0.0]
    working = [n for n, u in zip(e.names, qp.allocate(e, demand).u, strict=True) if u > 0.3]
    broken = qp.allocate(e.failed(working[:3]), demand)
    assert max(broken.u[e.index(n)] for n in working[:3]) == 0
    assert np.abs(broken.residual).max() < 1e-3 * 3e5


def test_many_demands_equal_one_at_a_time():
    e = jets()
    demand = np.random.default_rng(1).normal(size=(30, 3)) * np.array([2e5, 4e5, 3e5])
    many = qp.allocate(e, demand)
    assert many.ok
    assert many.worst_kkt < 1e-9
    assert many.wrench + many.residual == pytest.approx(demand, rel=1e-12)
    for k in (0, 13, 29):
        assert many.u[k] == pytest.approx(qp.allocate(e, demand[k]).u, abs=1e-9)


def test_history_and_options():
    e = Effectors(("elevon", "up", "down"), [[-2e6, 2.7e5, -2.5e5]], [-0.3, 0, 0], [0.2, 1, 1], rate=[0.35, np.inf, np.inf], flow=[0, 8, 8])
    demand = (4e5 * np.sin(0.1 * np.arange(80)))[:, None]
    found = qp.history(e, demand, dt=0.06)
    assert found.ok
    assert np.abs(np.diff(found.u[:, 0])).max() <= 0.35 * 0.06 + 1e-12
    step = qp.allocate(e, demand[1], previous=found.u[0], dt=0.06)
    assert step.u == pytest.approx(found.u[1], abs=1e-9)
    with pytest.raises(ModelError, match="belong together"):
        qp.allocate(e, demand[1], dt=0.06)
    with pytest.raises(ModelError, match="use history"):
        qp.allocate(e, demand, previous=found.u[0], dt=0.06)
    with pytest.raises(ModelError, match="not installed or unknown"):
        qp.allocate(e, demand[1], method="magic")
    with pytest.raises(ModelError, match="weights have"):
        qp.allocate(e, demand[1], weights=qp.weights_for(jets()))
    with pytest.raises(ModelError, match="0 < a < b"):
        qp.blend(a=1e-3, b=1e-4)


def test_history_from_beyond_a_limit_keeps_its_rates():
    e = Effectors(("elevon", "jet"), [[2.0, -3.0]], [-1, 0], [1, 1], rate=[0.5, np.inf], flow=[0, 0.3])
    found = qp.history(e, np.ones((4, 1)), dt=0.1, start=[1.12, 0.0])
    assert found.u[:, 0] == pytest.approx([1.07, 1.02, 0.97, 0.92])
    assert found.saturated[:, 0].all()
    assert found.ok
    assert found.worst_kkt < 1e-9


def test_a_back_end_that_cannot_prove_its_answer_says_so():
    e = jets()
    found = qp.allocate(e, [2e5, 3e5, -1e5], method="highs")
    assert found.ok == (found.worst_kkt <= backends.ACCEPTED)
    assert found.status in (Status.OK, Status.MAX_ITERATIONS)
