"""Models as frozen values: definition, names, parameters, and what a wrong definition is told."""

import casadi as ca
import numpy as np
import pytest

import models
from models.core import Model, ModelError, Var, define

POSITION, SPEED = Var("position", "m", 2.0, (-100.0, 100.0)), Var("speed", "m/s", 3.0)
FORCE, MASS, ENERGY = Var("force", "N"), Var("mass", "kg", 1.0, (0.1, 100.0)), Var("energy", "J")


def rhs(x, u, p):
    return {"position": x.speed, "speed": u.force / p.mass}


def out(x, u, p):
    return {"energy": p.mass * x.speed**2 / 2}


def cart(**changes):
    settings = {
        "name": "cart", "rhs": rhs, "states": [POSITION, SPEED], "inputs": [FORCE], "params": {MASS: 2.0}, "outputs": [ENERGY], "out": out,
    } | changes  # fmt: skip
    return define(settings.pop("name"), settings.pop("rhs"), **settings)


def test_rates_outputs_and_parameters():
    model = cart()
    assert model.xdot([1.0, 2.0], [3.0]) == pytest.approx([2.0, 1.5])
    assert model.xdot([1.0, 2.0], [3.0], {"mass": 6.0}) == pytest.approx([2.0, 0.5])
    assert model.y([1.0, 2.0], [3.0], [4.0]) == pytest.approx([8.0])
    batch = model.xdot([[1.0, 2.0], [1.0, 5.0]], [3.0], [[2.0], [4.0]])
    assert batch == pytest.approx(np.array([[2.0, 1.5], [5.0, 0.75]]))
    assert (model.index("speed"), model.index("force"), model.index("mass"), model.index("energy")) == (1, 0, 0, 0)


def test_states_by_name():
    model = cart()
    assert model.state(speed=2.0, position=1.0).tolist() == [1.0, 2.0]
    for values, text in (
        ({"speed": 1.0}, "missing position"),
        ({"speed": 1.0, "position": 0.0, "positon": 1.0}, "did you mean 'position'"),
        ({"speed": 1.0, "position": 1e6}, "position = 1e\\+06 m is outside"),
        ({"speed": [1.0], "position": 0.0}, "state: speed: expected one number"),
    ):
        with pytest.raises(ModelError, match=text):
            model.state(**values)


def test_other_default_parameters_make_another_model():
    model = cart()
    heavy = model.with_params(mass=8.0)
    assert (model.p0[0], heavy.p0[0]) == (2.0, 8.0)
    assert heavy.xdot([0.0, 1.0], [4.0])[1] == 0.5
    for changes, text in (
        ({"mas": 1.0}, "did you mean 'mass'"),
        ({"mass": -1.0}, "mass = -1 kg is outside"),
        ({"mass": [1.0, 2.0]}, "p: mass: expected one number"),
        ({"mass": np.nan}, "p: mass: expected a finite number"),
    ):
        with pytest.raises(ModelError, match=text):
            model.with_params(**changes)
        with pytest.raises(ModelError, match=text):
            model.xdot([0.0, 0.0], [0.0], changes)
    with pytest.raises(ModelError, match=r"p: expected shape"):
        model.xdot([0.0, 0.0], [0.0], [1.0, 2.0])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"rhs": lambda x, u, p: {"position": x.speed}}, "cart: rhs: no expression for speed"),
        ({"rhs": lambda x, u, p: rhs(x, u, p) | {"sped": 0}}, "cart: rhs: unknown name 'sped'; did you mean 'speed'"),
        (
            {"rhs": lambda x, u, p: {"position": ca.vertcat(x.speed, x.speed), "speed": 0}},
            r"position has shape \(2, 1\), expected a scalar",
        ),
        ({"rhs": lambda x, u, p: {"position": x.sped, "speed": 0}}, "unknown name 'sped'; did you mean 'speed'"),
        ({"rhs": lambda x, u, p: {"position": ca.SX.sym("wind"), "speed": 0}}, "position uses the symbol 'wind'"),
        ({"rhs": lambda x, u, p: {"position": ca.MX.sym("m"), "speed": 0}}, "position is MX"),
        ({"rhs": lambda x, u, p: {"position": "speed", "speed": 0}}, "position is str"),
        ({"rhs": lambda x, u, p: ca.vertcat(x.speed, 0)}, "expected {name: expression}, got SX"),
        ({"rhs": lambda x, u, p: [x.speed, 0]}, "got list"),
        ({"out": None}, "outputs are declared but no `out`"),
        ({"out": lambda x, u, p: {}}, "cart: out: no expression for energy"),
        ({"outputs": []}, "cart: out: unknown name 'energy'"),
        ({"name": "my cart"}, "letters, digits"),
        ({"name": "_cart"}, "letters, digits"),
        ({"name": "my__cart"}, "letters, digits"),
        ({"name": 3}, "letters, digits"),
        ({"states": [POSITION, SPEED, POSITION]}, "'position' is declared twice"),
        ({"states": [], "rhs": lambda x, u, p: {}, "out": lambda x, u, p: {"energy": 0}}, "at least one state"),
        ({"params": {MASS: -2.0}}, "mass = -2 kg is outside"),
        ({"params": {MASS: "2"}}, "expected real numbers"),
        ({"params": {MASS: [2.0, 3.0]}}, "params: expected shape"),
        ({"params": {MASS: float("nan")}}, "mass must be a finite number"),
        ({"outputs": [Var("speed", "m/s")], "out": lambda x, u, p: {"speed": x.speed}}, "'speed' names one of states and one of outputs"),
    ],
)
def test_wrong_definitions(changes, text):
    with pytest.raises(ModelError, match=text):
        cart(**changes)


