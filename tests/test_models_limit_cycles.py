"""Limit cycles of jet loops: closed forms against root finders and time integration."""

import math

import numpy as np
import pytest
from conftest import random_loops
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

from models.checked import ModelError, Status
from models.describing import schmitt_df
from models.flexible_loop import jet_plant
from models.limit_cycles import (
    SIGN_CHANGE,
    closed_form_table,
    describing_cycle,
    frequency_bounds,
    sensitivities,
    symmetric_cycle,
)
from models.limit_cycles_events import simulate_loop
from models.modulators import SchmittTrigger

PAPER = SchmittTrigger(0.7, 0.3)
A, TAU = 0.15, 0.7


# --- closed forms -------------------------------------------------------------------------------------------------


def test_the_numbers_of_the_paper():
    exact, predicted = symmetric_cycle(PAPER, a=A, tau=TAU), describing_cycle(PAPER, a=A, tau=TAU)
    assert exact.w == pytest.approx(0.4298, abs=5e-5)
    assert predicted.w == pytest.approx(0.4281, abs=5e-5)
    assert (exact.w, predicted.w) == pytest.approx((0.429794, 0.428128), abs=5e-7)
    assert (predicted.trigger_amplitude, exact.amplitude) == pytest.approx((0.870529, 0.772109), abs=5e-7)
    slopes = sensitivities(PAPER, a=A, tau=TAU)["w_exact"]
    assert [slopes[name] for name in ("u_on", "u_off", "tau")] == pytest.approx([-0.2513, -0.1603, 0.0260], abs=5e-5)


@pytest.mark.parametrize("row", [(0.15, 0.7, 0.3, 0.7), (2.0, 1.0, 0.2, 0.4), (0.01, 0.5, 0.1, 4.0), (0.15, 0.7, 0.3, 2.5)])
def test_the_exact_cycle_is_what_an_integration_of_the_motion_settles_to(row):
    """Switching by scipy's event location, started off the cycle."""
    a, u_on, u_off, tau = row
    cycle = symmetric_cycle(SchmittTrigger(u_on, u_off), a=a, tau=tau)
    x, level, t, ons, extremes = np.array([0.0, 1.02 * cycle.rate]), 0.0, 0.0, [], []
    for _ in range(60):
        edges = [u_on, -u_on] if level == 0 else [level * u_off]
        events = []
        for edge in edges:

            def event(t, x, edge=edge):
                return x[0] + tau * x[1] - edge

            event.terminal = True
            event.direction = math.copysign(1, edge) if level == 0 else -level
            events.append(event)
        span = 10 * cycle.period
        flight = solve_ivp(lambda t, x, y=level: [x[1], -a * y], (t, t + span), x, events=events, rtol=1e-11, atol=1e-13 * cycle.amplitude,
                           max_step=cycle.pulse / 40)  # fmt: skip
        t, x = flight.t[-1], flight.y[:, -1]
        hit = next(i for i, found in enumerate(flight.t_events) if len(found))
        level = (1.0 if hit == 0 else -1.0) if level == 0 else 0.0
        extremes.append(np.abs(flight.y[0]).max())
        if level == 1:
            ons.append(t)
    assert np.diff(ons)[-1] == pytest.approx(cycle.period, rel=1e-6)
    assert max(extremes[-4:]) == pytest.approx(cycle.amplitude, rel=2e-3)  # steps do not meet the extreme itself
    growth = np.diff(ons) - cycle.period
    if 1e-4 < cycle.multiplier < 0.9 and abs(growth[1]) > 1e-6 * cycle.period:
        assert growth[2] / growth[1] == pytest.approx(cycle.multiplier, abs=0.02)


def test_the_describing_function_cycle_solves_the_harmonic_balance():
    rows = random_loops(400, 4)
    table = closed_form_table(rows)
    exists = table["margin"] > 0
    assert 100 < exists.sum() < 350
    for i in np.flatnonzero(exists):
        a, u_on, u_off, tau = rows[i]
        w, amplitude = table["w_df"][i], table["A_df_trigger"][i]
        G = a * (1 + 1j * w * tau) / (1j * w) ** 2
        assert abs(1 + schmitt_df(SchmittTrigger(u_on, u_off), amplitude) * G) < 1e-9 * max(1, abs(G) / amplitude)
    assert np.isnan(table["w_df"][~exists]).all()


def test_a_root_finder_finds_the_same_cycle():
    for a, u_on, u_off, tau in random_loops(60, 5):
        trigger = SchmittTrigger(u_on, u_off)
        predicted = describing_cycle(trigger, a=a, tau=tau)
        if predicted.w is None:
            continue

        def balance(z, trigger=trigger, a=a, tau=tau):
            amplitude, w = trigger.u_on * (1 + math.exp(z[0])), math.exp(z[1])
            value = 1 + complex(schmitt_df(trigger, amplitude)) * a * (1 + 1j * w * tau) / (1j * w) ** 2
            return [value.real, value.imag]

        guess = [math.log(predicted.trigger_amplitude / u_on - 1) + 0.05, math.log(predicted.w) - 0.03]
        root, _, success, _ = fsolve(balance, guess, xtol=1e-13, full_output=True)
        if success == 1:
            assert math.exp(root[1]) == pytest.approx(predicted.w, rel=1e-6)


