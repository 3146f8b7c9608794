"""Exact motion of jet loops: plants, event-exact simulation, periodic orbits; against small steps and finite differences."""

import math

import numpy as np
import pytest
from conftest import random_loops
from scipy.linalg import expm

from models.checked import ModelError
from models.flexible_loop import FLEXIBLE_001, LinearLoop, Mode, from_control, jet_plant
from models.limit_cycles import symmetric_cycle
from models.limit_cycles_events import simulate_loop
from models.limit_cycles_shooting import Shooting
from models.modulators import SchmittTrigger
from models.periodic_orbits import OrbitError, OrbitGuess, find_orbits, from_harmonic, from_rigid, from_run, solve_orbit

PAPER = SchmittTrigger(0.7, 0.3)
A, TAU = 0.15, 0.7


# --- plants ---------------------------------------------------------------------------------------------------------


def test_the_response_of_the_flexible_plant_with_delay():
    loop = jet_plant(A, tau=TAU, modes=[*FLEXIBLE_001, Mode(-0.3, -0.01 + 2j)], samples=3, sample=0.1)
    w = np.array([0.1, 0.44, 1.9, 7.0])
    s = 1j * w
    G = 1 / s**2
    for gain, pole in ((1.0, -0.0023 + 0.45j), (-0.3, -0.01 + 2j)):
        G = G + gain / ((s - pole) * (s - np.conj(pole)))
    assert loop.response(w) == pytest.approx(A * (1 + TAU * s) * G * np.exp(-0.3 * s), rel=1e-10)


def test_transition_is_the_matrix_exponential():
    loop = jet_plant(A, tau=TAU, modes=[Mode(1.0, -0.0023 + 0.45j), Mode(0.3, -0.01 + 7j)])
    for t in (0.0, 1e-4, 0.3, 20.0, 700.0):
        block = np.zeros((7, 7))
        block[:6, :6], block[:6, 6] = loop.A * t, loop.B * t
        moved, forced = loop.transition(t)
        assert moved == pytest.approx(expm(block)[:6, :6], rel=1e-10, abs=1e-12)
        assert forced == pytest.approx(expm(block)[:6, 6], rel=1e-10, abs=1e-12)


def test_linear_parts_from_outside():
    control = pytest.importorskip("control")
    own = jet_plant(A, tau=TAU)
    w = np.array([0.2, 0.7, 3.0])
    for system in (([A * TAU, A], [1.0, 0.0, 0.0]), control.tf([A * TAU, A], [1, 0, 0]), (own.A, own.B, own.C),
                   control.ss(own.A, own.B[:, None], own.C[None], 0)):  # fmt: skip
        assert from_control(system).response(w) == pytest.approx(own.response(w), rel=1e-9)
    loop = from_control(([A * TAU, A], [1.0, 0.0, 0.0]))
    orbit = solve_orbit(loop, PAPER, from_harmonic(loop, PAPER, amplitude=0.87, w=0.43))
    assert orbit.w == pytest.approx(symmetric_cycle(PAPER, a=A, tau=TAU).w, rel=1e-9)
    for bad, text in ((control.tf([1], [1, 1], 0.1), "continuous"), (([1.0, 1.0], [1.0, 2.0]), "feed-through"), (7, "state space")):
        with pytest.raises(ModelError, match=text):
            from_control(bad)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: jet_plant(-1.0, tau=1.0), "a = -1"),
        (lambda: jet_plant(1.0, tau=-1.0), "tau"),
        (lambda: jet_plant(1.0, tau=1.0, samples=2), "sample"),
        (lambda: jet_plant(1.0, tau=1.0, samples=-2, sample=1.0), "whole number"),
        (lambda: Mode(1.0, 0.1 + 1j), "real part"),
        (lambda: Mode(1.0, -0.1 - 1j), "imaginary part"),
        (lambda: LinearLoop("x", np.eye(2), np.ones(3), np.ones(2), np.ones(2), np.ones(2)), "B: expected shape"),
    ],
)
def test_plants_that_are_refused(make, text):
    with pytest.raises(ModelError, match=text):
        make()


