"""Allocation solvers side by side: time for each solve and optimality on 10,000 demands that follow each other.

The task: bounded weighted least squares (``allocation.qp``) for 3 effectors on one axis, 10 jets on three axes and all 44 jets of the
orbiter on three axes; effectors, limits and weights stay, the demand changes from sample to sample.  Every tool is called through the
fastest interface it has: set up once, only the linear term updated, warm started where it can be; what is measured is the loop over
the demands.  The cost ratio (1e-2) is one that every tool can solve without refinement.  Optimality is judged by this project's own
residuals of each answer (primal, dual, gap; the worst over all demands), not by what the tool reports, and by the distance from the
optimum (the answer of the own solver, whose residuals are at rounding).

Run: python -m benchmarks.allocation [--quick] [--json]
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.optimize import lsq_linear

from allocation import backends, qp_native
from benchmarks import _bench
from models.checked import Array
from models.thrusters import orbiter_jets

DEMANDS = 10_000
RATIO = 1e-2
TEN = ("L1L", "L1U", "L2D", "L1A", "R1R", "R1U", "R2D", "R1A", "F1U", "F1D")
BUDGET = 6.0  # s for one tool: it answers as many of the demands as fit


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """One set of effectors with its demands and, for the tools, the quadratic program 1/2 u'Hu + f'u."""

    B: Array
    lower: Array
    upper: Array
    weight: Array
    demand: Array

    @property
    def H(self) -> Array:
        """Hessian, B'B + diag(weight^2)."""
        return np.asarray(self.B.T @ self.B + np.diag(self.weight**2))

    @property
    def f(self) -> Array:
        """Linear terms, one row for each demand: -B'v."""
        return np.ascontiguousarray(-self.demand @ self.B)


@dataclass(frozen=True, slots=True)
class Row:
    """One tool on one problem: microseconds for each solve, worst KKT residual and distance from the optimum, demands answered."""

    effectors: int
    tool: str
    microseconds: float
    kkt: float
    distance: float
    answered: int
    note: str = ""


def problem(n: int, demands: int = DEMANDS) -> Problem:
    """3: elevon and two opposed jets, one axis; 10 and 44: orbiter jets, moments in parts of half their sum."""
    if n == 3:
        B, low = np.array([[-1.0, 0.6, -0.55]]), np.array([-0.4, 0.0, 0.0])
        high, size = np.array([0.3, 1.0, 1.0]), np.array([1.0])
    else:
        jets = orbiter_jets() if n == 44 else orbiter_jets().pick(TEN)
        B = jets.effectiveness()[3:]
        B = B / (0.5 * np.abs(B).sum(axis=1))[:, None]
        low, high, size = np.zeros(n), np.ones(n), np.full(3, 0.35)
    m = len(B)
    rng = np.random.default_rng(5)
    t = 0.06 * np.arange(demands)
    periods, phases = rng.uniform(5, 40, (6, m)), rng.uniform(0, 2 * np.pi, (6, m))
    waves = np.sin(2 * np.pi * t[:, None, None] / periods + phases).sum(axis=1) / 2
    return Problem(B, low, high, RATIO * np.linalg.norm(B, axis=0), size * waves)


Solve = Callable[[int], Array]


def own(p: Problem, *, single: bool = False) -> Callable[[], Array]:
    """All demands at once: effectors written into the compiled code, or read as data."""
    axis, preferred = np.ones(len(p.B)), np.zeros(p.B.shape[1])
    if single:
        return lambda: (
            qp_native.solve_many(
                p.B, p.demand, lower=p.lower, upper=p.upper, axis_weight=axis, effector_weight=p.weight, preferred=preferred
            ).u
        )
    solver = qp_native.fixed(p.B, lower=p.lower, upper=p.upper, axis_weight=axis, effector_weight=p.weight, preferred=preferred)
    return lambda: solver(p.demand).u


def osqp(p: Problem) -> Solve:
    import osqp as package

    solver, n, f = package.OSQP(), len(p.weight), p.f
    solver.setup(
        sp.triu(sp.csc_matrix(p.H), format="csc"), f[0], sp.eye(n, format="csc"), p.lower, p.upper, eps_abs=1e-9, eps_rel=1e-9,
        max_iter=20000, verbose=False, check_termination=10, adaptive_rho_interval=50,
    )  # fmt: skip

    def solve(k: int) -> Array:
        solver.update(q=f[k])
        return np.asarray(solver.solve(raise_error=False).x)

    return solve


