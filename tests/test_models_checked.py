"""The checked numeric entry: every silent habit of CasADi is refused with the argument, the value and the expectation."""

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import models
from models.checked import ModelError, Status, Var, as_batch, as_finite, as_scalar, as_vector, evaluate, frozen, unknown_name

X, U, P = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("p", 1)
F = ca.Function("f", [X, U, P], [X * P[0] + ca.vertcat(U, U), ca.mtimes(X, U.T)], ["x", "u", "p"], ["a", "b"])
x, u, p = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.1, 0.2]), np.array([2.0])
STATES = (Var("V", "m/s", 7e3, (1.0, 2e4)), Var("gamma", "rad", 0.1, (-1.3, 1.3)), Var("h", "m", 1e5))


def a(values, inputs, factor):
    return values * factor + np.tile(inputs, 2)


# --- calls --------------------------------------------------------------------------------------------------------


def test_single_and_batch_calls():
    one, matrix = evaluate(F, x, u, p)
    assert one.shape == (4,)
    assert matrix.shape == (4, 2)
    assert one == pytest.approx(a(x, u, 2.0), rel=1e-15)
    assert matrix == pytest.approx(np.outer(x, u), rel=1e-15)
    batch = np.array([x, 2 * x, -x])
    many, matrices = evaluate(F, batch, u, p)
    assert many.shape == (3, 4)
    assert matrices.shape == (3, 4, 2)
    for i in range(3):
        assert many[i] == pytest.approx(a(batch[i], u, 2.0), rel=1e-15)
        assert matrices[i] == pytest.approx(np.outer(batch[i], u), rel=1e-15)
    rows, _ = evaluate(F, batch, np.array([u, 3 * u, u]), np.array([[1.0], [2.0], [3.0]]))
    assert rows[1] == pytest.approx(a(batch[1], 3 * u, 2.0), rel=1e-15)
    single, _ = evaluate(F, batch[:1], u, p)
    assert single.shape == (1, 4)  # a batch of one stays a batch


def test_square_batch_is_not_transposed():
    batch = np.arange(16.0).reshape(4, 4)
    assert evaluate(F, batch, u, p)[0][1] == pytest.approx(a(batch[1], u, 2.0))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((x, u), ["f", "3 arguments", "'p'", "got 2"]),  # CasADi: the missing one is silently zero
        ((x,), ["got 1"]),
        ((), ["got 0"]),
        ((x, u, p, p), ["got 4"]),
        ((np.float64(1.0), u, p), ["f: x", "(4,)", "()"]),  # CasADi: broadcast to all four
        ((np.array([1.0]), u, p), ["f: x", "(4,)", "(1,)"]),
        ((x[None].T, u, p), ["f: x", "(4,)", "(4, 1)"]),
        ((x[None, None], u, p), ["f: x", "(1, 1, 4)"]),
        ((np.ones((4, 3)), u, p), ["f: x", "(4, 3)"]),  # CasADi: mapped over columns
        ((x, u[None].T, p), ["f: u", "(2, 1)"]),
        ((x, u, np.array([])), ["f: p", "(0,)"]),
        ((x[:3], u, p), ["f: x", "(3,)"]),
        ((np.append(x, 5.0), u, p), ["f: x", "(5,)"]),
        ((np.array([1, math.nan, 3, 4]), u, p), ["f: x[1]", "nan"]),
        ((np.array([[1, 2, 3, 4], [1, 2, 3, math.inf]]), u, p), ["f: x[1][3]", "inf"]),
        ((x + 1j, u, p), ["f: x", "real numbers"]),
        ((["1", "2", "3", "4"], u, p), ["f: x", "real numbers"]),
        ((x, u, [None]), ["f: p", "real numbers"]),
        ((x > 2, u, p), ["f: x", "real numbers"]),
        ((X, u, p), ["f: x", "real numbers"]),
        (([[1, 2], [3]], u, p), ["f: x", "real numbers"]),
        ((np.ones((0, 4)), u, p), ["f: the batch is empty"]),
        ((np.ones((3, 4)), np.ones((2, 2)), p), ["f: u", "2 rows", "3"]),
        ((np.ma.masked_array(x, mask=[0, 1, 0, 0]), u, p), ["f: x", "real numbers"]),
    ],
)
def test_what_casadi_accepts_in_silence_is_refused(arguments, words):
    with pytest.raises(ModelError) as error:
        evaluate(F, *arguments)
    for word in words:
        assert word in str(error.value)


