"""Chains of problems: every layout, data of each kind, compiled and interpreted, against SciPy, and what a chain leaves unsolved."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from allocation import active_set, qp_chain, qp_native
from benchmarks.allocation import problem
from models import native
from models.checked import ModelError, evaluate

M, N = 2, 5
ROWS = 1499  # neither a whole number of chains nor of vectors


def walk(rows=ROWS, seed=4):
    """One set of effectors and demands that wander from inside the attainable set to outside and back."""
    rng = np.random.default_rng(seed)
    B, lower, upper = rng.normal(size=(M, N)), -rng.random(N), rng.random(N)
    t = np.arange(rows)[:, None] / 60
    demand = 2.5 * np.sin(t * [1.0, 1.7] + [0.0, 1.0]) * np.abs(B).sum(axis=1) / 2
    return B, demand, lower, upper, np.ones(M), np.full(N, 1e-2), rng.uniform(-0.1, 0.1, N)


def columns_of(B, *others):
    return [np.ascontiguousarray(np.swapaxes(B, -1, -2)).reshape(*B.shape[:-2], -1), *others]


def chain_of(compiled):
    given = active_set.symbols(M, N)
    return qp_chain.make(active_set.steps(given, count=1), active_set.ending(given), compiled=compiled)


@pytest.fixture(scope="module")
def compiled():
    if not native.native_available():
        pytest.skip("no C compiler on this machine")
    return chain_of(True)


@pytest.fixture(scope="module")
def interpreted():
    return chain_of(False)


def by_scipy(B, demand, lower, upper, W, b, p):
    A, right = np.vstack([W[:, None] * B, np.diag(b)]), np.concatenate([W * demand, b * p])
    return lsq_linear(A, right, (lower, upper), method="bvls", tol=1e-15).x


def test_a_walk_against_scipy(compiled, interpreted):
    data = walk()
    wanted = np.array([by_scipy(data[0], v, *data[2:]) for v in data[1]])
    at_limits = (wanted == data[2]) | (wanted == data[3])
    assert (at_limits[1:] != at_limits[:-1]).any(axis=1).sum() > 50  # the set of free effectors changes many times
    for chain in (compiled, interpreted):
        u, _, kkt, solved = chain.run(columns_of(*data), ROWS, None)
        assert solved.all()
        assert kkt.max() < 1e-12
        assert u == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("rows", [1, 7, 8, 63, 64, 65, 129, 1000, 9000])
def test_every_layout(rows, compiled, interpreted):
    columns = columns_of(*walk(rows))
    one, other = (chain.run(columns, rows, None) for chain in (compiled, interpreted))
    assert one[3].all()
    assert other[3].all()
    assert one[0] == pytest.approx(other[0], abs=1e-11)


def test_data_of_every_kind(compiled, interpreted):
    """Shared by all problems, or each its own; with and without prices to begin with; the order is only a help."""
    shared = columns_of(*walk())
    own = [c if k == 1 else np.repeat(c[None], ROWS, axis=0) for k, c in enumerate(shared)]
    first = compiled.run(shared, ROWS, None)
    shuffled = np.random.default_rng(1).permutation(ROWS)
    for chain in (compiled, interpreted):
        assert chain.run(own, ROWS, None)[0] == pytest.approx(first[0], abs=1e-12)
        assert chain.run(own, ROWS, first[1])[0] == pytest.approx(first[0], abs=1e-12)
        assert chain.run(own, ROWS, np.full((ROWS, M), 1e3))[0] == pytest.approx(first[0], abs=1e-9)
        mixed = chain.run(qp_chain.pick(shared, shuffled), ROWS, None)
        assert mixed[3].all()
        assert mixed[0] == pytest.approx(first[0][shuffled], abs=1e-9)


def test_threads_do_not_change_a_bit(compiled):
    columns = columns_of(*walk(9000))
    first = replace(compiled, threads=1).run(columns, 9000, None)
    for threads in (2, 3, 7):
        again = replace(compiled, threads=threads).run(columns, 9000, None)
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


@pytest.mark.parametrize("use_compiler", [False, True])
def test_what_the_chains_leave_is_solved_from_the_beginning(use_compiler, monkeypatch):
    if use_compiler and not native.native_available():
        pytest.skip("no C compiler on this machine")
    B, demand, lower, upper, W, b, p = walk()
    right = qp_native.fixed(B, lower=lower, upper=upper, axis_weight=W, effector_weight=b, preferred=p, compiled=False)(demand)
    monkeypatch.setattr(qp_chain, "ROUNDS", 0)
    hasty = qp_native.fixed(B, lower=lower, upper=upper, axis_weight=W, effector_weight=b, preferred=p, compiled=use_compiler)
    columns = [demand]
    left = ~hasty.kit.chain.run(columns, ROWS, None)[3]
    assert 0 < left.sum() < ROWS  # kinks that no straight line foresees
    monkeypatch.undo()
    found = hasty(demand)
    assert found.solved.all()
    assert found.u == pytest.approx(right.u, abs=1e-10)


def test_neighbours_lead_to_most_answers(monkeypatch):
    """44 jets, demands from sample to sample: 41 more proofs than problems; 102 without the straight line through two neighbours."""
    p, rows = problem(44, 2000), 2000
    given = active_set.constants(
        p.B, lower=p.lower, upper=p.upper, axis_weight=np.ones(3), effector_weight=p.weight, preferred=np.zeros(44)
    )
    chain = qp_chain.make(active_set.steps(given, count=1), active_set.ending(given), compiled=False)
    proofs = []

    def counted(function, *arguments):
        if function is chain.ending:
            proofs.append(len(arguments[0]))
        return evaluate(function, *arguments)

    monkeypatch.setattr(qp_chain, "evaluate", counted)
    assert chain.run([p.demand], rows, None)[3].all()
    assert sum(proofs) - rows < 70


@pytest.mark.parametrize("use_compiler", [False, True])
@pytest.mark.parametrize("every", [2, 25])
def test_demands_of_zero_are_met_in_the_chain(use_compiler, every, monkeypatch):
    """Nothing but exact zeros proves them, and their neighbours do not lead there."""
    if use_compiler and not native.native_available():
        pytest.skip("no C compiler on this machine")
    rng = np.random.default_rng(0)
    B, t = rng.normal(size=(3, 10)), np.arange(1200)
    demand = np.sin(t[:, None] / 40 + [0.0, 1.0, 2.0]) * 0.6 * np.abs(B).sum(axis=1)
    demand[(t // every) % 2 == 1] = 0.0
    data = {"axis_weight": np.ones(3), "effector_weight": np.full(10, 3e-4), "preferred": np.zeros(10)}
    alone = []
    anew = qp_native._Kit.anew
    monkeypatch.setattr(qp_native._Kit, "anew", lambda kit, columns, rows: alone.append(rows) or anew(kit, columns, rows))
    found = qp_native.solve_many(B, demand, lower=-np.ones(10), upper=np.ones(10), **data, compiled=use_compiler)
    assert found.solved.all()
    assert np.abs(found.u[(demand == 0).all(axis=1)]).max() == 0
    assert alone == []
    history = qp_native.solve_history(
        B, demand[:200], lower=-np.ones(10), upper=np.ones(10), **data, room=np.full(10, np.inf), start=np.zeros(10)
    )
    assert history.solved.all()
    assert alone == []


def test_the_best_of_all_steps_counts():
    """With weights twelve decades apart the last step can be worse than one before it."""
    rng = np.random.default_rng(0)
    count, kit = 5000, qp_native._kit(2, 2, False)
    B = np.abs(rng.normal(size=(count, 2, 2))) * np.sign(rng.normal(size=(count, 1, 2)))
    W, b = 10 ** rng.uniform(-2, 2, (count, 2)), 10 ** rng.uniform(-8, 0, (count, 2))
    demand = rng.normal(size=(count, 2)) * np.abs(B).sum(axis=2) * 10 ** rng.uniform(-3, 0, (count, 1))
    columns = columns_of(B, demand, np.zeros((count, 2)), rng.random((count, 2)), W, b, np.zeros((count, 2)))
    y = qp_chain.settled(kit.thorough, columns, np.zeros((count, 2)))
    last, best = evaluate(kit.ending, *columns, y)[2], kit.anew(columns, count)[2]
    assert (best.max(axis=1) <= np.maximum(last.max(axis=1), 1e-9)).all()
    assert (qp_chain.good(best) & ~qp_chain.good(last)).any()


def test_wrong_warm_starts_are_refused():
    B, demand, lower, upper, W, b, p = walk(20)
    data = {"lower": lower, "upper": upper, "axis_weight": W, "effector_weight": b, "preferred": p}
    solver = qp_native.fixed(B, **data, compiled=False)
    for y in (np.zeros((M, 20)), np.zeros(20 * M), np.zeros((19, M))):
        with pytest.raises(ModelError, match=r"y has shape .* expected \(20, 2\)"):
            qp_native.solve_many(B, demand, **data, y=y)
        with pytest.raises(ModelError, match=r"y has shape .* expected \(20, 2\)"):
            solver(demand, y)
    with pytest.raises(ModelError, match="B has shape"):
        qp_native.fixed(3.0, **data)
    still = {"room": np.full(N, np.inf), "start": np.zeros(N)}
    for change, message in (
        ({"room": np.full(N, -1.0)}, "room: expected 5 numbers >= 0"), ({"room": np.full(N, np.nan)}, "room"),
        ({"room": np.ones(2)}, "room"), ({"start": np.zeros(3)}, r"start has shape \(3,\), expected \(5,\)"),
    ):  # fmt: skip
        with pytest.raises(ModelError, match=f"solve_history: {message}"):
            qp_native.solve_history(B, demand, **data, **(still | change))
    assert qp_native.solve_many(B.tolist(), demand.tolist(), **data).solved.all()
