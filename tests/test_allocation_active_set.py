"""The own solver against enumeration of all active sets, SciPy, and its own proof; compiled, interpreted, warm started, over a history."""

import itertools

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from allocation import active_set, backends, qp_native
from models import native
from models.checked import ModelError, evaluate
from models.thrusters import orbiter_jets


def problems(m, n, count, seed, *, spread=5.0):
    """Random problems: unequal weights over `spread` decades, one- and two-sided limits, demands from easy to far out of reach."""
    rng = np.random.default_rng(seed)
    B = rng.normal(size=(count, m, n)) * 10 ** rng.uniform(-2, 4, (count, m, 1))
    scale = np.abs(B).sum(axis=2)
    lower = np.where(rng.random((count, n)) < 0.5, 0.0, -rng.random((count, n)))
    upper = rng.random((count, n))
    demand = rng.normal(size=(count, m)) * scale * rng.choice([0.05, 0.3, 1.0, 3.0], (count, 1))
    axis = 1 / scale
    effector = 10 ** rng.uniform(-1 - spread / 2, -1, (count, n))
    return B, demand, lower, upper, axis, effector, rng.uniform(-0.2, 0.2, (count, n))


def solve(B, demand, lower, upper, axis, effector, preferred, **more):
    return qp_native.solve_many(
        B, demand, lower=lower, upper=upper, axis_weight=axis, effector_weight=effector, preferred=preferred, **more
    )


def enumerated(B, v, low, high, W, b, p):
    """Optimum by trying every combination of lower, free and upper."""
    n, best = len(low), (np.inf, None)
    H, g = (B.T * W**2) @ B + np.diag(b**2), (B.T * W**2) @ v + b**2 * p
    for choice in itertools.product((0, 1, 2), repeat=n):
        kind = np.array(choice)
        free = kind == 1
        u = np.where(kind == 0, low, high)
        if free.any():
            u[free] = np.linalg.solve(H[np.ix_(free, free)], g[free] - H[np.ix_(free, ~free)] @ u[~free])
        if (u < low - 1e-12).any() or (u > high + 1e-12).any():
            continue
        cost = ((W * (B @ u - v)) ** 2).sum() + ((b * (u - p)) ** 2).sum()
        if cost < best[0]:
            best = cost, u
    return best[1]


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 4), (2, 5), (3, 3), (3, 6)])
def test_equals_enumeration(m, n):
    data = problems(m, n, 40, seed=10 * m + n, spread=2.0)
    found = solve(*data)
    assert found.solved.all()
    for k in range(40):
        assert found.u[k] == pytest.approx(enumerated(*(d[k] for d in data)), abs=1e-8)


@pytest.mark.parametrize(("m", "n"), [(1, 3), (2, 7), (3, 10), (4, 12), (6, 12), (3, 44), (6, 44)])
def test_every_answer_is_proved(m, n):
    data = problems(m, n, 60 if n > 12 else 300, seed=m + n)
    found = solve(*data)
    assert found.solved.all()
    assert found.kkt.max() < 1e-9
    assert ((found.u >= data[2]) & (found.u <= data[3])).all()
    again = np.array([  # the same residuals by other code
        backends.residuals(B, v, u, lower=low, upper=high, axis=W, effector=b, preferred=p, price=y)
        for B, v, low, high, W, b, p, u, y in zip(*data, found.u, found.y, strict=True)
    ])  # fmt: skip
    assert again.max() < 1e-9


def test_equals_scipy_on_the_orbiters_jets():
    B = orbiter_jets().effectiveness()[3:]
    W = 1 / np.abs(B).sum(axis=1)
    b = 1e-2 * np.linalg.norm(W[:, None] * B, axis=0)
    demand = np.random.default_rng(3).normal(size=(12, 3)) * np.abs(B).sum(axis=1) * 0.2
    found = solve(B, demand, np.zeros(44), np.ones(44), W, b, np.zeros(44))
    for v, u in zip(demand, found.u, strict=True):
        stacked, right = np.vstack([W[:, None] * B, np.diag(b)]), np.concatenate([W * v, np.zeros(44)])
        exact = lsq_linear(stacked, right, (0, 1), method="bvls", tol=1e-15, max_iter=1000).x
        assert u == pytest.approx(exact, abs=1e-9)


