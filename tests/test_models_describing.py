"""Describing functions against integrals of their definition, known closed forms, simulated words, and python-control."""

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from models import ModelError
from models.describing import SampledMode, numerical_df, predict, relay_df, sampled_df, sampled_modes, sampled_region, schmitt_df
from models.modulators import DiscretePWPF, SchmittTrigger, dead_band_relay
from models.modulators_runs import run
from models.nyquist import LinearPart, intersections, linear_part, rational, state_space

A = np.array([0.701, 0.87, 1.5, 10.0, 300.0])
TRIGGER = SchmittTrigger(0.7, 0.3)


def test_relay_family_by_its_switching_angles():
    """Fourier integral of the known pulse: on from asin(u_on/A) to pi - asin(u_off/A)."""
    for on, off in ((0.7, 0.3), (0.7, 0.7), (0.7, 0.0), (0.7, -0.7), (0.5, -0.2)):
        for a in A:
            first, last = math.asin(on / a), math.pi - math.asin(off / a)
            b1 = 2 / math.pi * quad(math.sin, first, last)[0]
            a1 = 2 / math.pi * quad(math.cos, first, last)[0]
            assert relay_df(a, u_on=on, u_off=off) == pytest.approx((b1 + 1j * a1) / a, rel=1e-12, abs=1e-14)
    assert np.allclose(relay_df(A, u_on=0.0, u_off=0.0, level=3.0), 12 / (np.pi * A))
    assert relay_df(0.69, u_on=0.7, u_off=0.3) == 0


def test_quadrature_of_relays_is_exact():
    assert np.allclose(numerical_df(TRIGGER, A), schmitt_df(TRIGGER, A), rtol=1e-13, atol=1e-15)
    assert np.allclose(numerical_df(np.sign, A), 4 / (np.pi * A), rtol=1e-13)

    def two_position(x, before):
        return np.where(x >= 0.6, 2.0, np.where(x <= -0.6, -2.0, np.where(before >= 0, 2.0, -2.0)))

    assert np.allclose(numerical_df(two_position, A, hysteretic=True), relay_df(A, u_on=0.6, u_off=-0.6, level=2.0), rtol=1e-13)


def test_quadrature_of_smooth_and_hysteretic_elements():
    s = 0.5 / A
    saturation = 2 / np.pi * (np.arcsin(s) + s * np.sqrt(1 - s**2))
    assert np.allclose(numerical_df(lambda x: np.clip(x, -0.5, 0.5), A), saturation, rtol=1e-6)
    assert np.allclose(numerical_df(lambda x: x**3, A), 0.75 * A**2, rtol=1e-6)
    k = 1 - 0.4 / A
    backlash = (np.pi / 2 + np.arcsin(k) + k * np.sqrt(1 - k**2) - 4j * 0.2 / A * (1 - 0.2 / A)) / np.pi
    play = numerical_df(lambda x, before: np.clip(before, x - 0.2, x + 0.2), A, hysteretic=True)
    assert np.allclose(play, backlash, rtol=1e-6)
    biased = numerical_df(lambda x: x**2, A, bias=0.3)  # 2 bias A sin is what is left of the square
    assert np.allclose(biased, 0.6, rtol=1e-4)
    assert numerical_df(np.sign, A.reshape(5, 1)).shape == (5, 1)


def test_quadrature_takes_straight_lines_between_samples():
    """A sine drawn by straight lines of width pi/16 keeps sinc(pi/32)^2 of its fundamental, exactly."""
    assert numerical_df(lambda x: x, 2.0, samples=16) == pytest.approx(np.sinc(1 / 32) ** 2, rel=1e-12)


def test_error_of_quadrature_falls_with_the_square_of_the_step():
    error = [abs(numerical_df(lambda x: x**3, 1.0, samples=n) - 0.75) for n in (64, 128, 256, 512)]
    slope = np.polyfit(np.log([64, 128, 256, 512]), np.log(error), 1)[0]
    assert slope == pytest.approx(-2, abs=0.1)


def test_modes_of_table_2():
    names = {p: {str(m.mc) for m in sampled_modes(p)} for p in (2, 3, 4, 5)}
    assert names == {2: {"1"}, 3: {"1", "1/2"}, 4: {"1", "2"}, 5: {"1", "1/2", "2", "2/3"}}
    assert SampledMode((1, 1, -1, -1, -1)).mc == Fraction(2, 3)


def responds(mode, trigger, X, psi):
    """Whether the sine really gives the word, sample by sample, from its own previous output."""
    out = []
    for k, before in enumerate(np.roll(mode.word, 1)):
        out.append(int(trigger.step([before], X * math.cos(2 * math.pi * k / mode.period + psi))[1]))
    return tuple(out) == mode.word


