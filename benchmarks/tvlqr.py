"""Gains along an entry, side by side: the workbench, scipy and, where installed, Drake, each as fast as it goes at equal accuracy.

The task: from the entry state of reference N1 to K(t) every 4 s and at the end: fly the reference to its stop altitude,
linearize along it, sweep the Riccati equation back.  Weights are constant and diagonal in the states, so that every tool
solves the same problem.  The error is the largest of |K - K_true| over the times, relative to the largest magnitude of
each gain; K_true is scipy's DOP853 at its tightest tolerance, and the workbench at 1/8 s must agree with it.  Every tool
gets, in hindsight, the loosest tolerance that meets the target.  The workbench has two ways: one function for flight and gains
(``ocp.tracker``), with and without its certificate, and node by node (``ocp.tvlqr``), always certified; no other tool proves
its answer.  The tracker delivers its own nodes (more than the grid); its error is taken on the grid, by ``Gains.at``.

Run: python -m benchmarks.tvlqr [--quick] [--json]
"""

from __future__ import annotations

import importlib.util
import itertools
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import ODEintWarning, odeint, solve_ivp
from scipy.interpolate import CubicSpline

import ocp
from benchmarks import _bench, _entry
from benchmarks._entry import SCALE, SPACING, STOP, UPPER, Array, Problem
from models import ModelError, native
from ocp.methods import RK8

TRACKS = (44, 48, 52, 56, 60, 64, 72, 80, 96, 120, 160, 200)  # steps of the workbench's tracker
STEPS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)  # s between the workbench's nodes
LIMIT = 12.0  # s: a tool that needs longer for one answer is not asked for a tighter one
Solver = Callable[[], tuple[Array, Array]]


@dataclass(frozen=True, slots=True)
class Row:
    """One tool at one target: its setting, error, best time, time of building before it (s), and what to know."""

    target: float
    tool: str
    setting: str
    error: float | None
    reached: bool
    seconds: float | None
    build_s: float | None
    note: str = ""


def grid(t_f: float) -> Array:
    """Times at which gains are delivered, s: every SPACING, and the end."""
    return np.append(np.arange(0.0, t_f - 1e-3, SPACING), t_f)


def workbench(p: Problem, model: Any, step: float) -> tuple[Array, Array]:
    """The workbench with nodes `step` s apart; gains with their certificate."""
    flight = ocp.simulate(
        model, ocp.constant(lift_ratio=p.u), x0=p.x0, until=ocp.falls_below("h", STOP), t_max=3000.0, method=RK8(step=step)
    )  # fmt: skip
    gains = ocp.tvlqr(ocp.linearize(flight), Q=p.Q, R=p.R, Qf=p.Qf)
    times = grid(float(flight.t[-1]))
    nodes = np.searchsorted(gains.t, times - 1e-6)
    return times, gains.K[nodes, 0]


def tracked(p: Problem, track: ocp.Tracker, certify: bool) -> tuple[Array, Array]:
    """The workbench's single function; its own nodes."""
    gains = track(p.x0, [p.u], Q=p.Q, R=p.R, Qf=p.Qf, certify=certify)
    return gains.t, gains.K[:, 0]


def compiled(p: Problem, track: ocp.Tracker) -> Solver:
    """The same function as compiled code, its weights packed beforehand as the tracker packs them."""
    upper = np.triu_indices(len(p.Q))
    values = [np.asarray(p.x0), np.array([p.u]), track.model.p0, p.Q[upper], np.linalg.inv(p.R).ravel(), p.Qf[upper]]
    function = native.compile(track.function)
    n = len(p.x0) + len(upper[0])

    def solve() -> tuple[Array, Array]:
        t_f, _, _, swept, rates = function(*values)
        z = track.dense[1] @ swept.T[::-1] + t_f[0] * (track.dense[2] @ rates.T[::-1])
        return t_f[0] * track.dense[0], z[:, n:]

    return solve


def on_grid(answer: tuple[Array, Array]) -> tuple[Array, Array]:
    """An answer on dense nodes, cubic between them, at the common times."""
    times = grid(float(answer[0][-1]))
    return times, np.asarray(CubicSpline(*answer)(times))


