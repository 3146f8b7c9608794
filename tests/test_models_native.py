"""Compiled functions against CasADi's interpreter: numbers, branches, tables, NaN, batches, threads, state of the processor."""

import ctypes
import math
import os
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest

import models
from models import native, native_loop, native_source, tables
from models.checked import ModelError, evaluate

ACCURATE, FAST = 1e-12, 1e-9

UNARY = {
    "sin": ca.sin, "cos": ca.cos, "tan": lambda a: ca.tan(0.3 * a), "exp": lambda a: ca.exp(0.5 * a), "log": lambda a: ca.log(2 + a * a),
    "sqrt": lambda a: ca.sqrt(1 + a * a), "asin": lambda a: ca.asin(0.9 * ca.sin(a)), "acos": lambda a: ca.acos(0.9 * ca.cos(1.3 * a)),
    "atan": ca.atan, "sinh": lambda a: ca.sinh(0.3 * a), "cosh": lambda a: ca.cosh(0.3 * a), "tanh": ca.tanh, "asinh": ca.asinh,
    "acosh": lambda a: ca.acosh(2 + a * a), "atanh": lambda a: ca.atanh(0.8 * ca.sin(a)), "erf": ca.erf, "log1p": lambda a: ca.log1p(a * a),
    "expm1": lambda a: ca.expm1(0.2 * a), "fabs": ca.fabs, "sign": ca.sign, "floor": lambda a: ca.floor(3.7 * a),
    "ceil": lambda a: ca.ceil(3.3 * a), "neg": lambda a: -a, "inv": lambda a: 1 / (3 + a), "sq": lambda a: a * a, "not": ca.logic_not,
}  # fmt: skip
BINARY = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "div": lambda a, b: a / (4 + b * b),
    "pow": lambda a, b: (1.5 + a * a) ** (0.3 * b), "atan2": lambda a, b: ca.atan2(a, b + 5), "hypot": ca.hypot, "fmod": ca.fmod,
    "fmin": ca.fmin, "fmax": ca.fmax, "copysign": ca.copysign, "less": lambda a, b: a < b, "at_most": lambda a, b: a <= b,
    "and": lambda a, b: ca.logic_and(a > 0.1, b > 0), "or": lambda a, b: ca.logic_or(a > 0.1, b < 0), "same": lambda a, b: a == b,
    "other": lambda a, b: a != b, "branch": lambda a, b: ca.if_else(a < b, ca.sqrt(b - a), a**2), "remainder": ca.remainder,
    "root of one side": lambda a, b: ca.if_else(a > b, ca.log(a - b), 3 * b),
}  # fmt: skip
TABLE = tables.line("bumps", np.linspace(-2, 2, 9), values=np.cos(np.arange(9.0)), outside="clamp")
UNEVEN = tables.line("uneven", [-2.0, -1.1, 0.2, 0.9, 2.5], values=[0.3, 1.0, -0.4, 0.8, 0.1], outside="linear")
GRID = tables.grid("hills", [-2.0, -1, 0, 1, 2], [-2.0, -0.7, 0.1, 1, 2], values=np.sin(np.arange(25.0).reshape(5, 5)))


@pytest.fixture(autouse=True, scope="module")
def _cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REENTRY_CACHE", str(tmp_path_factory.mktemp("native")))
        patch.delenv("REENTRY_NATIVE", raising=False)
        yield


needs_compiler = pytest.mark.skipif(not native.native_available(), reason="no C compiler on this machine")