# --- simulation -----------------------------------------------------------------------------------------------------


def reference_simulation(loop, trigger, x0, t_max, bias=0.0):
    """Fixed small steps of the exact transition, switching at the end of the step after a crossing: first order in the step."""
    dt, on, off = 2e-3, trigger.u_on, trigger.u_off
    moved, forced = loop.transition(dt)
    x, y, times = np.array(x0), 0.0, []
    queue = [0.0] * round(loop.delay / dt)
    for k in range(round(t_max / dt)):
        s = float(loop.C @ x)
        new = math.copysign(1.0, s) if abs(s) >= on else 0.0 if y * s <= off else y
        if new != y:
            times.append(k * dt)
        y = new
        queue.append(y)
        x = moved @ x + forced * (bias - queue.pop(0))
    return np.array(times), x


@pytest.mark.parametrize(("modes", "samples", "bias"), [((), 0, 0.0), (FLEXIBLE_001, 0, 0.1), (FLEXIBLE_001, 4, 0.0)])
def test_switchings_are_those_of_small_steps(modes, samples, bias):
    loop = jet_plant(A, tau=TAU, modes=modes, samples=samples, sample=0.1)
    x0 = [0.5, 0.1, *([0.0] * (len(loop.A) - 2))]
    run = simulate_loop(loop, PAPER, x0=x0, t_max=30.0, bias=bias)
    times, x = reference_simulation(loop, PAPER, x0, 30.0, bias)
    assert len(times) == len(run.events) > 3
    assert run.t[run.events] == pytest.approx(times, abs=8e-2)
    assert run.x[-1] == pytest.approx(x, abs=4e-2)


def test_every_switching_lies_on_its_threshold_and_nothing_is_missed():
    loop = jet_plant(A, tau=TAU, modes=[*FLEXIBLE_001, Mode(0.05, -0.02 + 6j)])
    run = simulate_loop(loop, PAPER, x0=[0.5, 0.1, 0, 0, 0.01, 0], t_max=300.0)
    before = run.y[run.events - 1]
    level = np.where(before == 0, 0.7 * run.y[run.events], 0.3 * before)
    assert run.s[run.events] == pytest.approx(level, abs=1e-12)
    t, x = run.dense(16)
    y = np.append(np.repeat(run.y[:-1], 16), run.y[-1])
    s = x @ loop.C
    assert (np.abs(s[y == 0]) <= 0.7 + 1e-12).all()
    assert (s[y == 1] >= 0.3 - 1e-12).all()
    assert (s[y == -1] <= -0.3 + 1e-12).all()
    assert np.interp(run.t, t, s) == pytest.approx(run.s, abs=1e-12)


def test_a_dip_that_comes_back_within_one_step_is_seen():
    """The trigger's input touches the threshold by 1e-4 between two nodes."""
    mode = Mode(1.0, complex(-1e-6, 1.0))
    loop = jet_plant(1e-9, tau=0.0, modes=[mode])
    for height, switches in ((0.7 * (1 + 1e-4), True), (0.7 * (1 - 1e-4), False)):
        phase = 0.2
        run = simulate_loop(
            loop, SchmittTrigger(0.7, 0.1), x0=[0.0, 0.0, height * math.cos(phase), height * math.sin(phase)], t_max=0.45, step=0.45
        )
        assert (len(run.events) > 0) is switches


