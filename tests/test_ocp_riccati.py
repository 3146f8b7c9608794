"""Algebraic Riccati and Lyapunov equations: residual of the equation itself, SciPy, python-control, errors."""

import numpy as np
import pytest
import scipy.linalg as sla

import models
from ocp.riccati import care, dare, dlyapunov, lyapunov


def problem(seed, *, spread=0.0):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 9)), int(rng.integers(1, 4))
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
    F, G = rng.standard_normal((n, n)), rng.standard_normal((m, m))
    Q, R = F @ F.T, G @ G.T + np.eye(m)
    N = 0.1 * F @ rng.standard_normal((n, m)) / n
    d, e = 10.0 ** rng.uniform(-spread, spread, n), 10.0 ** rng.uniform(-spread, spread, m)
    return (d[:, None] * A / d, d[:, None] * B * e, Q / d[:, None] / d, R * e[:, None] * e, N / d[:, None] * e), d


def scaled_error(S, wanted):
    d = 1 / np.sqrt(np.diag(wanted))
    return np.abs((S - wanted) * d[:, None] * d).max()


@pytest.mark.parametrize("spread", [0.0, 5.0])
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("cross", [False, True])
def test_care_satisfies_its_equation(seed, spread, cross):
    (A, B, Q, R, N), d = problem(seed, spread=spread)
    N = N if cross else np.zeros_like(N)
    found = care(A, B, Q, R, N=N)
    S = found.S
    g = B.T @ S + N.T
    equation = (A.T @ S + S @ A - g.T @ np.linalg.inv(R) @ g + Q) * d[:, None] * d
    assert np.abs(equation).max() < 1e-10 * max(1.0, np.abs(S * d[:, None] * d).max())
    assert found.residual < 1e-12
    assert found.eigenvalues.real.max() < 0
    if spread == 0:
        wanted = sla.solve_continuous_are(A, B, Q, R, s=N)
        assert scaled_error(S, wanted) < 1e-8


@pytest.mark.parametrize("spread", [0.0, 5.0])
@pytest.mark.parametrize("seed", range(6))
def test_dare_satisfies_its_equation(seed, spread):
    (A, B, Q, R, N), _ = problem(seed, spread=spread)
    found = dare(A, B, Q, R, N=N)
    S = found.S
    K = np.linalg.inv(R + B.T @ S @ B) @ (B.T @ S @ A + N.T)
    # Cost of the closed loop, another form of the equation.
    closed = A - B @ K
    other = Q - N @ K - K.T @ N.T + K.T @ R @ K + closed.T @ S @ closed
    assert scaled_error(other, S) < 1e-9
    assert found.residual < 1e-11
    assert np.abs(found.eigenvalues).max() < 1
    if spread == 0:
        assert scaled_error(S, sla.solve_discrete_are(A, B, Q, R, s=N)) < 1e-7


@pytest.mark.parametrize("seed", range(4))
def test_equations_against_python_control(seed):
    control = pytest.importorskip("control")
    (A, B, Q, R, N), _ = problem(seed)
    X, poles, _ = control.care(A, B, Q, R, N, np.eye(len(A)), method="scipy")
    found = care(A, B, Q, R, N=N)
    assert scaled_error(found.S, X) < 1e-9
    assert np.allclose(np.poly(found.eigenvalues), np.poly(poles), rtol=1e-6)
    A = A - (np.abs(A).sum() + 1) * np.eye(len(A))
    assert np.allclose(lyapunov(A, Q).S, control.lyap(A, Q, method="scipy"), rtol=1e-10, atol=1e-12 * np.abs(Q).max())
    A = A / (2 * np.abs(A).sum())
    assert np.allclose(dlyapunov(A, Q).S, control.dlyap(A, Q, method="scipy"), rtol=1e-10, atol=1e-12 * np.abs(Q).max())


def test_lyapunov_is_the_integral_of_the_decay():
    A, Q = np.array([[-1.0, 3.0], [0.0, -2.0]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    t = np.linspace(0, 40, 40001)
    flow = np.array([sla.expm(A * 0.001)])
    value, step = np.eye(2), []
    for _ in t:
        step.append(value @ Q @ value.T)
        value = flow[0] @ value
    wanted = np.trapezoid(step, t, axis=0)
    found = lyapunov(A, Q)
    assert np.allclose(found.S, wanted, rtol=2e-6)
    assert found.residual < 1e-15


def test_dlyapunov_is_the_sum_of_the_powers():
    A, Q = np.array([[0.5, 0.3], [0.0, -0.7]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    wanted = sum(np.linalg.matrix_power(A, i) @ Q @ np.linalg.matrix_power(A, i).T for i in range(200))
    assert np.allclose(dlyapunov(A, Q).S, wanted, rtol=1e-13)


def test_double_integrator_has_its_closed_form():
    S = care([[0, 1], [0, 0]], [[0], [1]], np.eye(2), [[1]]).S
    assert np.allclose(S, [[np.sqrt(3), 1], [1, np.sqrt(3)]], rtol=1e-14)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_rounding_asymmetry_is_accepted_at_any_size_and_a_real_one_is_not(size):
    A, B = [[0, 1], [0, 0]], [[0], [1]]
    rounding = size * np.array([[2.0, 1.0], [1.0 + 1e-13, 3.0]])
    exact = size * np.array([[2.0, 1.0], [1.0, 3.0]])
    assert scaled_error(care(A, B, rounding, [[size]]).S, care(A, B, exact, [[size]]).S) < 1e-12
    with pytest.raises(models.ModelError, match=r"Q: must be symmetric, but Q\[0\]\[1\]"):
        care(A, B, size * np.array([[2.0, 1.0], [1.001, 3.0]]), [[size]])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"A": np.zeros((2, 3))}, "A: expected a square matrix"),
        ({"B": np.zeros((3, 1))}, r"B: expected a matrix of shape \(2, n\), got \(3, 1\)"),
        ({"Q": np.eye(3)}, r"Q: expected a matrix of shape \(2, 2\)"),
        ({"R": np.eye(2)}, r"R: expected a matrix of shape \(1, 1\)"),
        ({"R": [[-1.0]]}, "R: must be positive definite, but its smallest eigenvalue is -1"),
        ({"Q": [[1.0, np.nan], [0.0, 1.0]]}, r"Q\[0\]\[1\]: expected a finite number"),
    ],
)
def test_bad_arguments_are_named(change, text):
    good = {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "Q": np.eye(2), "R": [[1.0]]}
    with pytest.raises(models.ModelError, match=text):
        care(**{**good, **change})
    assert np.allclose(care(**good).S[0, 1], 1)  # a good problem after a bad one


def test_equations_without_solution_say_so():
    with pytest.raises(models.ModelError, match=r"care: .*out of reach"):
        care(np.diag([1.0, -1.0]), [[0.0], [1.0]], np.eye(2), [[1.0]])
    with pytest.raises(models.ModelError, match=r"dare: .*out of reach"):
        dare(np.diag([2.0, 0.5]), [[0.0], [1.0]], np.eye(2), [[1.0]])
    with pytest.raises(models.ModelError, match=r"eigenvalues .* add to zero"):
        lyapunov(np.diag([1.0, -1.0]), np.eye(2))
    with pytest.raises(models.ModelError, match=r"eigenvalues .* multiply to one"):
        dlyapunov(np.diag([2.0, 0.5]), np.eye(2))