def tracker_rows(p: Problem, model: Any, target: float, truth: Array, *, quick: bool) -> list[Row]:
    """The tracker without and with its certificate."""
    search = 8.0 if target > 1e-7 else 4.0
    build, rows = time.perf_counter(), []
    made = {n: ocp.tracker(model, until=ocp.falls_below("h", STOP), steps=n, search=search, t_max=700.0) for n in TRACKS}
    build = (time.perf_counter() - build) / len(TRACKS)
    for certify in (False, True):
        name = f"workbench, one function, {'with' if certify else 'without'} certificate"
        settings = ((f"{n} steps", partial(tracked, p, made[n], certify)) for n in TRACKS)
        rows.append(loosest(target, name, settings, truth, quick=quick, build=build, project=on_grid))
    first, *others = TRACKS
    begin = time.perf_counter()
    answer = compiled(p, made[first])
    build = time.perf_counter() - begin
    fast = itertools.chain([(f"{first} steps", answer)], ((f"{n} steps", compiled(p, made[n])) for n in others))
    name = "workbench, one function compiled, without certificate"
    rows.append(loosest(target, name, fast, truth, quick=quick, build=build, project=on_grid))
    return rows


def fly(p: Problem, method: str, rtol: float) -> tuple[float, Array]:
    """The reference by solve_ivp: (t_f, scaled end state)."""

    def altitude(_t: float, z: Array) -> float:
        return float(z[2] * SCALE[2] - STOP)

    setattr(altitude, "terminal", True)  # noqa: B010 (a function has no such attribute for the type checker)
    flown = solve_ivp(_entry.flight_rate(p), (0.0, 3000.0), p.x0 / SCALE, method=method, rtol=rtol, atol=1e-2 * rtol, events=altitude)
    return float(flown.t[-1]), flown.y[:, -1]


def scipy_gains(p: Problem, rate: Any, *, forward: tuple[str, float], backward: tuple[str, float]) -> tuple[Array, Array]:
    """Scipy: the reference forward, then reference and S together backward."""
    t_f, z_f = fly(p, *forward)
    times = grid(t_f)
    y_f = np.concatenate([z_f, np.diag(p.scaled_weights[2])[UPPER]])
    method, rtol = backward
    if method == "odeint":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ODEintWarning)  # said by the message too
            y, info = odeint(rate, y_f, times[::-1], tfirst=True, rtol=rtol, atol=1e-2 * rtol, full_output=True, mxstep=2000)
        if info["message"] != "Integration successful.":
            raise RuntimeError("odeint gave up")
    else:
        flown = solve_ivp(rate, (t_f, 0.0), y_f, method=method, rtol=rtol, atol=1e-2 * rtol, t_eval=times[::-1])
        if not flown.success:
            raise RuntimeError(flown.message)
        y = flown.y.T
    return times, _entry.gain_of(p, y[::-1, :4], y[::-1, 4:])


def relative_error(K: Array, truth: Array) -> float | None:
    """Largest difference over the times, relative to the largest magnitude of each gain; None for no usable answer."""
    if K.shape != truth.shape or not np.isfinite(K).all():
        return None
    return float((np.abs(K - truth).max(axis=0) / np.abs(truth).max(axis=0)).max())


def loosest(
    target: float, tool: str, settings: Iterator[tuple[str, Solver]], truth: Array, *,
    quick: bool, build: float | None = None, note: str = "", project: Callable[[tuple[Array, Array]], tuple[Array, Array]] = lambda a: a,
) -> Row:  # fmt: skip
    """Try settings from loose to tight until the target is met, then time that one."""
    closest, at = None, ""
    for setting, solve in settings:
        begin = time.perf_counter()
        try:
            answer = solve()
            error = relative_error(project(answer)[1], truth)
        except (RuntimeError, ModelError):
            error = None
        spent = time.perf_counter() - begin
        if error is not None and error <= target:
            seconds = min(spent, _bench.best(solve, repeat=1 if quick else 200))
            return Row(target, tool, setting, error, True, seconds, build, note)
        if error is not None and (closest is None or error < closest):
            closest, at = error, setting
        if spent > LIMIT:
            break
    return Row(target, tool, at, closest, False, None, build, note)


