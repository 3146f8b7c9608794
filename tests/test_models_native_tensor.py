"""Spline tables in compiled code: the bits of CasADi's interpreter, whatever the degrees, and no change to code that is not known."""

import casadi as ca
import numpy as np
import pytest

from models import native
from models.checked import evaluate
from models.native import native_available
from models.native_source import scalar_code
from models.native_tensor import quicker

NODES = (
    np.array([0.0, 0.7, 1.0, 2.5, 2.9, 4.0, 5.0, 7.0]),
    np.array([-2.0, -1.0, 0.5, 1.0, 3.0, 3.5]),
    np.array([1.0, 2.0, 4.0, 8.0, 9.0]),
)


def knots_of(nodes, degree, repeated):
    inner = np.repeat(nodes[1:-1], np.where(np.arange(1, len(nodes) - 1) == repeated, 2, 1))
    return np.concatenate([np.repeat(nodes[0], degree + 1), inner, np.repeat(nodes[-1], degree + 1)])


def table(degrees, components, *, mode="binary", repeated=-1):
    rng = np.random.default_rng(11)
    knots = [knots_of(nodes, n, repeated) for nodes, n in zip(NODES, degrees, strict=False)]
    size = components * int(np.prod([len(k) - n - 1 for k, n in zip(knots, degrees, strict=True)]))
    options = {"never_inline": True, "lookup_mode": [mode] * len(degrees)}
    spline = ca.Function.bspline("tensor", [k.tolist() for k in knots], rng.normal(size=size).tolist(), list(degrees), components, options)
    x = ca.MX.sym("x", len(degrees))
    return ca.Function("twice", [x], [spline(x), spline(0.5 * x + 0.5)])


def points(count):
    """Inside cells, on knots, on edges, outside."""
    rng = np.random.default_rng(12)
    columns = []
    for nodes in NODES[:count]:
        inside = rng.uniform(nodes[0], nodes[-1], 300)
        columns.append(np.concatenate([rng.permutation(np.concatenate([inside, np.tile(nodes, 20)])), [nodes[0] - 1, nodes[-1] + 1]])[:302])
    return np.column_stack(columns)


@pytest.mark.skipif(not native_available(), reason="no C compiler")
@pytest.mark.parametrize(
    ("degrees", "components"),
    [((2, 2, 2), 3), ((2, 2, 1), 1), ((3, 3), 1), ((1, 3), 2), ((3,), 2), ((1,), 1), ((4,), 1), ((2, 4, 3), 2)],
)
def test_same_bits_as_the_interpreter(degrees, components):
    for function in (table(degrees, components), table(degrees, components, mode="linear"), table(degrees, components, repeated=2)):
        x = points(len(degrees))
        compiled = native.compile(function, lanes=1, threads=1)
        assert compiled.backend == "c"
        wanted = evaluate(function, x)
        assert np.abs(wanted[0]).max() > 0.1
        for found, value in zip(compiled(x), wanted, strict=True):
            np.testing.assert_array_equal(found, value)


def test_only_known_code_is_changed():
    function = table((2, 2, 2), 3)
    generator = ca.CodeGenerator("plain", {"with_header": False})
    generator.add(function)
    text = generator.dump()
    changed = quicker(text)
    assert changed.count("rw_boor_eval(") == 2  # its definition and the call
    assert quicker("int f(void) { return 0; }\n") == "int f(void) { return 0; }\n"
    other = text.replace("const casadi_int* lookup_mode, casadi_int* iw", "casadi_int* iw, const casadi_int* lookup_mode")
    assert quicker(other) == other
    assert "rw_boor_eval(" in scalar_code([function], unit="unit")
