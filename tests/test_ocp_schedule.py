"""Schedules: means, optimal breakpoints and fitted constants against closed forms and brute force."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import ModelError
from ocp.schedule import Schedule, best_breakpoints, fit_commands, time_means

NAMES = ("a", "b")


def test_means_of_straight_lines() -> None:
    t = np.linspace(0, 10, 41)
    schedule = time_means(t, np.column_stack([t, 3 + 0 * t]), names=NAMES, breakpoints={"a": [4.0]})
    np.testing.assert_allclose(schedule.K, [[2.0, 3.0], [7.0, 3.0]], rtol=1e-14)
    np.testing.assert_allclose(schedule([0.0, 3.999, 4.0, 99.0])[:, 0], [2, 2, 7, 7])


def test_mean_over_a_breakpoint_between_nodes_and_a_doubled_node() -> None:
    t = np.array([0.0, 1.0, 1.0, 2.0, 4.0])
    K = np.array([[0.0], [1.0], [5.0], [5.0], [9.0]])
    schedule = time_means(t, K, names=("k",), breakpoints={"k": [3.0]})
    first = (0.5 + 5.0 + (5 + 7) / 2) / 3
    np.testing.assert_allclose(schedule.K[:, 0], [first, 8.0], rtol=1e-14)


def test_breakpoints_of_a_step_are_found() -> None:
    t = np.linspace(0, 400, 401)
    K = np.where(t < 120, 1.0, np.where(t < 300, -2.0, 5.0))
    found = best_breakpoints(t, K, pieces=3)
    np.testing.assert_allclose(found, [120, 300], atol=1.5)


@given(st.integers(0, 10_000))
def test_breakpoints_beat_every_other_choice(seed: int) -> None:
    generator = np.random.default_rng(seed)
    t, K = np.linspace(0, 1, 14), generator.normal(size=14)
    middle = 0.5 * (K[1:] + K[:-1])

    def cost(cuts: tuple[int, ...]) -> float:
        pieces = np.split(middle, cuts)
        return float(sum(((piece - piece.mean()) ** 2).sum() for piece in pieces))

    best = min(cost(cuts) for cuts in itertools.combinations(range(1, 13), 2))
    found = best_breakpoints(t, K, pieces=3)
    assert cost(tuple(np.rint(found * 13).astype(int))) == pytest.approx(best, rel=1e-9, abs=1e-12)


def test_fit_recovers_constants_that_flew() -> None:
    generator = np.random.default_rng(1)
    t, X = generator.uniform(0, 10, 400), generator.normal(size=(400, 2)) * [1e-3, 1e4]
    true = Schedule(NAMES, np.array([6.0]), np.array([[2.0, 1e-5], [2.0, -3e-5]]), 0.0)
    u = (true(t) * X).sum(axis=1)
    found = fit_commands(t, X, u, names=NAMES, breakpoints={"b": [6.0]})
    np.testing.assert_allclose(found.K, true.K, rtol=1e-10)
    assert found.residual < 1e-12


def test_weights_decide_between_contradicting_samples() -> None:
    t, X, u = np.array([0.0, 1.0]), np.ones((2, 1)), np.array([1.0, 3.0])
    found = fit_commands(t, X, u, names=("k",), weight=[3.0, 1.0])
    assert found.K[0, 0] == pytest.approx(1.5, rel=1e-12)
    assert found.residual == pytest.approx(np.sqrt((0.5**2 + 1.5**2) / 2), rel=1e-12)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: time_means([0, 1], [[1, 2], [3, 4]], names=NAMES, breakpoints={"c": [0.5]}), "'c'"),
        (lambda: time_means([0, 1], [[1, 2], [3, 4]], names=NAMES, breakpoints={"a": [2.0]}), "inside"),
        (lambda: time_means([0, 1], [[1, 2, 3], [3, 4, 5]], names=NAMES), "shape|values"),
        (lambda: time_means([1, 1], [[1, 2], [3, 4]], names=NAMES), "span"),
        (lambda: best_breakpoints([0, 1], [1, 2], pieces=1), "pieces"),
        (lambda: best_breakpoints([0, 1], [1, 2], pieces=500), "pieces"),
        (lambda: best_breakpoints([], [], pieces=2), "expected t"),
        (lambda: best_breakpoints([0, 1], [1, 2, 3], pieces=2), "expected t"),
        (lambda: best_breakpoints([2, 0, 1], [1, 2, 3], pieces=2), "sort"),
        (lambda: best_breakpoints([1, 1], [1, 2], pieces=2), "span"),
        (lambda: fit_commands([0, 1], [[1, 0], [2, 1]], [1, 2], names=NAMES, weight=[1, -1]), "negative"),
        (lambda: fit_commands([0, 1], [[1, 0], [2, 1]], [1, 2], names=NAMES, weight=[1.0]), "weight"),
        (lambda: Schedule(NAMES, 1.0, [[1, 2], [3, 4]], 0.0), "flat list"),
        (lambda: Schedule(NAMES, [1.0], [[1, 2], [3, 4]], 0.0)([[1.0]]), "flatten"),
        (lambda: fit_commands([0, 1], [[1, 1], [2, 2]], [1, 2], names=NAMES), "SINGULAR"),
        (lambda: fit_commands([0, 1], [[1, 0], [2, 0]], [1, 2], names=NAMES), "SINGULAR.*b"),
        (lambda: fit_commands([0, 1], [[1, 0], [2, 1]], [1, 2, 3], names=NAMES), "u: expected"),
    ],
)
def test_bad_input(call, text: str) -> None:
    with pytest.raises(ModelError, match=text):
        call()