def random_function(seed):
    """A function of (x (4,), z (2,)) that returns values, a matrix and the next memory, from all operations, tables and branches."""
    random = np.random.default_rng(seed)
    x, z = ca.SX.sym("x", 4), ca.SX.sym("z", 2)
    pool = [*ca.vertsplit(x), *ca.vertsplit(z), ca.SX(1.25)]
    for _ in range(25):
        a, b = (pool[i] for i in random.integers(0, len(pool), 2))
        kind = random.integers(0, 12)
        if kind < 5:
            new = UNARY[random.choice(list(UNARY))](a)
        elif kind < 10:
            new = BINARY[random.choice(list(BINARY))](a, b)
        elif kind == 10:
            new = (TABLE, UNEVEN)[random.integers(0, 2)](2.2 * ca.sin(a))
        else:
            new = GRID(1.8 * ca.sin(a), 1.8 * ca.cos(b))
        pool.append(3 * ca.sin(new) if random.random() < 0.3 else new / ca.sqrt(1 + new * new))  # keeps every size near one
    memory = ca.vertcat(0.9 * z[0] + 0.1 * pool[-1], ca.if_else(pool[-2] > 0.3, 1, ca.if_else(pool[-2] < -0.3, -1, z[1])))
    return ca.Function(f"random{seed}", [x, z], [ca.vertcat(*pool[-4:]), ca.reshape(ca.vertcat(*pool[-7:-1]), 2, 3), memory])


def points(seed, count=37):
    random = np.random.default_rng(1000 + seed)
    return random.uniform(-2, 2, (count, 4)), random.uniform(-1, 1, (count, 2))


def well_conditioned(function, arguments):
    """Rows at which a change of the arguments by 1e-14 changes no output by more than 1e-13 of its size: off branches, no cancellation."""
    wanted = evaluate(function, *arguments, finite=False)
    good = np.ones(len(arguments[0]), dtype=bool)
    for sign in (1, -1):
        moved = evaluate(function, *(a * (1 + sign * 1e-14) for a in arguments), finite=False)
        for w, m in zip(wanted, moved, strict=True):
            w, m = w.reshape(len(w), -1), m.reshape(len(m), -1)
            good &= np.isfinite(w).all(axis=1) & (np.abs(m - w) <= 1e-13 * np.maximum(np.abs(w), 1e-3)).all(axis=1)
    return good


def deviation(found, wanted, rows):
    worst = 0.0
    for f, w in zip(found, wanted, strict=True):
        assert f.shape == w.shape
        if rows.any():
            worst = max(worst, float(np.max(np.abs(f[rows] - w[rows]) / np.maximum(np.abs(w[rows]), 1e-3))))
    return worst


def compare(seeds):
    """Number of rows compared; the compiler runs beside the interpreter."""

    def one(seed):
        f, arguments = random_function(seed), points(seed)
        wanted, rows = evaluate(f, *arguments, finite=False), well_conditioned(f, arguments)
        for lanes, mode, limit in ((1, "accurate", ACCURATE), (4, "accurate", ACCURATE), (8, "fast", FAST)):
            compiled = native.compile(f, lanes=lanes, mode=mode)
            assert compiled.backend == ("c" if lanes == 1 else "lanes")
            found, finite = compiled.run(*arguments)
            assert deviation(found, wanted, rows) <= limit, (seed, lanes, mode)
            assert finite[rows].all()
        return int(rows.sum())

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return sum(pool.map(one, seeds))


@needs_compiler
def test_random_functions_agree():
    assert compare(range(50)) > 800  # most rows are well conditioned


@needs_compiler
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_five_hundred_random_functions_agree():
    assert compare(range(50, 550)) > 8000


@needs_compiler
def test_a_wrong_operation_is_seen(monkeypatch):
    monkeypatch.setitem(native_source._NUMBERS, ca.OP_SUB, "({1} - {0})")
    with pytest.raises(AssertionError):
        compare(range(3))


ENTRY_MODELS = {
    "planar": lambda: models.entry_planar(models.SOYUZ),
    "planar us76": lambda: models.entry_planar(models.APOLLO, atmosphere=models.us76()),
    "3dof smooth": lambda: models.entry_3dof(models.SOYUZ, atmosphere=models.us76_smooth()),
}


@needs_compiler
@pytest.mark.parametrize("name", ENTRY_MODELS)
@pytest.mark.parametrize(("mode", "limit"), [("accurate", ACCURATE), ("fast", FAST)])
def test_entry_models_agree_inside_and_outside_their_tables(name, mode, limit):
    model = ENTRY_MODELS[name]()
    random = np.random.default_rng(3)
    x = np.array([v.nominal for v in model.states]) * random.uniform(0.3, 0.9, (300, len(model.states)))
    x[:, model.index("h")] = random.uniform(-3e3, 140e3, 300)
    u = random.uniform(-1, 1, (300, 1))
    for function in (model.rhs, model.out):
        wanted = evaluate(function, x, u, model.p0)[0]
        found = native.compile(function, mode=mode)(x, u, model.p0)[0]
        assert np.max(np.abs(found - wanted) / np.abs(wanted).max(axis=0)) <= limit
        if mode == "accurate":
            assert np.array_equal(found, wanted)  # the same operations in the same order