@pytest.mark.parametrize("trigger", [SchmittTrigger(0.45, 0.45), SchmittTrigger(0.45, 0.2)])
def test_region_is_where_the_relay_gives_the_word(trigger):
    rng = np.random.default_rng(3)
    for mode in (m for p in (2, 3, 4, 5, 6) for m in sampled_modes(p)):
        region = sampled_region(mode, trigger, largest=3.0)
        corners = len(region.C)
        C = np.concatenate([rng.dirichlet(np.ones(corners), 60) @ region.C, rng.uniform(-3, 3, 300) + 1j * rng.uniform(-3, 3, 300)])
        edges = np.roll(region.C, -1) - region.C
        inside = np.array([(((np.conj(edges) * (c - region.C)).imag) >= -1e-12).all() for c in C])
        assert 60 <= inside.sum() < 360
        for c, within in zip(C, inside, strict=True):
            assert responds(mode, trigger, abs(c), np.angle(c)) == within, (mode.word, c)


def test_region_of_the_paper():
    """Eq 9: u_on/cos(psi) <= X <= u_on/|sin(psi)| for |psi| < pi/4; period 2 is a ray from -u_on."""
    region = sampled_region(SampledMode((1, 0, -1, 0)), dead_band_relay(0.45))
    assert region.C.real.min() == pytest.approx(0.45)
    assert np.abs(region.C.imag).max() == pytest.approx(0.45)
    assert np.allclose(region.minus_inverse, -region.C)  # eq 8: X at the angle -pi + psi
    ray = sampled_region(SampledMode((1, -1)), dead_band_relay(0.45)).minus_inverse
    assert np.allclose(ray.imag, 0, atol=1e-12)
    assert ray.real.max() == pytest.approx(-0.45)


def test_sampled_df_is_the_ratio_of_the_fundamentals():
    mode, X, psi = SampledMode((1, 1, 0, -1, -1)), 1.3, 0.4
    k = np.arange(5)
    x = X * np.cos(2 * np.pi * k / 5 + psi)
    turn = np.exp(-2j * np.pi * k / 5)
    assert sampled_df(mode, X, psi) == pytest.approx(np.dot(mode.word, turn) / np.dot(x, turn), rel=1e-12)


def loop_of(k):
    """Linear part of the modulator by hand, eq 11 with m of eq 3."""
    m, n = 12 / 23, 17 / 23
    return lambda z: k * m * (z + 1) / (z * (z - n))


@pytest.mark.parametrize(("k", "words"), [(1.0, {(1, 0, -1, 0), (1, 1, -1, -1)}), (0.8, {(1, 0, -1, 0)}), (0.5, set())])
def test_conclusions_of_the_paper(k, words):
    found = predict(loop_of(k), dead_band_relay(0.45), periods=range(2, 9))
    assert {p.mode.word for p in found if p.predicted} == words


def test_prediction_of_period_four_is_exact():
    """Opposite half-periods: the fundamental is all there is.  k = 1 gives the printed 0.5868 and 0.0880."""
    one = next(p for p in predict(loop_of(1.0), dead_band_relay(0.45)) if p.mode.word == (1, 0, -1, 0))
    x = one.X * np.cos(np.pi / 2 * np.arange(4) + one.psi)
    assert x[:2] == pytest.approx([0.5868, -0.0880], abs=5e-5)
    cycle = run(DiscretePWPF(k=1.0), np.zeros(400), z0=[x[0], 0.0, 1.0])  # after the 1, whose error was that of the 0 before it
    assert np.array_equal(cycle.y, np.tile([0, -1, 0, 1], 100))
    assert cycle.z[0] == pytest.approx(x[0], rel=1e-12)
    borders = [brentq(lambda k, w=w: next(p.margin for p in predict(loop_of(k), dead_band_relay(0.45)) if p.mode.word == w), 0.6, 1.2)
               for w in ((1, 0, -1, 0), (1, 1, -1, -1))]  # fmt: skip
    assert borders == pytest.approx([0.766875, 0.45 * 818 / 408], rel=1e-9)


def test_jet_loop():
    """a = 0.15, u_on = 0.7, u_off = 0.3, tau = 0.7: printed w_DF = 0.4281 rad/s."""
    found = intersections(([0.105, 0.15], [1, 0, 0]), lambda a: schmitt_df(TRIGGER, a), frequencies=(0.01, 100), amplitudes=(0.5, 1e3))
    assert len(found) == 1
    assert found[0].w == pytest.approx(0.428128, abs=5e-7)
    assert found[0].A == pytest.approx(0.870529, abs=1e-6)
    assert found[0].stability == "stable"
    assert found[0].residual < 1e-12


def test_dead_zone_relay_with_three_lags_has_two():
    """K/(s (s + 1)(s + 2)) crosses the axis at sqrt 2 with K/6; N = 6/K has a small unstable and a large stable root, in closed form."""
    K, u = 20.0, 0.3
    found = intersections(
        rational([K], [1, 3, 2, 0]), lambda a: relay_df(a, u_on=u, u_off=u), frequencies=(0.1, 10), amplitudes=(0.1, 30), points=50
    )  # the small root lies within the step from which on the relay fires
    square = np.roots([(6 / K) ** 2, -((4 / np.pi) ** 2), (4 * u / np.pi) ** 2])
    wanted = np.sort(np.sqrt(square))
    found = sorted(found, key=lambda i: i.A)
    assert [i.A for i in found] == pytest.approx(wanted, rel=1e-9)
    assert [i.w for i in found] == pytest.approx([math.sqrt(2)] * 2, rel=1e-9)
    assert [i.stability for i in found] == ["unstable", "stable"]
    none = intersections(rational([0.1], [1, 3, 2, 0]), lambda a: relay_df(a, u_on=u, u_off=u), frequencies=(0.1, 10), amplitudes=(0.1, 30))
    assert none == ()


