"""Pseudo-inverses, daisy chain, attainable set, on-off bound, predictive allocation."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog, minimize
from scipy.spatial import ConvexHull

from allocation import attainable, bound, predictive, pseudo_inverse, qp
from allocation.core import Effectors
from models.checked import ModelError
from models.thrusters import orbiter_jets

RNG = np.random.default_rng(11)


def some(m, n, seed=0, **more):
    rng = np.random.default_rng(seed)
    return Effectors(tuple(f"e{i}" for i in range(n)), rng.normal(size=(m, n)), -rng.random(n), rng.random(n), **more)


def reachable(e, wrench):
    """By linear programming."""
    n = len(e.names)
    return linprog(np.zeros(n), A_eq=e.B, b_eq=wrench, bounds=list(zip(e.lower, e.upper, strict=True))).status == 0


def test_weighted_pseudo_inverse_is_the_least_cost_answer():
    e = Effectors(tuple("abcde"), some(2, 5).B, np.full(5, -9.0), np.full(5, 9.0))
    weights = qp.Weights(np.ones(2), np.array([1.0, 2.0, 3.0, 0.5, 1.0]), np.array([0.1, 0, 0, 0, -0.1]))
    v = 0.05 * RNG.normal(size=2)
    found = pseudo_inverse.weighted(e, v, weights=weights)
    assert found.residual == pytest.approx([0, 0], abs=1e-12)
    exact = minimize(lambda u: ((weights.effector * (u - weights.preferred)) ** 2).sum(), np.zeros(5), constraints=[
        {"type": "eq", "fun": lambda u: e.B @ u - v}], options={"ftol": 1e-14}).x  # fmt: skip
    assert found.u == pytest.approx(exact, abs=1e-6)


def test_redistribution_meets_more_and_still_misses_some():
    e = some(3, 8, seed=4)
    demand = RNG.normal(size=(400, 3)) * np.abs(e.B).sum(axis=1) * 0.2
    inside = attainable.attainable_set(e).contains(demand)
    cut = np.abs(pseudo_inverse.weighted(e, demand).residual).max(axis=1)
    again = np.abs(pseudo_inverse.redistributed(e, demand).residual).max(axis=1)
    best = np.abs(qp.allocate(e, demand).residual).max(axis=1)
    assert (best[inside] < 1e-5).all()
    assert (cut[inside] > 1e-3).sum() > (again[inside] > 1e-3).sum() > 0
    one = pseudo_inverse.redistributed(e, demand[7])
    assert one.u == pytest.approx(pseudo_inverse.redistributed(e, demand).u[7], abs=1e-12)


def test_daisy_chain_asks_the_next_group_for_the_rest():
    e = Effectors(("elevon", "up", "down"), [[-2.0, 1.0, -1.0]], [-0.3, 0, 0], [0.2, 1, 1])
    groups = (("elevon",), ("up", "down"))
    found = pseudo_inverse.daisy_chain(e, [[0.4], [1.0], [-0.9]], groups=groups)
    assert found.u == pytest.approx(np.array([[-0.2, 0, 0], [-0.3, 0.4, 0], [0.2, 0, 0.5]]), abs=1e-12)
    assert found.residual == pytest.approx(np.zeros((3, 1)), abs=1e-12)
    with pytest.raises(ModelError, match="two groups"):
        pseudo_inverse.daisy_chain(e, [0.1], groups=(("up",), ("up", "down")))


@pytest.mark.parametrize(("m", "n"), [(1, 4), (2, 6), (3, 7), (4, 7)])
def test_attainable_set_equals_the_hull_of_all_corners(m, n):
    e = some(m, n, seed=m * n)
    corners = np.array([[lo if c == 0 else hi for c, lo, hi in zip(choice, e.lower, e.upper, strict=True)]
                        for choice in itertools.product((0, 1), repeat=n)]) @ e.B.T  # fmt: skip
    made = attainable.attainable_set(e)
    assert made.rank == m
    assert made.contains(corners).all()
    assert np.isclose(made.margin(corners), 0, atol=1e-9).any()
    if m > 1:
        hull = ConvexHull(corners)
        planes = {tuple(row) for row in hull.equations.round(6)}
        assert len(made.offsets) == len(planes)  # every facet once
    for wrench in RNG.normal(size=(60, m)) * np.abs(e.B).sum(axis=1) * 0.3:
        assert made.contains(wrench) == reachable(e, wrench)
        factor = float(made.reach(wrench))
        assert made.contains(wrench * factor * 0.999)
        assert not made.contains(wrench * factor * 1.001)


def test_attainable_set_of_the_orbiters_jets():
    jets = orbiter_jets()
    e = Effectors(jets.names, jets.effectiveness()[3:], np.zeros(44), np.ones(44), axes=("L", "M", "N"))
    made = attainable.attainable_set(e)
    for direction in RNG.normal(size=(8, 3)) * made.scale:
        factor = float(made.reach(direction))
        assert reachable(e, direction * factor * 0.9999)
        assert not reachable(e, direction * factor * 1.0001)
        assert np.abs(qp.allocate(e, direction * factor * 0.999).residual / made.scale).max() < 1e-5
        assert np.abs(qp.allocate(e, direction * factor * 1.01).residual / made.scale).max() > 1e-4


def test_flat_sets_and_outlines():
    e = Effectors(("a", "b"), [[1.0, 1.0], [2.0, 2.0]], [0, 0], [1, 1], axes=("x", "y"))
    made = attainable.attainable_set(e)
    assert made.rank == 1
    assert made.contains([[1.0, 2.0], [2.0, 4.0], [0, 0], [1.0, 2.1], [2.1, 4.2]]).tolist() == [True, True, True, False, False]
    assert np.isnan(made.reach([1.0, 0.0])) or made.reach([1.0, 0.0]) == pytest.approx(0, abs=1e-6)
    square = Effectors(("a", "b"), [[1.0, 0.0], [0.0, 2.0]], [0, -1], [1, 1], axes=("x", "y"))
    outline = attainable.attainable_set(square).outline(("x", "y"))
    assert {tuple(p) for p in outline.round(9)} == {(0, -2), (1, -2), (1, 2), (0, 2)}
    assert attainable.attainable_part(square, [4.0, 4.0]) == pytest.approx([1.0, 1.0], rel=1e-6)
    with pytest.raises(ModelError, match="more than"):
        attainable.attainable_set(some(6, 60))


@pytest.mark.parametrize(("unit", "label"), [("N m", "x [N m]"), ("", "x")])
def test_figure_of_the_attainable_set_names_the_unit(unit, label):
    e = Effectors(("a", "b"), [[1.0, 0.0], [0.0, 2.0]], [0, -1], [1, 1], axes=("x", "y"), unit=unit)
    ax = attainable.attainable_set(e).plot([[0.5, 0.5], [3.0, 3.0]]).axes[0]
    assert ax.get_xlabel() == label
    assert ax.get_ylabel() == label.replace("x", "y")


def test_on_off_bound_equals_enumeration():
    rng = np.random.default_rng(3)
    e = Effectors(tuple("abcdef"), rng.normal(size=(2, 6)), np.zeros(6), np.ones(6), flow=rng.uniform(1, 2, 6))
    weights = qp.Weights(np.array([1.0, 0.5]), np.ones(6), np.zeros(6))
    demand = rng.normal(size=(6, 2))
    found = bound.on_off(e, demand, weights=weights)
    fuel = bound.PROPELLANT * e.flow / e.flow.sum()
    able = weights.axis * np.abs(e.B).sum(axis=1)  # the axis that matters most costs 1 where all is missed
    for k, v in enumerate(demand):
        costs = [
            np.abs(weights.axis * (e.B @ np.array(c) - v)).sum() / able.max() + fuel @ np.array(c)
            for c in itertools.product((0.0, 1.0), repeat=6)
        ]
        assert found.cost[k] == pytest.approx(min(costs), rel=1e-6)
        assert found.proof[k] <= found.cost[k]
    assert found.allocation.ok
    assert np.isin(found.allocation.u, (0, 1)).all()


def test_scale_of_the_weights_is_of_no_effect_on_the_bound():
    """An error of 2e-4 of what both jets can do is not worth a jet that is half of the propellant, in whatever unit the weights are."""
    e = Effectors(("surface", "jet"), [[1e5, 40.0]], [-1, 0], [1, 1], flow=[0, 1])
    for demand, fires in ((1e5 + 40.0, 0), (1e5 + 40.0 + 200, 1)):
        strong = Effectors(e.names, [[1e5, demand - 1e5]], e.lower, e.upper, flow=e.flow)
        for scale in (1e-9, 1.0, 1e6):
            found = bound.on_off(strong, [demand], weights=qp.Weights(np.array([scale]), np.ones(2), np.zeros(2)))
            assert found.allocation.u[1] == fires, (demand, scale)
            able = 1e5 + strong.B[0, 1]
            assert found.cost == pytest.approx(bound.PROPELLANT if fires else (demand - 1e5) / able, rel=1e-6)


def test_jets_that_push_against_each_other():
    e = Effectors(("up", "down", "side"), [[26.0, -25.0, 0.1], [0.3, 0.0, 8.0]], np.zeros(3), np.ones(3), flow=[4, 4, 4])
    weights = qp.Weights(np.ones(2), np.ones(3), np.zeros(3))
    demand = np.array([[1.0, 0.0], [1.0, 8.0], [26.0, 0.0], [-25.0, 8.0]])
    fuel = bound.PROPELLANT * e.flow / 12
    able = np.abs(e.B).sum(axis=1).max()
    for opposed in (True, False):
        found = bound.on_off(e, demand, weights=weights, opposed=opposed)
        allowed = [c for c in itertools.product((0.0, 1.0), repeat=3) if opposed or not c[0] * c[1]]
        for k, v in enumerate(demand):
            costs = [np.abs(e.B @ np.array(c) - v).sum() / able + fuel @ np.array(c) for c in allowed]
            assert found.allocation.u[k].tolist() == list(allowed[int(np.argmin(costs))])
        assert found.allocation.u[0].tolist() == ([1, 1, 0] if opposed else [0, 0, 0])
    jammed = bound.on_off(e.failed({"up": 1.0}), demand[0], weights=weights, opposed=False)
    assert jammed.allocation.u.tolist() == [1, 1, 0]  # the only answer to a jet that does not stop
    always = Effectors(e.names, e.B, [0.5, 0.5, 0], e.upper, flow=e.flow)
    assert bound.on_off(always, demand[0], weights=weights, opposed=False).allocation.ok


def test_on_off_bound_with_short_pulses_and_surfaces():
    e = Effectors(("surface", "jet"), [[1.0, 1.0]], [-0.2, 0], [0.2, 1], flow=[0, 1])
    weights = qp.Weights(np.ones(1), np.ones(2), np.zeros(2))
    met = bound.on_off(e, [0.6], weights=weights, shortest=0.4)
    assert met.allocation.residual == pytest.approx([0], abs=1e-6)
    assert met.allocation.u[1] == pytest.approx(0.4, abs=1e-6)  # the jet is dear, the surface free
    whole = bound.on_off(e, [0.6], weights=weights)
    assert whole.allocation.u == pytest.approx([-0.2, 1], abs=1e-6)
    with pytest.raises(ModelError, match="shortest"):
        bound.on_off(e, [0.6], shortest=2.0)


def test_what_jammed_jets_burn_is_no_cost():
    e = Effectors(("up", "down"), [[1.0, -1.0]], [0, 0], [1, 1], flow=[2.0, 2.0])
    found = bound.on_off(e.failed({"up": 1, "down": 0.5}), [0.2])
    assert float(found.cost) == pytest.approx(0.3 / 1.5, rel=1e-9)  # missed, in parts of what the two deliver
    half = bound.on_off(e.failed({"down": 0}), [1.0])
    assert float(half.cost) == pytest.approx(bound.PROPELLANT / 2, rel=1e-6)  # one of two equal jets: parts of the flow of all


def test_predictive_plan_is_the_optimum_of_its_problem():
    e = Effectors(("s", "up", "down"), [[-2.0, 1.0, -1.0]], [-0.3, 0, 0], [0.2, 1, 1], rate=[0.5, np.inf, np.inf], flow=[0, 1, 1])
    trade = predictive.Tradeoff(horizon=3, impulse=0.4, propellant=0.05, travel=0.2)
    weights = qp.Weights(np.ones(1), np.array([0.02, 0.1, 0.1]), np.zeros(3))
    demand, before, owed = np.array([[0.5], [-0.2], [0.9]]), np.array([0.05, 0, 0]), np.array([0.1])
    plan = predictive.planner(e, dt=0.1, tradeoff=trade, weights=weights).plan(demand, before, owed)
    assert plan.status.ok

    def cost(x):
        u, last, missed, total = x.reshape(3, 3), before, owed.copy(), 0.0
        for k in range(3):
            error = demand[k] - e.B @ u[k]
            missed = missed + error
            total += (error**2).sum() + trade.impulse * (missed**2).sum() + trade.propellant * (e.flow @ u[k]) / 2
            total += trade.travel * ((u[k, 0] - last[0]) / 0.5) ** 2 + ((weights.effector * u[k]) ** 2).sum()
            last = u[k]
        return total

    rates = [{"type": "ineq", "fun": lambda x, k=k, s=s: 0.05 - s * (x[3 * k] - (before[0] if k == 0 else x[3 * k - 3]))}
             for k in range(3) for s in (-1, 1)]  # fmt: skip
    exact = minimize(
        cost, plan.u.ravel() * 0.9, bounds=[(-0.3, 0.2), (0, 1), (0, 1)] * 3, constraints=rates, options={"ftol": 1e-14, "maxiter": 500}
    )
    assert cost(plan.u.ravel()) == pytest.approx(exact.fun, rel=1e-6)
    assert plan.u.ravel() == pytest.approx(exact.x, abs=1e-3)
    assert np.abs(np.diff(plan.u[:, 0], prepend=0.05)).max() <= 0.05 + 1e-7


def test_predictive_trades_what_it_is_told_to():
    e = Effectors(("s", "up", "down"), [[-2e6, 2.7e5, -2.5e5]], [-0.3, 0, 0], [0.2, 1, 1], rate=[0.35, np.inf, np.inf], flow=[0, 8, 8])
    demand = (5e5 * np.sin(0.15 * np.arange(60)))[:, None]
    asked = {"plain": {}, "thrifty": {"propellant": 1.0}, "calm": {"travel": 1.0}}
    runs = {n: predictive.receding_horizon(e, demand, dt=0.06, tradeoff=predictive.Tradeoff(**t)) for n, t in asked.items()}
    assert all(r.ok for r in runs.values())
    fuel = {n: (r.u @ e.flow).sum() for n, r in runs.items()}
    travel = {n: np.abs(np.diff(r.u[:, 0])).sum() for n, r in runs.items()}
    error = {n: (r.residual**2).mean() for n, r in runs.items()}
    assert fuel["thrifty"] < fuel["plain"]
    assert travel["calm"] < travel["plain"]
    assert error["plain"] < min(error["thrifty"], error["calm"])
    with pytest.raises(ModelError, match="horizon"):
        predictive.Tradeoff(horizon=0)
    with pytest.raises(ModelError, match="one row for each cycle"):
        predictive.planner(e, dt=0.06).plan(demand[:3], np.zeros(3))


def test_predictive_plan_with_nothing_to_do_is_solved():
    e = Effectors(("surface", "jet"), [[2.0, -3.0], [0.5, 0.2]], [-1, 0], [1, 1], rate=[0.5, np.inf], flow=[0, 0.3])
    for demand in (np.zeros((3, 2)), np.full((3, 2), 1e-9)):
        found = predictive.receding_horizon(e, demand, dt=0.1)
        assert found.ok
        assert np.abs(found.u).max() < 1e-6
