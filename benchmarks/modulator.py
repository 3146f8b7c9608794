"""Jet modulators: ten million steps beside numba and plain Python, the map of limit cycles, the describing function and the exact cycle.

Steps: 1000 demands of 10,000 samples through the sampled modulator of Lu & Zhang 2012 (paper 000); every tool returns all outputs.
Numba runs with fastmath on all threads, in two forms, with outputs in double precision and in single bytes.  Plain Python runs one
demand; its time for all is extrapolated, and said so.  Map: the census at 200 x 200 points of (k, delta), with and without a compiler.
Cycle: frequency of the Schmitt trigger's loop of Deng et al. 2016 (paper 001) by python-control's describing function and by this project.

Run: python -m benchmarks.modulator [--quick] [--json]
"""

from __future__ import annotations

import importlib.util
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from benchmarks import _bench
from models.census_map import census_map
from models.describing import schmitt_df
from models.limit_cycles import describing_cycle, symmetric_cycle
from models.modulators import DiscretePWPF, SchmittTrigger
from models.modulators_runs import run
from models.nyquist import intersections

try:
    import control
except ImportError:
    control = None

RUNS, STEPS = 1000, 10_000
MODULATOR = DiscretePWPF(k=0.8, delta=0.01, h=0.1)
Array = np.ndarray


def demands(runs: int, steps: int) -> Array:
    """Harmonic demands of all amplitudes and many frequencies."""
    rng = np.random.default_rng(4)
    amplitude, frequency, phase = rng.uniform(0.1, 1, (runs, 1)), rng.uniform(0.5, 3, (runs, 1)), rng.uniform(0, 6, (runs, 1))
    return np.asarray(amplitude * np.sin(frequency * MODULATOR.Ts * np.arange(steps) + phase))


def plain(r: list[float]) -> list[int]:
    """The same in plain floats."""
    p = MODULATOR
    m, n, on, off, k, delta = p.m, p.n, p.u_on, p.u_off, p.k, p.delta
    x = e = 0.0
    y, out = 0, []
    for demand in r:
        new = demand + delta - k * y
        x = n * x + m * (new + e)
        e = new
        if x >= on or (y > 0 and x > off):
            y = 1
        elif x <= -on or (y < 0 and x < -off):
            y = -1
        else:
            y = 0
        out.append(y)
    return out


def steps_rows(*, quick: bool) -> list[dict[str, Any]]:
    """Times of the steps, the tools taking turns, and the share of outputs that differ from ours."""
    runs, steps = (100, 2000) if quick else (RUNS, STEPS)
    r = demands(runs, steps)
    ours = run(MODULATOR, r)
    jobs: list[tuple[str, str, Callable[[], Array]]] = [
        ("workbench", f"{ours.backend}, int8", lambda: run(MODULATOR, r, dtype=np.int8).y),
        ("workbench", f"{ours.backend}, float64", lambda: run(MODULATOR, r).y),
    ]
    if importlib.util.find_spec("numba") is not None:
        from benchmarks import _modulator_numba

        p = MODULATOR
        values = np.array([p.m, p.n, p.u_on, p.u_off, p.k, p.delta])

        def numba_job(kernel: Any, kind: Any) -> Array:
            return np.asarray(kernel(r, values, np.empty(r.shape, dtype=kind)))

        for name, kernel in _modulator_numba.KERNELS.items():
            jobs += [("numba", f"{name}, {np.dtype(kind).name}", partial(numba_job, kernel, kind)) for kind in (np.float64, np.int8)]
    rows = [
        {"tool": tool, "detail": detail, "seconds": math.inf, "differing": float(np.mean(job() != ours.y))} for tool, detail, job in jobs
    ]
    for _ in range(2 if quick else 30):
        for row, (_, _, job) in zip(rows, jobs, strict=True):
            begin = time.perf_counter()
            job()
            row["seconds"] = min(row["seconds"], time.perf_counter() - begin)
    one = r[0].tolist()
    begin = time.perf_counter()
    out = np.array(plain(one))
    spent = (time.perf_counter() - begin) * runs
    rows.append(
        {"tool": "plain Python", "detail": "one run, time extrapolated", "seconds": spent, "differing": float(np.mean(out != ours.y[0]))}
    )
    for row in rows:
        row["steps_per_s"] = runs * steps / row["seconds"]
    return rows


