"""Longitudinal entry guidance in measured quantities: the law, its reference, and dispersed flights of several gain schedules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline

from models.core import Array, Model, ModelError, evaluate, frozen
from ocp.laws import Law, constant, sampled
from ocp.methods import RK4
from ocp.simulate import Ensemble, simulate, simulate_ensemble
from ocp.stops import falls_below
from ocp.trajectory import Trajectory

MEASURED = ("n_x", "hdot", "s", "sdot")
AFTERWARDS = 400.0  # s by which the reference is continued below its end, for cases that arrive late

GainsAt = Callable[[Array], Array]  # t (M,) -> K (M, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Miss:
    """Range errors of one set of cases under one schedule.

    Attributes
    ----------
    km : ndarray, shape (N,)
        Downrange at the stop minus that of the reference, km; NaN never occurs: failed cases are left out here.
    cases : ndarray, shape (N,)
        Case numbers of those that arrived.
    failed : tuple of (case number, reason)
    """

    km: Array
    cases: np.ndarray
    failed: tuple[tuple[int, str], ...]

    @property
    def rms(self) -> float:
        """Root mean square, km."""
        return float(np.sqrt(np.mean(self.km**2)))

    @property
    def p95(self) -> float:
        """95th percentile of the magnitude, km."""
        return float(np.percentile(np.abs(self.km), 95))

    @property
    def worst(self) -> float:
        """Largest magnitude, km."""
        return float(np.abs(self.km).max())


def continued(reference: Trajectory, step: float) -> Trajectory:
    """The reference flown on below its end, for cases that arrive later than the reference."""
    law = constant(lift_ratio=float(reference.u[0, 0]))
    end = float(reference.t[-1]) + AFTERWARDS
    return simulate(reference.model, law, x0=reference.x[0], p=reference.p, t_max=end, method=RK4(step=step))


def measured_reference(reference: Trajectory) -> CubicSpline:
    """Measured quantities of the reference against time, shape (4,) at each time."""
    smooth = np.concatenate([[True], np.diff(reference.t) > 0])
    return CubicSpline(reference.t[smooth], np.column_stack([reference[n] for n in MEASURED])[smooth])


def guidance_law(reference: Trajectory, schedule: GainsAt, *, sample: float, limit: float, gate: float, name: str) -> Law:
    """Sampled law u = u_ref + K(t) [y - y_ref(t)], |u| <= limit, feedback off while |n_x| < gate.

    Parameters
    ----------
    reference : Trajectory
        Constant-input reference that covers all the time that cases may take.
    schedule : callable
        t (M,) -> K (M, 4) for (n_x, hdot, s, sdot), in the sign of Tang & Zhao 2000, eq. 1.
    sample : float
        Time between commands, s.
    limit : float
        Largest |u|: the vehicle's L/D, at bank 0 and 180 degrees.
    gate : float
        Axial load, g0, above which feedback is on.
    """
    model = reference.model
    outputs = [v.name for v in model.outputs]
    table = measured_reference(reference)
    u_ref = float(reference.u[0, 0])

    def signals(start: Array, _end: Array) -> Array:
        return np.hstack([table(np.minimum(start, reference.t[-1])), schedule(start)])

    def step(t: ca.SX, x: ca.SX, y: ca.SX, z: ca.SX, w: ca.SX) -> tuple[ca.SX, ca.SX]:
        measured = ca.vertcat(*[y[outputs.index(n)] if n in outputs else x[model.index(n)] for n in MEASURED])
        correction = ca.dot(w[4:], measured - w[:4])
        on = ca.fabs(measured[0]) >= gate
        return ca.fmin(ca.fmax(u_ref + ca.if_else(on, correction, 0), -limit), limit), z

    return sampled(step, sample=sample, signals=signals, n_signals=8, name=name)


def dispersed_cases(model: Model, x0: Array, half_widths: Mapping[str, float], *, cases: int, seed: tuple[int, int]) -> tuple[Array, Array]:
    """Initial states (N, nx) and parameters (N, np): independent uniform deviations with the given half-widths.

    Parameters
    ----------
    half_widths : mapping
        gamma (rad), V (m/s), density, drag, lift (fractions), wave_amplitude (fixed), wave_length (m).
    seed : (seed of the study, number of the set)
        Each set has its own stream; case i is the same whatever the number of cases.
    """
    if cases < 1:
        raise ModelError(f"dispersions: expected at least 1 case, got {cases}")
    draws = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed))).random((cases, 6))
    uniform, phase = 2 * draws[:, :5] - 1, 2 * np.pi * draws[:, 5]
    states, params = np.tile(x0, (cases, 1)), np.tile(model.p0, (cases, 1))
    states[:, model.index("gamma")] += half_widths["gamma"] * uniform[:, 0]
    states[:, model.index("V")] += half_widths["V"] * uniform[:, 1]
    for k, (name, width) in enumerate((("rho_factor", "density"), ("CD_factor", "drag"), ("CL_factor", "lift"))):
        params[:, model.index(name)] *= 1 + half_widths[width] * uniform[:, 2 + k]
    params[:, model.index("wave_amplitude")] = half_widths["wave_amplitude"]
    params[:, model.index("wave_length")] = half_widths["wave_length"]
    params[:, model.index("wave_phase")] = phase
    return states, params


def fly(
    law: Law, reference: Trajectory, cases: tuple[Array, Array], *, stop_altitude: float, t_max: float, step: float,
    progress: Callable[[float], None] | None = None,
) -> Miss:  # fmt: skip
    """Fly all cases under a law and compare their range at the stop with the reference's own."""
    flown: Ensemble = simulate_ensemble(
        reference.model, law, x0=cases[0], p=cases[1], until=falls_below("h", stop_altitude), t_max=t_max,
        method=RK4(step=step), progress=progress,
    )  # fmt: skip
    arrived = np.flatnonzero(flown.ok)
    km = (flown["s"][arrived] - reference["s"][-1]) / 1e3
    return Miss(frozen(km), arrived, tuple(flown.failures()))


def interpolated(t: Array, K: Array) -> GainsAt:
    """Time-varying gains: cubic through the nodes, held outside."""
    smooth = np.concatenate([[True], np.diff(t) > 0])
    spline = CubicSpline(t[smooth], K[smooth])
    return lambda times: np.asarray(spline(np.clip(times, t[0], t[-1])))


def commands(law: Law, model: Model, t: Array, x: Array, p: Array) -> Array:
    """Inputs (M, nu) that a sampled law without memory would give at times t (M,) and states x (M, nx)."""
    bound = law.bind(model)
    if bound.step is None or len(bound.z0):
        raise ModelError(f"commands: law {law.name} must be sampled and without memory")
    y = evaluate(model.out, x, np.zeros((len(t), len(model.inputs))), p)[0]
    return evaluate(bound.step, t[:, None], x, y, bound.z0, bound.signals(t, t + (bound.sample or 0.0)))[0]