@needs_compiler
def test_functions_of_matrices_and_loops_run_in_c():
    a, b = ca.MX.sym("a", 9), ca.MX.sym("b", 3)
    solved = ca.Function("step", [a, b], [ca.solve(ca.reshape(a, 3, 3) + 4 * ca.DM.eye(3), b, "qr")])  # the name of a libc function
    arguments = (np.random.default_rng(0).uniform(0, 1, (7, 9)), np.arange(21.0).reshape(7, 3))
    compiled = native.compile(solved)
    assert compiled.backend in ("c", "lanes")
    np.testing.assert_allclose(compiled(*arguments)[0], evaluate(solved, *arguments)[0], rtol=1e-12)
    x = ca.MX.sym("x", 2)
    spline = ca.interpolant("t", "bspline", [[0.0, 1, 2, 3, 4]], [0.0, 1, 4, 9, 16])
    mixed = ca.Function("mixed", [x], [spline(x[0]) * ca.sin(x[1]), ca.mtimes(x, x.T)])
    values = np.random.default_rng(1).uniform(0.1, 3.9, (9, 2))
    for found, wanted in zip(native.compile(mixed)(values), evaluate(mixed, values), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-12)


@needs_compiler
@pytest.mark.parametrize("name", ["exp", "step", "main", "write", "x", "L", "rw_run"])
def test_names_of_functions_and_inputs_do_not_matter(name):
    x = ca.SX.sym(name if name.isidentifier() else "x")
    f = ca.Function(name, [x], [ca.exp(x)], [name], ["y"])
    for lanes in (1, 4):
        assert native.compile(f, lanes=lanes)(np.array([0.5]))[0] == pytest.approx(math.exp(0.5), rel=1e-15)


@needs_compiler
@pytest.mark.parametrize("mode", ["accurate", "fast"])
def test_functions_that_are_never_inlined_run_in_lanes(mode):
    x = ca.SX.sym("x", 2)
    inner = ca.Function("inner", [x], [ca.vertcat(ca.sin(x[0]) * x[1], x[0] - x[1])], {"never_inline": True})
    outer = ca.Function("outer", [x], [inner(inner(x)) + x])
    points = np.random.default_rng(4).normal(size=(9, 2))
    for function in (inner, outer):
        compiled = native.compile(function, mode=mode, lanes=4)
        assert compiled.backend == "lanes"
        assert compiled(points)[0] == pytest.approx(evaluate(function, points)[0], rel=FAST)


@needs_compiler
def test_sparse_empty_and_constant_results():
    x = ca.SX.sym("x", 3)
    sparse = ca.SX(3, 2)
    sparse[2, 0], sparse[0, 1] = x[0], x[1] * 2
    f = ca.Function("f", [x, ca.SX.sym("none", 0)], [sparse, ca.vertcat(ca.inf, -1, math.nan), ca.SX(2, 1)])
    for lanes in (1, 2, 8):
        out, finite = native.compile(f, lanes=lanes).run(np.arange(15.0).reshape(5, 3), np.zeros((5, 0)))
        assert not finite.any()
        for found, wanted in zip(out, evaluate(f, np.arange(15.0).reshape(5, 3), np.zeros((5, 0)), finite=False), strict=True):
            np.testing.assert_array_equal(found, wanted)


