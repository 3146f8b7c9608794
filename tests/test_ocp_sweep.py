"""The Riccati sweep where it is hard: heavy terminal weights, growth out of reach, coarse coefficients, gains between nodes."""

import dataclasses
import sys

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import models
import ocp.sweep
from ocp.linearize import Linearization
from ocp.riccati import packed_places
from ocp.tvlqr import tvlqr, tvlqr_sensitivity


def system(t, A, B, c=None):
    """Linearization on the nodes; A, B, c are functions of time, or constant."""
    values = [
        np.array([v(s) if callable(v) else v for s in t], dtype=float)
        for v in (A, B, np.zeros(len(np.array(B(0.0) if callable(B) else B))) if c is None else c)
    ]
    N, n, m = values[1].shape
    return Linearization(t, np.zeros((N, n)), np.zeros((N, m)), *values[:2], np.zeros((N, 0, n)), np.zeros((N, 0, m)), values[2])


def oscillator(w, dt, duration):
    t = np.arange(4 * round(duration / dt / 4) + 1) * dt
    return system(t, np.array([[0.0, 1.0], [-w * w, 0.0]]), np.array([[0.0], [1.0]]))


def by_inverse(lin, weight, back):
    """S at times `back` before the end (rising), for Q = R = 1: the inverse of S starts tiny and is not stiff."""
    A, B = lin.A[0], lin.B[0]

    def rate(_tau, p):
        P = p.reshape(2, 2)
        return (B @ B.T - A @ P - P @ A.T - P @ P).ravel()

    flown = solve_ivp(rate, (0.0, back[-1]), np.eye(2).ravel() / weight, method="DOP853", rtol=1e-12, atol=1e-20, t_eval=back)
    return np.linalg.inv(flown.y.T.reshape(-1, 2, 2))


HEAVY = [(3.0, 0.1, 1e8), (10.0, 0.05, 1e10), (30.0, 0.0125, 1e12), (10.0, 0.05, 1e6), (3.0, 0.1, 1e16)]


@pytest.mark.parametrize(("w", "dt", "weight"), HEAVY)
def test_a_heavy_terminal_weight_is_no_obstacle_and_leaves_no_error_behind(w, dt, weight):
    lin = oscillator(w, dt, 6.0)
    gains = tvlqr(lin, Q=np.eye(2), R=[[1.0]], Qf=weight * np.eye(2))
    S = by_inverse(lin, weight, (lin.t[-1] - lin.t)[::-1][1:])[::-1]
    d = 1 / np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    error = np.abs((gains.S[:-1] - S) * d[:, :, None] * d[:, None, :]).max()
    steps = len(gains.dense.h)
    assert gains.certificate.local_residual < 3e-8
    assert error < 2e-6
    assert error < 2 * steps * gains.certificate.local_residual
    assert steps < 40 * len(lin.t)  # the layer at the end, 1/weight wide, costs nothing


def test_the_local_defect_sees_what_the_largest_S_hides(monkeypatch):
    lin = oscillator(10.0, 0.05, 8.0)
    weights = {"Q": np.eye(2), "R": [[1.0]], "Qf": 1e10 * np.eye(2)}
    true = by_inverse(lin, 1e10, np.array([0.0, lin.t[-1]]))[1][1]
    right = tvlqr(lin, **weights)
    monkeypatch.setattr(ocp.sweep, "LEVELS", 0)
    with pytest.raises(models.ModelError, match="no certificate: where S is small the Riccati defect is"):
        tvlqr(lin, **weights)
    monkeypatch.setattr(sys.modules["ocp.tvlqr"], "LOCAL_ACCEPT", np.inf)
    wrong = tvlqr(lin, **weights)
    assert wrong.certificate.riccati_residual < 1e-6
    assert np.abs(wrong.K[0] / true - 1).max() > 1e-2
    assert wrong.certificate.local_residual > 1e-3
    assert np.abs(right.K[0] / true - 1).max() < 1e-4


def test_growth_beyond_the_numbers_is_told_from_nodes_too_far_apart():
    weights = {"Q": np.eye(2), "R": [[1.0]], "Qf": np.eye(2)}
    t = np.linspace(0, 400, 1601)
    with pytest.raises(models.ModelError, match=r"S exceeds the largest number near t = 4\d\.\d* s: over this horizon a mode grows"):
        tvlqr(system(t, np.diag([1.0, -1.0]), np.array([[0.0], [1.0]])), **weights)
    with pytest.raises(models.ModelError, match=r"reach 1e\+05 1/s, too fast for these nodes \(the smallest step"):
        tvlqr(system(np.linspace(0, 400, 5), np.diag([1e5, -1.0]), np.array([[0.0], [1.0]])), **weights)
    assert np.isfinite(tvlqr(system(t[:401], np.diag([1.0, -1.0]), np.array([[0.0], [1.0]])), **weights).S).all()