# --- periodic orbits ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", random_loops(12, 8))
def test_shooting_gives_the_closed_form(row):
    a, u_on, u_off, tau = row
    trigger, loop = SchmittTrigger(u_on, u_off), jet_plant(a, tau=tau)
    cycle = symmetric_cycle(trigger, a=a, tau=tau)
    guess = from_rigid(loop, trigger, a=a, tau=tau)
    rough = OrbitGuess(guess.times * 1.01, guess.levels, guess.period * 1.01, guess.x0 * np.array([1.01, 0.99]))
    orbit = solve_orbit(loop, trigger, rough)
    assert orbit.w == pytest.approx(cycle.w, rel=1e-8)
    assert orbit.x0 == pytest.approx([cycle.switching, cycle.rate], rel=1e-7)
    assert orbit.multipliers == pytest.approx([cycle.multiplier], abs=1e-6)
    assert orbit.duty == pytest.approx(cycle.duty, rel=1e-7)
    assert orbit.symmetric
    assert orbit.stable
    assert orbit.residual < 1e-7


def test_the_jacobian_of_the_shooting_equations():
    loop = jet_plant(A, tau=TAU, modes=FLEXIBLE_001, samples=50, sample=0.1)
    shooting = Shooting(loop, PAPER, 0.07, np.array([1.0, 0.0, -1.0, 0.0]))
    z = np.array([0.4, 0.3, 0.05, -0.1, 3.1, 7.0, 9.4, 13.3])
    jacobian = shooting.equations(z)[1]
    for i in range(len(z)):
        step = np.zeros(len(z))
        step[i] = 1e-6
        column = (shooting.equations(z + step)[0] - shooting.equations(z - step)[0]) / 2e-6
        assert jacobian[:, i] == pytest.approx(column, abs=1e-7)


def flow_multipliers(orbit, loop, trigger, bias):
    """Eigenvalues of the derivative of the state after one period by central differences of simulations (no delay)."""
    n = len(loop.A)
    at = 0.5 * (orbit.times[1] + orbit.times[2] if orbit.levels[1] == 0 else orbit.times[1])
    moved, forced = loop.transition(at - orbit.times[1])
    k = int(np.argmin(np.abs(orbit.run.t - orbit.times[1])))
    start = moved @ orbit.run.x[k] + forced * bias
    columns = []
    for i in range(n):
        ends = []
        for sign in (1, -1):
            x0 = start.copy()
            x0[i] += sign * 1e-5
            ends.append(simulate_loop(loop, trigger, x0=x0, t_max=orbit.period, bias=bias).x[-1])
        columns.append((ends[0] - ends[1]) / 2e-5)
    return np.linalg.eigvals(np.column_stack(columns))


@pytest.mark.parametrize(("bias", "guess"), [(0.0, (0.715, 0.706)), (0.0, (0.75, 0.3)), (0.05, (0.715, 0.706))])
def test_floquet_multipliers_are_those_of_the_flow(bias, guess):
    loop = jet_plant(A, tau=TAU, modes=FLEXIBLE_001)
    orbit = solve_orbit(loop, PAPER, from_harmonic(loop, PAPER, amplitude=guess[0], w=guess[1]), bias=bias)
    values = flow_multipliers(orbit, loop, PAPER, bias)
    others = np.delete(values, np.argmin(np.abs(values - 1)))
    assert np.sort(np.abs(others)) == pytest.approx(np.sort(np.abs(orbit.multipliers)), rel=1e-3, abs=1e-5)
    assert not orbit.stable


def test_exact_orbits_of_the_flexible_loop_contradict_the_describing_function():
    """Both intersections are predicted stable; both exact orbits are unstable, and simulations leave them."""
    loop = jet_plant(A, tau=TAU, modes=FLEXIBLE_001)
    found = find_orbits(loop, PAPER, guesses=[from_harmonic(loop, PAPER, amplitude=c, w=w) for c, w in ((0.715, 0.706), (0.75, 0.3))])
    assert [o.w for o in found] == pytest.approx([0.673365, 0.263196], abs=1e-6)
    for orbit in found:
        assert orbit.symmetric
        assert orbit.residual < 1e-9
        x0 = orbit.x0 * (1 + 1e-6)
        run = simulate_loop(loop, PAPER, x0=x0, t_max=120 * orbit.period, output=1.0)
        at = np.arange(1, 100) * orbit.period
        t, x = run.dense(8)
        gap = [float(np.abs(x[np.argmin(np.abs(t - moment))] - orbit.x0).max()) for moment in at]
        assert max(gap) > 0.05


