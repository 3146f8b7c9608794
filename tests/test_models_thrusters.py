"""Thruster sets: moments about any centre of mass, symmetry, rank, failures; the orbiter's jets; elevons and flap on three axes."""

import numpy as np
import pytest

from models import thrusters
from models.checked import ModelError
from models.thrusters import ThrusterSet, orbiter_jets

FIELDS = {"t_on_min": 0.08, "delay_on": 0.0, "delay_off": 0.0, "isp": 280.0}


def pair(**changes):
    given = {
        "names": ("left", "right"), "position": [[-3.0, -2.0, 0.5], [-3.0, 2.0, 0.5]], "direction": [[0, 0.6, 0.8], [0, -0.6, 0.8]],
        "thrust": [100.0, 100.0], "manifold": ("A", "B"), "kind": ("primary", "primary"), **FIELDS,
    }  # fmt: skip
    return ThrusterSet(**(given | changes))


def test_moment_by_hand_about_two_centres():
    B = pair().effectiveness()
    # r = (-3, -2, 0.5), F = (0, 60, 80): r x F = (-2*80 - 0.5*60, 0.5*0 + 3*80, -3*60)
    assert B[:, 0] == pytest.approx([0, 60, 80, -190, 240, -180])
    assert B[:, 1] == pytest.approx([0, -60, 80, 190, 240, 180])
    moved = pair().effectiveness([-3.0, 0.0, 0.5])
    assert moved[3:, 0] == pytest.approx([-160, 0, 0])
    cg = np.array([0.3, -0.2, 0.7])
    assert pair().effectiveness(cg)[3:] == pytest.approx(B[3:] - np.cross(cg, pair().force).T)


def test_flow_symmetry_rank():
    jets = pair()
    assert jets.flow == pytest.approx(100 / (280 * 9.80665))
    assert jets.mirrored() == {"left": "right", "right": "left"}
    assert jets.rank() == 2
    assert jets.rank(axes=("M",)) == 1
    with pytest.raises(ModelError, match="left has no mirror image; the nearest, right"):
        pair(thrust=[100.0, 101.0]).mirrored()
    with pytest.raises(ModelError, match="unknown name 'pitch'"):
        jets.rank(axes=("pitch",))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"direction": [[0, 0.6, 0.9], [0, -0.6, 0.8]]}, "left: direction has length"),
        ({"thrust": [100.0, -1.0]}, "right: thrust -1"),
        ({"t_on_min": -0.1}, "a time is negative"),
        ({"position": np.zeros((3, 3))}, r"position has shape \(3, 3\)"),
        ({"names": ("left", "left")}, "different names"),
        ({"manifold": ("A",)}, "1 entries of manifold"),
        ({"isp": np.nan}, "finite"),
    ],
)
def test_bad_sets_are_refused(changes, message):
    with pytest.raises(ModelError, match=message):
        pair(**changes)


def test_the_orbiters_44_jets():
    jets = orbiter_jets()
    assert len(jets) == 44
    assert jets.kind.count("primary") == 38
    assert jets.kind.count("vernier") == 6
    assert jets.rank() == 6
    vernier = jets.pick([n for n, kind in zip(jets.names, jets.kind, strict=True) if kind == "vernier"])
    assert vernier.rank() == 5
    assert vernier.rank(axes=("L", "M", "N")) == 3
    mirror = jets.mirrored()
    assert all(mirror[mirror[name]] == name for name in jets.names)
    assert mirror["L2D"] == "R2D"
    assert mirror["F3U"] == "F3U"
    pitch = jets.effectiveness()[4]
    up = sum(pitch[jets.names.index(f"{side}{k}U")] for side in "LR" for k in (1, 2, 4))
    down = sum(pitch[jets.names.index(f"{side}{k}D")] for side in "LR" for k in (2, 3, 4))
    assert up / 1e3 == pytest.approx(267, abs=0.5)
    assert down / 1e3 == pytest.approx(-253, abs=0.5)


def test_failures_of_jets_and_manifolds():
    jets = orbiter_jets()
    left = jets.without(["F1F"], manifolds=["L2", "R5"])
    assert set(jets.names) - set(left.names) == {"F1F", "L2L", "L2U", "L2D", "R5R", "R5D"}
    assert left.effectiveness()[:, left.names.index("R1A")] == pytest.approx(jets.effectiveness()[:, jets.names.index("R1A")])
    with pytest.raises(ModelError, match="unknown name 'L9'"):
        jets.without(manifolds=["L9"])
    with pytest.raises(ModelError, match="unknown name 'X1U'"):
        jets.pick(["X1U"])


def test_elevons_and_flap():
    made = thrusters.elevons_and_flap(
        qbar=2000.0, area=250.0, chord=12.0, Cm_elevon=-0.3, Cm_flap=-0.1, CN_elevon=0.8, CA_elevon=0.1, arm=6.0,
        elevon=(-0.5, 0.3), flap=(-0.2, 0.4), rates=(0.35, 0.02),
    )  # fmt: skip
    together, apart = made.moments @ [1, 1, 0], made.moments @ [1, -1, 0]
    assert together == pytest.approx([0, 2000 * 250 * 12 * -0.3, 0])
    # left edge down, right edge up: the left wing rises (right wing down, L > 0) and is held back (nose left, N < 0)
    assert apart == pytest.approx([2000 * 250 * 0.8 * 6, 0, -2000 * 250 * 0.1 * 6])
    assert made.moments[:, 2] == pytest.approx([0, 2000 * 250 * 12 * -0.1, 0])
    force = np.array([-1.0, 0, -1.0])  # aft and up, at the left elevon
    assert np.sign(np.cross([0, -6.0, 0], force))[[0, 2]].tolist() == np.sign(made.moments[[0, 2], 0]).tolist()
    with pytest.raises(ModelError, match="qbar"):
        thrusters.elevons_and_flap(
            qbar=-1.0, area=1.0, chord=1.0, Cm_elevon=0, Cm_flap=0, CN_elevon=0, arm=1, elevon=(0, 1), flap=(0, 1), rates=(1, 1)
        )
