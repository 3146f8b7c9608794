"""Design of jet loops: against brute force over all parameters, the bands it must keep, and what it refuses."""

import math

import numpy as np
import pytest

from models.checked import ModelError, Status
from models.flexible_loop import FLEXIBLE_001, Mode
from models.limit_cycles import symmetric_cycle
from models.modulators import SchmittTrigger
from ocp.jet_design import Band, DesignError, JetLimits, bands_around, design_trigger

PAPER = SchmittTrigger(0.7, 0.3)
A, TAU = 0.15, 0.7
BANDS = bands_around(FLEXIBLE_001)


def outside(w, bands, harmonics):
    return all(not band.low < n * w < band.high for band in bands for n in harmonics)


def brute_force(amplitude, bands, limits, count=200_000):
    """Least duty among random triggers of the wanted amplitude: u_off and the pulse are drawn, tau and u_on follow."""
    rng = np.random.default_rng(11)
    pulse = rng.uniform(limits.pulse_min, 6.0, count)
    r = 0.5 * A * pulse
    s = 2 * amplitude - r**2 / A
    h = s * rng.uniform(0, 1, count)
    ok = (s > 0) & (h >= limits.hysteresis_min)
    u_on, tau = (s + h) / 2, h / (2 * r)
    period = 2 * (2 * r / A + s / r)
    w = 2 * math.pi / period
    ok &= (np.abs(r - A * tau) / (r + A * tau) <= limits.contraction) & (u_on <= limits.u_on_max) & (tau <= limits.tau_max)
    for band in bands:
        for n in limits.harmonics:
            ok &= (n * w <= band.low) | (n * w >= band.high)
    return float((4 * r / (A * period))[ok].min())


@pytest.mark.parametrize(
    "limits",
    [
        JetLimits(),
        JetLimits(pulse_min=1.0, harmonics=(1, 3, 5)),
        JetLimits(pulse_min=1.8),
        JetLimits(pulse_min=0.3, hysteresis_min=0.2, contraction=0.9),
        JetLimits(pulse_min=1.0, tau_max=0.35, contraction=0.6),
    ],
)
def test_no_other_trigger_fires_less(limits):
    found = design_trigger(PAPER, a=A, tau=TAU, bands=BANDS, limits=limits)
    cycle = symmetric_cycle(found.trigger, a=A, tau=found.tau)
    assert cycle.amplitude == pytest.approx(symmetric_cycle(PAPER, a=A, tau=TAU).amplitude, rel=1e-9)
    assert abs(found.amplitude_change) < 1e-9
    assert cycle.pulse >= limits.pulse_min * (1 - 1e-9)
    assert math.sqrt(cycle.multiplier) <= limits.contraction + 1e-9
    assert found.trigger.h >= limits.hysteresis_min - 1e-9
    assert found.tau <= limits.tau_max * (1 + 1e-9)
    assert outside(cycle.w * (1 - 1e-9), BANDS, limits.harmonics) or outside(cycle.w * (1 + 1e-9), BANDS, limits.harmonics)
    best = brute_force(cycle.amplitude, BANDS, limits)
    assert cycle.duty <= best * (1 + 1e-9)
    assert cycle.duty == pytest.approx(best, rel=0.1)  # so near do random draws come
    assert found.violation < 1e-7
    assert abs(found.optimality) < 1e-6


def test_the_default_design_settles_in_one_pulse():
    found = design_trigger(PAPER, a=A, tau=TAU, bands=BANDS)
    assert found.cycle.pulse == pytest.approx(0.5, rel=1e-8)
    assert found.tau == pytest.approx(0.25, rel=1e-8)  # r/a: half a pulse
    assert found.cycle.multiplier < 1e-12
    assert (found.trigger.u_on, found.trigger.u_off) == pytest.approx((0.7767963, 0.7580463), abs=1e-6)
    assert found.cycle.duty < 0.03 * found.before.duty


def test_another_amplitude_can_be_asked_for():
    found = design_trigger(PAPER, a=A, tau=TAU, bands=BANDS, amplitude=0.4)
    assert found.cycle.amplitude == pytest.approx(0.4, rel=1e-9)


def test_modes_and_bands():
    two = bands_around([*FLEXIBLE_001, Mode(0.1, -0.02 + 2j)], width=0.1)
    assert [edge for band in two for edge in (band.low, band.high)] == pytest.approx([0.405, 0.495, 1.8, 2.2])
    found = design_trigger(PAPER, a=A, tau=TAU, bands=two, limits=JetLimits(harmonics=(1, 3, 5, 7)))
    assert outside(found.cycle.w, two, (1, 3, 5, 7))
    assert (np.diff(found.excluded.ravel()) > 0).all()


def test_what_cannot_be_designed():
    with pytest.raises(DesignError, match="pulses of at least 8") as error:
        design_trigger(PAPER, a=A, tau=TAU, bands=BANDS, limits=JetLimits(pulse_min=8.0))
    assert error.value.status is Status.INFEASIBLE
    with pytest.raises(DesignError, match="outside the bands"):
        design_trigger(PAPER, a=A, tau=TAU, bands=[Band(1e-4, 9.0)])
    for make in (
        lambda: Band(0.5, 0.4), lambda: Band(-1.0, 0.4), lambda: JetLimits(pulse_min=0.0), lambda: JetLimits(pulse_min=math.nan),
        lambda: JetLimits(contraction=1.0), lambda: JetLimits(harmonics=()), lambda: JetLimits(hysteresis_min=-1.0),
        lambda: bands_around(FLEXIBLE_001, width=1.5),
        lambda: design_trigger(PAPER, a=math.nan, tau=TAU, bands=BANDS), lambda: design_trigger(PAPER, a=A, tau=-1.0, bands=BANDS),
        lambda: design_trigger(PAPER, a=A, tau=TAU, bands=BANDS, amplitude=-1.0),
        lambda: design_trigger(SchmittTrigger(0.7, 0.7), a=A, tau=TAU, bands=BANDS),
    ):  # fmt: skip
        with pytest.raises(ModelError):
            make()
