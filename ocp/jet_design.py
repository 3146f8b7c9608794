"""Design of a Schmitt-trigger jet loop: the limit cycle away from the modes, at the least firing, with the same pointing accuracy.

The closed form of the rigid limit cycle (:mod:`models.limit_cycles`) makes it a small optimal design problem in (u_on, u_off, tau), solved
by IPOPT with exact derivatives in every frequency interval that the bands leave free, and checked against the reduced problem: at a given
amplitude A_T everything but the damping of the cycle depends on the coasting rate r alone, and firing duty and frequency grow with it.
What the flexible plant then does is a matter of simulation and of its exact orbits (:mod:`models.periodic_orbits`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models.checked import Array, ModelError, Status, as_scalar
from models.flexible_loop import Mode
from models.limit_cycles import SymmetricCycle, exact_amplitude, exact_duty, exact_frequency, symmetric_cycle
from models.modulators import SchmittTrigger

GRID = 20_001
GAP = 1e-6  # largest relative difference of the optimum from the least duty of the reduced problem
FEASIBLE = 1e-7  # largest violation of a scaled constraint


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Frequencies (low, high) in rad/s that the limit cycle and its harmonics must leave alone."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 < as_scalar("Band: low", self.low) < as_scalar("Band: high", self.high):
            raise ModelError(f"Band: ({self.low}, {self.high}) rad/s; expected 0 < low < high")


@dataclass(frozen=True, slots=True, eq=False)
class JetLimits:
    """Limits of the design.

    Attributes
    ----------
    pulse_min : float
        Shortest firing, s, > 0.
    contraction : float
        Largest factor by which a deviation of the rate survives one pulse, |r - a tau|/(r + a tau), in (0, 1).
    tau_max, u_on_max : float
        Largest lead, s, and largest threshold; infinite unless given.
    hysteresis_min : float
        Least u_on - u_off, against noise.
    harmonics : tuple of int
        Multiples of the frequency that must leave the bands too; a symmetric cycle has odd ones only.
    """

    pulse_min: float = 0.5
    contraction: float = 0.5
    tau_max: float = math.inf
    u_on_max: float = math.inf
    hysteresis_min: float = 0.0
    harmonics: tuple[int, ...] = (1, 3)

    def __post_init__(self) -> None:
        for name in ("pulse_min", "tau_max", "u_on_max"):
            value = getattr(self, name)
            if not (isinstance(value, (int, float)) and value > 0):
                raise ModelError(f"JetLimits: {name} = {value!r}; expected > 0")
        if not 0 < as_scalar("JetLimits: contraction", self.contraction) < 1:
            raise ModelError(f"JetLimits: contraction = {self.contraction}; expected between 0 and 1")
        if as_scalar("JetLimits: hysteresis_min", self.hysteresis_min) < 0:
            raise ModelError(f"JetLimits: hysteresis_min = {self.hysteresis_min}; expected >= 0")
        if not math.isfinite(self.pulse_min) or not self.harmonics or any(not isinstance(n, int) or n < 1 for n in self.harmonics):
            raise ModelError(f"JetLimits: pulse_min {self.pulse_min}, harmonics {self.harmonics}; expected a finite time and numbers >= 1")


@dataclass(frozen=True, slots=True, eq=False)
class JetDesign:
    """A tuned loop.

    Attributes
    ----------
    trigger : SchmittTrigger
    tau : float
        Lead, s.
    a : float
    cycle, before : SymmetricCycle
        Closed-form rigid cycles of the tuned and of the given loop.
    excluded : ndarray, shape (M, 2)
        Frequency intervals that the bands and their fractions take, rad/s.
    solved : tuple of (low, high, duty or None)
        Every free interval with the optimum found in it.
    optimality : float
        (duty found - least duty of the reduced problem)/least duty.
    violation : float
        Largest violation of a scaled constraint.
    """

    trigger: SchmittTrigger
    tau: float
    a: float
    cycle: SymmetricCycle
    before: SymmetricCycle
    excluded: Array
    solved: tuple[tuple[float, float, float | None], ...]
    optimality: float
    violation: float

    @property
    def amplitude_change(self) -> float:
        """Relative change of the closed-form amplitude A_T."""
        return self.cycle.amplitude / self.before.amplitude - 1


class DesignError(ModelError):
    """No design meets the limits; ``status`` says why."""

    def __init__(self, message: str, status: Status) -> None:
        super().__init__(message)
        self.status = status


def bands_around(modes: Iterable[Mode], *, width: float = 0.2) -> tuple[Band, ...]:
    """A band of +-`width` (relative) around the frequency of every mode."""
    relative = as_scalar("bands_around: width", width)
    if not 0 < relative < 1:
        raise ModelError(f"bands_around: width = {relative}; expected between 0 and 1")
    return tuple(Band((1 - relative) * mode.frequency, (1 + relative) * mode.frequency) for mode in modes)


def design_trigger(
    trigger: SchmittTrigger,
    *,
    a: float,
    tau: float,
    bands: Sequence[Band],
    limits: JetLimits = JetLimits(),
    amplitude: float | None = None,
) -> JetDesign:
    """Least firing duty 4 r/(a P) subject to bands, amplitude A_T and shortest pulse; at equal duty the fastest settling.

    Parameters
    ----------
    trigger : SchmittTrigger
        The loop to start from.
    a, tau : float
        Angular acceleration of the jets, and its lead, s.
    bands : sequence of Band
    limits : JetLimits
    amplitude : float, optional
        Closed-form A_T to be met exactly; that of the given loop unless given.

    Returns
    -------
    JetDesign

    Raises
    ------
    DesignError
        INFEASIBLE with what is in the way; UNDECIDED where the optimizer and the reduced problem disagree.
    """
    before = symmetric_cycle(trigger, a=a, tau=tau)
    wanted = before.amplitude if amplitude is None else as_scalar("design_trigger: amplitude", amplitude)
    if wanted <= 0:
        raise ModelError(f"design_trigger: amplitude = {wanted:.6g}; expected > 0")
    excluded = _excluded(bands, limits.harmonics)
    problem = _Problem(float(a), wanted, limits)
    rates, possible = problem.grid(excluded)
    if not possible.any():
        raise DesignError(
            f"design: no (u_on, u_off, tau) has A_T = {wanted:.6g}, pulses of at least {limits.pulse_min:.6g} s and a frequency outside"
            " the bands; narrow the bands, or allow shorter pulses or another amplitude",
            Status.INFEASIBLE,
        )
    solved = []
    best: tuple[float, Array, float] | None = None
    for low, high in _free(excluded, float(problem.frequency(rates[-1:])[0])):
        duty, values, violation = problem.optimize(low, high)
        solved.append((low, high, duty))
        if duty is not None and (best is None or duty < best[0]):
            best = duty, values, violation
    if best is None:
        raise DesignError("design: the optimizer found no feasible point although there is one; start nearer to it", Status.UNDECIDED)
    least = float(problem.duty(np.array(problem.least_rate(excluded, rates, possible))))
    optimality = (best[0] - least) / least
    if abs(optimality) > GAP:
        raise DesignError(f"design: firing duty {best[0]:.6g} found, {least:.6g} possible; the optimum is not certified", Status.UNDECIDED)
    tuned, lead = problem.settled(best[1])
    cycle = symmetric_cycle(tuned, a=a, tau=lead)
    return JetDesign(tuned, lead, float(a), cycle, before, excluded, tuple(solved), optimality, best[2])


def _excluded(bands: Sequence[Band], harmonics: Sequence[int]) -> Array:
    """Union of the bands divided by the harmonics, as disjoint increasing intervals (M, 2)."""
    pieces = sorted((band.low / n, band.high / n) for band in bands for n in harmonics)
    merged: list[list[float]] = []
    for low, high in pieces:
        if merged and low <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], high)
        else:
            merged.append([low, high])
    return np.array(merged, dtype=float).reshape(-1, 2)


def _free(excluded: Array, top: float) -> list[tuple[float, float]]:
    """What the excluded intervals leave of (0, top)."""
    edges = [0.0, *excluded.ravel().tolist(), math.inf]
    pairs = [(low, min(high, top)) for low, high in zip(edges[::2], edges[1::2], strict=True)]
    return [(low, high) for low, high in pairs if low < high]


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The design problem at one amplitude: as an NLP in (u_on, u_off, tau), and reduced to the rate r."""

    a: float
    amplitude: float
    limits: JetLimits

    def frequency(self, r: Array) -> Array:
        """Frequency at the rate r: increasing for r^2 < 2 a A_T."""
        return np.asarray(math.pi * self.a * r / (r**2 + 2 * self.a * self.amplitude))

    def duty(self, r: Array) -> Array:
        """Firing duty at the rate r: increasing."""
        return np.asarray(2 * r**2 / (r**2 + 2 * self.a * self.amplitude))

    def leads(self, r: Array) -> tuple[Array, Array]:
        """Smallest and largest tau that the limits allow at the rate r; empty where smallest > largest."""
        s, q = 2 * self.amplitude - r**2 / self.a, self.limits.contraction
        ratio = (1 - q) / (1 + q)
        low = np.maximum(r / self.a * ratio, self.limits.hysteresis_min / (2 * r))
        high = np.minimum(r / self.a / ratio, self.limits.tau_max)
        return low, np.minimum(high, np.minimum(s, 2 * self.limits.u_on_max - s) / (2 * r))  # u_off >= 0, u_on <= its limit

    def grid(self, excluded: Array) -> tuple[Array, np.ndarray]:
        """Rates (GRID,) from the shortest pulse on, and which of them are possible."""
        shortest, top = 0.5 * self.a * self.limits.pulse_min, math.sqrt(2 * self.a * self.amplitude)
        if shortest >= top:
            return np.array([shortest]), np.array([False])
        rates = np.linspace(shortest, top, GRID)
        return rates, self.possible(rates, excluded)

    def possible(self, rates: Array, excluded: Array) -> np.ndarray:
        """Which rates the bands and the limits allow."""
        w = self.frequency(rates)
        inside = ((w[:, None] > excluded[:, 0]) & (w[:, None] < excluded[:, 1])).any(axis=1)
        low, high = self.leads(rates)
        return np.asarray(~inside & (low <= high))

    def least_rate(self, excluded: Array, rates: Array, possible: np.ndarray) -> float:
        """Least possible rate: the first of the grid, moved to the border before it by bisection."""
        first = int(np.argmax(possible))
        high = float(rates[first])
        low = float(rates[max(first - 1, 0)])
        for _ in range(60):
            middle = 0.5 * (low + high)
            if self.possible(np.array([middle]), excluded)[0]:
                high = middle
            else:
                low = middle
        return high

    def optimize(self, w_low: float, w_high: float) -> tuple[float | None, Array, float]:
        """Least duty with the frequency in an interval: duty (None if infeasible), (u_on, u_off, tau), violation."""
        v = ca.SX.sym("v", 3)
        u_on, u_off, tau = ca.vertsplit(v)
        r, limits, A = (u_on - u_off) / (2 * tau), self.limits, self.amplitude
        q = limits.contraction
        rows = [
            (exact_amplitude(self.a, u_on, u_off, tau) / A, 1.0, 1.0),
            (
                exact_frequency(self.a, u_on, u_off, tau) * math.sqrt(A / self.a),
                w_low * math.sqrt(A / self.a),
                w_high * math.sqrt(A / self.a),
            ),
            (2 * r / self.a / limits.pulse_min, 1.0, math.inf),
            ((u_on - u_off) / A, limits.hysteresis_min / A, math.inf),
            ((r - self.a * tau) / (r + self.a * tau), -q, q),
        ]
        g, lower, upper = ca.vertcat(*(row[0] for row in rows)), [row[1] for row in rows], [row[2] for row in rows]
        options: dict[str, Any] = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-10,
                   "ipopt.constr_viol_tol": 1e-10,
                   "ipopt.bound_relax_factor": 0.0, "ipopt.max_iter": 400, "error_on_fail": False}  # fmt: skip
        duty = exact_duty(self.a, u_on, u_off, tau)
        solver = ca.nlpsol("jet_design", "ipopt", {"x": v, "f": ca.log(duty), "g": g}, options)
        guess = self._guess(w_low, w_high)
        box = [1e-9 * A, 0.0, 1e-9 * math.sqrt(A / self.a)], [limits.u_on_max, limits.u_on_max, limits.tau_max]
        answer = solver(x0=guess, lbx=box[0], ubx=box[1], lbg=lower, ubg=upper)
        values, found = answer["x"].full().ravel(), answer["g"].full().ravel()
        violation = float(np.max([np.array(lower) - found, found - np.array(upper), np.zeros(5)]))
        if not (np.isfinite(values).all() and np.isfinite(found).all()) or violation > FEASIBLE:
            return None, values, math.inf
        return float(math.exp(float(answer["f"]))), values, violation

    def _guess(self, w_low: float, w_high: float) -> Array:
        """A point in the middle of the interval with the amplitude and the fastest settling."""
        top = math.sqrt(2 * self.a * self.amplitude)
        w = min(0.5 * (w_low + w_high), 0.999 * float(self.frequency(np.array(top))))
        half = math.pi * self.a / (2 * w)
        r = half - math.sqrt(max(half**2 - top**2, 0.0))
        s = 2 * self.amplitude - r**2 / self.a
        tau = min(r / self.a, 0.9 * s / (2 * r))
        return np.array([s / 2 + r * tau, s / 2 - r * tau, tau])

    def settled(self, values: Array) -> tuple[SchmittTrigger, float]:
        """Trigger and lead with rate and amplitude of an optimum, with the lead nearest to r/a: a deviation dies in one pulse."""
        r = max(float((values[0] - values[1]) / (2 * values[2])), 0.5 * self.a * self.limits.pulse_min)
        low, high = (float(bound) for bound in self.leads(np.array(r)))
        tau = min(max(r / self.a, low), high)
        s = 2 * self.amplitude - r**2 / self.a
        return SchmittTrigger(s / 2 + r * tau, max(s / 2 - r * tau, 0.0)), tau
