"""C source of CasADi functions: one case at a time by CasADi's generator, or several in the lanes of SIMD vectors.

A lane program is written from the instructions of an SX function: every number becomes a vector with one case in each lane,
a comparison becomes a mask, a branch a selection of bits, so that the lanes never influence each other.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from models.native_spline import literal, spline_of
from models.native_tensor import quicker
from models.native_vector import prologue

PART = 2500  # instructions in one C function: compilers take more than linear time over longer ones, and each end costs stores and loads
WIDEST = 2**20  # bytes in one array of vectors: they stand on the stack
LONG = 3000  # instructions from which on CasADi's C, which is one long function, takes compilers much longer than ours in parts
LARGEST = 60_000  # instructions worth writing out in lanes; above, CasADi's own C keeps its loops as loops
PREFIX = "rw_"  # before every generated name, so that no user's name meets one of the C library


class Unsupported(Exception):
    """The function cannot be written in this form; the text says why."""


_NUMBERS = {
    ca.OP_ASSIGN: "{0}", ca.OP_LIFT: "{0}", ca.OP_ADD: "({0} + {1})", ca.OP_SUB: "({0} - {1})", ca.OP_MUL: "({0} * {1})",
    ca.OP_DIV: "({0} / {1})", ca.OP_NEG: "(-{0})", ca.OP_SQ: "({0} * {0})", ca.OP_TWICE: "(2.0 * {0})", ca.OP_INV: "(1.0 / {0})",
    ca.OP_FABS: "lane_fabs({0})", ca.OP_SIGN: "lane_sign({0})", ca.OP_COPYSIGN: "lane_copysign({0}, {1})",
    ca.OP_FMIN: "lane_fmin({0}, {1})", ca.OP_FMAX: "lane_fmax({0}, {1})",
}  # fmt: skip
_LIBM = {
    ca.OP_SQRT: "sqrt", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil", ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SIN: "sin", ca.OP_COS: "cos",
    ca.OP_TAN: "tan", ca.OP_ASIN: "asin", ca.OP_ACOS: "acos", ca.OP_ATAN: "atan", ca.OP_SINH: "sinh", ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh", ca.OP_ASINH: "asinh", ca.OP_ACOSH: "acosh", ca.OP_ATANH: "atanh", ca.OP_ERF: "erf", ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
}  # fmt: skip
_LIBM2 = {
    ca.OP_POW: "pow", ca.OP_CONSTPOW: "pow", ca.OP_ATAN2: "atan2", ca.OP_HYPOT: "hypot", ca.OP_FMOD: "fmod", ca.OP_REMAINDER: "remainder"
}  # fmt: skip
_WITH_A_NUMBER = {ca.OP_FMIN: "lane_least({0}, {1})", ca.OP_FMAX: "lane_most({0}, {1})"}  # where the second is a constant, not NaN
_COMPARISONS = {ca.OP_LT: "({0} < {1})", ca.OP_LE: "({0} <= {1})", ca.OP_EQ: "({0} == {1})", ca.OP_NE: "({0} != {1})"}
_LOGIC = {ca.OP_NOT: "(~{0})", ca.OP_AND: "({0} & {1})", ca.OP_OR: "({0} | {1})"}


def dense(function: ca.Function, name: str) -> ca.Function:
    """The same function under another name, with dense inputs and outputs."""
    kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
    symbols = [kind.sym(f"a{i}", *function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(r) for r in function.call(symbols)]
    return ca.Function(name, symbols, ca.cse(results) if kind is ca.SX else results)


NO_C = ("CvodesInterface", "IdasInterface")  # CasADi would write C for them that does not compile


def scalar_code(functions: Sequence[ca.Function], *, unit: str) -> str:
    """CasADi's own C code of the functions (already dense, and named with the prefix), with its spline tables made quicker."""
    generator = ca.CodeGenerator(unit, {"with_header": False})
    for function in functions:
        generator.add(function)
    return quicker(str(generator.dump()))