def test_a_wrong_answer_has_large_residuals():
    data = [d[:1] for d in problems(3, 6, 1, seed=5)]
    found = solve(*data)
    B, v, low, high, W, b, p = (d[0] for d in data)
    for j in range(6):
        for move in (-1e-3, 1e-3):
            u = found.u[0].copy()
            u[j] = np.clip(u[j] + move * (high[j] - low[j]), low[j], high[j])
            if u[j] == found.u[0, j]:
                continue
            assert backends.residuals(B, v, u, lower=low, upper=high, axis=W, effector=b, preferred=p).max() > 1e-5


def test_half_and_half_does_not_pass():
    # at b/W = 1e-3 an answer that gives half of the demand to the expensive effector is right to 1e-6 of W^2; its prices say otherwise
    B, one = np.array([[1.0, 1.0]]), np.ones(1)
    wrong = backends.residuals(B, one, np.array([0.5, 0.5]), lower=np.zeros(2), upper=np.full(2, 2.0), axis=one,
                               effector=np.array([1e-7, 1e-3]), preferred=np.zeros(2))  # fmt: skip
    assert wrong.max() > 0.1


def test_ties_symmetry_and_fixed_effectors():
    B = np.array([[1.0, 1.0, -1.0, -1.0, 0.0]])
    data = (
        B,
        np.array([[1.5], [0.0], [-5.0]]),
        np.zeros(5),
        np.array([1.0, 1.0, 1.0, 0.0, 1.0]),
        np.ones(1),
        np.full(5, 1e-3),
        np.zeros(5),
    )
    found = solve(*data)
    assert found.solved.all()
    assert found.u[0] == pytest.approx([0.75, 0.75, 0, 0, 0], abs=1e-6)
    assert np.abs(found.u[1]).max() == 0
    assert found.u[2] == pytest.approx([0, 0, 1, 0, 0])


@pytest.mark.parametrize(("m", "n"), [(1, 3), (2, 5)])
def test_compiled_equals_interpreted_and_fixed(m, n):
    rng = np.random.default_rng(8)
    B, lower, upper = rng.normal(size=(m, n)), -rng.random(n), rng.random(n)
    weights = {"axis_weight": np.ones(m), "effector_weight": 10 ** rng.uniform(-3, -1, n), "preferred": np.zeros(n)}
    demand = np.cumsum(rng.normal(size=(1200, m)), axis=0) * 0.1
    slow = qp_native.solve_many(B, demand, lower=lower, upper=upper, **weights, compiled=False)
    fast = qp_native.solve_many(B, demand, lower=lower, upper=upper, **weights, compiled=True)
    solver = qp_native.fixed(B, lower=lower, upper=upper, **weights)
    assert slow.solved.all()
    assert fast.solved.all()
    assert fast.u == pytest.approx(slow.u, abs=1e-10)
    assert solver(demand).u == pytest.approx(slow.u, abs=1e-10)
    assert solver(demand, slow.y).u == pytest.approx(slow.u, abs=1e-10)
    backwards = solver(demand[::-1])
    assert backwards.u[::-1] == pytest.approx(slow.u, abs=1e-10)  # the order of the demands is only a help


def test_one_function_for_closed_loops():
    data = problems(3, 6, 200, seed=77, spread=2.0)
    B, *rest = data
    columns = [np.swapaxes(B, 1, 2).reshape(200, 18), *rest]
    u, y, kkt, solved = evaluate(active_set.solver(3, 6), *columns, np.zeros((200, 3)))
    assert solved.min() == 1
    assert kkt.max() < 1e-9
    assert u == pytest.approx(solve(*data).u, abs=1e-9)
    warm = evaluate(active_set.solver(3, 6, count=1), *columns, y)
    assert warm[0] == pytest.approx(u, abs=1e-9)
    few = evaluate(active_set.solver(3, 6, count=1), *columns, np.zeros((200, 3)))
    assert np.array_equal(few[3][:, 0] > 0, few[2].max(axis=1) <= 1e-9)  # it says so where one step was not enough
    assert few[3].min() == 0


