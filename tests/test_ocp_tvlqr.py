"""Time-varying gains: closed forms, order, fixed point, SciPy integration, affine term, jumps, sensitivities, errors."""

import numpy as np
import pytest
import scipy.linalg as sla
from scipy.integrate import solve_ivp

import models
import ocp.sweep
from ocp.linearize import Linearization
from ocp.lqr import dlqr, lqr
from ocp.tvlqr import Variation, dtvlqr, tvlqr, tvlqr_sensitivity


def linearization(t, A, B, c=None):
    t = np.asarray(t, dtype=float)
    As, Bs = np.array([A(v) for v in t]), np.array([B(v) for v in t])
    N, n, m = Bs.shape
    cs = np.zeros((N, n)) if c is None else np.array([c(v) for v in t])
    return Linearization(t, np.zeros((N, n)), np.zeros((N, m)), As, Bs, np.zeros((N, 0, n)), np.zeros((N, 0, m)), cs)


def constant(t, A, B, c=None):
    return linearization(t, lambda _: np.array(A, float), lambda _: np.array(B, float), None if c is None else lambda _: np.array(c, float))


def drifting():
    """Two inputs, four states, everything varies; scales from 1 to 1e4."""
    scale = np.array([1.0, 1e2, 1e-2, 1e4])

    def A(t):
        a = np.array([[-0.2, np.sin(t), 0, 0.1], [0.3, 0.4 * np.cos(2 * t), 1, 0], [0, -1, 0.1 * t, 0.5], [1, 0, np.exp(-t), -0.5]])
        return scale[:, None] * a / scale

    def B(t):
        return scale[:, None] * np.array([[1.0, 0], [np.cos(t), 0.2], [0, 1 + 0.3 * t], [0.1, 0]])

    def Q(t):
        q = np.diag([1.0, 0.5 + 0.2 * np.sin(t), 2.0, 0.1]) + 0.05
        return q / scale / scale[:, None]

    def R(t):
        return np.array([[1.0 + 0.3 * t, 0.1], [0.1, 0.5]])

    return scale, A, B, Q, R, np.diag([3.0, 1.0, 0.2, 1.0]) / scale**2


def test_against_an_adaptive_integration():
    scale, A, B, Q, R, Qf = drifting()
    t = np.linspace(0, 4, 161)
    lin = linearization(t, A, B, lambda s: scale * np.array([0.1, np.sin(s), 0.3, -0.2]))
    gains = tvlqr(lin, Q=np.array([Q(v) for v in t]), R=np.array([R(v) for v in t]), Qf=Qf)

    def backward(tau, z):
        s = 4 - tau
        S, v = z[:16].reshape(4, 4), z[16:]
        a, b = scale[:, None] ** -1 * A(s) * scale, B(s) / scale[:, None]
        w = b @ np.linalg.inv(R(s)) @ b.T
        c = np.array([0.1, np.sin(s), 0.3, -0.2])
        dS = S @ a + a.T @ S - S @ w @ S + Q(s) * scale * scale[:, None]
        return np.concatenate([dS.ravel(), (a - w @ S).T @ v + S @ c])

    start = np.concatenate([(Qf * scale * scale[:, None]).ravel(), np.zeros(4)])
    flow = solve_ivp(backward, (0, 4), start, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=4 - t[::-1])
    S = flow.y[:16].T.reshape(-1, 4, 4)[::-1]
    s = flow.y[16:].T[::-1]
    found = gains.S * scale * scale[:, None]
    assert np.abs(found - S).max() < 1e-8 * np.abs(S).max()
    for i in range(0, 161, 7):
        rb = np.linalg.inv(R(t[i])) @ (B(t[i]) / scale[:, None]).T
        assert np.abs(gains.K[i] * scale - rb @ S[i]).max() < 2e-8 * np.abs(rb @ S[i]).max()
        assert np.abs(gains.k[i] - rb @ s[i]).max() < 1e-8
    assert gains.certificate.riccati_residual < 1e-8
    assert gains.certificate.spectral_abscissa is None


def scalar(N, a=0.3, q=2.0, r=0.5, sf=0.0, T=2.0, b=0.8):
    """Swept and exact S of S' = -2 a S + b^2 S^2/r - q."""
    t = np.linspace(0, T, N + 1)
    gains = tvlqr(constant(t, [[a]], [[b]]), Q=[[q]], R=[[r]], Qf=[[sf]])
    w = b * b / r
    beta = np.sqrt(a * a + q * w)
    exact = (a + beta * np.tanh(beta * (T - t) + np.arctanh((w * sf - a) / beta))) / w
    return gains, exact