@dataclass(slots=True)
class Unit:
    """One C file in the making: the functions written so far, each under one name."""

    fast: bool
    lanes: int
    scalars: list[ca.Function] = field(default_factory=list)
    text: list[str] = field(default_factory=list)
    names: dict[int, str] = field(default_factory=dict)
    kept: list[ca.Function] = field(default_factory=list)  # a hash is an address: valid while the function lives

    def lane_function(self, function: ca.Function) -> str:
        """Name of ``void name(const L *x, L *y)`` that evaluates `function`, dense inputs and outputs stacked by columns."""
        size = sum(function.numel_in(i) for i in range(function.n_in())) + sum(function.numel_out(i) for i in range(function.n_out()))
        self.require_room(size)
        key = function.__hash__()
        if key not in self.names:
            self.kept.append(function)
            self.names[key] = self._write(function)
        return self.names[key]

    def scalar_function(self, function: ca.Function) -> str:
        """As :meth:`lane_function`, through CasADi's C code, one lane after the other."""
        for part in (function, *function.find_functions()):
            if part.class_name() in NO_C:
                raise Unsupported(f"{part.name()} ({part.class_name()}) cannot be written as C; use an integrator of fixed steps")
        scalar = dense(function, f"{PREFIX}scalar{len(self.scalars)}")
        self.scalars.append(scalar)
        name = f"{PREFIX}each{len(self.scalars)}"
        sizes_in = [scalar.nnz_in(i) for i in range(scalar.n_in())]
        sizes_out = [scalar.nnz_out(i) for i in range(scalar.n_out())]
        self.require_room(-(-(scalar.sz_w() + sum(sizes_in) + sum(sizes_out)) // self.lanes))  # one lane after the other
        pointers_in = ", ".join(f"x + {sum(sizes_in[:i])}" for i in range(len(sizes_in)))
        pointers_out = ", ".join(f"y + {sum(sizes_out[:i])}" for i in range(len(sizes_out)))
        self.text.append(
            f"PART void {name}(const L *in, L *out) {{\n"
            f"  double x[{sum(sizes_in) + 1}], y[{sum(sizes_out) + 1}], w[{scalar.sz_w() + 1}];\n  i64 iw[{scalar.sz_iw() + 1}];\n"
            f"  for (int l = 0; l < LANES; l++) {{\n"
            f"    const double *arg[{scalar.sz_arg() + 1}] = {{{pointers_in}}};\n"
            f"    double *res[{scalar.sz_res() + 1}] = {{{pointers_out}}};\n"
            f"    for (int k = 0; k < {sum(sizes_in)}; k++) x[k] = in[k][l];\n"
            f"    int failed = {scalar.name()}(arg, res, iw, w, 0);\n"
            f'    for (int k = 0; k < {sum(sizes_out)}; k++) out[k][l] = failed ? __builtin_nan("") : y[k];\n  }}\n}}\n'
        )
        return name

    def single_function(self, function: ca.Function) -> str:
        """As :meth:`lane_function`, for one lane."""
        if function.is_a("SXFunction") and function.n_instructions() > LONG:
            return self.lane_function(function)
        return self.scalar_function(function)

    def require_room(self, numbers: int) -> None:
        """Refuse what would not stand on the stack of a thread."""
        if 8 * self.lanes * numbers > WIDEST:
            raise Unsupported(f"it needs {numbers} numbers at a time in each of {self.lanes} lanes, more than {WIDEST} bytes")

    def whole_in_c(self, name: str) -> bool:
        """True if the function of this name is evaluated one lane after the other from beginning to end."""
        return name.startswith(f"{PREFIX}each")

    def source(self, driver: str) -> str:
        """The whole file."""
        scalars = scalar_code(self.scalars, unit=f"{PREFIX}scalars") if self.scalars else ""
        body = "".join(self.text) + driver
        extremes = any(f"lane_{name}(" in body for name in ("fmin", "fmax", "least", "most"))
        names = (tuple(_LIBM.values()), tuple(dict.fromkeys(_LIBM2.values())))
        return scalars + prologue(self.lanes, *names, fast=self.fast, extremes=extremes) + body

    def _write(self, function: ca.Function) -> str:
        name = f"{PREFIX}f{len(self.names)}_{len(self.kept)}"
        spline = spline_of(function)
        if spline is not None:
            self.text.append(spline.code(name, fast=self.fast))
            return name
        if not function.is_a("SXFunction"):
            try:
                expanded = function.expand()
            except RuntimeError:
                return self.scalar_function(function)
            if _calls(expanded, function):  # it cannot be expanded
                return self.scalar_function(function)
            function = expanded
        if function.n_instructions() > LARGEST:
            raise Unsupported(f"it has {function.n_instructions()} instructions, more than {LARGEST}")
        symbols = function.sx_in()
        shared = ca.Function(name, symbols, ca.cse(function.call(symbols)))  # equal subexpressions once: the same numbers
        if _calls(shared, function):  # one that is never to be inlined: what was made only calls it
            shared = function
        self.kept.append(shared)
        self.text.append(_Writer(self, shared, name).code())
        return name


@dataclass(slots=True)
class Value:
    """Result of one instruction: C expression, number or mask, where it was made and where it is last used."""

    text: str
    mask: bool = False
    number: bool = False  # a constant that is not NaN
    part: int = -1  # -1: a constant or an input, written out at every use
    last: int = -1
    slot: int = -1


class _Writer:
    """Writes the body of one SX function as parts that hand on values through an array."""

    def __init__(self, unit: Unit, function: ca.Function, name: str) -> None:
        self.unit, self.function, self.name = unit, function, name
        self.inputs = [_positions(function.sparsity_in(i)) for i in range(function.n_in())]
        self.outputs = [_positions(function.sparsity_out(i)) for i in range(function.n_out())]
        self.first_in = _offsets([function.numel_in(i) for i in range(function.n_in())])
        self.first_out = _offsets([function.numel_out(i) for i in range(function.n_out())])

    def code(self) -> str:
        steps = list(self._steps())
        parts = max((s.part for s in steps), default=-1) + 1
        self._assign_slots([v for s in steps for v in s.results], parts)
        width = 1 + max((v.slot for s in steps for v in s.results), default=-1)
        self.unit.require_room(width)
        lines, calls = [], []
        for part in range(parts):
            lines.append(
                f"PART void {self.name}_{part}(const L *restrict x, L *restrict w, L *restrict y) {{\n  (void)x; (void)w; (void)y;\n"
            )
            for step in (s for s in steps if s.part == part):
                lines.append("  " + step.text(part) + "\n")
                for value in step.results:
                    if value.slot >= 0:
                        lines.append(f"  w[{value.slot}] = (L){value.text};\n")
            lines.append("}\n")
            calls.append(f"  {self.name}_{part}(x, w, y);\n")
        zero = f"  for (int k = 0; k < {self.first_out[-1]}; k++) y[k] = lane_all(0.0);\n" if self._has_gaps() else ""
        return "".join(lines) + f"PART void {self.name}(const L *x, L *y) {{\n  L w[{width + 1}];\n{zero}" + "".join(calls) + "}\n"

    def _has_gaps(self) -> bool:
        f = self.function
        return any(f.nnz_out(i) < f.numel_out(i) for i in range(f.n_out()))

    def _steps(self) -> Iterator[_Step]:
        f, slots, count = self.function, {}, 0
        calls: Any = None
        for k in range(f.n_instructions()):
            op, part = f.instruction_id(k), count // PART
            if op == ca.OP_CONST:
                constant = f.instruction_constant(k)
                slots[f.instruction_output(k)[0]] = Value(f"lane_all({literal(constant)})", number=constant == constant)
                continue
            if op == ca.OP_INPUT:
                i, nonzero = f.instruction_input(k)
                slots[f.instruction_output(k)[0]] = Value(f"x[{self.first_in[i] + self.inputs[i][nonzero]}]")
                continue
            operands = [slots.get(i, Value("lane_all(0.0)")) for i in f.instruction_input(k)]
            for value in operands:
                value.last = max(value.last, part)
            count += 1
            if op == ca.OP_OUTPUT:
                i, nonzero = f.instruction_output(k)
                yield _Step(part, f"y[{self.first_out[i] + self.outputs[i][nonzero]}] = {{0}};", operands, [], False)
            elif op == ca.OP_CALL:
                if calls is None:
                    calls = f.instructions_sx().elements()
                yield self._call(calls[k].which_function(), k, part, operands, slots)
                count += 20
            else:
                value = Value(f"a{k}", mask=op in _COMPARISONS or op in _LOGIC, part=part)
                slots[f.instruction_output(k)[0]] = value
                kind = "M" if value.mask else "L"
                yield _Step(part, f"{kind} a{k} = {_template(op, operands)};", operands, [value], op in _LOGIC, op == ca.OP_IF_ELSE_ZERO)

    def _call(self, callee: ca.Function, k: int, part: int, operands: list[Value], slots: dict[int, Value]) -> _Step:
        """Calls pass dense columns; nonzeros of a sparse argument are put in their places, others are zero."""
        sizes, places = [callee.numel_in(i) for i in range(callee.n_in())], []
        for i, first in enumerate(_offsets(sizes)[:-1]):
            places += [first + position for position in _positions(callee.sparsity_in(i))]
        numel_out = [callee.numel_out(i) for i in range(callee.n_out())]
        sources = []
        for i, first in enumerate(_offsets(numel_out)[:-1]):
            sources += [first + position for position in _positions(callee.sparsity_out(i))]
        if len(places) != len(operands) or len(sources) != len(self.function.instruction_output(k)):
            raise Unsupported(f"its call of {callee.name()} does not pass one number for each element")
        fill = " ".join(f"c{k}[{place}] = {{{n}}};" for n, place in enumerate(places))
        results = []
        text = f"L c{k}[{sum(sizes) + 1}] = {{{{{{{{0}}}}}}}}, r{k}[{sum(numel_out) + 1}];"
        text += f" {fill} {self.unit.lane_function(callee)}(c{k}, r{k});"
        for n, (slot, source) in enumerate(zip(self.function.instruction_output(k), sources, strict=True)):
            if slot < 0:
                continue
            value = Value(f"a{k}_{n}", part=part)
            slots[slot] = value
            results.append(value)
            text += f" L a{k}_{n} = r{k}[{source}];"
        return _Step(part, text, operands, results, False)

    def _assign_slots(self, values: list[Value], parts: int) -> None:
        """Places in the hand-over array for the values used in a later part; a place is free again after the last use."""
        free: list[int] = []
        width = 0
        ends: list[list[int]] = [[] for _ in range(parts + 1)]
        reached = 0
        for value in values:
            if value.last <= value.part:
                continue
            while reached < value.part:
                for slot in ends[reached]:
                    heapq.heappush(free, slot)
                reached += 1
            if free:
                value.slot = heapq.heappop(free)
            else:
                value.slot, width = width, width + 1
            ends[value.last].append(value.slot)


@dataclass(slots=True)
class _Step:
    """One statement: a template over operands that may be masks or numbers, local or handed over."""

    part: int
    template: str
    operands: list[Value]
    results: list[Value]
    logic: bool  # operands are wanted as masks
    first_is_mask: bool = False

    def text(self, part: int) -> str:
        texts = []
        for i, value in enumerate(self.operands):
            wants_mask = self.logic or (self.first_is_mask and i == 0)
            text = value.text
            if 0 <= value.part != part:
                text = f"w[{value.slot}]" if not value.mask else f"((M)w[{value.slot}])"
            if wants_mask and not value.mask:
                text = f"({text} != 0.0)"
            elif value.mask and not wants_mask:
                text = f"lane_number({text})"
            texts.append(text)
        return self.template.format(*texts)


def _template(op: int, operands: Sequence[Value]) -> str:
    if op in _LIBM:
        return f"lane_{_LIBM[op]}({{0}})"
    if op in _LIBM2:
        return f"lane_{_LIBM2[op]}({{0}}, {{1}})"
    if op == ca.OP_IF_ELSE_ZERO:
        return "lane_pick({0}, {1})"
    if op in _WITH_A_NUMBER and operands[1].number:
        return _WITH_A_NUMBER[op]
    for table in (_NUMBERS, _COMPARISONS, _LOGIC):
        if op in table:
            return table[op]
    known = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == op]
    raise Unsupported(f"it contains the operation {known[0] if known else op}")


def _calls(outer: ca.Function, inner: ca.Function) -> bool:
    """True if `outer` contains a call of the very function `inner`."""
    return inner.__hash__() in {g.__hash__() for g in outer.find_functions(0)}


def _positions(sparsity: ca.Sparsity) -> list[int]:
    """Place of each nonzero in the dense matrix, by columns."""
    return list(sparsity.find())


def _offsets(sizes: Sequence[int]) -> list[int]:
    out = [0]
    for size in sizes:
        out.append(out[-1] + size)
    return out