def test_matrix_inputs_are_refused():
    m = ca.SX.sym("m", 2, 3)
    function = ca.Function("g", [m], [2 * m])
    with pytest.raises(ModelError, match=r"g: i0: is a matrix \(2, 3\)"):
        evaluate(function, np.ones(2))  # CasADi: repeats the column


def test_results_that_are_not_finite_are_named():
    z = ca.SX.sym("z")
    function = ca.Function("root", [z], [ca.sqrt(z), 1 / z], ["z"], ["s", "q"])
    with pytest.raises(ModelError, match=r"root: output s is not finite \(row 2\)"):
        evaluate(function, np.array([[1.0], [4.0], [-1.0], [-2.0]]))
    with pytest.raises(ModelError, match="root: output q is not finite"):
        evaluate(function, np.array([0.0]))
    s, q = evaluate(function, np.array([[1.0], [-1.0]]), finite=False)
    assert np.isfinite(s[:, 0]).tolist() == [True, False]
    assert q[:, 0].tolist() == [1.0, -1.0]
    with pytest.raises(ModelError, match="expected a finite number"):
        evaluate(function, np.array([math.nan]), finite=False)


def test_functions_without_some_argument_or_output():
    empty = ca.SX(0, 1)
    function = ca.Function("h", [X, empty], [2 * X, empty, ca.SX(0, 4)], ["x", "u"], ["y", "nothing", "C"])
    y, nothing, c = evaluate(function, np.array([x, x, x]), np.zeros(0))
    assert y.shape == (3, 4)
    assert nothing.shape == (3, 0)
    assert c.shape == (3, 0, 4)
    y, nothing, c = evaluate(function, x, [])
    assert (y.shape, nothing.shape, c.shape) == ((4,), (0,), (0, 4))


MUTATIONS = st.sampled_from(
    [
        "drop",
        "extra",
        "shorter",
        "longer",
        "scalar",
        "column",
        "nan",
        "inf",
        "complex",
        "text",
        "none",
        "rows",
        "empty",
        "deep",
        "bool",
        "object",
    ]
)


def mutate(arguments, which, kind, place):
    value = np.asarray(arguments[which])
    out = list(arguments)
    if kind == "drop":
        return out[:which] + out[which + 1 :]
    if kind == "extra":
        return [*out, value]
    bad = value.astype(complex if kind == "complex" else float)
    if kind in ("nan", "inf"):
        bad.flat[place % bad.size] = {"nan": math.nan, "inf": -math.inf}[kind]
    out[which] = {
        "shorter": bad[..., :-1], "longer": np.append(bad, bad[..., :1], axis=-1), "scalar": float(np.real(bad.flat[0])),
        "column": bad[..., None] if bad.shape[-1] > 1 else bad[None, ..., None], "nan": bad, "inf": bad, "complex": bad,
        "text": [str(v) for v in bad], "none": None, "rows": np.ones((3, bad.size)) if bad.ndim == 1 else bad[:-1],
        "empty": np.ones((0, bad.shape[-1])), "deep": bad[None, None], "bool": bad > 0, "object": bad.astype(object),
    }[kind]  # fmt: skip
    if kind == "rows":
        out[(which + 1) % 3] = np.ones((2, np.asarray(arguments[(which + 1) % 3]).shape[-1]))
    return out


@settings(max_examples=600)
@given(which=st.integers(0, 2), kind=MUTATIONS, place=st.integers(0, 100), batch=st.booleans())
def test_no_mutation_of_a_call_is_silent(which, kind, place, batch):
    good = [np.array([x, x + 1, x + 2, x + 3]) if batch else x, u, p]
    bad = mutate(good, which, kind, place)
    with pytest.raises(ModelError) as error:
        evaluate(F, *bad)
    assert str(error.value).startswith("f:")
    assert evaluate(F, *good)[0].shape == ((4, 4) if batch else (4,))  # the good call after the bad one


@settings(max_examples=300)
@given(which=st.sampled_from(["x", "u", "p"]), kind=MUTATIONS, place=st.integers(0, 100))
def test_no_mutation_of_a_model_call_is_silent(which, kind, place):
    if kind in ("drop", "rows", "extra"):
        return  # the signature itself, and equal rows, are covered above
    model = models.entry_planar(models.SOYUZ)
    good = {"x": np.array([7e3, -0.02, 8e4, 1.0]), "u": np.array([0.3]), "p": model.p0}
    bad = dict(good)
    bad[which] = mutate([good["x"], good["u"], good["p"]], list("xup").index(which), kind, place)[list("xup").index(which)]
    if kind == "none" and which == "p":
        return  # None means the defaults
    with pytest.raises(ModelError):
        model.xdot(**bad)