@needs_compiler
def test_wide_functions_run_one_case_at_a_time(monkeypatch):
    x = ca.SX.sym("x", 2)
    wide = ca.Function("wide", [x], [x[0] * ca.SX(np.arange(1000.0)) + x[1]])
    values = np.array([[1.0, 2], [3, 4], [5, 6]])
    monkeypatch.setattr(native_source, "WIDEST", 30_000)
    for long in (3000, 100):  # CasADi's C, then ours
        monkeypatch.setattr(native_source, "LONG", long)
        compiled = native.compile(wide, lanes=8)
        assert compiled.backend == "c"
        assert "1002 numbers" in compiled.reason
        assert np.array_equal(compiled(values)[0], evaluate(wide, values)[0])


# One row never depends on another.


@needs_compiler
@pytest.mark.parametrize("mode", ["accurate", "fast"])
def test_bits_do_not_depend_on_batch_or_threads(mode):
    f, arguments = random_function(4), points(4, 1000)
    whole = native.compile(f, threads=1, mode=mode).run(*arguments)[0]
    for threads in (2, 3):
        again = native.compile(f, threads=threads, mode=mode).run(*arguments)[0]
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(again, whole, strict=True))
    for size in (1, 3, 4, 5, 7, 999):
        one = native.compile(f, threads=2, mode=mode)
        chunks = [one.run(*(a[i : i + size] for a in arguments))[0] for i in range(0, min(1000, 50 * size), size)]
        for k, w in enumerate(whole):
            joined = np.concatenate([c[k] for c in chunks])
            assert np.array_equal(joined, w[: len(joined)], equal_nan=True), size


def test_tasks_that_share_the_processors_take_their_part(monkeypatch):
    monkeypatch.setattr(native, "processors", lambda: 6)

    def parts(threads=6, rows=1000):
        seen = []
        native.in_threads(lambda first, last: seen.append((first, last)), rows, 4, threads, keep=(), vectors_each=1)
        seen.sort()
        assert seen[0][0] == 0
        assert seen[-1][1] == rows
        assert [first for first, _ in seen[1:]] == [last for _, last in seen[:-1]]
        return len(seen)

    assert parts() == 6
    for tasks, wanted in ((1, 6), (2, 3), (4, 1), (6, 1), (100, 1)):
        with native.shared_by(tasks):
            assert parts() == wanted
            assert parts(threads=2) == min(2, wanted)
    with pytest.raises(ValueError, match="left"), native.shared_by(3):
        raise ValueError("left")
    assert parts() == 6
    with pytest.raises(ModelError, match="expected an integer >= 1, got 0"), native.shared_by(0):
        pass


@needs_compiler
def test_bits_do_not_depend_on_lanes_in_accurate_mode():
    f, arguments = random_function(11), points(11, 50)  # has sin(atan(x)), which GCC 12 replaces unless it is told not to
    whole = evaluate(f, *arguments, finite=False)
    for lanes in (1, 2, 4, 8, 16):
        for a, b in zip(native.compile(f, lanes=lanes).run(*arguments)[0], whole, strict=True):
            assert np.array_equal(a, b, equal_nan=True), lanes


@needs_compiler
@pytest.mark.parametrize("mode", ["accurate", "fast"])
def test_nan_in_one_lane_harms_no_other(mode):
    x = ca.SX.sym("x")
    spline = TABLE(x)
    f = ca.Function("f", [x], [ca.vertcat(ca.sqrt(x), ca.log(x), 1 / x, ca.if_else(x > 0, ca.log(x), -1), ca.sin(x), ca.exp(x)), spline])
    values = np.random.default_rng(0).uniform(0.1, 2, (64, 1))
    compiled = native.compile(f, mode=mode)
    clean, all_finite = compiled.run(values)
    assert all_finite.all()
    harmed = values.copy()
    harmed[[3, 21, 40], 0] = [-1.0, 0.0, 1e4]  # NaN, infinity, overflow of exp
    found, finite = compiled.run(harmed)
    assert np.flatnonzero(~finite).tolist() == [3, 21, 40]
    for a, b in zip(found, clean, strict=True):
        assert np.array_equal(a[finite], b[finite])
    assert found[0][3, 3] == -1.0  # the branch not taken is log of a negative number
    with pytest.raises(ModelError, match=r"f: output o0 is not finite \(row 3\)"):
        compiled(harmed)


