"""Equation 20: printed pieces, limits, NumPy against CasADi bit for bit, what it over-delivers below its floor."""

import casadi as ca
import numpy as np
import pytest

from allocation import blending
from allocation.blending import Handover
from models.checked import ModelError, evaluate

DEG = np.pi / 180
LITERAL = Handover(rcs_inhibit_above_q2=False)


def test_printed_pieces():
    # k_de(1750) = 1/2: limits -16.5 and 9 deg
    elevon, k_blend = blending.share_arrays([20 * DEG, -20 * DEG, 5 * DEG, 0.25 * DEG], 1750.0, 0.0)
    assert elevon / DEG == pytest.approx([9, -16.5, 5, 0.25])
    assert k_blend == pytest.approx([1 - 9 / 20, 1 - 16.5 / 20, 0, 0.5])
    assert blending.share_arrays(3 * DEG, 900.0, 0.0)[0] == 0
    assert blending.share_arrays(3 * DEG, 900.0, 0.0)[1] == 1


@pytest.mark.parametrize(("qbar", "share"), [(0, 0), (1000, 0), (1001.5, 0.001), (2500, 1), (9000, 1)])
def test_authority(qbar, share):
    q = ca.SX.sym("q")
    assert float(ca.Function("k", [q], [blending.authority(q, q1=1000.0, q2=2500.0)])(qbar)) == pytest.approx(share, abs=1e-12)


def test_trim_takes_from_the_limits_and_zero_stays_inside():
    elevon, _ = blending.share_arrays([-30 * DEG, 30 * DEG], 3000.0, [-28 * DEG, 15 * DEG])
    assert elevon / DEG == pytest.approx([-5, 3])
    beyond, k_blend = blending.share_arrays([-2 * DEG, 2 * DEG], 2400.0, [-35 * DEG, -35 * DEG])
    assert beyond[0] == 0  # the trim is beyond its stop: nothing is left on that side
    assert beyond[1] == pytest.approx(2 * DEG)
    assert k_blend == pytest.approx([1, 0])


def test_no_jets_above_q2_unless_literal():
    args = (0.2 * DEG, 2600.0, 0.0)
    assert blending.share_arrays(*args)[1] == 0
    assert blending.share_arrays(*args, handover=LITERAL)[1] == pytest.approx(0.6)


def test_over_delivery_below_the_floor():
    demand = np.linspace(-0.5, 0.5, 401) * DEG
    elevon, k_blend = blending.share_arrays(demand, 3000.0, 0.0, handover=LITERAL)
    excess = np.abs(elevon + k_blend * demand) - np.abs(demand)
    assert excess == pytest.approx(np.abs(elevon) * (1 - np.abs(demand) / (0.5 * DEG)), abs=1e-15)
    assert excess.max() == pytest.approx(0.125 * DEG, rel=1e-9)


def states(count, seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.2, count), rng.uniform(-100, 4000, count), rng.uniform(-0.7, 0.5, count)


@pytest.mark.parametrize("handover", [Handover(), LITERAL, Handover(q1=300.0, q2=700.0, lower=-0.1, upper=0.3, floor=0.02)])
def test_numpy_and_casadi_are_equal_bit_for_bit(handover):
    demand, qbar, trim = states(20_000)
    one = np.ones((len(demand), 1))
    columns = [v[:, None] for v in (demand, qbar, trim)]
    elevon, duty, k_blend = evaluate(blending.paper(handover), *columns, -1e6 * one, 2.6e5 * one, -2.5e5 * one, 0 * one)
    same = blending.share_arrays(demand, qbar, trim, handover=handover)
    assert np.array_equal(elevon[:, 0], same[0])
    assert np.array_equal(k_blend[:, 0], same[1])
    moment = k_blend[:, 0] * (-1e6 * demand)
    assert duty[:, 0] == pytest.approx(np.where(moment > 0, moment / 2.6e5, moment / 2.5e5), rel=1e-14)


def test_moments_add_up_above_the_floor():
    demand, qbar, trim = states(5000, seed=4)
    elevon, k_blend = blending.share_arrays(demand, qbar, trim, handover=LITERAL)
    large = np.abs(demand) >= 0.5 * DEG
    assert (elevon + k_blend * demand)[large] == pytest.approx(demand[large], rel=1e-12)
    assert ((k_blend >= 0) & (k_blend <= 1)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"q1": 2500.0}, "q1 < q2"), ({"lower": 0.1}, "contain zero"), ({"floor": 0.0}, "floor"), ({"q2": np.nan}, "finite")],
)
def test_bad_parameters_are_refused(changes, message):
    with pytest.raises(ModelError, match=message):
        Handover(**changes)


def test_nan_is_refused():
    with pytest.raises(ModelError, match="qbar"):
        blending.share_arrays(0.1, np.nan, 0.0)