def test_commands_that_start_at_a_limit():
    # jets at rest stand at their lower limit: whether they are about to leave it or stay decides the slope of the first step
    B, demand, lower, upper, axis, effector, _ = problems(1, 10, 300, seed=3)
    lower, zero = np.zeros_like(lower), np.zeros_like(lower)
    columns = [np.swapaxes(B, 1, 2).reshape(300, 10), demand, lower, upper, axis, effector, zero]
    _, _, kkt, solved = evaluate(active_set.solver(1, 10, count=12), *columns, np.zeros((300, 1)))
    assert solved.min() == 1
    assert kkt.max() < 1e-9


def test_it_is_differentiable_inside_a_loop():
    columns, _ = active_set.symbols(1, 2)
    y = ca.SX.sym("y")
    u = active_set.solver(1, 2).call([*columns, y])[0]
    slope = ca.Function("slope", [*columns, y], [ca.jacobian(u, columns[1])])
    found = evaluate(slope, [1.0, 1.0], [0.5], [-1, -1], [1, 1], [1.0], [1e-3, 1e-2], [0, 0], [0.0])[0]
    # u = C B' / (1 + B C B') v with C = diag(1/b^2)
    compliance = np.array([1e6, 1e4])
    assert found == pytest.approx(compliance / (1 + compliance.sum()), rel=1e-9)


@pytest.mark.parametrize(("m", "n", "N"), [(1, 3, 120), (3, 8, 40)])
def test_history_keeps_within_its_rates_and_is_optimal_at_each_sample(m, n, N):
    rng = np.random.default_rng(2)
    B, lower, upper = rng.normal(size=(m, n)), -np.ones(n), np.ones(n)
    room = np.where(np.arange(n) % 2 == 0, 0.05, np.inf)
    demand = np.cumsum(rng.normal(size=(N, m)), axis=0) * 0.3
    weights = {"axis_weight": np.ones(m), "effector_weight": np.full(n, 0.01), "preferred": np.zeros(n)}
    found = qp_native.solve_history(B, demand, lower=lower, upper=upper, **weights, room=room, start=np.zeros(n))
    assert found.solved.all()
    before = np.zeros(n)
    for v, u in zip(demand, found.u, strict=True):
        assert (np.abs(u - before) <= room + 1e-12).all()
        low, high = qp_native.within(lower, upper, before, room)
        stacked, right = np.vstack([B, 0.01 * np.eye(n)]), np.concatenate([v, np.zeros(n)])
        wide = high - low > 1e-9
        exact = lsq_linear(stacked[:, wide], right - stacked[:, ~wide] @ low[~wide], (low[wide], high[wide]), method="bvls", tol=1e-14).x
        assert u[wide] == pytest.approx(exact, abs=1e-8)
        before = u


def test_history_solves_alone_what_its_steps_leave(monkeypatch):
    rng = np.random.default_rng(5)
    B, demand = rng.normal(size=(3, 9)), np.cumsum(rng.normal(size=(130, 3)), axis=0)
    data = {
        "lower": np.zeros(9), "upper": np.ones(9), "axis_weight": np.ones(3), "effector_weight": np.full(9, 1e-3),
        "preferred": np.zeros(9), "room": np.full(9, 0.1), "start": np.full(9, 0.5),
    }  # fmt: skip
    usual = qp_native.solve_history(B, demand, **data)
    monkeypatch.setattr(qp_native, "LINKS", 1)
    qp_native._chain.cache_clear()
    hard = qp_native.solve_history(B, demand, **data)
    qp_native._chain.cache_clear()
    assert usual.solved.all()
    assert hard.solved.all()
    assert hard.u == pytest.approx(usual.u, abs=1e-9)
    assert np.array_equal(hard.solved, hard.kkt.max(axis=1) <= 1e-9)


