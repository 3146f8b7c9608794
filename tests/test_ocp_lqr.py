"""Time-invariant gains: python-control, simulated decay, integral action, modes named, weights refused."""

import numpy as np
import pytest
import scipy.linalg as sla

import models
from models import Var
from ocp.linearize import Linearization, linearize
from ocp.lqr import NotStabilizable, dlqr, lqi, lqr


def random_plant(seed):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 9)), int(rng.integers(1, 4))
    F = rng.standard_normal((n, n))
    return rng.standard_normal((n, n)), rng.standard_normal((n, m)), F @ F.T, np.diag(rng.uniform(0.1, 3, m))


def pendulum():
    states = (Var("theta", "rad", 0.1), Var("q", "rad/s", 0.1))
    return models.define(
        "pendulum",
        lambda x, u, p: {"theta": x.q, "q": 4 * x.theta + u.torque},
        states=states,
        inputs=(Var("torque", "N m"),),
        outputs=(Var("angle", "rad", 0.1), Var("spin", "rad/s", 0.1)),
        out=lambda x, u, p: {"angle": x.theta, "spin": x.q + 0.5 * u.torque},
    )


@pytest.mark.parametrize("seed", range(6))
def test_gains_against_python_control(seed):
    control = pytest.importorskip("control")
    A, B, Q, R = random_plant(seed)
    N = 0.05 * Q @ B
    for ours, theirs in ((lqr, control.lqr), (dlqr, control.dlqr)):
        for cross in (None, N):
            wanted = theirs(A, B, Q, R, *(() if cross is None else (cross,)))[0]
            K = ours(A, B, Q=Q, R=R, N=cross).K[0]
            assert np.abs(K - wanted).max() < 1e-8 * np.abs(wanted).max()


def test_spectral_abscissa_is_the_simulated_decay():
    A, B, Q, R = random_plant(11)
    gains = lqr(A, B, Q=Q, R=R)
    flow = sla.expm((A - B @ gains.K[0]) * 50.0)
    later = sla.expm((A - B @ gains.K[0]) * 60.0)
    assert np.log(np.linalg.norm(later) / np.linalg.norm(flow)) / 10 == pytest.approx(gains.certificate.spectral_abscissa, rel=0.05)
    sampled = dlqr(A, B, Q=Q, R=R)
    powers = [np.linalg.norm(np.linalg.matrix_power(A - B @ sampled.K[0], i)) for i in (60, 80)]
    assert np.log(powers[1] / powers[0]) / 20 == pytest.approx(sampled.certificate.spectral_abscissa, rel=0.1)


def test_the_gain_minimizes_the_simulated_cost():
    A, B, Q, R = np.array([[0.0, 1.0], [2.0, -0.3]]), np.array([[0.2], [1.0]]), np.diag([2.0, 1.0]), np.array([[0.5]])
    gains = lqr(A, B, Q=Q, R=R)

    def cost(K):
        closed = A - B @ K
        return np.trace(sla.solve_continuous_lyapunov(closed.T, -(Q + K.T @ R @ K)))

    best = cost(gains.K[0])
    assert best == pytest.approx(np.trace(gains.S[0]), rel=1e-12)
    for i, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        change = np.zeros((1, 2))
        change[0, i] = sign * 0.05
        assert cost(gains.K[0] + change) > best * (1 + 1e-6)


def test_a_linearization_gives_the_same_gain_with_names():
    lin = linearize(pendulum(), x=[0, 0], u=[0])
    gains = lqr(lin, Q=np.eye(2), R=[[1.0]])
    plain = lqr([[0, 1], [4, 0]], [[0], [1]], Q=np.eye(2), R=[[1.0]])
    assert np.allclose(gains.K, plain.K, rtol=1e-14)
    assert [v.name for v in gains.states] == ["theta", "q"]
    # K1 = 4 + sqrt(17), K2 = sqrt(2 K1 + 1): the scalar equations solved by hand.
    assert gains.K[0, 0] == pytest.approx([4 + np.sqrt(17), np.sqrt(2 * (4 + np.sqrt(17)) + 1)], rel=1e-13)