@needs_compiler
def test_comparison_with_nan_takes_the_branch_of_the_interpreter():
    x = ca.SX.sym("x")
    bad = ca.log(x)
    f = ca.Function(
        "f", [x],
        [ca.vertcat(ca.if_else(bad < 0, 1, 2), ca.if_else(ca.logic_not(bad >= 0), 1, 2)), ca.vertcat(ca.fmin(bad, 7), ca.fmax(7, bad)),
         ca.vertcat(ca.sign(bad), bad != 0)],
    )  # fmt: skip
    values = np.array([[-1.0], [0.5], [2.0], [1.0]])
    for mode in ("accurate", "fast"):
        for found, wanted in zip(native.compile(f, mode=mode).run(values)[0], evaluate(f, values, finite=False), strict=True):
            np.testing.assert_array_equal(found, wanted)


# The same entry checks as the interpreted function.


@pytest.mark.parametrize("off", [False, True])
def test_arguments_are_checked_as_those_of_the_function(off, monkeypatch):
    if off:
        monkeypatch.setenv("REENTRY_NATIVE", "off")
    elif not native.native_available():
        pytest.skip("no C compiler")
    f = random_function(2)
    compiled = native.compile(f)
    assert (compiled.backend == "interpreter") is off
    x, z = points(2, 3)
    cases = [
        (x,), (x, z, z), (x[:, :3], z), (x, z[:2]), (x[0][None, None], z), (np.full(4, np.nan), z), (x[:0], z[:0]), (x.astype(bool), z),
        (1.0, z), (x.T, z),
    ]  # fmt: skip
    for arguments in cases:
        with pytest.raises(ModelError) as theirs:
            evaluate(f, *arguments)
        with pytest.raises(ModelError) as ours:
            compiled(*arguments)
        assert str(ours.value) == str(theirs.value)
    for arguments in ((x, z), (x[0], z[0]), (x[0], z), (x, z[0]), (x[:1], z[:1]), (np.asfortranarray(x), z[::-1])):
        for found, wanted in zip(compiled.run(*arguments)[0], evaluate(f, *arguments, finite=False), strict=True):
            assert found.shape == wanted.shape
            np.testing.assert_allclose(found, wanted, rtol=1e-11)


def test_options_are_checked():
    f = random_function(0)
    for options in ({"lanes": 3}, {"lanes": True}, {"threads": 0}, {"threads": 1.5}, {"mode": "quick"}):
        with pytest.raises(ModelError, match=next(iter(options))):
            native.compile(f, **options)
    a = ca.SX.sym("a", 2, 2)
    with pytest.raises(ModelError, match="matrix"):
        native.compile(ca.Function("f", [a], [a]))


# The state of the floating-point unit.


def float_state():
    """Subnormals kept, rounding to nearest, masks and modes of the processor."""
    libm = ctypes.CDLL(None)
    tiny = np.array([5e-324])
    return (bool((tiny * 1.0 != 0)[0]), libm.fegetround(), float(1.0 + np.float64(2**-53)), float(np.float64(1.0) - 2**-54))


@needs_compiler
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="fegetround by its name in the running program")
@pytest.mark.parametrize("mode", ["accurate", "fast"])
@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_state_of_the_processor_is_unchanged_in_every_thread(mode, lanes):
    before, seen = float_state(), []
    assert before[0]
    functions = [model().rhs for model in ENTRY_MODELS.values()] if lanes == 8 else [ENTRY_MODELS["3dof smooth"]().rhs]

    def work():
        for function in functions:
            shapes = [(2000, function.size1_in(i)) for i in range(function.n_in())]
            native.compile(function, mode=mode, lanes=lanes, threads=2).run(*(np.full(shape, 0.7) for shape in shapes))
            seen.append(float_state())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    work()
    later = threading.Thread(target=lambda: seen.append(float_state()))  # begins in the state that the process has now
    later.start()
    later.join()
    assert seen == [before] * (2 * len(functions) + 1)


@needs_compiler
def test_subnormal_numbers_survive_inside():
    x = ca.SX.sym("x")
    f = ca.Function("f", [x], [x * 0.5 + 0])
    for mode in ("accurate", "fast"):
        for lanes in (1, 8):
            assert native.compile(f, mode=mode, lanes=lanes)(np.array([1e-310]))[0][0] == 5e-311


