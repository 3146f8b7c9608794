"""A CasADi function as a folder of C99 that needs nothing else: source, header, build file, test vectors and a test that checks itself."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, evaluate
from models.native_source import NO_C, PREFIX, dense
from models.native_spline import literal

_HEADERS = {"math.h", "string.h", "stdlib.h", "stdio.h"}
_SIGNATURE = r"(\(const casadi_real\*\* arg, casadi_real\*\* res, casadi_int\* iw, casadi_real\* w, int mem\) ?\{)"

_TEST = """/* Compares {name} with its test vectors; prints the largest deviation and returns 0 if it is small enough. */
#include <math.h>
#include <stdio.h>
#include "{name}.h"
#include "{name}_vectors.h"

int main(void) {{
  static casadi_real in[{n_in} + 1], out[{n_out} + 1], w[{name}_SZ_W + 1];
  static casadi_int iw[{name}_SZ_IW + 1];
  static const casadi_real *arg[{name}_SZ_ARG + 1];
  static casadi_real *res[{name}_SZ_RES + 1];
  static const int first_in[] = {{{first_in}}}, first_out[] = {{{first_out}}};
  double tolerance = sizeof(casadi_real) == 8 ? 1e-12 : 1e-4, worst = 0;
  int i, k, mem = {name}_checkout();
  for (i = 0; i < {points}; i++) {{
    for (k = 0; k < {n_in}; k++) in[k] = (casadi_real){name}_inputs[i][k];
    for (k = 0; k < {args}; k++) arg[k] = in + first_in[k];
    for (k = 0; k < {results}; k++) res[k] = out + first_out[k];
    if ({name}(arg, res, iw, w, mem)) {{ printf("point %d: the function failed\\n", i); return 1; }}
    for (k = 0; k < {n_out}; k++) {{
      double wanted = {name}_outputs[i][k], error = fabs((double)out[k] - wanted) / {name}_scale[k];
      if (!(error <= worst)) worst = error;
      if (!(error <= tolerance)) {{
        printf("point %d, output %d: %.17g, expected %.17g\\n", i, k, (double)out[k], wanted);
        return 1;
      }}
    }}
  }}
  {name}_release(mem);
  printf("{points} points, largest relative deviation %.3g\\n", worst);
  return 0;
}}
"""

_CMAKE = """cmake_minimum_required(VERSION 3.13)
project({name} C)
set(CMAKE_C_STANDARD 99)
add_library({name} {name}.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(UNIX)
  target_link_libraries({name} PUBLIC m)
endif()
enable_testing()
add_executable({name}_test {name}_test.c)
target_link_libraries({name}_test {name})
add_test(NAME {name} COMMAND {name}_test)
"""


def export(function: ca.Function, folder: str | Path, *, points: Sequence[ArrayLike] | None = None) -> tuple[Path, ...]:
    """Write a function as C99 with its own test.  The code allocates nothing and keeps no state.

    Parameters
    ----------
    function : casadi.Function
        Inputs that are columns.  In C it is called ``rw_`` and its name, and takes and returns dense columns.
    folder : path
        Made if need be; files of the same names are replaced.
    points : sequence of array_like, optional
        Arguments of the test vectors, one array (N, n_i) for each input; without it numbers between 0.5 and 1.5.

    Returns
    -------
    tuple of Path
        Source, header, test vectors, test program, CMake file.

    Raises
    ------
    ModelError
        A function that CasADi cannot write as plain C, or no test point with finite results.
    """
    name = PREFIX + re.sub(r"\W", "_", function.name())
    flat = dense(function, name)
    source, header = _code(flat, name, function.name())
    arguments, results = _vectors(flat, points)
    n_in, n_out = arguments.shape[1], results.shape[1]
    sizes_in = [flat.numel_in(i) for i in range(flat.n_in())]
    sizes_out = [flat.numel_out(o) for o in range(flat.n_out())]
    scale = np.maximum(np.abs(results).max(axis=0), 1e-300)
    vectors = (
        f"/* Test vectors of {name}: inputs and outputs, each stacked by columns; scale: largest size of each output. */\n"
        + _matrix(f"{name}_inputs", arguments) + _matrix(f"{name}_outputs", results)
        + f"static const double {name}_scale[{n_out}] = {{{', '.join(literal(float(v)) for v in scale)}}};\n"
    )  # fmt: skip
    test = _TEST.format(
        name=name, n_in=n_in, n_out=n_out, points=len(arguments), args=flat.n_in(), results=flat.n_out(),
        first_in=", ".join(str(sum(sizes_in[:i])) for i in range(len(sizes_in) + 1)),
        first_out=", ".join(str(sum(sizes_out[:i])) for i in range(len(sizes_out) + 1)),
    )  # fmt: skip
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    files = {
        f"{name}.c": source, f"{name}.h": header, f"{name}_vectors.h": vectors, f"{name}_test.c": test,
        "CMakeLists.txt": _CMAKE.format(name=name),
    }  # fmt: skip
    for file, text in files.items():
        (place / file).write_text(text, encoding="ascii")
    return tuple(place / file for file in files)


def _code(flat: ca.Function, name: str, shown: str) -> tuple[str, str]:
    """Source and header, without warnings of a strict compiler."""
    for part in flat.find_functions():
        if part.class_name() in NO_C:
            raise ModelError(f"export: {shown} holds {part.name()} ({part.class_name()}), which has no C code; take fixed steps instead")
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": True})
    with tempfile.TemporaryDirectory() as folder:
        try:
            generator.add(flat)
            generator.generate(f"{folder}/")
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(f"export: {shown} cannot be written as C: {reason}; export the parts around that operation") from None
        source, header = (Path(folder, f"{name}{ending}").read_text(encoding="utf-8") for ending in (".c", ".h"))
    foreign = sorted(set(re.findall(r"#include [<\"]([^>\"]+)[>\"]", source)) - _HEADERS)
    foreign += re.findall(r"#error (.*)", source)
    foreign += re.findall(r"\berfinv\b", source)[:1] + re.findall(r"(?m)^extern (?!\"C\")[^;]*;", source)
    if foreign:
        raise ModelError(f"export: {shown} needs {foreign[0]}, which is not part of C99; export the parts around that operation")
    source = re.sub(_SIGNATURE, r"\1\n  (void)arg; (void)res; (void)iw; (void)w; (void)mem;", source)
    return re.sub(r"(_release\(int mem\) \{)", r"\1\n  (void)mem;", source), header


def _vectors(flat: ca.Function, points: Sequence[ArrayLike] | None) -> tuple[Array, Array]:
    """Finite test points: arguments (N, sum n_i) and results (N, sum of sizes), stacked by columns."""
    if points is None:
        random = np.random.default_rng(0)
        given = [random.uniform(0.5, 1.5, (16, flat.size1_in(i))) for i in range(flat.n_in())]
    else:
        given = [np.atleast_2d(np.asarray(p, dtype=float)) for p in points]
    outputs = evaluate(flat, *given, finite=False)
    stacked = np.hstack([np.moveaxis(out, 1, -1).reshape(len(out), -1) if out.ndim == 3 else out for out in outputs])
    good = np.isfinite(stacked).all(axis=1)
    if not good.any():
        raise ModelError(f"export: {flat.name()}: no test point gives finite results; pass points= inside the domain of the function")
    return np.hstack(given)[good], stacked[good]


def _matrix(name: str, values: Array) -> str:
    rows = ",\n  ".join("{" + ", ".join(literal(float(v)) for v in row) + "}" for row in values)
    return f"static const double {name}[{values.shape[0]}][{values.shape[1]}] = {{\n  {rows}}};\n"