@contextmanager
def without_compiler() -> Iterator[None]:
    before = os.environ.get("REENTRY_NATIVE")
    os.environ["REENTRY_NATIVE"] = "off"
    try:
        yield
    finally:
        os.environ.pop("REENTRY_NATIVE")
        if before is not None:
            os.environ["REENTRY_NATIVE"] = before


def map_rows(*, quick: bool) -> list[dict[str, Any]]:
    """Times of the census map."""
    size = 40 if quick else 200
    k, delta = np.linspace(0, 6, size), np.linspace(0, 0.1125, size)
    first = census_map(MODULATOR_OF_MAP, k, delta)
    rows = [{"tool": "compiled", "seconds": _bench.best(lambda: census_map(MODULATOR_OF_MAP, k, delta), repeat=5, budget=10.0)}]
    with without_compiler():
        begin = time.perf_counter()
        second = census_map(MODULATOR_OF_MAP, k, delta)
        rows.append({"tool": "NumPy", "seconds": time.perf_counter() - begin})
    same = first.words == second.words and bool((first.exists == second.exists).all() and (first.decided == second.decided).all())
    for row in rows:
        row.update(points=size * size, words=len(first.words), undecided=int((~first.decided).sum()), same=same)
    return rows


MODULATOR_OF_MAP = DiscretePWPF(km=4.0, tau_m=0.2, u_on=0.45, h=0.0, Ts=0.06)


A_JET, TAU, TRIGGER = 0.15, 0.7, SchmittTrigger(0.7, 0.3)


def flown_frequency(cycles: int = 200) -> float:
    """Frequency of the loop after many cycles, from switch to switch in plain floats: parabolas, nothing shared with the workbench."""
    u_on, u_off = TRIGGER.u_on, TRIGGER.u_off
    theta, rate, period = 0.2, 0.5, 0.0
    for _ in range(2 * cycles):
        side = 1.0 if rate > 0 else -1.0  # the other half of the cycle is its mirror image
        theta, rate = side * theta, side * rate
        coast = (u_on - theta - TAU * rate) / rate
        theta += rate * coast
        # firing until theta + tau rate = u_off: -a t^2/2 + (rate - a tau) t + (u_on - u_off) = 0
        b = rate - A_JET * TAU
        fire = (b + math.sqrt(b * b + 2 * A_JET * (u_on - u_off))) / A_JET
        theta, rate = theta + rate * fire - A_JET * fire * fire / 2, rate - A_JET * fire
        period = coast + fire
        theta, rate = side * theta, side * rate
    return math.pi / period


class ControlTrigger(control.descfcn.DescribingFunctionNonlinearity if control else object):
    """Schmitt trigger with dead zone for python-control, which has relays with two positions only."""

    def __init__(self, analytic: bool) -> None:
        self.analytic, self.y = analytic, 0

    def __call__(self, x: float) -> float:
        """Output for the next sample of the input."""
        if x >= TRIGGER.u_on or (self.y > 0 and x > TRIGGER.u_off):
            self.y = 1
        elif x <= -TRIGGER.u_on or (self.y < 0 and x < -TRIGGER.u_off):
            self.y = -1
        else:
            self.y = 0
        return float(self.y)

    def _isstatic(self) -> bool:
        return False

    def describing_function(self, A: float) -> complex:
        """Closed form, where it is to be used."""
        if not self.analytic:
            raise NotImplementedError
        if TRIGGER.u_on > A:
            return 0j
        on, off = TRIGGER.u_on / A, TRIGGER.u_off / A
        return complex(2 * (math.sqrt(1 - on**2) + math.sqrt(1 - off**2)), -2 * (on - off)) / (math.pi * A)


