"""Back ends on demands where refinement alone does not converge: exact solvers must not look wrong for it."""

import numpy as np
import pytest

from allocation import backends, qp_native


@pytest.mark.parametrize("name", [n for n in ("daqp", "quadprog", "lsq_linear") if n in backends.available()])
def test_exact_solvers_are_exact(name):
    rng = np.random.default_rng(42)
    for m, n in ((1, 3), (3, 10), (3, 44)):  # the last of three draws
        B = rng.normal(size=(m, n))
        rng.normal(size=(10_000, m))
        demand = rng.normal(size=(10_000, m)) * 0.3 * np.abs(B).sum(axis=1)
        W = np.ones(m) / np.abs(B).sum(axis=1)
        b = 3e-4 * np.linalg.norm(W[:, None] * B, axis=0)
        lower, upper = np.where(rng.random(n) < 0.5, -1.0, 0.0), np.ones(n)
    chosen = demand[[7, 191, 0, 1, 2]]
    own = qp_native.solve_many(B, chosen, lower=lower, upper=upper, axis_weight=W, effector_weight=b, preferred=np.zeros(n))
    assert own.solved.all()
    solver = backends.Backend.of(name, B, axis=W, effector=b, preferred=np.zeros(n))
    for v, wanted in zip(chosen, own.u, strict=True):
        u, kkt = solver.solve(v, lower=lower, upper=upper)
        assert kkt.max() < 1e-6
        assert u == pytest.approx(wanted, abs=1e-6)