def test_scalar_problem_has_its_closed_form():
    gains, exact = scalar(400, sf=0.4)
    assert np.abs(gains.S[:, 0, 0] - exact).max() < 1e-9 * exact.max()
    assert gains.K[:, 0, 0] == pytest.approx(0.8 / 0.5 * exact, rel=1e-8)


def test_order_of_convergence_is_five(monkeypatch):
    monkeypatch.setattr(ocp.sweep, "LEVELS", 0)
    counts = np.array([64, 128, 256, 512])
    errors = []
    for N in counts:
        gains, exact = scalar(int(N), T=1.0)
        errors.append(np.abs(gains.S[::4, 0, 0] - exact[::4]).max())
    slope = np.polyfit(np.log(1.0 / counts), np.log(errors), 1)[0]
    assert abs(slope - 5) < 0.1


def test_nodes_between_the_steps_are_as_good_as_the_steps(monkeypatch):
    monkeypatch.setattr(ocp.sweep, "LEVELS", 0)
    gains, exact = scalar(64, T=2.0)
    error = np.abs(gains.S[:, 0, 0] - exact)
    assert error[1::2].max() < 2 * error[::4].max()
    assert error[2::4].max() < 2 * error[::4].max()


def test_the_defect_is_the_local_error(monkeypatch):
    monkeypatch.setattr(ocp.sweep, "LEVELS", 0)
    gains, exact = scalar(80, T=2.0)
    S, wanted = gains.S[::4, 0, 0], exact[::4]
    # What one step adds: the error now less the error before, carried back by the closed loop.
    closed = 0.3 - 0.8**2 / 0.5 * 0.5 * (wanted[1:] + wanted[:-1])
    local = (S - wanted)[:-1] - np.exp(2 * closed * 0.1) * (S - wanted)[1:]
    assert np.abs(local).max() / exact.max() == pytest.approx(gains.certificate.riccati_residual, rel=0.2)


A2, B2 = np.array([[0.0, 1.0], [0.5, -0.1]]), np.array([[0.1], [1.0]])


def test_terminal_fixed_point_stays_put():
    point = lqr(A2, B2, Q=np.eye(2), R=[[0.3]])
    gains = tvlqr(constant(np.linspace(0, 10, 201), A2, B2), Q=np.eye(2), R=[[0.3]], Qf=point.S[0])
    assert np.abs(gains.S - point.S[0]).max() < 2e-8 * np.abs(point.S).max()
    assert np.abs(gains.K - point.K[0]).max() < 2e-8 * np.abs(point.K).max()


def test_finite_horizon_converges_to_the_infinite_one():
    point = lqr(A2, B2, Q=np.eye(2), R=[[0.3]])
    gains = tvlqr(constant(np.linspace(0, 30, 601), A2, B2), Q=np.eye(2), R=[[0.3]], Qf=np.zeros((2, 2)))
    assert gains.K[0, 0] == pytest.approx(point.K[0, 0], rel=1e-8)
    assert np.abs(gains.S[-1]).max() == 0


def test_terminal_gain_is_its_closed_form():
    Qf = np.array([[3.0, 0.5], [0.5, 2.0]])
    gains = tvlqr(constant(np.linspace(0, 1, 41), A2, B2), Q=np.eye(2), R=[[0.3]], Qf=Qf)
    assert gains.K[-1] == pytest.approx(B2.T @ Qf / 0.3, rel=1e-15)


def test_a_heavy_terminal_weight_is_integrated_on_finer_steps():
    a, q, r, sf = 0.3, 2.0, 0.5, 400.0
    t = np.linspace(0, 2, 21)
    gains = tvlqr(constant(t, [[a]], [[1.0]]), Q=[[q]], R=[[r]], Qf=[[sf]])
    w, beta = 1 / r, np.sqrt(a * a + q / r)
    exact = (a + beta / np.tanh(beta * (2 - t) + np.arctanh(beta / (w * sf - a)))) / w
    assert gains.certificate.riccati_residual < 2e-9
    assert np.abs(gains.S[:, 0, 0] - exact).max() < 1e-7 * sf
    assert np.abs(gains.S[:10, 0, 0] / exact[:10] - 1).max() < 1e-6


def test_a_jump_of_the_input_matrix_is_a_jump_of_the_gain_and_a_kink_of_S():
    t1, t2 = np.linspace(0, 1, 41), np.linspace(1, 2, 21)
    late, early = np.array([[0.0], [2.0]]), B2
    t = np.concatenate([t1, t2])
    lin = constant(t, A2, B2)
    Bs = np.concatenate([np.repeat(early[None], 41, 0), np.repeat(late[None], 21, 0)])
    lin = Linearization(lin.t, lin.x0, lin.u0, lin.A, Bs, lin.C, lin.D, lin.c)
    gains = tvlqr(lin, Q=np.eye(2), R=[[0.3]], Qf=np.eye(2))
    second = tvlqr(constant(t2, A2, late), Q=np.eye(2), R=[[0.3]], Qf=np.eye(2))
    first = tvlqr(constant(t1, A2, early), Q=np.eye(2), R=[[0.3]], Qf=second.S[0])
    assert gains.S == pytest.approx(np.concatenate([first.S, second.S]), rel=1e-8)
    assert (gains.S[40] == gains.S[41]).all()
    assert np.abs(gains.K[40] - gains.K[41]).max() > 0.1
    assert gains.at([1.0]).K[0] == pytest.approx(gains.K[41], rel=1e-12)