@pytest.mark.parametrize("bias", [0.02, 0.3, -0.3])
def test_asymmetric_cycles_hold_the_disturbance(bias):
    """Momentum: the mean torque of the jets is the disturbance."""
    loop = jet_plant(A, tau=TAU)
    found = find_orbits(loop, PAPER, guesses=[from_rigid(loop, PAPER, a=A, tau=TAU)], starts=[[0.5, 0.1]], bias=bias)
    assert found
    for orbit in found:
        mean = orbit.levels @ np.diff(np.append(orbit.times, orbit.period)) / orbit.period
        assert mean == pytest.approx(bias, rel=1e-9)
        assert not orbit.symmetric
        assert orbit.stable


def test_a_one_sided_cycle_in_closed_form():
    """Disturbance b a against pulses on one side: rates at the switchings +-v, on u_on = x + tau v, off u_off = y - tau v."""
    bias, tau = 0.4, 0.2
    trigger, loop = SchmittTrigger(0.7, 0.6), jet_plant(A, tau=tau)
    guess = from_run(simulate_loop(loop, trigger, x0=[0.6, 0.0], t_max=200.0, bias=bias))
    orbit = solve_orbit(loop, trigger, guess, bias=bias)
    v = (trigger.u_on - trigger.u_off) / (2 * tau)  # the parabolas of firing and coasting share their ends
    assert len(orbit.times) == 2
    assert orbit.period == pytest.approx(2 * v / (A * (1 - bias)) + 2 * v / (A * bias), rel=1e-9)
    assert orbit.duty == pytest.approx(bias, rel=1e-9)


@pytest.mark.parametrize(
    ("row", "samples"),
    [
        ((0.02, 0.7, 0.2, 3.0), 1),
        ((0.02, 0.7, 0.2, 3.0), 3),
        ((0.02, 0.7, 0.2, 3.0), 10),
        ((0.15, 0.5, 0.45, 3.0), 20),
        ((0.5, 0.5, 0.2, 6.0), 40),
    ],
)
def test_orbits_with_a_delay_of_whole_samples(row, samples):
    """The orbit that shooting gives is the one that simulations settle to, and the multiplier is their rate of settling."""
    a, u_on, u_off, tau = row
    trigger = SchmittTrigger(u_on, u_off)
    loop = jet_plant(a, tau=tau, samples=samples, sample=0.1)  # the last two delays are longer than a firing
    run = simulate_loop(loop, trigger, x0=[0.8 * u_on, 0.05], t_max=3000.0)
    orbit = solve_orbit(loop, trigger, from_run(run))
    assert orbit.stable
    assert run.frequency(2000.0) == pytest.approx(orbit.w, rel=1e-7)
    ons = run.t[run.events[run.y[run.events] == 1]]
    error = np.diff(ons) - orbit.period
    seen = [error[k + 1] / error[k] for k in range(1, len(error) - 1) if 1e-8 < abs(error[k + 1]) and abs(error[k]) < 1e-2]
    if seen:
        assert seen[-1] == pytest.approx(orbit.multipliers[0].real, abs=0.02)


def test_what_is_no_orbit_is_not_returned():
    loop = jet_plant(A, tau=TAU, modes=FLEXIBLE_001)
    with pytest.raises(OrbitError, match=r"no orbit|replay|convergence|singular"):
        solve_orbit(loop, PAPER, from_harmonic(loop, PAPER, amplitude=3.0, w=3.0))
    with pytest.raises(ModelError, match="levels"):
        solve_orbit(loop, PAPER, OrbitGuess(np.array([0.0, 1.0]), np.array([1.0, -1.0]), 2.0, np.zeros(4)))
    with pytest.raises(ModelError, match="amplitude"):
        from_harmonic(loop, PAPER, amplitude=0.5, w=0.4)