# Closed loops.


def falling(bad=False):
    """c = [height, speed] under gravity q (one number a group) with p = [drag]."""
    c, q, p = ca.SX.sym("c", 2), ca.SX.sym("q", 2), ca.SX.sym("p", 1)
    h, v = c[0], c[1]
    for _ in range(4):
        v = v + q[0] * (-q[1] - p[0] * v * ca.fabs(v))
        h = h + q[0] * v
    h = ca.if_else(p[0] > 0.9, ca.sqrt(h - 50.0), h) if bad else h
    return ca.Function("group", [c, q, p], [ca.vertcat(h, v), ca.horzcat(h, v)]), ca.Function("margin", [c, p], [c[0] / 100])


@needs_compiler
@pytest.mark.parametrize("mode", ["accurate", "fast"])
@pytest.mark.parametrize("cases", [1, 5, 300])
def test_loop_agrees_with_the_interpreter_case_by_case(mode, cases, monkeypatch):
    group, margin = falling(bad=True)
    random = np.random.default_rng(0)
    c0, p = np.column_stack([random.uniform(80, 130, cases), np.zeros(cases)]), random.uniform(0, 1, (cases, 1))
    p[:3] = [[0.0], [0.95], [0.5]][:cases]
    q = np.column_stack([np.full(70, 0.02), np.full(70, 9.81)])
    compiled = native_loop.compile_loop(group, margin, mode=mode)
    assert compiled.backend == "lanes"
    found = compiled.run(c0, q, p)
    monkeypatch.setenv("REENTRY_NATIVE", "off")
    interpreted = native_loop.compile_loop(group, margin)
    assert interpreted.backend == "interpreter"
    wanted = interpreted.run(c0, q, p)
    assert np.array_equal(found.index, wanted.index)
    assert np.array_equal(found.outcome, wanted.outcome)
    if cases == 300:
        assert set(found.outcome.tolist()) == {0, 1, 2}
    for name in ("before", "after"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-12 if mode == "accurate" else 1e-9)
    for i in range(min(cases, 20)):  # the same by hand
        c = c0[i]
        for m in range(70):
            after = np.asarray(group(c, q[m], p[i])[0]).ravel()
            if not after[0] > 0:
                break
            c = after
        else:
            m = 70
        assert found.index[i] == m
        np.testing.assert_allclose(found.before[i], c, rtol=1e-9)


@needs_compiler
def test_loop_bits_do_not_depend_on_cases_threads_or_lanes():
    group, margin = falling()
    random = np.random.default_rng(5)
    c0, p = np.column_stack([random.uniform(20, 130, 101), np.zeros(101)]), random.uniform(0, 1, (101, 1))
    q = np.column_stack([np.full(90, 0.02), np.full(90, 9.81)])
    whole = native_loop.compile_loop(group, margin, threads=1).run(c0, q, p)
    for options in ({"threads": 2}, {"lanes": 1}, {"lanes": 4, "threads": 3}, {"lanes": 8, "threads": 2}):
        again = native_loop.compile_loop(group, margin, **options).run(c0, q, p)
        assert np.array_equal(again.after, whole.after)
        assert np.array_equal(again.index, whole.index)
    parts = [native_loop.compile_loop(group, margin).run(c0[i : i + 7], q, p[i : i + 7]) for i in range(0, 101, 7)]
    assert np.array_equal(np.concatenate([e.after for e in parts]), whole.after)


def test_loop_arguments_are_checked(monkeypatch):
    monkeypatch.setenv("REENTRY_NATIVE", "off")
    group, margin = falling()
    loop = native_loop.compile_loop(group, margin)
    q = np.ones((3, 2))
    for c0, p in ((np.ones((2, 3)), np.ones((2, 1))), (np.ones((2, 2)), np.ones((3, 1))), (np.ones((0, 2)), np.ones((0, 1)))):
        with pytest.raises(ModelError, match="group"):
            loop.run(c0, q, p)
    with pytest.raises(ModelError, match="margin"):
        native_loop.compile_loop(group, ca.Function("margin", [ca.SX.sym("c", 3), ca.SX.sym("p")], [ca.SX(1)]))