@pytest.mark.parametrize("excess", [1e-6, 0.3])
def test_no_intersection_beyond_the_limit_of_theorem_1(excess):
    limit = 0.25 * math.pi * 0.7 * math.sqrt(0.4)
    tau = math.sqrt(limit / A)
    inside, outside = (describing_cycle(PAPER, a=A, tau=tau * math.sqrt(1 + sign * excess)) for sign in (-1, 1))
    assert inside.w is not None
    assert inside.trigger_amplitude >= 0.7
    assert outside.w is None
    assert "no intersection" in outside.reason
    assert symmetric_cycle(PAPER, a=A, tau=1.2 * tau).w > 0
    # brute force: no amplitude and frequency come near the balance
    amplitudes, w = np.geomspace(0.7, 70, 700)[:, None], np.geomspace(1e-3, 1e2, 3000)[None]
    far = tau * math.sqrt(1.3)
    value = np.abs(1 + schmitt_df(PAPER, amplitudes) * A * (1 + 1j * w * far) / (1j * w) ** 2)
    assert value.min() > 0.02


def test_both_frequencies_depend_on_one_number():
    rows = random_loops(2000, 6)
    table = closed_form_table(rows)
    h, s = rows[:, 1] - rows[:, 2], rows[:, 1] + rows[:, 2]
    kappa = 8 * rows[:, 0] * s * rows[:, 3] ** 2 / (math.pi * h**2)
    use = table["margin"] > 0
    z = np.array([brentq(lambda z, k=k: z**3 + z - k, 0, max(k, 1.0), xtol=1e-300, rtol=1e-14) for k in kappa[use]])
    assert (table["w_df"] * s * rows[:, 3] / h)[use] == pytest.approx(z, rel=1e-11)
    sign = np.sign(table["w_exact"] - table["w_df"])[use]
    assert (sign == np.sign(SIGN_CHANGE - kappa[use])).all()


@pytest.mark.parametrize("count", [2000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_theorem_2_holds_and_is_not_trivial(count):
    table = closed_form_table(random_loops(2 * count, 7))
    use = table["margin"] > 0
    d, upper, lower, least = ((table[name])[use] for name in ("w_exact", "upper", "lower", "lower_abs"))
    d = d - table["w_df"][use]
    assert use.sum() > 0.4 * count
    assert (d <= upper).all()
    assert (d >= lower).all()
    assert (np.abs(d) >= least).all()
    assert (upper - d <= 2e-5 * table["w_df"][use]).all()
    assert np.median(least / np.abs(d)) > 0.999
    assert np.quantile(least / np.abs(d), 0.01) > 0.99
    assert (np.abs(d) - least <= 4e-5 * table["w_df"][use]).all()  # next to the change of sign too
    relative = d / table["w_df"][use]
    assert relative.max() < math.pi**2 / 8 - 1
    assert relative.max() > 0.99 * (math.pi**2 / 8 - 1)  # cannot be improved
    one = frequency_bounds(PAPER, a=A, tau=TAU)
    assert one.lower_abs <= 0.4297944346930662 - 0.4281275693640266 <= one.upper


def test_sensitivities_are_derivatives():
    slopes = sensitivities(PAPER, a=A, tau=TAU)
    base = np.array([A, 0.7, 0.3, TAU])
    for i, name in enumerate(("a", "u_on", "u_off", "tau")):
        step = np.zeros(4)
        step[i] = 1e-5
        table = closed_form_table([base + step, base - step])
        for key in ("w_exact", "A_exact", "w_df"):
            assert slopes[key][name] == pytest.approx((table[key][0] - table[key][1]) / 2e-5, rel=1e-7)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, -1.0])
@pytest.mark.parametrize("name", ["a", "tau"])
def test_numbers_that_make_no_loop(name, bad):
    values = {"a": A, "tau": TAU, name: bad}
    for function in (symmetric_cycle, describing_cycle, frequency_bounds, sensitivities):
        with pytest.raises(ModelError, match=f"^{name}"):
            function(PAPER, **values)
    with pytest.raises(ModelError, match="expected"):
        closed_form_table([values["a"], 0.7, 0.3, values["tau"]])


def test_without_hysteresis_there_is_no_cycle():
    relay = SchmittTrigger(0.7, 0.7)
    with pytest.raises(ModelError, match="chatter"):
        symmetric_cycle(relay, a=A, tau=TAU)
    assert describing_cycle(relay, a=A, tau=TAU).w is None
    run = simulate_loop(jet_plant(A, tau=TAU), relay, x0=[0.5, 0.05], t_max=50.0, max_nodes=5000)
    assert run.status is Status.MAX_ITERATIONS