def daqp(p: Problem) -> Solve:
    import daqp as package

    n, f = len(p.weight), p.f
    model = package.Model()
    model.setup(p.H, f[0], np.zeros((0, n)), p.upper, p.lower, np.zeros(n, dtype=np.int32))

    def solve(k: int) -> Array:
        model.update(f=f[k])
        return np.asarray(model.solve()[0])

    return solve


def quadprog(p: Problem) -> Solve:
    import quadprog as package

    n, f = len(p.weight), p.f
    inverse = np.linalg.inv(np.linalg.cholesky(p.H).T)  # it takes the factor of H ready made
    C, b = np.hstack([np.eye(n), -np.eye(n)]), np.concatenate([p.lower, -p.upper])
    return lambda k: np.asarray(package.solve_qp(inverse.copy(), -f[k], C, b, 0, True)[0])


def piqp(p: Problem) -> Solve:
    import piqp as package

    f = p.f
    solver = package.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-13, 0.0
    solver.settings.eps_duality_gap_abs, solver.settings.eps_duality_gap_rel = 1e-14, 0.0
    solver.settings.reg_lower_limit, solver.settings.reg_finetune_lower_limit = 1e-13, 1e-14
    solver.setup(np.asfortranarray(p.H), f[0], x_l=p.lower, x_u=p.upper)

    def solve(k: int) -> Array:
        solver.update(c=f[k])
        solver.solve()
        return np.array(solver.result.x)

    return solve


def proxqp(p: Problem) -> Solve:
    from proxsuite import proxqp as package

    n, f = len(p.weight), p.f
    solver = package.dense.QP(n, 0, n)
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-10, 0.0
    # without its warm start: after some thousand updates that ends in a segmentation fault (version 0.8.0)
    solver.init(p.H, f[0], None, None, np.eye(n), p.lower, p.upper)

    def solve(k: int) -> Array:
        solver.update(g=f[k])
        solver.solve()
        return np.array(solver.results.x)

    return solve


def clarabel(p: Problem) -> Solve:
    import clarabel as package

    n, f = len(p.weight), p.f
    settings = package.DefaultSettings()
    settings.verbose = False
    settings.presolve_enable = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    A, b = sp.vstack([sp.eye(n), -sp.eye(n)], format="csc"), np.concatenate([p.upper, -p.lower])
    solver = package.DefaultSolver(sp.triu(sp.csc_matrix(p.H), format="csc"), f[0], A, b, [package.NonnegativeConeT(2 * n)], settings)

    def solve(k: int) -> Array:
        solver.update(q=f[k])
        return np.array(solver.solve().x)

    return solve


def highs(p: Problem) -> Solve:
    import highspy as package

    n, f = len(p.weight), p.f
    solver = package.Highs()
    solver.setOptionValue("output_flag", False)
    solver.setOptionValue("qp_regularization_value", 0.0)
    solver.setOptionValue("qp_iteration_limit", 2000)  # version 1.15 can go round for ever on 44 effectors
    solver.addVars(n, p.lower, p.upper)
    lower = sp.tril(sp.csc_matrix(p.H), format="csc")
    hessian = package.HighsHessian()
    hessian.dim_, hessian.format_ = n, package.HessianFormat.kTriangular
    hessian.start_, hessian.index_, hessian.value_ = lower.indptr, lower.indices, lower.data
    solver.passHessian(hessian)
    index = np.arange(n, dtype=np.int32)

    def solve(k: int) -> Array:
        solver.changeColsCost(n, index, f[k])
        solver.run()
        return np.array(solver.getSolution().col_value)

    return solve


def scipy_bvls(p: Problem) -> Solve:
    A = np.vstack([p.B, np.diag(p.weight)])
    right = np.hstack([p.demand, np.zeros((len(p.demand), len(p.weight)))])
    return lambda k: np.asarray(lsq_linear(A, right[k], (p.lower, p.upper), method="bvls", tol=1e-14, max_iter=500).x)