def decades(first: float, last: float) -> Iterator[float]:
    """Tolerances from 10^first down to 10^last, two in a decade."""
    for exponent in np.arange(first, last - 0.25, -0.5):
        yield float(10.0**exponent)


def best_forward(p: Problem, target: float, truth: Array) -> tuple[str, float]:
    """The cheapest forward flight after which the gains can still meet the target with a third to spare."""
    rate, found = _entry.joint_rate(p), []
    for method in ("DOP853", "LSODA"):
        for rtol in decades(-6, -12):
            error = relative_error(scipy_gains(p, rate, forward=(method, rtol), backward=("odeint", 1e-12))[1], truth)
            if error is not None and error <= target / 3:
                found.append((_bench.best(partial(fly, p, method, rtol), repeat=10), (method, rtol)))
                break
    return min(found)[1]


def scipy_rows(p: Problem, target: float, truth: Array, *, quick: bool) -> list[Row]:
    """All scipy variants at one target."""
    forward = best_forward(p, target, truth)
    difference = _entry.matrix_rate(p, _entry.difference_jacobian(p, central=True))
    one_sided = _entry.matrix_rate(p, _entry.difference_jacobian(p, central=False))
    variants = [
        ("hand Jacobians, written out in floats", _entry.joint_rate(p), ("odeint", "LSODA", "DOP853", "RK45", "Radau")),
        ("hand Jacobians, NumPy matrices", _entry.matrix_rate(p, _entry.hand_jacobian(p)), ("odeint", "LSODA", "DOP853")),
        ("central differences, NumPy matrices", difference, ("odeint", "LSODA", "DOP853")),
        ("one-sided differences, NumPy matrices", one_sided, ("odeint", "DOP853")),
    ]
    rows = []
    for name, rate, methods in variants:
        for method in methods[:1] if quick else methods:
            _bench.announce(f"  {target:g}: scipy {method}, {name}")

            def settings(rate: Any = rate, method: str = method) -> Iterator[tuple[str, Solver]]:
                for rtol in decades(-5, -9 if method == "Radau" else -11.5):
                    text = f"rtol {rtol:.0e} ({forward[0]} {forward[1]:.0e} forward)"
                    yield text, partial(scipy_gains, p, rate, forward=forward, backward=(method, rtol))

            rows.append(loosest(target, f"scipy {method}, {name}", settings(), truth, quick=quick))
    return rows


def drake_rows(p: Problem, target: float, times: Array, truth: Array, *, quick: bool) -> list[Row]:
    """Drake with its default integrator and with a better one; empty where Drake is not installed."""
    if importlib.util.find_spec("pydrake") is None:
        return []
    from benchmarks import _entry_drake as drake

    drake.system(p)  # the first one also loads the library
    begin = time.perf_counter()
    plant = drake.system(p)
    build = time.perf_counter() - begin
    nodes = np.linspace(0.0, times[-1], 1 + int(np.ceil(times[-1] / 0.5)))
    flown = solve_ivp(_entry.flight_rate(p), (0.0, times[-1]), p.x0 / SCALE, method="DOP853", rtol=1e-13, atol=1e-15, t_eval=nodes)
    reference = drake.nominal(p, nodes, flown.y.T)

    def settings(integrator: str, accuracies: Sequence[float], step: float) -> Iterator[tuple[str, Solver]]:
        for accuracy in accuracies:
            text = f"{integrator}, accuracy {accuracy:g}, max step {step:g} s"
            yield text, partial(drake.gains, p, plant, reference, times, integrator=integrator, accuracy=accuracy, max_step=step)

    name, note = "Drake FiniteHorizonLinearQuadraticRegulator", "reference given, not timed"
    plans: list[tuple[str, tuple[float, ...], float, str]] = [
        ("runge_kutta5", (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7), 20.0, "best integrator")
    ]
    if not quick:
        ladder = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
        plans += [("runge_kutta3", ladder, 20.0, "default integrator"), ("runge_kutta3", (1e-4,), 0.1, "default settings")]
    rows = []
    for integrator, accuracies, step, what in plans:
        _bench.announce(f"  {target:g}: Drake, {what}")
        rows.append(
            loosest(target, f"{name}, {what}", settings(integrator, accuracies, step), truth, quick=quick, build=build, note=note)
        )  # fmt: skip
    return rows


