"""Modulators: one step in two languages, long runs compiled and interpreted, exact switching, static characteristics, refusals."""

import math
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models import ModelError
from models.modulators import PWM, ContinuousPWPF, DiscretePWPF, PseudoRate, SchmittTrigger, dead_band_relay
from models.modulators_runs import run
from models.modulators_static import RANGES, advice, duty, minimum_pulse, pseudo_rate_duty, sampled_duty

ALL = [
    SchmittTrigger(0.7, 0.3),
    dead_band_relay(0.4),
    DiscretePWPF(),
    DiscretePWPF(km=5.0, tau_m=0.17, u_on=0.6, h=0.25, k=1.2, delta=0.02, Ts=0.05, dead_low=0.1, dead_high=0.03),
    DiscretePWPF(Ts=0.5),
    ContinuousPWPF(),
    ContinuousPWPF(Ts=0.4, h=0.3),
    PseudoRate(),
    PWM(slots=7, minimum=2),
]
IDS = [f"{m.NAME}{i}" for i, m in enumerate(ALL)]


def written_out(values, r):
    """The sampled modulator by hand, in plain Python: the paper's recursion with its own letters."""
    km, tau_m, u_on, h, k, delta, Ts = values
    m, n = km * Ts / (2 * tau_m + Ts), (2 * tau_m - Ts) / (2 * tau_m + Ts)
    x = e = y = 0.0
    out = []
    for demand in r:
        now = demand + delta - k * y
        x, e = n * x + m * (now + e), now
        if y == 1:
            y = 1 if x > u_on - h else -1 if x <= -u_on else 0
        elif y == -1:
            y = -1 if x < -(u_on - h) else 1 if x >= u_on else 0
        else:
            y = 1 if x >= u_on else -1 if x <= -u_on else 0
        out.append(y)
    return np.array(out, dtype=float)


@pytest.mark.parametrize("values", [(4, 0.2, 0.45, 0, 0.8, 0, 0.06), (3, 0.15, 0.5, 0.2, 1.1, 0.03, 0.07), (4, 0.2, 0.45, 0.1, 1, 0, 0.7)])
def test_discrete_pwpf_is_the_papers_recursion(values):
    rng = np.random.default_rng(4)
    r = rng.uniform(-1, 1, 3000)
    km, tau_m, u_on, h, k, delta, Ts = values
    modulator = DiscretePWPF(km=km, tau_m=tau_m, u_on=u_on, h=h, k=k, delta=delta, Ts=Ts)
    assert np.array_equal(run(modulator, r).y, written_out(values, r))


def test_filter_parameters():
    m = DiscretePWPF()
    assert m.m == pytest.approx(12 / 23, rel=1e-15)  # eq 11 prints 0.5237
    assert m.n == pytest.approx(17 / 23, rel=1e-15)
    assert m.n == pytest.approx(0.7391, abs=5e-5)
    assert DiscretePWPF(Ts=0.4).n == 0


@pytest.mark.parametrize("modulator", ALL, ids=IDS)
def test_numpy_and_casadi_take_the_same_step(modulator):
    rng = np.random.default_rng(1)
    function = modulator.function()
    kernel, p = type(modulator).kernel(), modulator.parameters()
    z = np.tile(modulator.init(), (40, 1))
    exact = not isinstance(modulator, ContinuousPWPF)  # its exponentials may differ by a rounding
    for _ in range(60):
        r = rng.uniform(-1.3, 1.3, 40)
        z_next, y = modulator.step(z, r)
        for i in range(0, 40, 7):
            for f, given in ((function, (z[i], r[i])), (kernel, (z[i], r[i], p))):
                after, out = f(*given)
                assert np.allclose(np.asarray(after).ravel(), z_next[i], rtol=0, atol=0 if exact else 1e-13)
                assert abs(float(out) - y[i]) <= (0 if exact else 1e-13)
        z = z_next


@pytest.mark.parametrize("modulator", ALL, ids=IDS)
def test_long_run_is_the_steps(modulator, monkeypatch):
    rng = np.random.default_rng(2)
    r = rng.uniform(-1.2, 1.2, (37, 203))
    z = np.tile(modulator.init(), (37, 1))
    wanted = np.empty_like(r)
    for i in range(r.shape[1]):
        z, wanted[:, i] = modulator.step(z, r[:, i])
    found = [run(modulator, r), run(modulator, r, threads=1)]
    monkeypatch.setenv("REENTRY_NATIVE", "off")
    found += [run(modulator, r), run(modulator, r[:3])]  # many runs and few go different ways
    assert {answer.backend for answer in found[2:]} == {"interpreter"}
    tolerance = 1e-12 if isinstance(modulator, ContinuousPWPF) else 0
    for answer in found:
        assert np.abs(answer.y - wanted[: len(answer.y)]).max() <= tolerance
        assert np.abs(answer.z - z[: len(answer.z)]).max() <= tolerance


