"""Dispersed entries in three degrees of freedom, equally accurate: the workbench, scipy, numba, diffrax and CasADi's interpreter.

The task: Soyuz from its entry state to 10.8 km at a constant bank angle, exponential atmosphere, rotating Earth with J2; speed,
flight-path angle, density, drag and lift are dispersed.  The error is the distance from the true position at the stop, the largest
of the first 1000 cases (or of those flown).  The truth is scipy's DOP853 at a tight tolerance, with equations written here in
Cartesian axes; beyond the first cases it is the workbench at 1/4 s, which must agree with it.  Every tool gets, in hindsight,
the longest step or loosest tolerance that meets the target.  All fly two sets of equations, the spherical ones of `models.entry_3dof`
and the Cartesian ones of `models.entry_cartesian`, which need little trigonometry; the other tools have them written by hand, for a
constant bank angle and without the wave of the density that the models carry.  The tools take turns, and the best of several rounds
counts, so that what else the machine does meets all of them.  Times of compiling stand apart from the rates.

Run: python -m benchmarks.entry [--quick] [--json]
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import models
import ocp
from benchmarks import _bench, _figure
from models.native_loop import compile_loop
from ocp import flight
from ocp.methods import RK8

Array = np.ndarray
TARGET = 1e-2  # m
STOP, T_MAX, BANK = 10.8e3, 1500.0, 0.8
STEPS = (
    64.0, 56.0, 48.0, 44.0, 40.0, 38.0, 36.0, 34.0, 32.0, 30.0, 28.0, 26.0, 24.0, 22.0, 20.0, 18.0, 16.0, 14.0, 12.0, 10.0, 9.0, 8.0, 7.0,
    6.0, 5.0, 4.5, 4.0, 3.5, 3.0, 2.5, 2.0, 1.5, 1.0, 0.75, 0.5,
)  # fmt: skip
PLANET = models.EARTH
MU, RADIUS, SPIN, J2, EQUATOR = PLANET.mu, PLANET.radius, PLANET.rotation, PLANET.J2, PLANET.equatorial_radius
RHO0, HEIGHT = 1.225, 7110.0
COS_BANK, SIN_BANK = math.cos(BANK), math.sin(BANK)
WIDTHS = {"V": 20.0, "gamma": math.radians(0.1), "rho_factor": 0.15, "CD_factor": 0.05, "CL_factor": 0.1}  # uniform, half


@dataclass(frozen=True, slots=True)
class Row:
    """One tool: its setting, cases flown, error in m, entries per second, and compile (or first-call) time, s."""

    tool: str
    setting: str
    cases: int
    flown: int
    error_m: float
    rate: float
    build_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """The models by form, cases (spherical x0 (N, 6), p (N, np)), drag and lift areas over twice the mass (N, 2), true positions."""

    models: dict[str, models.Model]
    x0: Array
    p: Array
    k: Array
    truth: Array
    agreement_m: float


def spherical(h: float, lon: float, lat: float, V: float, gamma: float, psi: float, kd: float, kl: float) -> tuple[float, ...]:
    """Rate of (h, lon, lat, V, gamma, psi)."""
    sg, cg, sp, cp, sl, cl = math.sin(gamma), math.cos(gamma), math.sin(psi), math.cos(psi), math.sin(lat), math.cos(lat)
    r = RADIUS + h
    q = RHO0 * math.exp(-h / HEIGHT) * V * V
    oblate = 1.5 * MU * J2 * (EQUATOR / (r * r)) ** 2
    up = -MU / (r * r) + oblate * (3 * sl * sl - 1) + SPIN * SPIN * r * cl * cl
    north = -2 * oblate * sl * cl - SPIN * SPIN * r * sl * cl
    around = V * cg / r
    return (
        V * sg,
        around * sp / cl,
        around * cp,
        -kd * q + up * sg + north * cg * cp,
        (kl * q * COS_BANK + up * cg - north * sg * cp) / V + 2 * SPIN * cl * sp + around,
        (kl * q * SIN_BANK - north * sp) / (V * cg) + 2 * SPIN * (sl - cl * sg / cg * cp) + around * sp * sl / cl,
    )


def cartesian(x: float, y: float, z: float, u: float, v: float, w: float, kd: float, kl: float) -> tuple[float, ...]:
    """Rate of position and velocity in planet-fixed axes."""
    r2 = x * x + y * y + z * z
    r = math.sqrt(r2)
    V2 = u * u + v * v + w * w
    V = math.sqrt(V2)
    rho = RHO0 * math.exp((RADIUS - r) / HEIGHT)
    g = MU / (r2 * r)
    oblate, tilt = 1.5 * J2 * EQUATOR * EQUATOR / r2, 5 * z * z / r2
    plane = SPIN * SPIN - g * (1 + oblate * (1 - tilt))
    polar = -g * (1 + oblate * (3 - tilt))
    # lift: the part of r across v, of length r V_horizontal/V, and v x r, of length r V_horizontal
    climb = (x * u + y * v + z * w) / V2
    a, b, c = x - climb * u, y - climb * v, z - climb * w
    lift = kl * rho * V2 / math.sqrt(a * a + b * b + c * c)
    side, lift, drag = lift * SIN_BANK / V, lift * COS_BANK, kd * rho * V
    return (
        u,
        v,
        w,
        plane * x - drag * u + lift * a + side * (v * c - w * b) + 2 * SPIN * v,
        plane * y - drag * v + lift * b + side * (w * a - u * c) - 2 * SPIN * u,
        polar * z - drag * w + lift * c + side * (u * b - v * a),
    )


def spherical_altitude(h: float, lon: float, lat: float) -> float:
    return h


def cartesian_altitude(x: float, y: float, z: float) -> float:
    return math.sqrt(x * x + y * y + z * z) - RADIUS


def position(x: Array) -> Array:
    """Planet-fixed position (N, 3), m, of spherical states (N, 6)."""
    r, lon, lat = RADIUS + x[:, 0], x[:, 1], x[:, 2]
    return np.column_stack([r * np.cos(lat) * np.cos(lon), r * np.cos(lat) * np.sin(lon), r * np.sin(lat)])


def to_cartesian(x: Array) -> Array:
    """Position and velocity (N, 6) of spherical states (N, 6)."""
    _, lon, lat, V, gamma, psi = x.T
    east = np.column_stack([-np.sin(lon), np.cos(lon), 0 * lon])
    north = np.column_stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    up = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    parts = V * np.array([np.cos(gamma) * np.sin(psi), np.cos(gamma) * np.cos(psi), np.sin(gamma)])
    return np.hstack([position(x), parts[0][:, None] * east + parts[1][:, None] * north + parts[2][:, None] * up])


FORMS: dict[str, tuple[Callable[..., tuple[float, ...]], Callable[..., float], Callable[[Array], Array], Callable[[Array], Array]]] = {
    "spherical": (spherical, spherical_altitude, lambda x: x, position),
    "Cartesian": (cartesian, cartesian_altitude, to_cartesian, lambda y: y[:, :3]),
}


def by_scipy(form: str, x0: Array, k: Array, rtol: float) -> Array:
    """Positions at the stop (N, 3), one case after the other."""
    rate, altitude, start, place = FORMS[form]
    scale = np.array([RADIUS, 1.0, 1.0, 7e3, 1.0, 1.0]) if form == "spherical" else np.array([RADIUS] * 3 + [7e3] * 3)

    def height(_t: float, y: Array, _kd: float, _kl: float) -> float:
        return altitude(*y[:3].tolist()) - STOP

    setattr(height, "terminal", True)  # noqa: B010 (a function has no such attribute for the type checker)

    def plain(_t: float, y: Array, kd: float, kl: float) -> tuple[float, ...]:
        return rate(*y.tolist(), kd, kl)

    ends = []
    for y0, pair in zip(start(x0), k, strict=True):
        flown = solve_ivp(
            plain, (0.0, T_MAX), y0, method="DOP853", rtol=rtol, atol=rtol * scale * 1e-2, events=height, args=tuple(pair)
        )  # fmt: skip
        ends.append(flown.y[:, -1])
    return place(np.array(ends))


def by_workbench(task: Task, cases: int, step: float, mode: Any, form: str = "Cartesian") -> Array:
    """Positions at the stop (N, 3), NaN where a case failed."""
    return _fly(task.models[form], form, FORMS[form][2](task.x0[:cases]), task.p[:cases], step, mode)


def _fly(model: models.Model, form: str, x0: Array, p: Array, step: float, mode: Any) -> Array:
    flown = ocp.simulate_ensemble(
        model, ocp.constant(bank=BANK), x0=x0, p=p, until=ocp.falls_below("h", STOP), t_max=T_MAX, method=RK8(step=step), native=mode
    )  # fmt: skip
    return np.where(flown.ok[:, None], FORMS[form][3](np.asarray(flown.x)), np.nan)


def make_task(cases: int, *, compared: int, checked: int) -> Task:
    """Dispersed cases and the truth of the first `compared`, `checked` of them by scipy."""
    soyuz = models.SOYUZ
    ours = {"spherical": models.entry_3dof(soyuz, planet=PLANET), "Cartesian": models.entry_cartesian(soyuz, planet=PLANET)}
    model = ours["spherical"]
    draw = np.random.default_rng(3).uniform(-1.0, 1.0, (cases, len(WIDTHS)))
    offset = dict(zip(WIDTHS, (draw * list(WIDTHS.values())).T, strict=True))
    nominal = dict(soyuz.entry) | {"psi": math.radians(60.0)}
    x0 = np.column_stack([nominal[v.name] + offset.get(v.name, np.zeros(cases)) for v in model.states])
    p = np.column_stack([value + offset.get(v.name, np.zeros(cases)) for v, value in zip(model.params, model.p0, strict=True)])
    half = 0.5 * soyuz.area / soyuz.mass
    k = (
        half
        * np.column_stack([soyuz.CD * (1 + offset["CD_factor"]), soyuz.CL * (1 + offset["CL_factor"])])
        * (1 + offset["rho_factor"])[:, None]
    )
    truth = _fly(model, "spherical", x0[:compared], p[:compared], 0.25, "accurate")
    exact = by_scipy("Cartesian", x0[:checked], k[:checked], 3e-13)
    agreement = distance(truth[:checked], exact)
    truth[:checked] = exact
    return Task(ours, x0, p, k, truth, agreement)


def distance(a: Array, b: Array) -> float:
    """Largest distance, m; infinite for no usable answer."""
    found = np.linalg.norm(a - b, axis=1)
    return float(found.max()) if np.isfinite(found).all() else math.inf


def loosest(task: Task, settings: Sequence[float], solve: Callable[[float], Array]) -> tuple[float, float]:
    """(setting, error) of the first setting that meets the target, or of the last."""
    setting, error = settings[0], math.inf
    for setting in settings:
        ends = solve(setting)
        error = distance(ends, task.truth[: len(ends)])
        if error <= TARGET:
            break
    return setting, error


Timed = tuple[Row, Callable[[], Any]]  # a row whose rate is still to be measured, and the call to be timed


def in_turns(rows: Sequence[Timed], *, repeat: int) -> list[Row]:
    """Rates from the least time of each call, all calls taking turns."""
    least = [math.inf] * len(rows)
    for turn in range(repeat):
        _bench.announce(f"  round {turn + 1} of {repeat}")
        for i, (_, call) in enumerate(rows):
            least[i] = min(least[i], _bench.best(call, repeat=1))
    return [replace(row, rate=row.flown / seconds) for (row, _), seconds in zip(rows, least, strict=True)]


def workbench_rows(task: Task, counts: Sequence[int]) -> list[Timed]:
    """Compiled in both modes, and the interpreter."""
    rows: list[Timed] = []
    compared = len(task.truth)
    starts = {form: FORMS[form][2](task.x0) for form in FORMS}  # the other tools' rates leave out the change of coordinates too
    for mode, form in (("fast", "Cartesian"), ("fast", "spherical"), ("accurate", "Cartesian"), ("accurate", "spherical")):
        _bench.announce(f"  workbench, {mode}, {form}")
        model, x0 = task.models[form], starts[form]
        begin = time.perf_counter()
        by_workbench(task, min(64, compared), STEPS[-1], mode, form)
        build = time.perf_counter() - begin
        step, error = loosest(task, STEPS, lambda s, mode=mode, form=form: by_workbench(task, compared, s, mode, form))  # type: ignore[misc]
        for cases in counts:
            call = partial(_fly, model, form, x0[:cases], task.p[:cases], step, mode)
            rows.append((Row(f"workbench, {mode}, {form}", f"RK8, {step:g} s", cases, cases, error, 0.0, build), call))
    _bench.announce("  CasADi's interpreter")
    flown, step = min(200, compared), float(rows[0][0].setting.split()[1])
    call = partial(by_workbench, task, flown, step, "off")
    error = distance(call(), task.truth[:flown])
    return [*rows, *((Row("CasADi's interpreter, Cartesian", f"RK8, {step:g} s", cases, flown, error, 0.0), call) for cases in counts)]


def scipy_rows(task: Task, counts: Sequence[int], *, flown: int) -> list[Timed]:
    rows: list[Timed] = []
    for form in FORMS:
        _bench.announce(f"  scipy, {form}")
        tolerances = [10.0**e for e in np.arange(-6, -12.5, -0.5)]
        rtol, error = loosest(task, tolerances, partial(by_scipy, form, task.x0[:flown], task.k[:flown]))
        call = partial(by_scipy, form, task.x0[:flown], task.k[:flown], rtol)
        rows += [(Row(f"scipy DOP853, {form}", f"rtol {rtol:.0e}", cases, flown, error, 0.0), call) for cases in counts]
    return rows


def compiled_rows(task: Task, counts: Sequence[int], tool: str) -> list[Timed]:
    """numba or diffrax on all threads, both forms; empty where the tool is not installed."""
    if importlib.util.find_spec(tool) is None:
        return []
    kernel = importlib.import_module(f"benchmarks._entry_{tool}").kernel
    rows: list[Timed] = []
    compared = len(task.truth)
    for form, (rate, altitude, start, place) in FORMS.items():
        _bench.announce(f"  {tool}, {form}")
        fly, y0 = kernel(rate, altitude, STOP), np.ascontiguousarray(start(task.x0))
        begin = time.perf_counter()
        fly(y0[:2], task.k[:2], 1.0, T_MAX)
        build = time.perf_counter() - begin
        step, error = loosest(task, STEPS, lambda s, fly=fly, y0=y0, place=place: place(fly(y0[:compared], task.k[:compared], s, T_MAX)))  # type: ignore[misc]
        for cases in counts:
            call = partial(fly, y0[:cases], task.k[:cases], step, T_MAX)
            call()  # a new batch size may be compiled
            rows.append((Row(f"{tool}, {form}, all threads", f"RK8, {step:g} s", cases, cases, error, 0.0, build), call))
    return rows


def scaling(task: Task, cases: int, step: float, *, repeat: int) -> list[dict[str, Any]]:
    """Rates of the compiled loop alone, with its search for the stop, fast mode."""
    model = task.models["Cartesian"]
    law, until = ocp.constant(bank=BANK).bind(model), ocp.falls_below("h", STOP)
    engine = flight.prepare(model, law, RK8(step=step), T_MAX, until, alone=True)
    assert engine.margin is not None
    start, queue = engine.start(to_cartesian(task.x0[:cases])), engine.steps()
    table = []
    for lanes in (1, 2, 4, 8, 16):
        for threads in (1, 2):
            _bench.announce(f"  {lanes} lanes, {threads} threads")
            begin = time.perf_counter()
            loop = compile_loop(engine.group, engine.margin, stopping=engine.stopping, lanes=lanes, threads=threads, mode="fast")
            build = time.perf_counter() - begin
            seconds = _bench.best(partial(loop.run, start, queue, task.p[:cases]), repeat=repeat, budget=3.0)
            table.append({"lanes": lanes, "threads": threads, "backend": loop.backend, "rate": cases / seconds, "build_s": build})
    return table


def measure(*, quick: bool = False) -> dict[str, Any]:
    """All rows and the scaling."""
    counts, repeat = ((64,), 1) if quick else ((1000, 100_000), 5)
    task = make_task(counts[-1], compared=min(1000, counts[-1]), checked=4 if quick else 30)
    ours = workbench_rows(task, counts)
    compiled = [row for tool in ("numba", "diffrax") for row in compiled_rows(task, counts, tool)]
    rows = in_turns([*ours, *compiled, *scipy_rows(task, counts, flown=2 if quick else 10)], repeat=repeat)
    step = float(ours[0][0].setting.split()[1])
    return {
        "machine": _bench.machine(), "target_m": TARGET, "agreement_of_accurate_answers_m": task.agreement_m,
        "rows": [asdict(row) for row in rows],
        "scaling": [] if quick else scaling(task, 20_000, step, repeat=repeat),
    }  # fmt: skip


def show(result: dict[str, Any]) -> None:
    """The tables."""
    machine = result["machine"]
    print(f"{machine['processors']} processors, {machine['machine']}, Python {machine['python']}, CasADi {machine['casadi']},"
          f" SciPy {machine['scipy']}; the two accurate answers agree to {result['agreement_of_accurate_answers_m']:.1e} m")  # fmt: skip
    for cases in dict.fromkeys(row["cases"] for row in result["rows"]):
        rows = [row for row in result["rows"] if row["cases"] == cases]
        by_hand = max(row["rate"] for row in rows if row["tool"].startswith("scipy"))
        peer = max(row["rate"] for row in rows if row["tool"].startswith(("numba", "diffrax", "scipy")))
        lines = [
            (
                row["tool"], row["setting"] + ("" if row["flown"] == cases else f" ({row['flown']} flown)"), f"{row['rate']:,.3g}"
                if row["rate"] < 1e3 else f"{row['rate']:,.0f}", f"{row['error_m']:.1e}", f"{row['rate'] / by_hand:,.3g}",
                f"{row['rate'] / peer:.2f}", "-" if row["build_s"] is None else f"{row['build_s']:.2f} s",
            )
            for row in rows
        ]  # fmt: skip
        _bench.table(
            f"{cases} dispersed entries, target {result['target_m']:g} m",
            ("tool", "setting", "entries/s", "error m", "of scipy", "of best peer", "compile"), lines,
            note="of scipy: rate over that of the faster scipy; compile: first call, or loading from the cache (accurate: built before)",
        )  # fmt: skip
    if result["scaling"]:
        scales = [(str(s["lanes"]), str(s["threads"]), f"{s['rate']:,.0f}", f"{s['build_s']:.2f} s") for s in result["scaling"]]
        _bench.table("The compiled loop alone, fast mode, 20000 entries", ("lanes", "threads", "entries/s", "compile"), scales)


if __name__ == "__main__":
    _bench.run(__doc__, measure, show, figure=_figure.scaling)