def stages(p: Problem, model: Any, step: float) -> dict[str, float]:
    """Where the workbench's time goes, s."""
    until, law = ocp.falls_below("h", STOP), ocp.constant(lift_ratio=p.u)
    flight = ocp.simulate(model, law, x0=p.x0, until=until, t_max=3000.0, method=RK8(step=step))
    lin = ocp.linearize(flight)
    return {
        "reference flight": _bench.best(lambda: ocp.simulate(model, law, x0=p.x0, until=until, t_max=3000.0, method=RK8(step=step))),
        "Jacobians": _bench.best(lambda: ocp.linearize(flight)),
        "Riccati sweep and certificate": _bench.best(lambda: ocp.tvlqr(lin, Q=p.Q, R=p.R, Qf=p.Qf)),
    }


def measure(*, quick: bool = False) -> dict[str, Any]:
    """All rows, the agreement of the two accurate answers, and the stages of the workbench's time."""
    p = _entry.problem()
    begin = time.perf_counter()
    model = _entry.model_of()
    model_s = time.perf_counter() - begin
    times, truth = scipy_gains(p, _entry.joint_rate(p), forward=("DOP853", 3e-14), backward=("DOP853", 3e-14))
    targets = (1e-6,) if quick else (1e-6, 1e-8)
    rows: list[Row] = []
    first = 0.0
    for target in targets:
        _bench.announce(f"target {target:g}: the workbench")
        settings = ((f"RK8, nodes every {step:g} s", partial(workbench, p, model, step)) for step in STEPS)
        if not rows:
            begin = time.perf_counter()
            workbench(p, model, 4.0)
            first = time.perf_counter() - begin
        ours = loosest(target, "workbench, node by node, with certificate", settings, truth, quick=quick, build=model_s + first)
        rows += [*tracker_rows(p, model, target, truth, quick=quick), ours]
        rows += [*scipy_rows(p, target, truth, quick=quick), *drake_rows(p, target, times, truth, quick=quick)]
    agreement = relative_error(workbench(p, model, 0.125)[1], truth)
    return {
        "machine": _bench.machine(),
        "t_f_s": float(times[-1]),
        "agreement_of_accurate_answers": agreement,
        "rows": [asdict(row) for row in rows],
        "workbench_stages_s": {f"{step:g}": stages(p, model, step) for step in ((4.0,) if quick else (4.0, 1.0))},
    }


def show(result: dict[str, Any]) -> None:
    """The tables."""
    machine = result["machine"]
    print(f"{machine['processors']} processors, {machine['machine']}, Python {machine['python']}, CasADi {machine['casadi']},"
          f" SciPy {machine['scipy']}; the two accurate answers agree to {result['agreement_of_accurate_answers']:.1e}")  # fmt: skip
    for target in sorted({row["target"] for row in result["rows"]}, reverse=True):
        rows = [row for row in result["rows"] if row["target"] == target]
        ours = rows[0]["seconds"]
        lines = []
        for row in rows:
            ratio = f"{row['seconds'] / ours:.3g}" if ours and row["seconds"] else "-"
            time_text = _bench.milliseconds(row["seconds"]) if row["reached"] else "not reached"
            error = "-" if row["error"] is None else f"{row['error']:.1e}"
            lines.append((row["tool"], row["setting"], error, time_text, ratio, _bench.milliseconds(row["build_s"])))
        note = "time: best of up to 200; ratio: to the first row; build: model and functions, once.  Drake: reference given, not timed."
        _bench.table(f"K(t) to {target:g} of its maximum", ("tool", "setting", "error", "time", "ratio", "build"), lines, note=note)
    for step, parts in result["workbench_stages_s"].items():
        spent = [(name, f"nodes every {step} s", _bench.milliseconds(seconds)) for name, seconds in parts.items()]
        _bench.table("Where the workbench's time goes", ("stage", "setting", "time"), spent)


if __name__ == "__main__":
    _bench.run(__doc__, measure, show)