@pytest.mark.skipif(not native.native_available(), reason="no C compiler on this machine")
def test_compiled_history_equals_interpreted():
    rng = np.random.default_rng(6)
    data = {
        "lower": -np.ones(4), "upper": np.ones(4), "axis_weight": np.ones(2), "effector_weight": np.full(4, 1e-2),
        "preferred": np.zeros(4), "room": np.array([0.1, 0.2, np.inf, np.inf]), "start": np.array([1.4, 0, 0, 0]),
    }  # fmt: skip
    B, demand = rng.normal(size=(2, 4)), np.cumsum(rng.normal(size=(120, 2)), axis=0) * 0.3
    one, other = (qp_native.solve_history(B, demand, **data, compiled=c) for c in (False, True))
    assert other.u == pytest.approx(one.u, abs=1e-12)
    assert one.u[0, 0] == pytest.approx(1.3)  # from beyond the limit as fast as it may
    assert other.solved.all()


@pytest.mark.parametrize("bad", ["demand", "B", "lower", "upper", "axis_weight", "effector_weight", "preferred", "y"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_bad_sample_is_not_called_solved_and_harms_no_later_one(bad, value):
    solver = active_set.solver(1, 3)
    good = {
        "B": [1.0, 1.0, -1.0], "demand": [0.5], "lower": [0.0] * 3, "upper": [1.0] * 3, "axis_weight": [1.0],
        "effector_weight": [0.01] * 3, "preferred": [0.0] * 3, "y": [0.0],
    }  # fmt: skip
    spoiled = good | {bad: [value, *good[bad][1:]]}
    found = solver(**spoiled)
    assert np.isfinite(found["y_next"].full()).all()
    held = good | {"upper": [0.0] * 3, bad: [value, *(good | {"upper": [0.0] * 3})[bad][1:]]}  # nothing can move: easily "optimal"
    if bad != "y" and not (value == np.inf and bad in ("upper", "axis_weight", "effector_weight")):
        assert float(found["solved"]) == 0
        assert float(solver(**held)["solved"]) == 0
        assert max(found["kkt"].full().ravel()) > 1e-9
    after = solver(**(good | {"y": found["y_next"]}))
    assert float(after["solved"]) == 1
    assert after["u"].full().ravel() == pytest.approx([0.25, 0.25, 0.0], abs=1e-4)


def test_one_hopeless_problem_does_not_spoil_the_batch():
    # unscaled: gains of 1e25 beside a compliance of 1, where rounding can leave a pivot of zero
    rng = np.random.default_rng(0)
    for m, n in ((3, 7), (4, 6), (6, 14)):
        B, upper = rng.normal(size=(60, m, n)), rng.random((60, n))
        lower = -rng.random((60, n))
        B[::2] *= 1e9
        demand = np.einsum("kmn,kn->km", B, rng.uniform(-1, 1, (60, n)))
        effector = np.where(np.arange(60)[:, None] % 2 == 0, 3e-4, 1e-2) * np.ones((60, n))
        found = qp_native.solve_many(
            B, demand, lower=lower, upper=upper, axis_weight=np.ones(m), effector_weight=effector, preferred=np.zeros(n)
        )
        assert found.solved[1::2].all()
        assert np.isfinite(found.u).all()
        assert np.array_equal(found.solved, found.kkt.max(axis=1) <= 1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lower": np.array([2.0, 0.0])}, "above its upper"),
        ({"effector_weight": np.zeros(2)}, "not > 0"),
        ({"axis_weight": np.ones(2)}, "axis_weight has shape"),
        ({"upper": np.array([np.nan, 1.0])}, "finite"),
    ],
)
def test_bad_problems_are_refused(change, message):
    data = {"lower": np.zeros(2), "upper": np.ones(2), "axis_weight": np.ones(1), "effector_weight": np.ones(2), "preferred": np.zeros(2)}
    with pytest.raises(ModelError, match=message):
        qp_native.solve_many(np.ones((1, 2)), np.ones((3, 1)), **(data | change))


def test_too_many_axes():
    with pytest.raises(ModelError, match="1 to 6 axes"):
        active_set.symbols(7, 9)