def test_coefficients_the_nodes_do_not_resolve_show_in_the_defect(monkeypatch):
    """Halving converges to the wrong polynomial: only the change of interpolation shows it."""

    def swept(t):
        return tvlqr(system(t, lambda s: [[0.5 * np.sin(9 * s)]], [[1.0]]), Q=[[1.0]], R=[[1.0]], Qf=[[1.0]])

    monkeypatch.setattr(sys.modules["ocp.tvlqr"], "ACCEPT", 1.0)
    coarse, fine = swept(np.linspace(0, 4, 41)), swept(np.linspace(0, 4, 1281))
    error = np.abs(coarse.S - fine.S[::32]).max() / fine.S.max()
    assert error > 1e-6
    assert fine.certificate.riccati_residual < 3e-9
    assert coarse.certificate.riccati_residual > 0.3 * error
    assert coarse.certificate.local_residual > 0.3 * error


def wandering():
    def A(s):
        return [[-0.2, np.sin(s)], [0.3 - s, 0.4 * np.cos(2 * s)]]

    def B(s):
        return [[np.cos(s), 0.2], [1.0 + (2.0 if s >= 1.0 else 0.0), 0.1 * s]]

    return A, B, (lambda s: [0.3, np.sin(s)]), (lambda s: [[1.0 + 0.3 * s, 0.1], [0.1, 0.5]])


def on_two_segments(per_segment):
    """Nodes with a jump of B at 1 s, and the weight of the input on them."""
    A, B, c, R = wandering()
    first, second = np.linspace(0, 1, per_segment + 1), np.linspace(1, 2, per_segment + 1)
    early = system(first, A, lambda s: B(s) if s < 1 else [[np.cos(1.0), 0.2], [1.0, 0.1]], c)
    late = system(second, A, B, c)
    fields = [np.concatenate([getattr(early, f.name), getattr(late, f.name)]) for f in dataclasses.fields(Linearization)[:8]]
    r = np.array([R(s) for s in fields[0]])
    return tvlqr(Linearization(*fields), Q=np.diag([1.0, 2.0]), R=r, Qf=np.diag([1e4, 1e2]))


def test_between_the_nodes_gains_are_as_good_as_on_them():
    coarse, fine = on_two_segments(20), on_two_segments(640)
    found = coarse.at(fine.t)
    once = np.concatenate([np.diff(fine.t) > 0, [True]])  # of a jump the value after it
    for name in ("K", "k"):
        wanted, given = getattr(fine, name)[once], getattr(found, name)[once]
        assert np.abs(given - wanted).max() < 1e-7 * np.abs(wanted).max()
    second = coarse.t >= 1
    spline = CubicSpline(coarse.t[second][1:], coarse.K[second][1:])(fine.t[-300:])
    assert np.abs(spline - fine.K[-300:]).max() > 1e-3 * np.abs(fine.K).max()  # the layer at the end is no cubic
    after = np.concatenate([np.diff(coarse.t) > 0, [True]])
    assert coarse.at(coarse.t[after]).K == pytest.approx(coarse.K[after], rel=1e-9)
    assert coarse.at([-1.0, 5.0]).K == pytest.approx(coarse.K[[0, -1]], rel=1e-9)


def test_inside_the_layer_of_a_heavy_weight_too():
    lin = oscillator(10.0, 0.05, 2.0)
    gains = tvlqr(lin, Q=np.eye(2), R=[[1.0]], Qf=1e10 * np.eye(2))
    back = np.array([0.0, 1e-10, 1e-7, 1e-4, 1e-2, 0.033])
    true = by_inverse(lin, 1e10, back)[:, 1]
    assert gains.at(lin.t[-1] - back[3:]).K[:, 0] == pytest.approx(true[3:], rel=1e-6)
    assert gains.at(lin.t[-1]).K[0, 0] == pytest.approx([0.0, 1e10], abs=1e-3)


def test_gains_of_another_origin_forget_the_sweep():
    gains = tvlqr(oscillator(1.0, 0.1, 2.0), Q=np.eye(2), R=[[1.0]], Qf=np.eye(2))
    assert dataclasses.replace(gains, states=()).dense is gains.dense
    doubled = dataclasses.replace(gains, K=2 * gains.K)
    assert doubled.dense is None
    assert doubled.at([0.55]).K == pytest.approx(2 * gains.at([0.55]).K, rel=1e-4)


def test_tangents_through_a_heavy_weight():
    lin = oscillator(10.0, 0.05, 2.0)
    found = tvlqr_sensitivity(lin, Q=np.eye(2), R=[[1.0]], Qf=1e8 * np.eye(2))
    ends = [tvlqr(lin, Q=np.eye(2), R=[[1.0 + e]], Qf=1e8 * np.eye(2)).K for e in (1e-4, -1e-4)]
    central, index = (ends[0] - ends[1]) / 2e-4, found.names.index("R[u1]")
    assert np.abs(found.dK[index, :-4] - central[:-4]).max() < 1e-5 * np.abs(central[:-4]).max()


def test_packed_places_are_those_of_the_upper_triangle():
    full = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0], [3.0, 5.0, 6.0]])
    assert (full[np.triu_indices(3)][packed_places(3)] == full).all()
