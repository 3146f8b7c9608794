"""Long demand sequences through a modulator: one compiled loop over the samples, the runs in SIMD lanes and threads."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models import native, native_source
from models.checked import Array, ModelError, as_finite
from models.modulators_base import NUMPY, Modulator
from models.native_cache import Library, load
from models.native_compiler import NotCompiledError, cpu_target, flags_for

_BLOCK = 32  # samples of the demand put side by side at a time
_CHUNK = 128  # samples between two looks at the result, in CasADi's interpreter
_MANY = 8  # runs

_DRIVER = """
#if LANES == 8 && defined(__GNUC__) && !defined(__clang__)
/* Eight samples of eight runs turned about: three rounds of shuffles in place of 64 loads. */
static inline void eight_by_eight(const double *r, const i64 *row, i64 rs, L *to) {{
  L q[8], w[8];
  for (i64 l = 0; l < 8; l++) __builtin_memcpy(&q[l], r + row[l] * rs, sizeof(L));
  for (i64 i = 0; i < 8; i += 2) {{
    w[i] = __builtin_shuffle(q[i], q[i + 1], (M){{0, 8, 2, 10, 4, 12, 6, 14}});
    w[i + 1] = __builtin_shuffle(q[i], q[i + 1], (M){{1, 9, 3, 11, 5, 13, 7, 15}});
  }}
  for (i64 i = 0; i < 8; i += 4) for (i64 j = 0; j < 2; j++) {{
    q[i + j] = __builtin_shuffle(w[i + j], w[i + j + 2], (M){{0, 1, 8, 9, 4, 5, 12, 13}});
    q[i + j + 2] = __builtin_shuffle(w[i + j], w[i + j + 2], (M){{2, 3, 10, 11, 6, 7, 14, 15}});
  }}
  for (i64 j = 0; j < 4; j++) {{
    to[j] = __builtin_shuffle(q[j], q[j + 4], (M){{0, 1, 2, 3, 8, 9, 10, 11}});
    to[j + 4] = __builtin_shuffle(q[j], q[j + 4], (M){{4, 5, 6, 7, 12, 13, 14, 15}});
  }}
}}
#endif
#if LANES > 1
typedef {number} Out __attribute__((vector_size(LANES * sizeof({number})), may_alias));
#endif
#define EXPORT __attribute__((visibility("default")))
EXPORT void rw_modulate(const double *z0, i64 zs, const double *r, i64 rs, const double *p, i64 ps, i64 steps, {number} *y, double *z_end,
                        double *sum, i64 first, i64 last) {{
  for (i64 a = first; a < last; a += LANES) {{
    L in[{nz} + 1 + {np}], out[{nz} + 1], block[{block}], total = lane_all(0.0);
    {number} given[{block}][LANES] __attribute__((aligned(64)));
    i64 row[LANES], count = last - a < LANES ? last - a : LANES;
    for (i64 l = 0; l < LANES; l++) row[l] = a + (l < count ? l : count - 1);
    for (i64 k = 0; k < {nz}; k++) in[k] = lane_rows(z0 + k, row, zs);
    for (i64 k = 0; k < {np}; k++) in[{nz} + 1 + k] = lane_rows(p + k, row, ps);
    for (i64 t = 0; t < steps; t += {block}) {{
      i64 n = steps - t < {block} ? steps - t : {block};
      i64 beside = 0;
#if LANES == 8 && defined(__GNUC__) && !defined(__clang__)
      for (; beside + 8 <= n; beside += 8) eight_by_eight(r + t + beside, row, rs, block + beside);
#endif
      for (i64 l = 0; l < LANES; l++) {{
        const double *from = r + row[l] * rs + t;
        double *to = (double *)block + l;
        for (i64 s = beside; s < n; s++) to[s * LANES] = from[s];
      }}
      for (i64 s = 0; s < n; s++) {{
        in[{nz}] = block[s];
        total += block[s];
        {step}(in, out);
        for (i64 k = 0; k < {nz}; k++) in[k] = out[k];
#if LANES > 1
        *(Out *)given[s] = __builtin_convertvector(out[{nz}], Out);
#else
        given[s][0] = ({number})out[{nz}][0];
#endif
      }}
      for (i64 l = 0; l < count; l++) {{
        const {number} *from = (const {number} *)given + l;
        {number} *to = y + (a + l) * steps + t;
        for (i64 s = 0; s < n; s++) to[s] = from[s * LANES];
      }}
    }}
    for (i64 l = 0; l < count; l++) for (i64 k = 0; k < {nz}; k++) z_end[(a + l) * {nz} + k] = in[k][l];
    for (i64 l = 0; l < count; l++) sum[a + l] = total[l];
  }}
}}
"""


@dataclass(frozen=True, slots=True, eq=False)
class Pulses:
    """Answer of a modulator to a demand sequence.

    Attributes
    ----------
    y : ndarray, shape (N,) or (runs, N)
        Output of each sample.
    z : ndarray, shape (nz,) or (runs, nz)
        State after the last sample.
    backend : {"lanes", "c", "interpreter"}
        How it was computed; the numbers do not depend on it.
    """

    y: Array
    z: Array
    backend: native.Backend

    @property
    def duty(self) -> Array:
        """Mean output, shape () or (runs,)."""
        return np.asarray(self.y.mean(axis=-1))

    @property
    def pulses(self) -> np.ndarray:
        """Number of times that a jet is turned on, shape () or (runs,); a change of direction counts."""
        before = np.concatenate([np.zeros_like(self.y[..., :1]), self.y[..., :-1]], axis=-1)
        return np.asarray(((self.y != 0) & (self.y != before)).sum(axis=-1))


def run(
    modulator: Modulator | Sequence[Modulator], r: ArrayLike, *, z0: ArrayLike | None = None, threads: int | None = None,
    dtype: type[np.float64] | type[np.int8] = np.float64,
) -> Pulses:  # fmt: skip
    """Feed a demand sequence through a modulator.

    Parameters
    ----------
    modulator : Modulator, or a sequence of as many of one class as there are runs
    r : array_like, shape (N,) or (runs, N)
        Demand; one sequence serves all runs where there are several modulators or initial states.
    z0 : array_like, shape (nz,) or (runs, nz), optional
        State before the first sample; at rest if not given.
    threads : int, optional
        Threads that share the runs; all processors of this process if not given.
    dtype : {numpy.float64, numpy.int8}
        Type of y.  Bytes are an eighth of the memory and faster; not for a modulator whose output is a mean (:class:`ContinuousPWPF`).

    Raises
    ------
    ModelError
        Shapes that do not fit together, a number that is not finite, modulators of several classes.

    Notes
    -----
    The first call for a class compiles its step (about a second, kept in the cache of compiled code); without a compiler CasADi's
    interpreter or NumPy, whichever is faster for that number of runs, gives the same numbers.
    """
    several = not isinstance(modulator, Modulator)
    kind, p = _parameters(modulator)
    if dtype not in (np.float64, np.int8) or (dtype is np.int8 and kind.MEAN):
        raise ModelError(f"{kind.NAME}: dtype: expected numpy.float64{'' if kind.MEAN else ' or numpy.int8'}, got {dtype!r}")
    demand, checked = _numbers(f"{kind.NAME}: r", r)
    state = np.ascontiguousarray(as_finite(f"{kind.NAME}: z0", np.zeros(len(kind.STATES)) if z0 is None else z0))
    if demand.ndim not in (1, 2) or demand.size == 0:
        raise ModelError(f"{kind.NAME}: r: expected shape (N,) or (runs, N), none of them empty, got {demand.shape}")
    if state.ndim not in (1, 2) or state.shape[-1] != len(kind.STATES):
        raise ModelError(f"{kind.NAME}: z0: expected shape (nz,) or (runs, nz) for [{' '.join(kind.STATES)}], got {state.shape}")
    counts = {len(a) for a, batch in ((p, several), (demand, demand.ndim == 2), (state, state.ndim == 2)) if batch}
    if len(counts) > 1:
        raise ModelError(f"{kind.NAME}: modulators, demands and initial states are for {sorted(counts)} runs; give equal numbers, or one")
    runs = counts.pop() if counts else 1
    if runs == 0:
        raise ModelError(f"{kind.NAME}: no runs; give at least one")
    single = not several and demand.ndim == 1 and state.ndim == 1
    y, z, finite, backend = _advance(kind, state, demand, p if several else p[0], runs, threads, dtype)
    if not (checked or finite):
        as_finite(f"{kind.NAME}: r", demand)  # names the number; large finite ones, whose sum alone overflows, pass
    return Pulses(_read_only(y[0] if single else y), _read_only(z[0] if single else z), backend)


def _numbers(what: str, values: ArrayLike) -> tuple[Array, bool]:
    """Contiguous float64 array, and whether it is known to be finite: a large array of the right kind is looked at where it is read."""
    if type(values) is np.ndarray and values.dtype == np.float64 and values.flags.c_contiguous:
        return values, False
    return np.ascontiguousarray(as_finite(what, values)), True


def _read_only(array: Array) -> Array:
    """The array itself, read-only."""
    array.flags.writeable = False
    return array


def _parameters(modulator: Modulator | Sequence[Modulator]) -> tuple[type[Modulator], Array]:
    """Class and parameters (runs, np)."""
    all_of = [modulator] if isinstance(modulator, Modulator) else list(modulator)
    if not all_of or not all(isinstance(m, Modulator) for m in all_of):
        raise ModelError(f"run: expected a modulator or a sequence of them, got {modulator!r}; make one with models.modulators")
    kinds = {type(m) for m in all_of}
    if len(kinds) > 1:
        raise ModelError(f"run: modulators of several classes {sorted(k.__name__ for k in kinds)}; run each class by itself")
    return type(all_of[0]), np.array([m.parameters() for m in all_of])


def _advance(
    kind: type[Modulator], state: Array, demand: Array, p: Array, runs: int, threads: int | None, dtype: type
) -> tuple[Array, Array, bool, native.Backend]:  # fmt: skip
    """(y, z, whether the sum of each run's demand is finite, backend)."""
    steps, nz = demand.shape[-1], len(kind.STATES)
    key: Any = kind
    built = _compiled(key, native.switched_off(), "signed char" if dtype is np.int8 else "double")
    if built is None:
        y, z = _interpreted(kind, state, as_finite(f"{kind.NAME}: r", demand), p, runs)
        return y.astype(dtype, copy=False), z, True, "interpreter"
    library, lanes, backend = built
    y, z, total = np.empty((runs, steps), dtype=dtype), np.empty((runs, nz)), np.empty(runs)
    entry = library.entry("rw_modulate")
    given: list[Any] = []
    for array in (state, demand, p):
        given += [native.address(array), ctypes.c_longlong(array.shape[1] if array.ndim == 2 else 0)]
    given += [ctypes.c_longlong(steps), native.address(y), native.address(z), native.address(total)]
    workers = native.options(kind.kernel(), "auto", threads or "auto", "accurate")
    native.in_threads(lambda first, last: entry(*given, ctypes.c_longlong(first), ctypes.c_longlong(last)),
                      runs, lanes, workers, vectors_each=1 if steps > 1000 else 64,
                      keep=(library, state, demand, p, y, z, total))  # fmt: skip
    return y, z, bool(np.isfinite(total).all()), backend


@lru_cache(maxsize=32)
def _compiled(kind: type[Modulator], off: bool, number: str) -> tuple[Library, int, native.Backend] | None:
    """Library of a class of modulators with its lanes; None where nothing can be compiled."""
    if off:
        return None
    kernel = kind.kernel()
    try:
        written = native.write((kernel,), "auto", "accurate")
        driver = _DRIVER.format(step=written.names[0], nz=len(kind.STATES), np=len(kind.PARAMETERS), block=_BLOCK, number=number)
        # The step is a few instructions: a call through memory for each sample would cost more than they do.
        source = written.unit.source(driver).replace("#define PART static __attribute__((noinline))", "#define PART INLINE")
        library = load(source, flags_for(cpu_target(), fast=False))
    except (native_source.Unsupported, NotCompiledError, RuntimeError) as error:
        native.interpreted(kernel, error)
        return None
    return library, written.lanes, written.backend


def _interpreted(kind: type[Modulator], state: Array, demand: Array, p: Array, runs: int) -> tuple[Array, Array]:
    """The same without a compiler: few runs by CasADi's interpreter, some samples at a time, many by NumPy, sample by sample."""
    kernel, steps = kind.kernel(), demand.shape[-1]
    z = np.array(np.broadcast_to(state, (runs, kernel.size1_in(0))))
    rows, every = np.broadcast_to(p, (runs, kernel.size1_in(2))), np.broadcast_to(demand, (runs, steps))
    y = np.empty((runs, steps))
    if runs >= _MANY and not kind.ELEMENTARY:  # measured: there NumPy's work for one sample is less than the interpreter's
        now, parameters = tuple(z.T.copy()), tuple(rows.T.copy())
        for i in range(steps):
            now, y[:, i] = kind.advance(NUMPY, now, every[:, i], parameters)
        return y, np.stack(now, axis=1)
    for first in range(0, steps, _CHUNK):
        count = min(_CHUNK, steps - first)
        chain = kernel.mapaccum(count).map(runs)
        given = [z.T, every[:, first : first + count].reshape(1, -1), np.repeat(rows, count, axis=0).T]
        after, out = chain.call([ca.DM(g) for g in given])
        z = np.asarray(after.full()).T.reshape(runs, count, -1)[:, -1]
        y[:, first : first + count] = np.asarray(out.full()).reshape(runs, count)
    return y, z
