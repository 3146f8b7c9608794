"""Comparison of methods: metrics by hand, user's own allocator, rates, failures, samples, pulses."""

from dataclasses import replace

import numpy as np
import pytest

from allocation import compare, methods, qp
from allocation.compare import user_method
from allocation.core import Effectors
from allocation.demand_history import History
from models.checked import ModelError

DEMAND = np.array([[0.4], [1.0], [-0.9], [0.0], [0.2], [-3.0]])


def pitch(**changes):
    e = Effectors(("elevon", "up", "down"), [[-2.0, 1.0, -1.0]], [-0.3, 0, 0], [0.2, 1, 1], axes=("M",), flow=[0, 2, 2], **changes)
    return History(effectors=e, dt=0.5, demand=DEMAND).weighted()


def elevon_first(effectors, demand, previous):
    low, high = effectors.lower, effectors.upper
    elevon = np.clip(demand[0] / effectors.B[0, 0], low[0], high[0])
    rest = demand[0] - effectors.B[0, 0] * elevon
    return np.array([elevon, max(rest, 0.0), max(-rest, 0.0)])


def test_numbers_of_a_users_method_by_hand():
    found = compare.compare(pitch(), [user_method("mine", elevon_first)])["mine"]
    u = np.array([[-0.2, 0, 0], [-0.3, 0.4, 0], [0.2, 0, 0.5], [0, 0, 0], [-0.1, 0, 0], [0.2, 0, 1]])
    assert found.u == pytest.approx(u, abs=1e-12)
    assert found.residual[-1] == pytest.approx([-1.6])
    assert found.rms == pytest.approx(np.sqrt((1.6 / 3) ** 2 / 6))
    assert found.worst == pytest.approx(1.6 / 3)
    assert found.propellant == pytest.approx(2 * (0.4 + 0.5 + 1) * 0.5)
    assert found.travel == pytest.approx(0.1 + 0.5 + 0.2 + 0.1 + 0.3)
    assert np.isnan(found.worst_kkt)
    assert found.microseconds > 0


def test_pulses_fire_when_the_sum_of_duties_rounds_up():
    assert compare.pulses(np.array([[0.2], [0.4], [0.1], [1.0], [1.0], [0.0], [0.3], [0.4]])) == 2
    assert compare.pulses(np.array([[0.6], [0.0]])) == 1
    assert compare.pulses(np.zeros((5, 2))) == 0
    assert compare.pulses(np.ones((5, 3))) == 3


def test_all_methods_on_one_history():
    table = compare.compare(pitch(), methods.standard(solvers=("osqp", "daqp", "lsq_linear"), slow=6, bound_samples=6))
    own = table["QP (own)"]
    assert own.worst_kkt < 1e-9
    assert own.unsolved == 0
    for name in ("QP (osqp)", "QP (daqp)", "QP (lsq_linear)", "redistributed"):
        assert table[name].rms == pytest.approx(own.rms, rel=1e-4)
    assert table["pseudo-inverse"].rms > 1.1 * own.rms
    assert table["on-off bound (MILP)"].unsolved == 0
    names = [row[0] for row in table.rows()]
    assert names[0] == "QP (own)"
    assert all(len(row) == len(compare.COLUMNS) for row in table.rows())
    assert "QP (own)" in table._repr_html_()
    assert len(table.plot().axes) == 2
    with pytest.raises(ModelError, match="no method 'magic'"):
        table["magic"]


def test_figure_names_the_unit():
    labels = [ax.get_ylabel() for ax in compare.compare(pitch(unit="N m"), [methods.own()]).plot().axes]
    assert labels == ["M demand [N m]", "M unmet [N m]"]
    assert [ax.get_ylabel() for ax in compare.compare(pitch(), [methods.own()]).plot().axes] == ["M demand", "M unmet"]


def test_on_off_bound_fires_no_jets_against_each_other():
    e = Effectors(("elevon", "up", "down"), [[-1e3, 2.67e5, -2.53e5]], [-0.3, 0, 0], [0.2, 1, 1], flow=[0, 8, 8])
    history = History(effectors=e, dt=0.06, demand=np.array([[1.3e4], [2.5e5], [-2.5e5]]), axis_weight=np.ones((3, 1)),
                      effector_weight=np.ones((3, 3)))  # fmt: skip
    assert compare.compare(history, [methods.on_off_bound()]).outcomes[0].u[:, 1:].tolist() == [[0, 0], [1, 0], [0, 1]]
    both = compare.compare(history, [methods.on_off_bound(opposed=True)]).outcomes[0]
    assert both.u[:, 1:].tolist() == [[1, 1], [1, 0], [0, 1]]
    dear = compare.compare(history.part(slice(0, 1)), [methods.on_off_bound(opposed=True)]).outcomes[0]
    assert dear.propellant == pytest.approx(2 * 8 * 0.06)


def test_rates_bind_every_method():
    slow = pitch(rate=[0.2, np.inf, np.inf])
    table = compare.compare(
        slow, [user_method("mine", elevon_first), methods.own(), methods.backend("daqp"), methods.pseudo("redistributed")]
    )
    for outcome in table.outcomes:
        assert np.abs(np.diff(outcome.u[:, 0])).max() <= 0.2 * 0.5 + 1e-9
    assert table["QP (daqp)"].u == pytest.approx(table["QP (own)"].u, abs=1e-5)


