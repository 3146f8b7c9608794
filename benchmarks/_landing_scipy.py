"""Landing predictions with scipy: the equations of motion by hand in plain floats, restarted at the kinks of the bank profile."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

MU, RADIUS, SPIN = 3.986004418e14, 6371e3, 7.292115e-5
RHO0, HEIGHT, BALLISTIC, RATIO = 1.225, 7110.0, 450.0, 0.30
Line = tuple[float, float, float]  # bank angle at a time, rad and s, and its slope


def rate(line: Line) -> Callable[[float, Any], list[float]]:
    """Rate of [x y z u v w] over a rotating planet with a central field, along a straight line of the bank angle."""
    bank0, t0, slope = line
    exp, sqrt, sin, cos = math.exp, math.sqrt, math.sin, math.cos

    def f(t: float, s: Any) -> list[float]:
        x, y, z, u, v, w = s
        r = sqrt(x * x + y * y + z * z)
        V2 = u * u + v * v + w * w
        V = sqrt(V2)
        drag = 0.5 / BALLISTIC * RHO0 * exp(-(r - RADIUS) / HEIGHT) * V2
        bank = bank0 + slope * (t - t0)
        ex, ey, ez = u / V, v / V, w / V
        ux, uy, uz = x / r, y / r, z / r
        c = ux * ex + uy * ey + uz * ez
        nx, ny, nz = ux - c * ex, uy - c * ey, uz - c * ez
        n = sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx / n, ny / n, nz / n
        sx, sy, sz = ey * nz - ez * ny, ez * nx - ex * nz, ex * ny - ey * nx
        up, side = RATIO * drag * cos(bank), RATIO * drag * sin(bank)
        g = -MU / (r * r * r)
        return [
            u, v, w,
            g * x - drag * ex + up * nx + side * sx + 2 * SPIN * v + SPIN * SPIN * x,
            g * y - drag * ey + up * ny + side * sy - 2 * SPIN * u + SPIN * SPIN * y,
            g * z - drag * ez + up * nz + side * sz,
        ]  # fmt: skip

    return f


def fall(
    x: Any, T: Any, B: Any, *, stop: float, method: str = "DOP853", rtol: float = 1e-8, atol: float = 1e-3
) -> tuple[float, np.ndarray]:
    """(time, state) at the stop altitude, m, of a flight from time 0 along nodes (T, B) of the bank angle."""

    def height(_t: float, s: Any) -> float:
        return math.sqrt(s[0] ** 2 + s[1] ** 2 + s[2] ** 2) - RADIUS - stop

    height.terminal = True  # type: ignore[attr-defined]
    t, times, banks = 0.0, [0.0, *T, 3000.0], [B[0], *B, B[-1]]
    for k in range(len(times) - 1):
        if times[k + 1] <= t:
            continue
        line = (banks[k], times[k], (banks[k + 1] - banks[k]) / max(times[k + 1] - times[k], 1e-9))
        done = solve_ivp(rate(line), (t, times[k + 1]), x, method=method, rtol=rtol, atol=atol, events=height)
        if done.t_events[0].size:
            return float(done.t_events[0][0]), done.y_events[0][0]
        t, x = times[k + 1], done.y[:, -1]
    raise RuntimeError("the flight does not come down")