def cycle_rows(*, quick: bool) -> list[dict[str, Any]]:
    """Frequency of the jet loop a (1 + tau s)/s^2 with a Schmitt trigger: error against what each computes, and against the flown cycle.

    Parameters of Deng et al. 2016 (paper 001); the describing function's own solution from the cubic of its Theorem 1 by numpy.roots.
    """
    truth = flown_frequency()
    h, s = TRIGGER.u_on - TRIGGER.u_off, TRIGGER.u_on + TRIGGER.u_off
    roots = np.roots([1.0, 0.0, (h / (s * TAU)) ** 2, -8 * A_JET * h / (math.pi * s**2 * TAU)])
    predicted = float(roots[np.abs(roots.imag) < 1e-12].real[0])
    amplitudes = (1.0001 * TRIGGER.u_on, 10 * TRIGGER.u_on)
    numerator, denominator = [A_JET * TAU, A_JET], [1.0, 0.0, 0.0]

    def crossing() -> float:
        (found,) = intersections((numerator, denominator), partial(schmitt_df, TRIGGER), frequencies=(0.05, 5.0), amplitudes=amplitudes)
        return found.w

    jobs: list[tuple[str, str, float, Callable[[], float]]] = [
        ("workbench", "exact cycle, closed form", truth, lambda: symmetric_cycle(TRIGGER, a=A_JET, tau=TAU).w),
        ("workbench", "describing function, closed form", predicted, lambda: describing_cycle(TRIGGER, a=A_JET, tau=TAU).w or math.nan),
        ("workbench", "describing function, any linear part", predicted, crossing),
    ]
    if control is not None:
        plant, grid = control.tf(numerator, denominator), np.geomspace(*amplitudes, 20 if quick else 100)
        omega = np.geomspace(0.05, 5.0, 400)

        def by_control(analytic: bool) -> float:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = control.describing_function_response(plant, ControlTrigger(analytic), grid, omega).intersections
            return float(found[0][1]) if found else math.nan

        jobs += [(f"python-control {control.__version__}", f"describing function, {name}", predicted, partial(by_control, analytic))
                 for name, analytic in (("numerical", False), ("formula given to it", True))]  # fmt: skip
    rows = []
    for tool, what, aim, job in jobs:
        w = job()
        rows.append({
            "tool": tool, "what": what, "w": w, "error": abs(w / aim - 1), "from_the_flown_cycle": abs(w / truth - 1),
            "seconds": _bench.best(job, repeat=2 if quick else 20),
        })  # fmt: skip
    return rows


def measure(*, quick: bool = False) -> dict[str, Any]:
    """All three parts."""
    _bench.announce("steps")
    rows = steps_rows(quick=quick)
    _bench.announce("map")
    maps = map_rows(quick=quick)
    _bench.announce("cycle")
    return {"machine": _bench.machine(), "rows": rows, "map": maps, "cycle": cycle_rows(quick=quick)}


def show(result: dict[str, Any]) -> None:
    """The tables."""
    ours = result["rows"][0]["seconds"]
    lines = []
    for row in result["rows"]:
        rates = (f"{row['steps_per_s']:.3g}", f"{row['seconds'] / ours:.3g}", f"{row['differing']:.2g}")
        lines.append((row["tool"], row["detail"], _bench.milliseconds(row["seconds"]), *rates))
    _bench.table("Steps of the sampled modulator", ("tool", "how", "time", "steps/s", "ratio", "differing"), lines)
    lines = [(row["tool"], f"{row['points']} points, {row['words']} words", _bench.milliseconds(row["seconds"])) for row in result["map"]]
    _bench.table("Census map", ("how", "size", "time"), lines)
    if result["cycle"]:
        lines = [
            (
                row["tool"],
                row["what"],
                f"{row['w']:.6f}",
                f"{row['error']:.1e}",
                f"{row['from_the_flown_cycle']:.1e}",
                _bench.milliseconds(row["seconds"]),
            )
            for row in result["cycle"]
        ]
        _bench.table("Limit cycle of a jet loop", ("tool", "what", "rad/s", "error", "from the flown", "time"), lines)


if __name__ == "__main__":
    _bench.run(__doc__, measure, show)
