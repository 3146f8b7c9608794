"""Gains as a value: interpolation, jumps, held ends, shapes, notebook view, figure."""

import dataclasses

import numpy as np
import pytest

import models
from models import Var
from ocp.gains import Certificate, Gains


def gains(t, K, **change):
    t = np.asarray(t, dtype=float)
    K = np.asarray(K, dtype=float)
    N, _, nx = K.shape
    fields = {"t": t, "K": K, "k": 0.1 * K[:, :, 0], "S": np.repeat(np.eye(nx)[None], N, 0), "x0": 2 * K[:, 0, :], "u0": K[:, :, 1] - 1}
    return Gains(**{**fields, "certificate": Certificate(1e-9, 0.1, 10.0), **change})


def fields_of(value):
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def smooth(t):
    return np.stack([np.sin(t), np.cos(2 * t)], axis=-1)[:, None, :]


def test_between_nodes_the_gain_is_cubic():
    t = np.linspace(0, 3, 61)
    found = gains(t, smooth(t)).at(np.linspace(0.01, 2.99, 77))
    wanted = smooth(found.t)
    assert found.K.shape == (77, 1, 2)
    assert np.abs(found.K - wanted).max() < 1e-5
    assert np.abs(found.k - 0.1 * wanted[:, :, 0]).max() < 1e-6
    assert np.abs(found.x0 - 2 * wanted[:, 0]).max() < 2e-5
    assert np.abs(found.u0 - (wanted[:, :, 1] - 1)).max() < 1e-5
    cubic = gains(t, np.stack([t**3 - t, 1 + t**2], axis=-1)[:, None, :]).at([0.333, 2.718])
    assert cubic.K[:, 0, 0] == pytest.approx(np.array([0.333, 2.718]) ** 3 - np.array([0.333, 2.718]), rel=1e-12)


def test_interpolation_error_falls_with_the_fourth_power():
    errors = []
    for count in (21, 41, 81):
        t = np.linspace(0, 3, count)
        at = np.linspace(1, 2, 333)
        errors.append(np.abs(gains(t, smooth(t)).at(at).K - smooth(at)).max())
    assert np.polyfit(np.log([1, 0.5, 0.25]), np.log(errors), 1)[0] == pytest.approx(4, abs=0.2)


def test_nodes_are_met_and_ends_are_held():
    t = np.linspace(0, 3, 13)
    value = gains(t, smooth(t))
    assert value.at(t).K == pytest.approx(value.K, abs=1e-14)
    outside = value.at([-5.0, 99.0])
    assert outside.K[0] == pytest.approx(value.K[0], abs=1e-14)
    assert outside.K[1] == pytest.approx(value.K[-1], abs=1e-14)
    assert outside.t.tolist() == [-5.0, 99.0]


def test_a_jump_is_not_smoothed():
    t = np.concatenate([np.linspace(0, 1, 9), np.linspace(1, 2, 9)])
    K = smooth(t)
    K[9:] += 5.0
    value = gains(t, K)
    below, at, above = value.at([1 - 1e-9, 1.0, 1 + 1e-9]).K[:, 0, 0]
    assert below == pytest.approx(np.sin(1), rel=1e-8)
    assert at == pytest.approx(5 + np.sin(1), rel=1e-12)
    assert above == pytest.approx(5 + np.sin(1), rel=1e-8)
    # A stretch before the jump does not feel it.
    alone = gains(t[:9], K[:9]).at([0.77])
    assert value.at([0.77]).K == pytest.approx(alone.K, rel=1e-14)


def test_a_single_node_holds_everywhere():
    value = gains([0.0], [[[3.0, 4.0]]])
    assert value.at(7.0).K.tolist() == [[[3.0, 4.0]]]
    assert value.at([1.0, 2.0]).u0.tolist() == [[3.0], [3.0]]


def test_values_are_read_only_and_copied():
    t = np.linspace(0, 1, 5)
    K = smooth(t)
    value = gains(t, K)
    K[0] = 99
    assert value.K[0, 0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        value.K[0] = 1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"k": np.zeros((5, 2))}, r"Gains: k: expected shape \(5, 1\), got \(5, 2\)"),
        ({"x0": np.zeros((4, 2))}, r"Gains: x0: expected shape \(5, 2\)"),
        ({"t": [0.0, 1, 2, 1, 3]}, "must not decrease"),
        ({"t": []}, "N >= 1"),
        ({"S": np.full((5, 2, 2), np.nan)}, "Gains: S.*finite"),
        ({"states": (Var("a"),)}, "states: expected 2 variables"),
    ],
)
def test_wrong_fields_are_named(change, text):
    with pytest.raises(models.ModelError, match=text):
        Gains(**{**fields_of(gains(np.linspace(0, 1, 5), smooth(np.linspace(0, 1, 5)))), **change})


def test_times_must_be_finite():
    value = gains([0.0], [[[3.0, 4.0]]])
    with pytest.raises(models.ModelError, match=r"t\[1\]: expected a finite number"):
        value.at([0.0, np.nan])
    with pytest.raises(models.ModelError, match=r"t: expected shape \(M,\)"):
        value.at([[0.0]])


def test_views_show_names_and_units_and_escape_them():
    t = np.linspace(0, 3, 13)
    named = gains(t, smooth(t), states=(Var("V", "m/s"), Var("gamma", "rad")), inputs=(Var("bank", "rad"),))
    text = named._repr_html_()
    assert "V [m/s]" in text
    assert "bank [rad]" in text
    assert "1e-09" in text
    figure = named.plot()
    assert [a.get_title() for a in figure.axes] == ["bank per V [rad/(m/s)]", "bank per gamma [1]"]
    assert figure.axes[0].lines[0].get_ydata() == pytest.approx(named.K[:, 0, 0])
    nasty = gains(t, smooth(t), states=(Var("V", "<script>"), Var("gamma")), inputs=(Var("bank"),))
    assert "<script>" not in nasty._repr_html_()
    single = gains([0.0], [[[3.0, 4.0]]])
    assert "time-invariant" in single._repr_html_()
    assert len(single.plot().axes) == 2