def test_the_affine_term_settles_at_its_rest_point():
    """Far from the end s is the rest point of its own equation, found from the algebraic Riccati equation."""
    t = np.linspace(0, 40, 801)
    c = np.array([0.3, -0.2])
    gains = tvlqr(constant(t, A2, B2, c), Q=np.eye(2), R=[[0.3]], Qf=np.zeros((2, 2)))
    point = lqr(A2, B2, Q=np.eye(2), R=[[0.3]])
    closed = A2 - B2 @ point.K[0]
    s = np.linalg.solve(closed.T, -point.S[0] @ c)
    assert gains.k[0] == pytest.approx((B2.T @ s / 0.3), rel=1e-9)


def test_sensitivities_against_re_synthesis():
    scale, A, B, Q, R, Qf = drifting()
    t = np.linspace(0, 2, 81)
    lin = linearization(t, A, B)
    q, r = Q(0.3), R(0.2)
    found = tvlqr_sensitivity(lin, Q=q, R=r, Qf=Qf)
    assert found.names == tuple([f"Q[x{i}]" for i in range(1, 5)] + ["R[u1]", "R[u2]"] + [f"Qf[x{i}]" for i in range(1, 5)])
    for index in range(10):
        part, i = (("Q", index), ("R", index - 4), ("Qf", index - 6))[(index > 3) + (index > 5)]
        ends = []
        for sign in (1, -1):
            weights = {"Q": q.copy(), "R": r.copy(), "Qf": Qf.copy()}
            step = sign * 1e-4 * weights[part][i, i]
            weights[part][i, i] += step
            ends.append(tvlqr(lin, **weights).K)
        central = (ends[0] - ends[1]) / 2e-4
        error = np.abs((found.log_dK[index] - central) * scale).max()
        assert error < 1e-5 * np.abs(central * scale).max()


def test_sensitivity_along_a_named_variation():
    t = np.linspace(0, 2, 41)
    lin = constant(t, A2, B2)
    weights = {"Q": np.eye(2), "R": [[0.3]], "Qf": np.diag([1.0, 2.0])}
    everything = Variation(Q=np.repeat(np.eye(2)[None], 41, 0), R=[[0.3]], Qf=np.diag([1.0, 2.0]))
    found = tvlqr_sensitivity(lin, **weights, variations={"all": everything, "Q": Variation(Q=np.diag([1.0, 0.0]))})
    assert np.abs(found.dK[0]).max() < 1e-7  # all weights times one factor: the same gain
    single = tvlqr_sensitivity(lin, **weights)
    assert found.dK[1] == pytest.approx(single.dK[0], rel=1e-12)
    with pytest.raises(models.ModelError, match="bad: Q: expected shape"):
        tvlqr_sensitivity(lin, **weights, variations={"bad": Variation(Q=np.eye(3))})
    with pytest.raises(models.ModelError, match="mapping is empty"):
        tvlqr_sensitivity(lin, **weights, variations={})


@pytest.mark.parametrize(
    ("t", "text"),
    [
        (np.linspace(0, 1, 11), "10 intervals, expected a multiple of 4"),
        (np.linspace(0, 1, 4), "at least 5 nodes"),
        (np.concatenate([np.linspace(0, 1, 5), np.linspace(1, 2, 7)]), "from 1 s to 2 s has 6 intervals"),
        (np.array([0, 1, 2, 3, 5.0]), "use equal intervals"),
    ],
)
def test_unsuitable_grids_say_what_to_do(t, text):
    with pytest.raises(models.ModelError, match=text):
        tvlqr(constant(t, A2, B2), Q=np.eye(2), R=[[1.0]], Qf=np.eye(2))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"Q": np.diag([1.0, -1.0])}, "Q: must be positive semidefinite"),
        ({"Q": np.repeat(np.diag([1.0, -1.0])[None], 41, 0)}, "eigenvalue is -1 at node 0"),
        ({"Q": np.eye(3)}, r"Q: expected shape \(2, 2\) or, for each of the nodes, \(41, 2, 2\), got \(3, 3\)"),
        ({"R": [[0.0]]}, "R: must be positive definite"),
        ({"Qf": [[1.0, 1.0], [0.0, 1.0]]}, "Qf: must be symmetric"),
        ({"Qf": [[1.0, np.nan], [0.0, 1.0]]}, r"Qf\[0\]\[1\]: expected a finite number"),
    ],
)
def test_bad_weights_are_refused_and_a_good_problem_still_works(change, text):
    good = {"Q": np.eye(2), "R": [[1.0]], "Qf": np.eye(2)}
    lin = constant(np.linspace(0, 1, 41), A2, B2)
    before = tvlqr(lin, **good)
    with pytest.raises(models.ModelError, match=text):
        tvlqr(lin, **{**good, **change})
    assert (tvlqr(lin, **good).K == before.K).all()