# --- values -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, "3", None, [1.0], [[1.0]], 1j, True, np.array([1.0, 2.0])])
def test_scalars(value):
    with pytest.raises(ModelError, match="mass"):
        as_scalar("mass", value)
    assert as_scalar("mass", np.float32(2.0)) == 2.0


def test_a_lone_nan_is_not_finite():
    with pytest.raises(ModelError, match="a: expected a finite number, got nan"):
        as_finite("a", math.nan)


def test_vectors_name_their_component():
    assert as_vector("x0", [7e3, 0.0, 1e5], STATES).dtype == np.float64
    cases = [
        ([7e3, math.nan, 1e5], "x0: gamma must be a finite number, got nan"),
        ([7e3, -1.36, 1e5], r"x0: gamma = -1.36 rad .* \[-1.3, 1.3\].*degrees"),
        ([7.0e6, 0.0, 1e5], r"x0: V = 7e\+06 m/s .* \[1, 20000\].*unit m/s"),
        ([7e3, 0.0, 1e5, 0.0], r"x0: expected shape \(3,\) for \[V gamma h\], got \(4,\)"),
        ([[7e3, 0.0, 1e5]], r"x0: expected shape \(3,\)"),
        (7e3, r"got \(\)"),
        ([7e3, 1e400, 1e5], "x0: gamma must be a finite number, got inf"),
    ]
    for values, text in cases:
        with pytest.raises(ModelError, match=text):
            as_vector("x0", values, STATES)
    assert as_vector("x0", [7e3, -1.36, 1e5], STATES, domain=False)[1] == -1.36


def test_batches_name_their_case():
    good = np.array([[7e3, 0.0, 1e5]] * 3)
    assert as_batch("x0", good, STATES).shape == (3, 3)
    for column, value, text in ((1, 2.0, "gamma = 2 rad of case 2"), (0, math.nan, "V of case 2 must be a finite")):
        bad = good.copy()
        bad[2, column] = value
        with pytest.raises(ModelError, match=text):
            as_batch("x0", bad, STATES)
    with pytest.raises(ModelError, match=r"\(3,\) or \(N, 3\).*got \(2, 2\)"):
        as_batch("x0", np.ones((2, 2)), STATES)


def test_the_edges_of_a_range_belong_to_it():
    assert as_vector("x", [1.0, 1.3, 0.0], STATES)[0] == 1.0
    with pytest.raises(ModelError):
        as_vector("x", [np.nextafter(1.0, 0), 1.3, 0.0], STATES)


def test_frozen_is_a_read_only_copy():
    source = np.ones(3)
    copy = frozen(source)
    source[0] = 5.0
    assert copy[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        copy[0] = 2.0


@pytest.mark.parametrize(
    "arguments",
    [
        {"name": "two words"}, {"name": "lambda"}, {"name": 3}, {"nominal": 0.0}, {"nominal": -1.0}, {"nominal": math.nan},
        {"nominal": "1"}, {"valid": (1.0, 1.0)}, {"valid": (2.0, 1.0)}, {"valid": (math.nan, 1.0)}, {"valid": (0.0, 1.0, 2.0)},
    ],
)  # fmt: skip
def test_bad_variables(arguments):
    with pytest.raises(ModelError, match="Var"):
        Var(**{"name": "a", **arguments})


def test_labels_and_names():
    assert Var("V", "m/s", text="speed").label == "speed [m/s]"
    assert Var("V", "m/s").label == "V [m/s]"
    assert "did you mean 'gamma'?" in unknown_name("x", "gama", ["V", "gamma"])
    assert "known: V, h" in unknown_name("x", "qqq", ["V", "h"])
    assert "(none)" in unknown_name("x", "a", [])


def test_every_status_says_what_it_means_and_what_to_try():
    assert [s for s in Status if s.ok] == [Status.OK]
    for status in Status:
        assert status.value.endswith(".")
        assert len(status.value) > 30


def test_numpy_functions_on_symbols_are_an_error_under_test():
    symbol = ca.SX.sym("a")
    with pytest.raises((FutureWarning, TypeError, AttributeError)):
        np.cos(symbol)