def test_run_shapes_and_continuation():
    modulator, r = DiscretePWPF(k=1.0), np.sin(0.06 * np.arange(400))
    whole = run(modulator, r)
    first = run(modulator, r[:123])
    rest = run(modulator, r[123:], z0=first.z)
    assert whole.y.shape == (400,)
    assert whole.z.shape == (3,)
    assert np.array_equal(whole.y, np.concatenate([first.y, rest.y]))
    gains = run([DiscretePWPF(k=k) for k in (0.5, 0.8, 1.0)], r)
    assert gains.y.shape == (3, 400)
    assert np.array_equal(gains.y[2], whole.y)
    assert not np.array_equal(gains.y[0], whole.y)
    assert whole.duty == whole.y.mean()
    turned_on = sum(a != 0 and a != b for a, b in zip(whole.y, [0, *whole.y[:-1]], strict=True))
    assert whole.pulses == turned_on
    assert not whole.y.flags.writeable


def test_trigger_at_its_thresholds():
    t = SchmittTrigger(0.7, 0.3)
    below, above = np.nextafter(0.7, 0), np.nextafter(0.3, 1)
    cases = [
        (0, 0.7, 1),
        (0, below, 0),
        (1, above, 1),
        (1, 0.3, 0),
        (-1, -0.3, 0),
        (-1, -above, -1),
        (0, -0.7, -1),
        (1, -0.7, -1),
        (-1, 0.7, 1),
    ]
    for before, x, after in cases:
        assert t.step([before], x)[1] == after, (before, x)
    relay = dead_band_relay(0.45)
    for before in (-1, 0, 1):  # no memory
        assert [float(relay.step([before], x)[1]) for x in (0.45, np.nextafter(0.45, 0), -0.45, 0)] == [1, 0, -1, 0]


def test_dead_zone():
    m = DiscretePWPF(delta=0.02, dead_low=0.1, dead_high=0.05)
    assert np.allclose(m.f([-1, -0.1, -0.05, 0, 0.05, 0.2]), [-0.88, 0.02, 0.02, 0.02, 0.02, 0.17], rtol=0, atol=1e-15)
    r = np.linspace(-1, 1, 11)
    assert np.array_equal(DiscretePWPF(delta=0.01).f(r), 0.01 + r)


def test_continuous_pwpf_against_an_integrator_with_events():
    """Event location by SciPy; the demand changes sign and the state starts on the wrong side."""
    m = ContinuousPWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.2)

    def integrate(x, y, r, held):
        t, fired = 0.0, 0.0
        while t < held:
            levels = [(-1, 0.45, 1), (1, 0.45, 1)] if y == 0 else [(y, 0.25, -1)]

            def crossing(level):
                def event(_, state):
                    return level[0] * state[0] - level[1]

                event.terminal = True
                event.direction = level[2]
                return event

            out = solve_ivp(lambda _, s, y=y, r=r: [(-s[0] + 4 * (r - y)) / 0.2], (t, held), [x], events=[crossing(v) for v in levels],
                            rtol=1e-11, atol=1e-13)  # fmt: skip
            fired += y * (out.t[-1] - t)
            t, x = float(out.t[-1]), float(out.y[0, -1])
            if out.status == 1:
                y = 0 if y else next(s for (s, _, _), hit in zip(levels, out.t_events, strict=True) if len(hit))
        return x, y, fired / held

    rng = np.random.default_rng(5)
    z, state = m.init(), (0.0, 0.0)
    for r, held in zip(
        [0.6, -0.9, 0.02, 0.97, -0.3, *rng.uniform(-1, 1, 4)], [0.31, 0.4, 0.27, 0.5, 0.21, 0.3, 0.3, 0.3, 0.3], strict=True
    ):
        step = ContinuousPWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.2, Ts=held)
        z, mean = step.step(z, r)
        x, y, wanted = integrate(*state, r, held)
        state = (x, y)
        assert mean == pytest.approx(wanted, abs=1e-8)
        assert z == pytest.approx([x, y], abs=1e-7)


def test_continuous_step_does_not_depend_on_its_length():
    long = ContinuousPWPF(Ts=1.2)
    short = ContinuousPWPF(Ts=0.003)
    r = np.linspace(-1.1, 1.1, 23)
    z, y = long.step(np.tile(long.init(), (23, 1)), r)
    many = run(short, np.repeat(r[:, None], 400, axis=1))
    assert np.allclose(many.y.mean(axis=1), y, rtol=0, atol=1e-11)
    assert np.allclose(many.z, z, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("k", "h", "exact"), [(1.0, 0.2, Fraction(4, 9)), (1.0, 0.0, Fraction(8, 19)), (0.8, 0.0, Fraction(1, 2))])