def test_a_loop_too_fast_for_its_nodes_has_no_certificate():
    with pytest.raises(models.ModelError, match=r"rates of the problem near t = .* s reach 1e\+03 1/s, too fast for these nodes"):
        tvlqr(constant(np.linspace(0, 100, 5), [[0.0]], [[1.0]]), Q=[[1.0]], R=[[1e-6]], Qf=[[1e12]])
    point = Linearization.from_matrices(A2, B2)
    with pytest.raises(models.ModelError, match="use lqr"):
        tvlqr(point, Q=np.eye(2), R=[[1.0]], Qf=np.eye(2))


def test_discrete_gains_reach_the_infinite_horizon_and_the_smallest_cost():
    step = sla.expm(np.block([[A2, B2], [np.zeros((1, 3))]]) * 0.1)
    A, B = step[:2, :2], step[:2, 2:]
    point = dlqr(A, B, Q=np.eye(2), R=[[0.3]])
    gains = dtvlqr(np.repeat(A[None], 400, 0), np.repeat(B[None], 400, 0), Q=np.eye(2), R=[[0.3]], Qf=np.zeros((2, 2)))
    assert gains.K[0, 0] == pytest.approx(point.K[0, 0], rel=1e-11)
    fixed = dtvlqr(np.repeat(A[None], 50, 0), np.repeat(B[None], 50, 0), Q=np.eye(2), R=[[0.3]], Qf=point.S[0])
    assert np.abs(fixed.S - point.S[0]).max() < 1e-12 * np.abs(point.S).max()
    assert gains.certificate.riccati_residual < 1e-13


def test_discrete_gains_solve_the_stacked_least_squares_problem():
    rng = np.random.default_rng(5)
    steps, n, m = 6, 3, 2
    A, B, c = rng.standard_normal((steps, n, n)), rng.standard_normal((steps, n, m)), rng.standard_normal((steps, n))
    Q = np.array([np.diag(v) for v in rng.uniform(0.1, 2, (steps, n))])
    R = np.array([np.diag(v) for v in rng.uniform(0.1, 2, (steps, m))])
    Qf, x0 = np.diag([1.0, 2.0, 3.0]), np.array([1.0, -2.0, 0.5])
    gains = dtvlqr(A, B, Q=Q, R=R, Qf=Qf, c=c)
    x, flown = x0, []
    for i in range(steps):
        u = -gains.k[i] - gains.K[i] @ x
        flown.append(u)
        x = A[i] @ x + B[i] @ u + c[i]

    # All states as an affine function of all inputs: one linear least-squares problem.
    M, free = np.zeros((n, steps * m)), x0
    rows, right = [], []
    for i in range(steps):
        rows += [np.sqrt(Q[i]) @ M, np.sqrt(R[i]) @ np.eye(steps * m)[i * m : (i + 1) * m]]
        right += [-np.sqrt(Q[i]) @ free, np.zeros(m)]
        M = A[i] @ M
        M[:, i * m : (i + 1) * m] += B[i]
        free = A[i] @ free + c[i]
    rows.append(np.sqrt(Qf) @ M)
    right.append(-np.sqrt(Qf) @ free)
    wanted = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    assert np.concatenate(flown) == pytest.approx(wanted, rel=1e-10, abs=1e-11)


def test_discrete_errors_name_the_argument():
    A, B = np.repeat(A2[None], 3, 0), np.repeat(B2[None], 3, 0)
    good = {"Q": np.eye(2), "R": [[1.0]], "Qf": np.eye(2)}
    with pytest.raises(models.ModelError, match=r"A: expected shape \(N - 1, n, n\)"):
        dtvlqr(A[:0], B[:0], **good)
    with pytest.raises(models.ModelError, match=r"B: expected shape \(3, 2, m\)"):
        dtvlqr(A, B[:2], **good)
    with pytest.raises(models.ModelError, match="R: must be positive definite"):
        dtvlqr(A, B, **{**good, "R": [[-1.0]]})
    with pytest.raises(models.ModelError, match=r"t: expected a matrix of shape \(4\)"):
        dtvlqr(A, B, **good, t=[0.0, 1.0])
