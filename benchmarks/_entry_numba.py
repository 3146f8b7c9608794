"""Entries by numba: the rate and all 12 stages of a Runge-Kutta step written out and compiled, cases on all threads."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from scipy.integrate import DOP853

Array = np.ndarray


def step_source() -> str:
    """Python text of one step of order 8 on six floats, without its zero coefficients."""
    y = [f"y{m}" for m in range(6)]
    lines = [f"def step({', '.join(y)}, h, kd, kl):"]
    for i in range(len(DOP853.B)):
        terms = [(j, DOP853.A[i, j]) for j in range(i) if DOP853.A[i, j] != 0]
        at = [f"{y[m]} + h * ({' + '.join(f'{a!r} * k{j}_{m}' for j, a in _floats(terms))})" if terms else y[m] for m in range(6)]
        lines.append(f"    {', '.join(f'k{i}_{m}' for m in range(6))} = rate({', '.join(at)}, kd, kl)")
    weights = [(i, b) for i, b in enumerate(DOP853.B) if b != 0]
    ends = [f"{y[m]} + h * ({' + '.join(f'{b!r} * k{i}_{m}' for i, b in _floats(weights))})" for m in range(6)]
    return "\n".join([*lines, f"    return {', '.join(ends)}"])


def _floats(terms: list[tuple[int, Any]]) -> list[tuple[int, float]]:
    return [(i, float(a)) for i, a in terms]


def kernel(rate: Callable[..., Any], altitude: Callable[..., float], stop: float) -> Callable[[Array, Array, float, float], Array]:
    """(y0 (N, 6), (kd, kl) (N, 2), step s, t_max s) -> states at the stop altitude (N, 6); NaN where it is not reached."""
    compiled = numba.njit(fastmath=True, error_model="numpy")
    place: dict[str, Any] = {"rate": compiled(rate)}
    exec(step_source(), place)
    step, height = compiled(place["step"]), compiled(altitude)

    @numba.njit(fastmath=True, error_model="numpy")
    def one(start: Array, kd: float, kl: float, h: float, count: int) -> Any:
        y = (start[0], start[1], start[2], start[3], start[4], start[5])
        for _ in range(count):
            end = step(y[0], y[1], y[2], y[3], y[4], y[5], h, kd, kl)
            b = height(end[0], end[1], end[2]) - stop
            if b <= 0.0:
                low, high, a = 0.0, h, height(y[0], y[1], y[2]) - stop
                for _ in range(30):
                    at = high - b * (high - low) / (b - a)
                    end = step(y[0], y[1], y[2], y[3], y[4], y[5], at, kd, kl)
                    low, high, a, b = high, at, b, height(end[0], end[1], end[2]) - stop
                    if abs(b) < 1e-5 or a == b:
                        break
                return end
            y = end
        return (math.nan, math.nan, math.nan, math.nan, math.nan, math.nan)

    @numba.njit(parallel=True, fastmath=True, error_model="numpy")
    def fly(y0: Array, k: Array, h: float, t_max: float) -> Array:
        out = np.empty_like(y0)
        count = int(t_max / h) + 1
        for i in numba.prange(len(y0)):
            end = one(y0[i], k[i, 0], k[i, 1], h, count)
            for m in range(6):
                out[i, m] = end[m]
        return out

    return fly
