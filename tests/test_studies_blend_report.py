"""Figures and texts of the blending study: what they say is what was flown."""

from dataclasses import replace

import numpy as np
import pytest

from allocation.blending import Handover
from studies import blend, blend_design, blend_loop, blend_report

SHORT = blend_loop.LoopSettings(duration_s=30.0)


@pytest.fixture(scope="module")
def study():
    return blend.run()


def test_propellant_of_jets_that_do_not_work_is_not_drawn(study):
    loop = study.loop
    short = replace(loop, settings=SHORT)
    for changes in ({}, {"up_share": 0.5}, {"down_share": 0.25}):
        flight = blend_loop.fly(short, np.array(list(blend_design.START.values())), short.parameters(changes))
        assert blend_report.used(flight)[-1] == pytest.approx(flight.end["propellant"], rel=1e-9)
        assert flight.end["propellant"] > 1.0


def labels(axis):
    return [text.get_text() for text in axis.get_legend().get_texts()]


def test_figures_say_what_they_show(study):
    top = blend_report.window_figure(study).axes[0]
    assert top.get_title(loc="left").endswith("error: nominal")
    assert [text.get_text() for text in top.texts] == ["$q_1$", "$q_2$"]
    changed = replace(study, changes={"Cm_factor": 1.1}, stress={"stress +2 deg": study.flight, "stress -2 deg": study.flight})
    figure = blend_report.window_figure(changed)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles[0].endswith("error: this flight")
    assert titles[1].endswith("stress −2 deg")
    assert labels(figure.axes[2]) == ["elevon", "trim", "control term"]
    stressed = blend_report.stress_figure(changed)
    assert not any("-2" in axis.get_title(loc="left") for axis in stressed.axes)
    assert [text.get_text() for text in stressed.axes[1].texts] == ["$q_1$", "$q_2$"]
    assert labels(blend_report.flight_figure(study).axes[6]) == ["elevon", "trim"]
    (legend,) = blend_report.trim_figure(study).legends
    assert [text.get_text() for text in legend.get_texts()] == ["flight", "no trim, or beyond the tables"]


def test_texts_name_the_handover_that_was_flown():
    found = blend.run(handover=Handover(q1=600.0, q2=2200.0), settings=SHORT).result()
    assert "q1 = 600 to q2 = 2200 Pa" in found.lead
    said = [row.quantity + row.why for row in found.comparisons]
    assert any("pulses above 2200 Pa" in text for text in said)
    assert not any("2500" in text or "1 kPa" in text for text in (*said, found.lead))
