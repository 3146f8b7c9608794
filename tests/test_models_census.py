"""The census of the sampled modulator against the paper, exact rational arithmetic, and brute force from very many random states."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from models import census_native, census_pieces, native
from models.census import census, margin_of, orbit_of, rows_of
from models.census_map import census_map, cycle_border, shown_word
from models.census_native import words_of
from models.census_pieces import DECIDED, UNDECIDED, census_of, levels, smallest_rotation
from models.checked import ModelError, Status
from models.modulators import DiscretePWPF
from models.modulators_runs import run
from models.sampled_cycles import region

PAPER = DiscretePWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.0, k=1.0, delta=0.0, Ts=0.06)
OFF, ONE, TWO = (0,), (-1, 0, 1, 0), (-1, -1, 1, 1)
needs_compiler = pytest.mark.skipif(not native.native_available(), reason="no C compiler on this machine")


def drawn(rng):
    """A modulator in the recommended ranges and around them, with a demand; a third with n <= 0, a third without hysteresis."""
    u_on, tau = rng.uniform(0.3, 1.0), rng.uniform(0.1, 0.2)
    km = rng.uniform(2.5, 7.5)
    h = rng.choice([0.0, rng.uniform(0, 1) * u_on, rng.uniform(0.2, 0.8) * u_on])
    Ts = rng.choice([rng.uniform(0.02, 0.1), rng.uniform(0.1, 2 * tau), rng.uniform(2 * tau, 8 * tau), 2 * tau], p=[0.4, 0.3, 0.25, 0.05])
    modulator = DiscretePWPF(
        km=km, tau_m=tau, u_on=u_on, h=h, k=rng.uniform(0, 6), delta=rng.choice([0.0, rng.uniform(0, u_on / km)]), Ts=Ts
    )
    return modulator, float(rng.choice([0.0, rng.uniform(-1, 1)]))


def simulated(p, r, x, y1, y2, steps):
    """States after some steps, written apart from the product: plain arrays, a relay with hysteresis by comparison."""
    n, m = (2 * p.tau_m - p.Ts) / (2 * p.tau_m + p.Ts), p.km * p.Ts / (2 * p.tau_m + p.Ts)
    drive = np.array([m * (2 * (r + p.delta) - p.k * s) for s in (-2, -1, 0, 1, 2)])
    off = p.u_on - p.h
    for _ in range(steps):
        x = n * x + drive[y1 + y2 + 2]
        above, below = np.where(y1 == 1, off, p.u_on), np.where(y1 == -1, off, p.u_on)
        y1, y2 = (x >= above).astype(np.int8) - (x <= -below).astype(np.int8), y1
    return x, y1, y2


def words_by_force(p, r, x, y1, y2):
    """Word reached from each state, as (words, which of them)."""
    pole = abs((2 * p.tau_m - p.Ts) / (2 * p.tau_m + p.Ts))
    steps = int(25 / -np.log(max(pole, 1e-3))) + 40
    x, y1, y2 = simulated(p, r, x, y1, y2, steps)
    key = np.round(x * 1e8).astype(np.int64) * 9 + 3 * (y1 + 1) + y2 + 1
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    x, y1, y2 = simulated(p, r, x[first], y1[first], y2[first], steps)
    tape = []
    for _ in range(640):
        x, y1, y2 = simulated(p, r, x, y1, y2, 1)
        tape.append(y1)
    words = []
    for outputs in np.array(tape).T:
        period = next(q for q in range(1, 320) if (outputs[q:] == outputs[:-q]).all())
        words.append(smallest_rotation(outputs[:period].tolist()))
    return words, which.ravel()


def random_states(rng, p, r, count):
    reach = 2 * p.km * (abs(r) + p.delta + p.k)
    return rng.uniform(-reach, reach, count), rng.integers(-1, 2, count).astype(np.int8), rng.integers(-1, 2, count).astype(np.int8)


def check_against_force(seeds, states):
    undecided, tally = 0, Counter()
    for seed in seeds:
        rng = np.random.default_rng(seed)
        p, r = drawn(rng)
        found = census(p, r)
        undecided += not found.decided
        reached, _ = words_by_force(p, r, *random_states(rng, p, r, states))
        if found.decided:
            assert set(reached) <= set(found.words), (seed, p, r)
        for cycle in found.cycles:
            y = run(p, np.full(1000 * cycle.period, r), z0=cycle.state(p, r)).y
            assert (y.reshape(1000, -1) == cycle.word).all(), (seed, cycle.word)
            tally["missed by force"] += cycle.word not in reached
            tally["long"] += cycle.period > 5
        tally["several"] += len(found.cycles) > 1
    assert undecided <= len(seeds) // 100  # borders have measure zero
    assert tally["several"] > len(seeds) // 20
    assert tally["long"] > len(seeds) // 20


def test_a_hundred_random_modulators_by_brute_force():
    check_against_force(range(100), 100_000)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_thousand_random_modulators_by_brute_force():
    check_against_force(range(1000, 2000), 100_000)


# The paper's modulator.


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"k": 1.0}, (OFF, TWO, ONE)),
        ({"k": 0.8}, (OFF, ONE)),
        ({"k": 0.8, "delta": 0.01}, (OFF,)),
        ({"k": 0.75}, (OFF,)),
        ({"k": 5.2}, (OFF, TWO)),  # called free of such cycles in table 3, which looks at M_c = 1 only
        ({"k": 0.5}, (OFF,)),
    ],
)
def test_words_of_the_paper(changes, words):
    found = census(replace(PAPER, **changes))
    assert found.decided
    assert found.words == words
    assert found.quiet == (words == (OFF,))
    assert sum(c.basin.fraction for c in found.cycles) == pytest.approx(1.0, rel=1e-9)


def test_orbit_of_figure_5():
    one = census(PAPER).cycles[2]
    assert one.word == ONE
    assert np.abs(one.x) == pytest.approx([0.5868, 0.0880, 0.5868, 0.0880], abs=5e-5)
    assert one.margin == pytest.approx(np.abs(one.x[0]) - 0.45)
    assert one.mean == 0


@pytest.mark.parametrize(
    ("changes", "word", "parameter", "between", "border"),
    [
        ({}, ONE, "k", (0.5, 1.0), 0.766875),
        ({}, ONE, "k", (5.0, 6.0), 5.1125),
        ({"k": 1.0}, ONE, "delta", (0.0, 0.1), 0.03420),
        ({"k": 0.8}, ONE, "delta", (0.0, 0.1), 0.00486),
        ({}, TWO, "k", (0.5, 1.0), 0.902206),  # printed 0.9023
        ({"k": 1.0}, TWO, "delta", (0.0, 0.1), 0.01219),  # printed 0.0128
    ],
)
def test_borders_by_division(changes, word, parameter, between, border):
    modulator = replace(PAPER, **changes)
    low, high = cycle_border(modulator, word, parameter, between)
    assert 0 < high - low < 1e-9
    assert low == pytest.approx(border, abs=6e-6)
    where = region(modulator, word)
    exact = where.k_range(0.0) if parameter == "k" else where.delta_range(modulator.k)
    assert any(low - 1e-12 <= end <= high + 1e-12 for end in exact)


def test_border_needs_one_end_with_the_cycle():
    with pytest.raises(ModelError, match=r"\{-0\+0\} exists at k = 0.8 and exists at k = 0.9"):
        cycle_border(PAPER, ONE, "k", (0.8, 0.9))
    with pytest.raises(ModelError, match="parameter must be 'k' or 'delta'"):
        cycle_border(PAPER, ONE, "h", (0.8, 0.9))


# Proof.


@pytest.mark.parametrize("changes", [{"k": 0.766875}, {"k": 1.0, "delta": 0.1125}, {"k": 0.45 * 818 / 408}])
def test_border_collisions_are_undecided(changes):
    found = census(replace(PAPER, **changes))
    assert not found.decided
    assert found.status is Status.UNDECIDED
    assert found.borders
    assert found.reason.startswith("an orbit meets a threshold")
    assert all(abs(abs(b.threshold) - 0.45) < 1e-12 for b in found.borders)
    assert not found.quiet
    assert "undecided" in found._repr_html_()
    for sign in (-1, 1):  # and a hundred-thousandth of a millionth beside it they are decided
        moved = {name: value * (1 + sign * 1e-11) for name, value in changes.items() if name != "k" or len(changes) == 1}
        assert census(replace(PAPER, **(changes | moved))).decided


def test_what_is_too_long_is_given_up(monkeypatch):
    monkeypatch.setattr(census_pieces, "STEPS", 200)
    found = census(DiscretePWPF(Ts=1e-4, k=1.0), 0.3123)
    assert not found.decided
    assert found.reason.startswith("given up")


def test_cycles_exist_in_exact_arithmetic():
    checked = 0
    for seed in range(60):
        p, r = drawn(np.random.default_rng(seed))
        if r != 0:  # f(r) is rounded
            continue
        km, tau, on, h, k, delta, Ts = (Fraction(v) for v in (p.km, p.tau_m, p.u_on, p.h, p.k, p.delta, p.Ts))
        n, m = (2 * tau - Ts) / (2 * tau + Ts), km * Ts / (2 * tau + Ts)
        for cycle in census(p, r).cycles:
            y, period = cycle.word, cycle.period
            drive = [m * (2 * delta - k * (y[i - 1] + y[i - 2 % period if period > 1 else 0])) for i in range(period)]
            x = sum(n ** (period - 1 - i) * drive[i] for i in range(period)) / (1 - n**period)
            for i in range(period):
                x = n * x + drive[i]
                assert float(x) == pytest.approx(cycle.x[i], rel=1e-12, abs=1e-13)
                up, down = (on - h if y[i - 1] == 1 else on), (on - h if y[i - 1] == -1 else on)
                assert (1 if x >= up else -1 if x <= -down else 0) == y[i]
                checked += 1
    assert checked > 50


def test_last_pieces_hold_every_orbit():
    for seed in range(12):
        rng = np.random.default_rng(seed)
        p, r = drawn(rng)
        ((_, pieces, _, decided),) = levels(rows_of(p, r))
        assert decided.all()
        x, y1, y2 = simulated(p, r, *random_states(rng, p, r, 5_000), 1500)
        held = np.zeros(len(x), dtype=bool)
        for history, low, high in zip(pieces.history, pieces.low, pieces.high, strict=True):
            held |= (3 * (y1 + 1) + y2 + 1 == history) & (low <= x) & (x <= high)
        assert held.all()


def test_intervals_of_parameters_hold_for_every_point_in_them():
    rng, boxes = np.random.default_rng(5), 0
    for _ in range(150):
        p, _ = drawn(rng)
        k0, d0 = rng.uniform(0, 3), rng.uniform(0, 0.05)
        width = 10 ** rng.uniform(-4, -1.5)
        k1, d1 = k0 + width, d0 + 0.1 * width
        whole = words_of(rows_of(p, 0.0, k=k0, k_high=k1, f=d0, f_high=d1))
        if whole.outcome[0] != DECIDED:
            continue
        boxes += 1
        wanted = {whole.word(i) for i in range(len(whole.point))}
        points = words_of(rows_of(p, 0.0, k=rng.uniform(k0, k1, 50), f=rng.uniform(d0, d1, 50), f_high=None))
        assert (points.outcome == DECIDED).all()
        found = [set() for _ in range(50)]
        for i, point in enumerate(points.point):
            found[point].add(points.word(i))
        assert all(words == wanted for words in found)
    assert boxes > 60


# Basins.


def test_basins_are_where_the_states_go():
    for seed in (3, 4, 5, 6, 7, 8, 9):
        rng = np.random.default_rng(seed)
        p, r = drawn(rng)
        found = census(p, r)
        low = min(c.basin.low.min() for c in found.cycles if c.basin.low.size)
        high = max(c.basin.high.max() for c in found.cycles if c.basin.low.size)
        count = 20_000
        x, y1, y2 = rng.uniform(low, high, count), rng.integers(-1, 2, count).astype(np.int8), rng.integers(-1, 2, count).astype(np.int8)
        words, which = words_by_force(p, r, x, y1, y2)
        for cycle in found.cycles:
            reached = np.isin(which, [i for i, word in enumerate(words) if word == cycle.word])
            assert (cycle.basin.holds(x, y1, y2) == reached).mean() > 0.9999
            spread = np.sqrt(max(cycle.basin.fraction * (1 - cycle.basin.fraction), 1e-6) / count)
            assert reached.mean() == pytest.approx(cycle.basin.fraction, abs=5 * spread)


# The compiled kernel.


def sets_of(words, count):
    found = [set() for _ in range(count)]
    for i, point in enumerate(words.point):
        found[point].add(words.word(i))
    return found


def mixed_rows():
    rng = np.random.default_rng(8)
    rows = [rows_of(*drawn(rng)) for _ in range(300)]
    rows += [rows_of(PAPER, 0.0, k=np.array([0.766875, 1.0, 5.2])), rows_of(PAPER, 0.0, f=0.1125, f_high=None)]
    slow = DiscretePWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.02, k=1.0, Ts=0.002)
    rows.append(rows_of(slow, 0.37))  # a period of many samples
    return np.concatenate(rows)


@needs_compiler
def test_compiled_census_is_the_one_in_numpy():
    rows = mixed_rows()
    compiled, plain = words_of(rows), census_of(rows)
    assert (compiled.outcome == plain.outcome).all()
    assert set(plain.outcome) == {DECIDED, UNDECIDED}
    assert sets_of(compiled, len(rows)) == sets_of(plain, len(rows))


@needs_compiler
@pytest.mark.parametrize(
    ("limit", "small"), [("ROOM 192", "ROOM 2"), ("MAX_SYMBOLS 256", "MAX_SYMBOLS 256\n#undef MAX_CYCLES\n#define MAX_CYCLES 1")]
)
def test_points_without_room_are_done_by_numpy(monkeypatch, limit, small):
    rows = mixed_rows()[::5]
    wanted = census_of(rows)
    assert f"#define {limit}" in census_native._SOURCE
    monkeypatch.setattr(census_native, "_SOURCE", census_native._SOURCE.replace(f"#define {limit}", f"#define {small}"))
    if "MAX_CYCLES" in small:
        monkeypatch.setattr(census_native, "CYCLES", 1)
    found = words_of(rows)
    assert (found.outcome == wanted.outcome).all()
    assert sets_of(found, len(rows)) == sets_of(wanted, len(rows))


def test_map_with_and_without_a_compiler(monkeypatch):
    k, delta = np.linspace(0, 6, 31), np.linspace(0, 0.11, 12)
    first = census_map(PAPER, k, delta)
    monkeypatch.setenv("REENTRY_NATIVE", "off")
    second = census_map(PAPER, k, delta)
    assert first.words == second.words
    assert (first.exists == second.exists).all()
    assert (first.decided == second.decided).all()


# The map.


def test_map_is_the_closed_forms_and_the_census():
    k, delta = np.linspace(0, 6, 47), np.linspace(0, 0.112, 23)
    found = census_map(PAPER, k, delta)
    assert found.decided.all()
    for word in ((1, 0, -1, 0), (1, 1, -1, -1), (1, 0, -1), (1, -1, 0), (1, -1)):
        where = region(PAPER, word)
        assert (found.of(word) == [[where.contains(a, b) for b in delta] for a in k]).all()
    rng = np.random.default_rng(2)
    for i, j in zip(rng.integers(0, 47, 25), rng.integers(0, 23, 25), strict=True):
        here = census(replace(PAPER, k=k[i], delta=delta[j]))
        assert {w for w, there in zip(found.words, found.exists[:, i, j], strict=True) if there} == set(here.words)
        assert found.quiet[i, j] == here.quiet
    assert found.of((1, 1, 1)).sum() == 0
    figure = found.plot()
    assert figure.axes[0].get_xlabel() == "feedback gain k"


def test_map_for_a_demand():
    found = census_map(replace(PAPER, h=0.2, dead_high=0.1), [0.7, 1.0], [0.0, 0.02], r=0.4)
    for i, k in enumerate(found.k):
        for j, delta in enumerate(found.delta):
            here = census(replace(PAPER, h=0.2, dead_high=0.1, k=k, delta=delta), 0.4)
            assert {w for w, there in zip(found.words, found.exists[:, i, j], strict=True) if there} == set(here.words)


def test_wrong_input():
    with pytest.raises(ModelError, match="census: r: expected a finite number"):
        census(PAPER, float("nan"))
    with pytest.raises(ModelError, match="census_map: k: expected increasing"):
        census_map(PAPER, [1.0, 0.5], [0.0])
    with pytest.raises(ModelError, match="census_map: delta: expected increasing"):
        census_map(PAPER, [1.0], [-0.1, 0.1])


def test_orbits_and_margins():
    x = orbit_of(PAPER, (1, 0, -1, 0))
    assert margin_of(PAPER, (1, 0, -1, 0), x) == pytest.approx(x[0] - 0.45)
    weak = replace(PAPER, k=0.7)
    assert margin_of(weak, (1, 0, -1, 0), orbit_of(weak, (1, 0, -1, 0))) < 0
    assert shown_word((0,) * 20) == "{0000000000000000… 20}"