@needs_compiler
def test_many_threads_call_one_function():
    f, arguments = random_function(6), points(6, 500)
    compiled = native.compile(f, threads=2)
    wanted, wrong = compiled.run(*arguments)[0], []

    def work():
        for _ in range(5):
            found = compiled.run(*arguments)[0]
            if not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(found, wanted, strict=True)):
                wrong.append(1)

    workers = [threading.Thread(target=work) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert wrong == []


# C as a product.


def strict(folder, *options):
    sources = [str(p) for p in folder.glob("*.c")]
    command = ["cc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", *options, *sources, "-o", str(folder / "self_test"), "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return subprocess.run([str(folder / "self_test")], capture_output=True, text=True, check=False)


@needs_compiler
def test_export_compiles_alone_and_passes_its_own_test(tmp_path):
    model = models.entry_3dof(models.SOYUZ, atmosphere=models.us76_smooth())
    random = np.random.default_rng(0)
    x = np.array([60e3, 0.1, 0.3, 6000.0, -0.05, 0.4]) * random.uniform(0.8, 1.2, (8, 6))
    exported = {"rhs": (model.rhs, [x, random.uniform(-1, 1, (8, 1)), np.tile(model.p0, (8, 1))]), "random": (random_function(7), None)}
    for name, (function, given) in exported.items():
        files = native.export(function, tmp_path / name, points=given)
        assert all(f.is_file() for f in files)
        assert len(files) == 5
        done = strict(tmp_path / name)
        assert done.returncode == 0, done.stdout
    rhs = tmp_path / "rhs"
    done = strict(rhs, "-Dcasadi_real=float")
    assert done.returncode == 0, done.stdout
    symbols = subprocess.run(["nm", "-u", str(rhs / "self_test")], capture_output=True, text=True, check=True).stdout
    assert [s for s in ("malloc", "calloc", "realloc", "free@") if s in symbols] == []
    source = next(rhs.glob("*_rhs.c"))
    source.write_text(source.read_text(encoding="ascii").replace("sin(", "cos("), encoding="ascii")
    assert strict(rhs).returncode == 1  # the driver sees a wrong number


def under_sanitizers(folder, seeds):
    functions = {f"random {seed}": (random_function(seed), None) for seed in seeds}
    for name, make in ENTRY_MODELS.items():
        model = make()
        x = np.array([v.nominal for v in model.states]) * np.random.default_rng(2).uniform(0.4, 0.9, (8, len(model.states)))
        functions[name] = (model.rhs, [x, np.full((8, 1), 0.3), np.tile(model.p0, (8, 1))])
    for name, (function, given) in functions.items():
        native.export(function, folder / name, points=given)
        done = strict(folder / name, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
        assert done.returncode == 0, (name, done.stdout + done.stderr)


@needs_compiler
def test_export_under_sanitizers(tmp_path):
    under_sanitizers(tmp_path, range(5))


@needs_compiler
@pytest.mark.slow
def test_fifty_exports_under_sanitizers(tmp_path):
    under_sanitizers(tmp_path, range(5, 55))


def test_export_refuses_what_is_not_plain_c(tmp_path):
    x = ca.SX.sym("x")
    with pytest.raises(ModelError, match="erfinv"):
        native.export(ca.Function("f", [x], [ca.erfinv(x)]), tmp_path)
    with pytest.raises(ModelError, match="points"):
        native.export(ca.Function("f", [x], [ca.log(-x)]), tmp_path)
    flow = ca.integrator("flow", "cvodes", {"x": x, "ode": -x}, 0, 1.0)
    y = ca.MX.sym("y")
    with pytest.raises(ModelError, match="export"):
        native.export(ca.Function("g", [y], [flow(x0=y)["xf"]]), tmp_path)


def test_import_starts_no_compiler():
    code = "import subprocess; subprocess.run = subprocess.Popen = None; import models.native, models.native_loop"
    subprocess.run([sys.executable, "-W", "error", "-c", textwrap.dedent(code)], check=True)
