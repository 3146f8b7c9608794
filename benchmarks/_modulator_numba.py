"""The sampled modulator by numba: one run after the other on each thread, and blocks of runs side by side so that LLVM makes vectors."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np

Array = np.ndarray
Kernel = Callable[[Array, Array, Array], Array]
LANES = 16


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=False)
def one_by_one(r: Array, p: Array, y: Array) -> Array:
    m, n, on, off, k, delta = p[0], p[1], p[2], p[3], p[4], p[5]
    for i in numba.prange(r.shape[0]):
        x, e, last = 0.0, 0.0, 0.0
        for t in range(r.shape[1]):
            new = r[i, t] + delta - k * last
            x = n * x + m * (new + e)
            e = new
            up = on if last <= 0.0 else off
            down = on if last >= 0.0 else off
            last = 1.0 if (x >= on or (last > 0.0 and x > up)) else (-1.0 if (x <= -on or (last < 0.0 and x < -down)) else 0.0)
            y[i, t] = last
    return y


@numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=False)
def side_by_side(r: Array, p: Array, y: Array) -> Array:
    """Blocks of 16 runs; the inner loop over them has no branch."""
    m, n, on, off, k, delta = p[0], p[1], p[2], p[3], p[4], p[5]
    blocks = (r.shape[0] + LANES - 1) // LANES
    steps = r.shape[1]
    for b in numba.prange(blocks):
        first = b * LANES
        count = min(LANES, r.shape[0] - first)
        x, e, last = np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
        demand, out = np.zeros((64, LANES)), np.zeros((64, LANES))
        for t0 in range(0, steps, 64):
            size = min(64, steps - t0)
            for i in range(count):
                for t in range(size):
                    demand[t, i] = r[first + i, t0 + t]
            for t in range(size):
                for i in range(LANES):
                    new = demand[t, i] + delta - k * last[i]
                    value = n * x[i] + m * (new + e[i])
                    up = off if last[i] > 0.0 else on
                    down = off if last[i] < 0.0 else on
                    plus = 1.0 if (value >= on) | ((last[i] > 0.0) & (value > up)) else 0.0
                    minus = 1.0 if (value <= -on) | ((last[i] < 0.0) & (value < -down)) else 0.0
                    x[i] = value
                    e[i] = new
                    last[i] = plus - minus
                    out[t, i] = plus - minus
            for i in range(count):
                for t in range(size):
                    y[first + i, t0 + t] = out[t, i]
    return y


KERNELS: dict[str, Kernel] = {"one run after the other": one_by_one, "16 runs side by side": side_by_side}