def test_stability_is_what_a_simulation_does():
    """Ideal relay behind the three lags, started below and above the predicted amplitude: both orbits come to it."""
    from scipy.integrate import solve_ivp

    found = intersections(rational([2.0], [1, 3, 2, 0]), lambda a: 4 / (np.pi * a) + 0j, frequencies=(0.1, 10), amplitudes=(1e-3, 1e2))
    assert [i.stability for i in found] == ["stable"]
    for start in (0.2, 5.0):
        out = solve_ivp(lambda _, x: [x[1], x[2], -3 * x[2] - 2 * x[1] - 2 * math.tanh(200 * x[0])], (0, 120), [start * found[0].A, 0, 0],
                        max_step=0.02)  # fmt: skip
        late = np.abs(out.y[0][out.t > 100]).max()
        assert late == pytest.approx(found[0].A, rel=0.15)


def test_sampled_linear_part_and_delay():
    m = DiscretePWPF(k=1.0)
    g = rational([m.m, m.m], [1, -m.n, 0], dt=0.06)
    w = np.array([1.0, 20.0])
    assert np.allclose(g(w), loop_of(1.0)(np.exp(1j * w * 0.06)))
    late = rational([m.m, m.m], [1, -m.n, 0], dt=0.06, delay=0.12)
    assert np.allclose(late(w), g(w) * np.exp(-2j * w * 0.06))
    found = intersections(g, lambda a: relay_df(a, u_on=0.45, u_off=0.45), frequencies=(1, math.pi / 0.06), amplitudes=(0.4, 50))
    for one in found:
        assert abs(1 + g(one.w) * relay_df(one.A, u_on=0.45, u_off=0.45)) < 1e-9


def test_state_space_is_the_rational_function():
    g = state_space([[0, 1], [-2, -3]], [0, 1], [5, 1], dt=None)
    w = np.geomspace(0.1, 10, 7)
    assert np.allclose(g(w), rational([1, 5], [1, 3, 2])(w), rtol=1e-12)
    assert g(1.0).shape == ()


def test_objects_of_python_control():
    control = pytest.importorskip("control")
    tf = control.tf([1.0], [1, 3, 2, 0])
    u = 0.1
    ours = intersections(tf, lambda a: relay_df(a, u_on=u, u_off=-u), frequencies=(0.1, 10), amplitudes=(u, 10))
    theirs = control.describing_function_response(tf, control.relay_hysteresis_nonlinearity(1, u), np.linspace(u, 5, 400)).intersections
    assert (ours[0].A, ours[0].w) == pytest.approx(theirs[0], rel=1e-4)
    sampled = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    assert linear_part(sampled).dt == 0.1
    assert linear_part(sampled)(3.0) == pytest.approx(1 / (np.exp(0.3j) - 0.5))
    with pytest.raises(ModelError, match="2 inputs"):
        linear_part(control.ss(np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: relay_df(0.0, u_on=1, u_off=0), "amplitudes > 0"),
        (lambda: relay_df(1.0, u_on=0.3, u_off=0.7), "u_off = 0.7 must lie between"),
        (lambda: relay_df(math.nan, u_on=1, u_off=0), "A: expected a finite number"),
        (lambda: numerical_df(lambda x: x[0], 1.0), "returned shape"),
        (lambda: numerical_df(np.log, [1.0]), "element"),
        (lambda: numerical_df(np.sign, 1.0, samples=4), "samples"),
        (lambda: numerical_df(lambda x, before: before + 1, 1.0, hysteretic=True), "does not repeat"),
        (lambda: sampled_modes(1), "period = 1"),
        (lambda: rational([1], [0, 0]), "not all zero"),
        (lambda: rational([1], [1, 0], dt=-1.0), "dt = -1"),
        (lambda: rational([1], [1, 0], dt=0.1, delay=0.15), "no whole number of samples"),
        (lambda: rational([1], [1, 0, 1])(1.0), "a pole lies there"),
        (lambda: linear_part("G"), "expected a LinearPart"),
        (lambda: state_space([[1, 0]], [1], [1]), "state_space: expected A"),
        (lambda: LinearPart(lambda s: s, None, -0.1), "delay"),
        (lambda: intersections(([1], [1, 1]), lambda a: 1 / a, frequencies=(0, 1), amplitudes=(1, 2)), "frequencies"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_refusals(make, says):
    with pytest.raises(ModelError, match=says):
        make()