def test_failures_priorities_and_parts():
    moving = replace(pitch(), lower=np.tile([-0.3, 0, 0], (6, 1)), upper=np.tile([0.2, 1, 1], (6, 1)))
    for names in (["up"], (name for name in ["up"]), {"up": None}):
        assert moving.failed(names).upper.tolist() == [[0.2, 0, 1]] * 6
    assert moving.failed({"elevon": 0.1}).lower[:, 0].tolist() == [0.1] * 6
    broken = pitch().failed(["up"])
    assert compare.compare(broken, [methods.own()])["QP (own)"].u[:, 1].max() == 0
    jammed = pitch().failed({"elevon": 0.1})
    assert compare.compare(jammed, [methods.own()])["QP (own)"].u[:, 0] == pytest.approx(np.full(6, 0.1))
    part = pitch().part(np.array([1, 3]))
    assert part.demand.tolist() == [[1.0], [0.0]]
    dear = pitch().weighted(cost={"elevon": 1e4})
    assert np.abs(compare.compare(dear, [methods.own()])["QP (own)"].u[0, 0]) < 1e-3


def test_slow_methods_get_a_part():
    one = compare.compare(pitch(), [user_method("mine", elevon_first, most=3)])["mine"]
    assert one.samples.tolist() == [0, 2, 5]
    assert one.pulses is None
    limited = compare.compare(pitch(rate=[0.2, np.inf, np.inf]), [user_method("mine", elevon_first, most=2)])["mine"]
    assert limited.samples.tolist() == [4, 5]  # in one piece, around the largest demand


@pytest.mark.parametrize("rate", [[np.inf] * 3, [0.2, np.inf, np.inf]])
def test_all_methods_on_the_same_samples(rate):
    history = pitch(rate=rate)
    both = compare.compare(history, [user_method("all", elevon_first), user_method("few", elevon_first, most=3)])
    whole, few = both.outcomes
    assert (len(whole.samples), len(few.samples)) == (6, 3)
    assert [o.name for o in both.same] == ["all", "few"]
    assert both.same[1] is few
    assert both.same[0].samples.tolist() == few.samples.tolist()
    assert np.array_equal(both.same[0].u, few.u)  # as a history of their own, which begins at rest
    assert both.rows(same=True)[0][1:4] == both.rows(same=True)[1][1:4]
    assert both._repr_html_().count("<table") == 2
    alone = compare.compare(history, [user_method("all", elevon_first)])
    assert alone.same == alone.outcomes
    assert alone._repr_html_().count("<table") == 1


def test_effectiveness_may_change_with_time():
    e = pitch().effectors
    B = np.array([[[-2.0 - k, 1.0, -1.0]] for k in range(6)])
    moving = History(effectors=e, dt=0.5, demand=DEMAND, B=B, lower=np.tile(e.lower, (6, 1)), upper=np.tile(e.upper, (6, 1))).weighted()
    table = compare.compare(moving, [methods.own(), user_method("mine", elevon_first), methods.backend("daqp"), methods.horizon()])
    assert table["QP (own)"].residual == pytest.approx(table["mine"].residual, abs=1e-4)
    assert table["QP (daqp)"].u == pytest.approx(table["QP (own)"].u, abs=1e-6)
    assert qp.allocate(moving.at(4), DEMAND[4]).residual == pytest.approx(table["QP (own)"].residual[4], abs=1e-6)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda e, v, u: np.zeros(2), r"mine: returned shape \(2,\) at sample 0"),
        (lambda e, v, u: np.full(3, np.nan), r"mine: u at sample 0\[0\]"),
    ],
)
def test_bad_answers_of_a_user_are_refused(function, message):
    with pytest.raises(ModelError, match=message):
        compare.compare(pitch(), [user_method("mine", function)])


def test_bad_histories_and_methods_are_refused():
    e = pitch().effectors
    with pytest.raises(ModelError, match="dt must be > 0"):
        History(effectors=e, dt=0.0, demand=DEMAND)
    with pytest.raises(ModelError, match="demand has shape"):
        History(effectors=e, dt=0.1, demand=DEMAND[0])
    with pytest.raises(ModelError, match="upper has shape"):
        History(effectors=e, dt=0.1, demand=DEMAND, upper=np.ones((2, 3)))
    with pytest.raises(ModelError, match="context qbar"):
        History(effectors=e, dt=0.1, demand=DEMAND, context={"qbar": np.ones(2)})
    with pytest.raises(ModelError, match="got no methods"):
        compare.compare(pitch(), [])
    with pytest.raises(ModelError, match="different names"):
        compare.compare(pitch(), [methods.own(), methods.own()])
    with pytest.raises(ModelError, match="no demand_rad in the context"):
        compare.compare(pitch(), [methods.paper_logic()])
    three = History(effectors=Effectors(("a", "b", "c"), np.eye(3), -np.ones(3), np.ones(3)), dt=0.1, demand=np.ones((2, 3)))
    with pytest.raises(ModelError, match="got 3 axes"):
        compare.compare(three, [methods.paper_logic()])