@pytest.mark.parametrize("cross", [False, True])
@pytest.mark.parametrize("choice", [{"C": [[1.0, 0.0]]}, {"outputs": ["angle"]}])
@pytest.mark.parametrize("named", [True, False])
def test_lqi_holds_its_reference_under_a_constant_disturbance(choice, cross, named):
    lin = linearize(pendulum(), x=[0, 0], u=[0])
    A, B = lin.A[0], lin.B[0]
    N = np.array([[0.1], [0.0], [0.05]]) if cross else None
    if not named:
        lin = Linearization.from_matrices(A, B, C=[[1.0, 0.0]])
        choice = {"C": choice["C"]} if "C" in choice else {"outputs": ["y1"]}
    gains = lqi(lin, Q=np.diag([1.0, 1.0, 2.0]), R=[[1.0]], N=N, **choice)
    K = gains.K[0]
    closed = np.block([[A - B @ K[:, :2], -B @ K[:, 2:]], [np.array([[1.0, 0.0]]), np.zeros((1, 1))]])
    assert np.linalg.eigvals(closed).real.max() == pytest.approx(gains.certificate.spectral_abscissa, rel=1e-9)
    source = np.array([0.0, 0.7, -0.2])  # a disturbance of 0.7, a reference angle of 0.2
    flow = sla.expm(np.block([[closed, source[:, None]], [np.zeros((1, 4))]]) * 60.0)
    assert flow[0, 3] == pytest.approx(0.2, rel=1e-9)


def test_lqi_integrates_an_output_with_feedthrough():
    gains = lqi(linearize(pendulum(), x=[0, 0], u=[0]), outputs=["spin"], Q=np.diag([1.0, 1.0, 2.0]), R=[[1.0]])
    A, B = np.array([[0, 1, 0], [4, 0, 0], [0, 1, 0.0]]), np.array([[0], [1], [0.5]])
    assert np.linalg.eigvals(A - B @ gains.K[0]).real.max() == pytest.approx(gains.certificate.spectral_abscissa, rel=1e-9)
    assert gains.certificate.spectral_abscissa < 0


def test_lqi_of_matrices_and_its_errors():
    A, B = [[0, 1], [4, 0]], [[0], [1]]
    named = lqi(linearize(pendulum(), x=[0, 0], u=[0]), outputs=["angle"], Q=np.eye(3), R=[[1.0]])
    plain = lqi(A, B, C=[[1.0, 0.0]], Q=np.eye(3), R=[[1.0]])
    assert np.allclose(named.K, plain.K, rtol=1e-13)
    assert named.states[-1].name == "integral_angle"
    assert named.states[-1].unit == "rad s"
    with pytest.raises(models.ModelError, match="did you mean 'angle'"):
        lqi(linearize(pendulum(), x=[0, 0], u=[0]), outputs=["angel"], Q=np.eye(3), R=[[1.0]])
    with pytest.raises(models.ModelError, match=r"Q: expected a matrix of shape \(3, 3\)"):
        lqi(A, B, C=[[1.0, 0.0]], Q=np.eye(2), R=[[1.0]])
    with pytest.raises(models.ModelError, match="C is missing"):
        lqi(A, B, Q=np.eye(3), R=[[1.0]])
    with pytest.raises(NotStabilizable, match=r"eigenvalue 0,.* integral_"):
        lqi(A, B, C=np.eye(2), Q=np.eye(4), R=[[1.0]])  # one input cannot hold angle and spin


