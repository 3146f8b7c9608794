"""Study and command of the jet loop: printed numbers, the quiet loop, one JSON object, clear refusals."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import Run

from models.flexible_loop import FLEXIBLE_001, Mode
from models.modulators import SchmittTrigger
from ocp.jet_design import JetLimits
from studies import jetloop


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "jetloop")


@pytest.fixture(scope="module")
def study() -> jetloop.JetLoopStudy:
    return jetloop.run(loops=1000)


def test_the_tuned_loop_is_quiet(study: jetloop.JetLoopStudy) -> None:
    assert study.quieter >= 5
    assert abs(study.design.amplitude_change) < 0.01
    assert len(study.before.runs) == len(study.after.runs) == 4
    assert all(run.t[-1] == 4000.0 and run.status.ok for run in (*study.before.runs, *study.after.runs))
    assert study.before.orbits
    assert not any(orbit.stable for orbit in study.before.orbits)
    assert len(study.after.orbits) == 1
    assert study.after.orbits[0].stable
    assert max(study.after.peaks) == pytest.approx(study.after.orbits[0].peak(study.after.loop.flexible), rel=0.02)
    assert study.bounds.broken == 0


def test_the_two_pulses_of_the_quiet_orbit_cancel_in_the_mode(study: jetloop.JetLoopStudy) -> None:
    """They are half a period of the mode apart; after the second one there is a tenth of what the first one leaves."""
    orbit = study.after.orbits[0]
    gap = orbit.times[2] - orbit.times[0]
    half = math.pi / 0.45
    assert min(gap, orbit.period / 2 - gap) == pytest.approx(half, rel=0.02)


def test_the_report_of_the_study(study: jetloop.JetLoopStudy) -> None:
    result = study.result()
    assert [item.name for item in result.figures] == [
        "jetloop_phase", "jetloop_resonance", "jetloop_nyquist", "jetloop_quiet", "jetloop_orbits", "jetloop_bounds",
    ]  # fmt: skip
    assert all(row.met is not False for row in result.comparisons)
    judged = [row for row in result.comparisons if row.tolerance is not None]
    assert [row.paper for row in judged] == [0.4298, 0.4281, 0.45]
    json.dumps(result.data, allow_nan=False)
    tight = result.data["theorem_2_random_loops"]
    assert tight["broken"] == 0
    assert tight["lower_over_absolute_difference"]["median"] > 0.999


def test_a_loop_with_another_mode_is_tuned_too() -> None:
    """Heavier, faster, less damped: the figures of merit are those of the orbit that is left."""
    modes = (Mode(0.5, complex(-0.004, 0.9)),)
    design, before, after = jetloop.designed(
        SchmittTrigger(0.5, 0.2), a=0.3, tau=0.5, modes=modes, width=0.2, limits=JetLimits(pulse_min=0.3)
    )
    assert abs(design.amplitude_change) < 1e-9
    assert max(after.peaks) < min(before.peaks) / 3


def test_the_command_prints_the_numbers(run: Run) -> None:
    code, out, err = run("--a", 0.15, "--u-on", 0.7, "--u-off", 0.3, "--tau", 0.7, "--json")
    data = json.loads(out)
    assert (code, err) == (0, "")
    found = [data[key] for key in ("w_exact", "w_df", "A_df_trigger", "A_exact")]
    assert found == pytest.approx([0.429794, 0.428128, 0.870529, 0.772109], abs=5e-7)
    assert data["w_df_reason"] is None
    assert json.loads(run("--json")[1]) == data
    bounds = data["theorem_2"]
    assert bounds["lower_abs"] <= abs(bounds["difference"]) <= bounds["upper"]


def test_no_intersection_is_null_with_its_reason(run: Run) -> None:
    code, out, _ = run("--tau", 2, "--json")
    data = json.loads(out)
    assert code == 0
    assert (data["w_df"], data["A_df_trigger"], data["theorem_2"]) == (None, None, None)
    assert "no intersection" in data["w_df_reason"]
    assert data["w_exact"] == pytest.approx(math.pi * 0.15 * 0.4 * 2 / (0.16 + 2 * 0.15 * 4))
    code, out, err = run("--tau", 2)
    assert code == 0
    assert "no intersection" in err
    data = json.loads(run("--u-off", 0.7, "--json")[1])
    assert data["w_exact"] is None
    assert "hysteresis" in data["w_exact_reason"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--u-off", 0.8), "u_off = 0.8"),
        (("--u-off", -0.1), "u_off = -0.1"),
        (("--a", "nan"), "a: expected a finite number"),
        (("--a", 0), "a = 0"),
        (("--tau", -1), "tau = -1"),
        (("--u-on", -1, "--u-off", -2), "u_on"),
        (("df", "--delay", 2), "sample"),
        (("exact", "--bias", 2), "--bias"),
        (("exact", "--bias", "nan"), "--bias"),
        (("simulate", "--mode", "1,2"), "--mode"),
        (("simulate", "--mode", "1,1,1"), "pole"),
        (("simulate", "--x0", "a"), "--x0"),
        (("simulate", "--x0", "1,2,3,4,5"), "--x0"),
        (("simulate", "--t-max", 0), "t_max"),
        (("simulate", "--t-max", "nan"), "t_max"),
        (("design", "--pulse-min", -1), "pulse_min"),
        (("design", "--width", 2), "width"),
    ],
)
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_wrong_input_is_refused_in_one_line(run: Run, arguments: tuple[object, ...], text: str, form: tuple[str, ...]) -> None:
    code, out, err = run(*arguments, *form)
    assert (code, out) == (2, "")
    assert text in err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1


def test_df_and_exact(run: Run) -> None:
    data = json.loads(run("df", "--json")[1])["intersections"]
    assert [(p["w"], p["A"]) for p in data] == [pytest.approx((0.4281275694, 0.8705285132), rel=1e-8)]
    assert data[0]["stability"] == "stable"
    code, out, _ = run("exact", "--json", "--delay", 2, "--ts", 0.05)
    (orbit,) = json.loads(out)["orbits"]
    assert code == 0
    assert orbit["stable"]
    assert orbit["w"] == pytest.approx(0.42153, abs=1e-5)
    code, out, _ = run("exact", "--bias", 0.1)
    assert code == 0
    assert "0.42445" in out.replace("│", "").replace(" ", "").replace("\n", "") or "0.4244" in out


def test_simulate_and_design(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("simulate", "--rigid", "--t-max", 600, "--json", "--out", "figures")
    data = json.loads(out)
    assert (code, data["status"]) == (0, "OK")
    assert data["w"] == pytest.approx(0.4297944, rel=1e-4)
    assert data["max_attitude"] == pytest.approx(0.7721088, rel=1e-4)
    assert (tmp_path / "figures" / "jetloop.png").read_bytes()[:4] == b"\x89PNG"
    code, out, _ = run("design", "--json")
    data = json.loads(out)
    assert code == 0
    assert data["quieter"] >= 5
    assert abs(data["amplitude_change"]) <= 0.01
    assert [orbit["stable"] for orbit in data["after"]["orbits"]] == [True]
    assert data["before"]["orbits"]


def test_starts_grow_with_the_thresholds() -> None:
    from models.flexible_loop import jet_plant

    small = jetloop.starts(jet_plant(0.15, tau=0.7, modes=FLEXIBLE_001), SchmittTrigger(0.7, 0.3))
    assert small[0] == pytest.approx([0.5, 0.1, 0, 0])
    large = jetloop.starts(jet_plant(0.15, tau=0.7, modes=FLEXIBLE_001), SchmittTrigger(7.0, 3.0))
    assert large[:, 0] == pytest.approx(10 * small[:, 0])
    assert np.isfinite(large).all()