TOOLS: dict[str, tuple[str, Callable[[Problem], Solve]]] = {
    "osqp": ("osqp", osqp),
    "daqp": ("daqp", daqp),
    "quadprog": ("quadprog", quadprog),
    "piqp": ("piqp", piqp),
    "proxqp": ("proxsuite", proxqp),
    "clarabel": ("clarabel", clarabel),
    "highs": ("highspy", highs),
    "scipy lsq_linear": ("scipy", scipy_bvls),
}


def timed(solve: Solve, count: int, budget: float, repeat: int) -> tuple[float, Array]:
    """Best time for each solve over the repetitions, and the answers, of as many demands as the budget allows."""
    began = time.perf_counter()
    first = [solve(k) for k in range(min(20, count))]
    each = (time.perf_counter() - began) / len(first)
    number = int(max(20, min(count, budget / max(repeat, 1) / max(each, 1e-9))))
    least, answers = float("inf"), np.empty((number, len(first[0])))
    for _ in range(repeat):
        began = time.perf_counter()
        for k in range(number):
            answers[k] = solve(k)
        least = min(least, time.perf_counter() - began)
    return least / number, answers


def judged(p: Problem, u: Array, best: Array) -> tuple[float, float]:
    """Worst KKT residual and largest distance from the optimum, in commands."""
    held = np.clip(u, p.lower, p.upper)
    kkt = backends.residuals(
        p.B,
        p.demand[: len(u)],
        held,
        lower=p.lower,
        upper=p.upper,
        axis=np.ones(len(p.B)),
        effector=p.weight,
        preferred=np.zeros(len(p.weight)),
    )
    return float(kkt.max()), float(np.abs(u - best[: len(u)]).max())


def run(n: int, *, demands: int = DEMANDS, budget: float = BUDGET, repeat: int = 3) -> list[Row]:
    """Every installed tool on one problem."""
    p = problem(n, demands)
    rows, reference = [], own(p, single=True)()
    for name, single in (("own, effectors in the code", False), ("own, effectors as data", True)):
        call = own(p, single=single)
        u = call()  # compiles
        kkt, distance = judged(p, u, reference)
        rows.append(Row(n, name, 1e6 * _bench.best(call, repeat=20 * repeat, budget=budget) / demands, kkt, distance, demands))
    for name, (package, make) in TOOLS.items():
        if importlib.util.find_spec(package) is None:
            rows.append(Row(n, name, float("nan"), float("nan"), float("nan"), 0, "not installed"))
            continue
        _bench.announce(f"{n} effectors: {name}")
        seconds, u = timed(make(p), demands, budget, repeat)
        rows.append(Row(n, name, 1e6 * seconds, *judged(p, u, reference), len(u)))
    return rows


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Rows of all tools on all problems."""
    rows: list[Row] = []
    for n in (3, 10, 44):
        rows += run(n, demands=1000, budget=0.3, repeat=1) if quick else run(n)
    return {"machine": _bench.machine(), "rows": [{k: None if v != v else v for k, v in asdict(row).items()} for row in rows]}


def show(result: dict[str, Any]) -> None:
    """The table."""
    rows, least = result["rows"], {}
    for row in rows:
        least.setdefault(row["effectors"], row["microseconds"])  # the first is the own solver
    _bench.table(
        "Bounded least squares, demands that follow each other",
        ("effectors", "tool", "us/solve", "times own", "KKT", "distance", "answered"),
        [shown(row, least[row["effectors"]]) for row in rows],
        note="KKT and distance: the worst of all answers, judged here; times own: beside the first row of the same problem",
    )  # fmt: skip


def shown(row: dict[str, Any], least: float) -> tuple[str, ...]:
    """A line of the table."""
    n, tool, each = str(row["effectors"]), row["tool"], row["microseconds"]
    if row["note"]:
        return (n, tool, "-", "-", "-", "-", row["note"])
    return (n, tool, f"{each:.3g}", f"{each / least:.3g}", f"{row['kkt']:.1e}", f"{row['distance']:.1e}", str(row["answered"]))


if __name__ == "__main__":
    _bench.run(__doc__, measure, show)