def test_published_duty_cycles(k, h, exact):
    found = sampled_duty(DiscretePWPF(k=k, h=h), 0.5)
    assert found.decided[0]
    assert found.fraction() == exact


def test_sampled_duty_is_the_long_run_mean():
    r = np.linspace(-0.95, 0.95, 39)
    for modulator in (DiscretePWPF(k=1.0, h=0.2), DiscretePWPF(delta=0.02), DiscretePWPF(Ts=0.5, k=0.6), PseudoRate()):
        found = sampled_duty(modulator, r)
        brute = run(modulator, np.repeat(r[:, None], 40_000, axis=1)).y[:, 10_000:].mean(axis=1)
        assert np.abs(found.duty - brute).max() < 2e-3
        assert found.decided.mean() > 0.9
        assert np.allclose(duty(modulator, r), found.duty)


def test_undecided_on_a_threshold():
    """m is 1/2 and n 1/2 exactly: from rest with f(r) = 1/4, x = 1/8, 5/16, ... tends to 1/2 = u_on from below and never reaches it."""
    modulator = DiscretePWPF(km=2.0, tau_m=1.5, Ts=1.0, u_on=0.5, k=1.0)
    assert modulator.m == modulator.n == 0.5
    found = sampled_duty(modulator, [0.25, 0.2])
    assert not found.decided[0]
    assert found.decided[1]
    with pytest.raises(ModelError, match="not decided"):
        found.fraction(0)
    assert found.fraction(1) == 0


def test_continuous_duty_closed_form_is_the_mean_of_long_steps():
    m = ContinuousPWPF()
    r = np.array([-1.2, -0.9, -0.3, 0.05, 0.1125, 0.1126, 0.3, 0.5, 0.8, 1.0, 1.06, 1.0626])
    mean = run(m, np.repeat(r[:, None], 20_000, axis=1)).y[:, 5000:].mean(axis=1)
    assert np.allclose(duty(m, r), mean, rtol=0, atol=2e-4)
    assert duty(m, 0.1125) == 0  # km r = u_on is not reached
    assert duty(m, 1.0626) == 1
    assert duty(m, [0.3]).shape == (1,)


def test_pseudo_rate_closed_form_is_the_limit_of_small_samples():
    r = np.array([0.08, 0.15, 0.3, 0.5, 0.7, 0.9])
    fine = PseudoRate(Ts=1e-4)
    mean = run(fine, np.repeat(r[:, None], 200_000, axis=1)).y[:, 50_000:].mean(axis=1)
    assert np.allclose(pseudo_rate_duty(fine, r), mean, rtol=0, atol=0.01)
    assert pseudo_rate_duty(PseudoRate(h=0.0), 0.6) == pytest.approx(0.5)
    assert np.array_equal(pseudo_rate_duty(fine, -r), -pseudo_rate_duty(fine, r))


def test_pwm_fires_its_share():
    m = PWM(slots=20, minimum=3)
    r = np.array([-0.77, -0.1, 0.0, 0.14, 0.15, 0.5, 2.0])
    y = run(m, np.repeat(r[:, None], 200, axis=1)).y
    assert np.array_equal(y.mean(axis=1), duty(m, r))
    assert np.allclose(duty(m, r), [-0.75, 0, 0, 0.15, 0.15, 0.5, 1.0])
    assert np.array_equal(duty(dead_band_relay(0.3), [-0.3, 0.2, 0.31]), [-1, 0, 1])


def test_minimum_pulse():
    m = ContinuousPWPF()
    assert minimum_pulse(m) == pytest.approx(0.01026, abs=5e-6)  # printed 10.3 ms
    r = np.array([0.45 / 4 * (1 + 1e-7)])
    share = duty(m, r)[0]
    off = -0.2 * math.log((4 * r[0] - 0.45) / (4 * r[0] - 0.25))
    assert minimum_pulse(m) == pytest.approx(off * share / (1 - share), rel=1e-5)  # T_on at the edge of the dead zone
    assert minimum_pulse(DiscretePWPF()) == 0.06
    assert minimum_pulse(PWM(slots=10, minimum=3, Ts=0.02)) == pytest.approx(0.06)
    assert minimum_pulse(ContinuousPWPF(km=0.1, h=0.2)) == math.inf
    assert minimum_pulse(SchmittTrigger(1, 0.5)) == 0


