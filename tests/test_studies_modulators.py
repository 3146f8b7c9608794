"""The modulator study: conclusions of paper 000, its misprints, and that figures and tables carry what they say."""

import json

import numpy as np
import pytest

from models import ModelError
from models.modulators_runs import run as run_modulator
from studies import modulators
from studies.modulators_figures import map_kinds
from studies.modulators_interactive import explored, map_explorer


@pytest.fixture(scope="module")
def study():
    return modulators.run(points=40)


@pytest.fixture(scope="module")
def result(study):
    return study.result()


def test_no_judged_row_is_missed(result):
    assert [row.quantity for row in result.comparisons if row.met is False] == []
    assert sum(row.met is True for row in result.comparisons) >= 15


def test_misprints_are_recorded_beside_the_value(result):
    rows = {row.quantity: row for row in result.comparisons}
    for quantity, printed, computed in (
        ("gain m of the filter (eq 11)", 0.5237, 12 / 23), ("M_c = 2: k at delta = 0", 0.9023, 0.45 * 818 / 408),
        ("M_c = 2: delta at k = 1", 0.0128, 0.012194),
    ):  # fmt: skip
        row = rows[quantity]
        assert row.paper == printed
        assert row.computed == pytest.approx(computed, rel=1e-4)
        assert row.computed != pytest.approx(printed, rel=5e-5)
        assert "misprint" in row.why or "slip" in row.why


def test_censuses(study):
    words = {name: set(found.words) for name, found in study.censuses.items()}
    one, two = (-1, 0, 1, 0), (-1, -1, 1, 1)
    assert words == {"original": {(0,), one}, "a": {(0,)}, "b": {(0,)}, "k = 1": {(0,), one, two}, "k = 5.2": {(0,), two}}
    assert all(found.decided for found in study.censuses.values())


def test_census_and_formula_agree_on_every_border(study):
    assert len(study.borders) == 6
    for border in study.borders:
        low, high = sorted(border.census)
        assert low - 1e-9 <= border.formula <= high + 1e-9
        assert high - low < 1e-8


def test_predictions(study):
    found = {k: {p.mode.word for p in all_of if p.predicted} for k, all_of in study.predictions.items()}
    assert found == {0.5: set(), 0.8: {modulators.M1}, 1.0: {modulators.M1, modulators.M2}}


def test_what_the_demand_leaves_behind(study):
    assert tuple(modulators.ending_word(study.endings[1.0])) == modulators.M1
    assert tuple(modulators.ending_word(study.endings[0.5])) == modulators.M2
    track = study.endings[1.0]
    assert (track.r[track.t >= 5.0] == 0).all()
    assert track.r[16] == pytest.approx(np.sin(0.96))


def test_tracking_numbers(study):
    """Impulse within a pulse or two of the demand; scheme b keeps the gain of the original, scheme a does not."""
    assert all(track.worst < 0.1 for track in study.tracks.values())
    gain = {name: answer.gain for name, answer in study.harmonics.items()}
    assert gain["b"] == pytest.approx(gain["original"], abs=2e-3)
    assert gain["a"] - gain["original"] > 0.05
    assert study.harmonics["b"].mean == pytest.approx(0.012, abs=2e-3)
    answer = modulators.harmonic(modulators.PAPER, 0.8, 1.0, seconds=100 * 2 * np.pi)
    t = 0.06 * np.arange(round(100 * 2 * np.pi / 0.06))
    y = run_modulator(modulators.PAPER, 0.8 * np.sin(t)).y
    assert answer.gain == pytest.approx(abs(2 * np.mean(y * np.exp(-1j * t))) / 0.8, rel=2e-3)


def test_map_says_what_the_formulas_say(study):
    """Off the borders, points of the map have a cycle exactly where its closed conditions hold."""
    found = study.map
    for word in (modulators.M1, modulators.M2):
        limits = modulators.region(modulators.PAPER, word)
        inside = np.array([[limits.contains(k, d) for d in found.delta] for k in found.k])
        assert np.array_equal(found.of(word)[found.decided], inside[found.decided])
    kinds = map_kinds(found)
    assert kinds.shape == (40, 40)
    assert np.array_equal(kinds == 0, found.quiet)
    assert found.decided.mean() > 0.95


def test_report_pieces(result):
    names = [item.name for item in result.figures]
    assert names == [
        "modulator_duty",
        "modulator_tracking",
        "modulator_endings",
        "modulator_describing",
        "modulator_schemes",
        "modulator_map",
    ]
    assert len(result.tables) == 6
    limits = result.tables[2]
    assert "{--++}" in limits.caption  # M_c = 2 is still there at k = 5.2
    exact = {row[0]: row[2] for row in result.tables[4].rows}
    assert exact["h = 0.2, k = 1"] == "4/9"
    assert exact["h = 0, k = 1"] == "8/19"
    assert exact["h = 0, k = 0.8"] == "1/2"
    json.dumps(result.data, allow_nan=False)


def test_refusals(study):
    with pytest.raises(ModelError, match="points = 1"):
        modulators.run(points=1)
    noise = np.random.default_rng(0).integers(-1, 2, 400).astype(float)
    track = study.endings[1.0]
    with pytest.raises(ModelError, match="no period"):
        modulators.ending_word(modulators.Track(track.t, track.r, noise, track.wanted, track.given))


def test_explorer_redraws_when_a_slider_moves():
    from matplotlib.figure import Figure

    figure = Figure()
    sliders = map_explorer(figure, points=12)
    axis = figure.axes[0]
    first, title = axis.images[0].get_array().copy(), axis.get_title()
    sliders["h"].set_val(0.5)
    assert not np.array_equal(axis.images[0].get_array(), first)
    sliders["h"].set_val(0.0)
    assert np.array_equal(axis.images[0].get_array(), first)
    assert axis.get_title() == title
    quiet = explored(modulators.PAPER, r=0.0, points=12).quiet.mean()
    assert title == f"proven quiet: {100 * quiet:.1f} % of the map"
    with pytest.raises(ModelError, match="points = 1"):
        map_explorer(Figure(), points=1)
