"""Chains of problems: every layout, data of each kind, compiled and interpreted, against SciPy, and what a chain leaves unsolved."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from allocation import active_set, qp_chain, qp_native
from models import native

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