def test_advice():
    assert advice(DiscretePWPF()) == ()
    assert advice(ContinuousPWPF()) == ()  # h = 0.44 u_on
    found = {a.parameter: a for a in advice(ContinuousPWPF(km=9.0, tau_m=0.05, u_on=0.2, h=0.01))}
    assert set(found) == set(RANGES)
    assert found["h"].recommended == pytest.approx((0.04, 0.16))
    assert "recommended 2.5 to 7.5" in str(found["km"])
    assert [a.parameter for a in advice(DiscretePWPF(h=0.2, k=1.0))] == ["h"]  # the sample is longer than the shortest pulse
    assert [a.parameter for a in advice(DiscretePWPF(Ts=0.4))] == ["Ts"]
    assert [a.parameter for a in advice(DiscretePWPF(delta=0.12))] == ["delta"]
    assert "does not fire" in str(advice(ContinuousPWPF(km=0.3))[-1])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: SchmittTrigger(0.3, 0.7), r"u_off = 0\.7 is above u_on = 0\.3"),
        (lambda: DiscretePWPF(h=0.5), r"u_off = -0\.05 < 0 \(h = 0\.5 is more than u_on = 0\.45\).*h <= u_on"),
        (lambda: DiscretePWPF(h=-0.1), r"h = -0\.1; expected >= 0"),
        (lambda: DiscretePWPF(k=-0.2), r"k = -0\.2; expected >= 0"),
        (lambda: DiscretePWPF(delta=-0.01), "delta"),
        (lambda: DiscretePWPF(k=math.nan), "k: expected a finite number"),
        (lambda: DiscretePWPF(Ts=0.0), "Ts = 0; expected > 0"),
        (lambda: DiscretePWPF(tau_m=-1.0), "tau_m"),
        (lambda: DiscretePWPF(km="4"), "km: expected real numbers"),
        (lambda: SchmittTrigger(0.0, 0.0), "u_on = 0; expected > 0"),
        (lambda: ContinuousPWPF(h=0.0), "switches infinitely often"),
        (lambda: PWM(slots=2.5), "whole number"),
        (lambda: PWM(slots=3, minimum=4), "longer than the period"),
        (lambda: run(DiscretePWPF(), [0.1, math.nan]), r"pwpf: r\[1\]"),
        (lambda: run(DiscretePWPF(), np.array([[0.1, 0.2], [0.3, math.inf]])), r"pwpf: r\[1\]\[1\]"),
        (lambda: run(ContinuousPWPF(), [0.1], dtype=np.int8), "dtype: expected numpy.float64,"),
        (lambda: run(DiscretePWPF(), []), "none of them empty"),
        (lambda: run(DiscretePWPF(), np.ones((3, 4)), z0=np.zeros((2, 3))), r"\[2, 3\] runs"),
        (lambda: run(DiscretePWPF(), [0.1], z0=[0.0]), "z0"),
        (lambda: run([DiscretePWPF(), PWM()], [0.1]), "several classes"),
        (lambda: run([], [0.1]), "expected a modulator"),
        (lambda: DiscretePWPF().step([0.0, 0.0], 0.1), r"z: expected shape \(3,\)"),
        (lambda: DiscretePWPF().step(np.zeros((2, 3)), [0.1, 0.2, 0.3]), "r: expected one number"),
        (lambda: sampled_duty(ContinuousPWPF(), 0.1), "use duty"),
        (lambda: duty(ContinuousPWPF(), math.inf), "duty: r"),
        (lambda: advice(PWM()), "expected a ContinuousPWPF or DiscretePWPF"),
    ],
)
def test_refusals(make, says):
    with pytest.raises(ModelError, match=says):
        make()


def test_sample_time_beyond_the_filter_is_handled():
    m = DiscretePWPF(Ts=0.9)
    assert -1 < m.n < 0
    assert np.array_equal(run(m, np.full(50, 0.3)).y, written_out((4, 0.2, 0.45, 0, 0.8, 0, 0.9), np.full(50, 0.3)))


def test_function_is_differentiable_code():
    f = DiscretePWPF().function()
    jacobian = ca.Function("j", [s := ca.SX.sym("z", 3), r := ca.SX.sym("r")], [ca.jacobian(f(s, r)[0], r)])
    assert float(jacobian([0.1, 0.0, 0.0], 0.2)[0]) == pytest.approx(12 / 23)


@pytest.mark.parametrize("shape", [(1, 5), (8, 33), (19, 40), (17, 300)], ids=str)
def test_bytes_are_the_same_pulses(shape):
    r = np.random.default_rng(5).uniform(-1.2, 1.2, shape)
    as_bytes, as_floats = run(DiscretePWPF(k=1.0), r, dtype=np.int8), run(DiscretePWPF(k=1.0), r)
    assert as_bytes.y.dtype == np.int8
    assert np.array_equal(as_bytes.y, as_floats.y)
    assert np.array_equal(as_floats.y, [written_out((4, 0.2, 0.45, 0, 1.0, 0, 0.06), row) for row in r])
    assert np.array_equal(as_bytes.z, as_floats.z)


def test_finite_demands_whose_sum_overflows_are_accepted():
    assert set(run(DiscretePWPF(), np.full((9, 40), 1e307)).y[:, -1]) == {1.0}