@pytest.mark.parametrize("spread", [0.0, 6.0])
def test_the_mode_out_of_reach_is_named(spread):
    rng = np.random.default_rng(3)
    names = ["V", "gamma", "h"]
    states = tuple(Var(name, "1", 1.0) for name in names)
    d = 10.0 ** rng.uniform(-spread, spread, 3)
    model = models.define(
        "chain",
        lambda x, u, p: {
            "V": -x.V + u.a * d[0],
            "gamma": 0.5 * x.gamma,
            "h": x.V * d[2] / d[0] + 0.2 * x.gamma * d[2] / d[1] - 3 * x.h,
        },
        states=states,
        inputs=(Var("a"),),
        outputs=(Var("height"),),
        out=lambda x, u, p: {"height": x.h},
    )
    with pytest.raises(NotStabilizable, match=r"eigenvalue 0\.5, dominated by the state gamma, is not reached"):
        lqr(linearize(model, x=[0, 0, 0], u=[0]), Q=np.eye(3), R=[[1.0]])
    with pytest.raises(NotStabilizable, match=r"eigenvalue 1\.5, dominated by the state x2"):
        dlqr(np.diag([0.5, 1.5]), [[1.0], [0.0]], Q=np.eye(2), R=[[1.0]])


@pytest.mark.parametrize("size", [1e-12, 1e-6, 1e6, 1e12])
def test_a_weakly_scaled_but_reachable_mode_is_not_refused(size):
    gains = lqr(np.diag([1.0, 2.0]), [[1.0], [size]], Q=np.diag([1.0, size**-2.0]), R=[[1.0]])
    plain = lqr(np.diag([1.0, 2.0]), [[1.0], [1.0]], Q=np.eye(2), R=[[1.0]])
    assert gains.K[0, 0] * [1.0, size] == pytest.approx(plain.K[0, 0], rel=1e-8)


def test_an_undamped_mode_without_weight_is_named():
    with pytest.raises(NotStabilizable, match="eigenvalue 0, dominated by the state x2, lies on the imaginary axis and is not seen by Q"):
        lqr(np.diag([-1.0, 0.0]), np.eye(2), Q=np.diag([1.0, 0.0]), R=np.eye(2))
    with pytest.raises(NotStabilizable, match="unit circle"):
        dlqr(np.diag([0.5, 1.0]), np.eye(2), Q=np.diag([1.0, 0.0]), R=np.eye(2))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"Q": np.diag([1.0, -1.0])}, "Q: must be positive semidefinite, but its smallest eigenvalue is -1"),
        ({"Q": 1e12 * np.diag([1.0, -1e-3])}, "Q: must be positive semidefinite"),
        ({"Q": [[1.0, 0.2], [0.0, 1.0]]}, "Q: must be symmetric"),
        ({"R": [[0.0]]}, "R: must be positive definite"),
        ({"R": [[np.inf]]}, "R.*finite"),
        ({"N": [[5.0], [0.0]]}, r"Q - N R\^-1 N\^T: must be positive semidefinite"),
        ({"N": [[5.0]]}, r"N: expected a matrix of shape \(2, 1\)"),
        ({"B": None}, "B is missing"),
    ],
)
def test_bad_weights_are_refused_and_a_good_problem_still_works(change, text):
    good = {"plant": [[0, 1], [0, 0]], "B": [[0], [1]], "Q": np.eye(2), "R": [[1.0]]}
    with pytest.raises(models.ModelError, match=text):
        lqr(**{**good, **change})
    assert lqr(**good).K[0, 0] == pytest.approx([1, np.sqrt(3)], rel=1e-13)


def test_points_that_are_no_regulator_problem_are_refused():
    lin = linearize(pendulum(), x=[0.1, 0], u=[0])
    with pytest.raises(models.ModelError, match=r"not an equilibrium: dq/dt = 0\.4 rad/s/s"):
        lqr(lin, Q=np.eye(2), R=[[1.0]])
    matrices = Linearization.from_matrices([[0, 1], [0, 0]], [[0], [1]])
    with pytest.raises(models.ModelError, match="leave it out"):
        lqr(matrices, [[0], [1]], Q=np.eye(2), R=[[1.0]])