def test_constant_and_sparse_expressions_are_dense():
    model = cart(rhs=lambda x, u, p: {"position": 0, "speed": 1.5})
    assert model.xdot([1.0, 1.0], [0.0]).tolist() == [0.0, 1.5]


def test_a_model_without_inputs_parameters_or_outputs():
    decay = define("decay", lambda x, u, p: {"a": -x.a}, states=[Var("a")])
    assert decay.xdot([2.0], []).tolist() == [-2.0]
    assert decay.xdot([[2.0], [3.0]], []).tolist() == [[-2.0], [-3.0]]
    assert decay.y([2.0], []).shape == (0,)
    assert decay.y([[2.0], [3.0]], []).shape == (2, 0)
    assert "decay" in decay._repr_html_()
    assert decay.plot() is not None


@pytest.mark.parametrize(
    ("inputs", "result", "text"),
    [
        ((3, 1, 1), (2, 1), r"takes inputs of sizes \(3, 1, 1\)"),
        ((2, 1), (2, 1), r"takes inputs of sizes \(2, 1\)"),
        ((2, 1, 1), (3, 1), r"returns \[\(3, 1\)\], declared is one column of 2"),
        ((2, 1, 1), (2, 2), r"returns \[\(2, 2\)\]"),
    ],
)
def test_functions_that_do_not_fit(inputs, result, text):
    good = cart()
    wrong = ca.Function("wrong", [ca.SX.sym("a", n) for n in inputs], [ca.SX.ones(*result)])
    with pytest.raises(ModelError, match=text):
        Model("cart", good.states, good.inputs, good.params, good.outputs, wrong, good.out, good.p0)


def test_a_model_is_frozen():
    model = cart()
    with pytest.raises(AttributeError):
        model.name = "other"
    with pytest.raises(ValueError, match="read-only"):
        model.p0[0] = 1.0
    with pytest.raises(ModelError, match="did you mean 'energy'"):
        model.index("enrgy")


def test_tables_for_people_escape_their_text():
    model = cart(source="<script>alert(1)</script>")
    page = model._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert all(name in page for name in ("position", "force", "mass", "energy"))


def test_the_figure_shows_what_depends_on_what():
    axes = models.entry_planar(models.SOYUZ).plot().axes[0]
    pattern = np.asarray(axes.images[0].get_array())
    # V gamma h s | lift_ratio: every rate but gamma's is free of the input, none depends on s
    assert pattern[:, 4].tolist() == [False, True, False, False]
    assert not pattern[:, 3].any()
    assert pattern[0, :3].all()
