"""Exact periodic orbits of a trigger with any linear plant: shooting on the switching times, replayed, with Floquet multipliers.

Between switchings the state is known in closed form (matrix exponentials), so the unknowns are the state at the first switching, the
times of the others and the period; Newton's method has exact derivatives.  Describing functions, closed forms or simulations give
guesses only: an orbit is returned after an independent simulation, which does not know its switching times, has gone through the same
switchings and come back.  Signs: see :mod:`models.flexible_loop`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, Status, as_finite, as_scalar, frozen
from models.flexible_loop import LinearLoop
from models.limit_cycles import symmetric_cycle
from models.limit_cycles_events import LoopRun, simulate_loop
from models.limit_cycles_shooting import OrbitError, Shooting, floquet, newton
from models.modulators import SchmittTrigger

REPLAYED = 1e-7  # residual of the replay, relative; a wrong orbit misses by 1e-2


__all__ = [
    "Orbit", "OrbitError", "OrbitGuess", "describe", "find_orbits", "from_harmonic", "from_rigid", "from_run", "solve_orbit",
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class OrbitGuess:
    """Where the search starts: switching times (N,) from 0 on, trigger output after each (N,), period, state at the first (n,)."""

    times: Array
    levels: Array
    period: float
    x0: Array


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """A verified periodic orbit.

    Attributes
    ----------
    times : ndarray, shape (N,)
        Switching times of the trigger within one period, s; the first is 0.
    levels : ndarray, shape (N,)
        Trigger output after each.
    period : float
        s.
    x0 : ndarray, shape (n,)
        State at the first switching.
    multipliers : ndarray of complex
        Floquet multipliers without the one that is 1 (the shift in time), by decreasing modulus.
    trivial : float
        Distance of that one from 1: a check of the others.
    residual : float
        Largest difference of the replay after one period, of switching times relative to the period and of the state relative to
        its size.
    run : LoopRun
        The replay, a little more than one period.
    loop, trigger, bias : what the orbit belongs to
    """

    times: Array
    levels: Array
    period: float
    x0: Array
    multipliers: np.ndarray
    trivial: float
    residual: float
    run: LoopRun
    loop: LinearLoop
    trigger: SchmittTrigger
    bias: float

    @property
    def w(self) -> float:
        """Angular frequency 2 pi/period, rad/s."""
        return 2 * math.pi / self.period

    @property
    def stable(self) -> bool:
        """All multipliers but the trivial one inside the unit circle."""
        return bool((np.abs(self.multipliers) < 1).all())

    @property
    def symmetric(self) -> bool:
        """The second half of the period mirrors the first."""
        half, odd = divmod(len(self.times), 2)
        if odd:
            return False
        shifted = np.abs(self.times[half:] - self.times[:half] - self.period / 2).max() <= 1e-6 * self.period
        return bool(shifted and (self.levels[half:] == -self.levels[:half]).all())

    @property
    def duty(self) -> float:
        """Fraction of the time in which a jet fires."""
        return float(np.abs(self.levels) @ np.diff(np.append(self.times, self.period)) / self.period)

    @property
    def pulses(self) -> int:
        """Firings in one period."""
        return int((self.levels != 0).sum())

    def path(self, parts: int = 16) -> tuple[Array, Array]:
        """Times (K,) and states (K, n) over one period."""
        t, x = self.run.dense(parts)
        inside = t <= self.period
        return t[inside], x[inside]

    def peak(self, row: Array) -> float:
        """Largest |row x| over the period, such as ``orbit.peak(orbit.loop.attitude)``."""
        return float(np.abs(self.path()[1] @ row).max())


def from_harmonic(loop: LinearLoop, trigger: SchmittTrigger, *, amplitude: float, w: float) -> OrbitGuess:
    """Guess from a describing function: the trigger's input is amplitude sin(w t)."""
    size, rate = as_scalar("from_harmonic: amplitude", amplitude), as_scalar("from_harmonic: w", w)
    if rate <= 0 or size < trigger.u_on:
        raise ModelError(f"from_harmonic: amplitude {size:.6g}, w {rate:.6g}; expected amplitude >= u_on = {trigger.u_on:.6g} and w > 0")
    state = np.linalg.solve(1j * rate * np.eye(len(loop.A)) - loop.A, loop.B.astype(complex))
    on, off = math.asin(trigger.u_on / size) / rate, (math.pi - math.asin(trigger.u_off / size)) / rate
    half = math.pi / rate
    x0 = np.imag(state * (size / (loop.C @ state)) * np.exp(1j * rate * on))
    return OrbitGuess(np.array([0.0, off - on, half, half + off - on]), np.array([1.0, 0.0, -1.0, 0.0]), 2 * half, x0)


def from_rigid(loop: LinearLoop, trigger: SchmittTrigger, *, a: float, tau: float) -> OrbitGuess:
    """Guess for a plant of :func:`models.flexible_loop.jet_plant`: the exact cycle of its rigid body, with the modes at rest."""
    cycle = symmetric_cycle(trigger, a=a, tau=tau)
    x0 = np.zeros(len(loop.A))
    x0[:2] = cycle.switching, cycle.rate
    half = cycle.period / 2
    return OrbitGuess(np.array([0.0, cycle.pulse, half, half + cycle.pulse]), np.array([1.0, 0.0, -1.0, 0.0]), cycle.period, x0)


def from_run(run: LoopRun, *, longest: int = 32, tolerance: float = 0.02) -> OrbitGuess | None:
    """Guess from the end of a simulation: the shortest pattern of switchings that repeats there; None if none does."""
    at = run.events
    t, y = run.t[at], run.y[at]
    for n in range(2, min(longest, len(at) // 2 - 1) + 1):
        if not np.array_equal(y[-n:], y[-2 * n : -n]):
            continue
        period = t[-1] - t[-1 - n]
        last, before = t[-n:] - t[-n], t[-2 * n : -n] - t[-2 * n]
        x, x_before = run.x[at[-n]], run.x[at[-2 * n]]
        if (
            np.abs(last - before).max() <= tolerance * period
            and np.abs(x - x_before).max() <= tolerance * np.abs(run.x[at[-2 * n :]]).max()
        ):
            return OrbitGuess(last, y[-n:].copy(), float(period), x.copy())
    return None


def solve_orbit(loop: LinearLoop, trigger: SchmittTrigger, guess: OrbitGuess, *, bias: float = 0.0) -> Orbit:
    """The exact periodic orbit near a guess, verified by replay.

    Parameters
    ----------
    loop : LinearLoop
    trigger : SchmittTrigger
    guess : OrbitGuess
        The sequence of its levels is kept.
    bias : float
        Constant disturbance as a fraction of the jets' torque: makes cycles asymmetric.

    Returns
    -------
    Orbit

    Raises
    ------
    OrbitError
        Newton's method does not converge, the switchings would change their order, or the replay takes another way.
    """
    shooting = Shooting(loop, trigger, as_scalar("solve_orbit: bias", bias), _levels(guess))
    z = np.concatenate([as_finite("guess: x0", guess.x0), as_finite("guess: times", guess.times)[1:], [as_scalar("period", guess.period)]])
    if len(z) != len(loop.A) + len(shooting.levels):
        raise ModelError(f"guess: expected {len(loop.A)} states and as many times as levels, got {len(guess.x0)} and {len(guess.times)}")
    missed, jacobian = shooting.equations(z)
    n = len(loop.A)
    z[:n] -= np.linalg.lstsq(jacobian[:, :n], missed, rcond=None)[0]  # the best state for these times: the equations are linear in it
    z = newton(shooting, z)
    x0, times, period = shooting.parts(z)
    run, residual = _replay(shooting, x0, times, period)
    multipliers, trivial = floquet(shooting, x0, times, period)
    return Orbit(
        frozen(times), frozen(shooting.levels), period, frozen(x0), multipliers, trivial, residual, run, loop, trigger, shooting.bias
    )  # fmt: skip


def find_orbits(
    loop: LinearLoop,
    trigger: SchmittTrigger,
    *,
    guesses: Iterable[OrbitGuess] = (),
    starts: ArrayLike = (),
    t_max: float = 4000.0,
    bias: float = 0.0,
) -> tuple[Orbit, ...]:
    """All different verified orbits that guesses and simulations lead to, by decreasing frequency; those that fail are left out.

    Parameters
    ----------
    guesses : iterable of OrbitGuess
    starts : array_like, shape (M, n)
        States from which the loop is simulated for `t_max` s; where its end repeats itself, an orbit is looked for.
    """
    points = np.asarray(starts, dtype=float).reshape(-1, len(loop.A))
    ends = (from_run(simulate_loop(loop, trigger, x0=x0, t_max=t_max, bias=bias)) for x0 in points)
    found: list[Orbit] = []
    for guess in (*guesses, *(end for end in ends if end is not None)):
        try:
            orbit = solve_orbit(loop, trigger, guess, bias=bias)
        except OrbitError:
            continue
        if not any(_same(orbit, other) for other in found):
            found.append(orbit)
    return tuple(sorted(found, key=lambda orbit: -orbit.w))


def _same(a: Orbit, b: Orbit) -> bool:
    """Equal periods and equal states at some switching of one."""
    if len(a.times) != len(b.times) or abs(a.period - b.period) > 1e-6 * a.period:
        return False
    nodes = a.run.events
    size = np.abs(a.run.x).max()
    return bool((np.abs(a.run.x[nodes] - b.x0).max(axis=1) <= 1e-5 * size).any())


def _levels(guess: OrbitGuess) -> Array:
    """Outputs after each switching, which must be a possible sequence."""
    levels = as_finite("guess: levels", guess.levels)
    before = np.roll(levels, 1)
    if levels.ndim != 1 or len(levels) < 2 or not np.isin(levels, (-1, 0, 1)).all() or (np.abs(levels - before) != 1).any():
        raise ModelError(f"guess: levels {levels.tolist()}; expected -1, 0 or 1 with single steps, closed in itself, such as [1, 0, -1, 0]")
    return levels


def _replay(shooting: Shooting, x0: Array, times: Array, period: float) -> tuple[LoopRun, float]:
    """Simulate one period from x0 without knowledge of the switching times, and compare."""
    loop, count = shooting.loop, len(times)
    pending: list[tuple[float, float]] = []
    for lap in range(1, math.ceil(loop.delay / period) + 1):
        due = times + loop.delay - lap * period
        pending += [(float(t), float(level)) for t, level in zip(due, shooting.levels, strict=True) if t > 0]
    if loop.delay > 0:
        pending.append((loop.delay, float(shooting.levels[0])))
    first = shooting.inputs(times, period)[0]
    end = period + 0.5 * times[1]
    run = simulate_loop(
        loop, shooting.trigger, x0=x0, t_max=end, bias=shooting.bias, output=float(shooting.levels[0]), settled=True,
        pending=tuple(sorted(pending)), applied=shooting.bias - first,
    )  # fmt: skip
    same = len(run.events) == count and np.array_equal(run.y[run.events], np.roll(shooting.levels, -1))
    if not same:
        raise OrbitError(
            f"orbit: the replay switches {len(run.events)} times to {run.y[run.events][:12].tolist()} in a period, the shooting {count}"
            " times: a threshold is crossed in between; it is no orbit of the loop",
            Status.INFEASIBLE,
        )
    wanted = np.append(times[1:], period)
    late = float(np.abs(run.t[run.events] - wanted).max()) / period
    miss = float(np.abs(run.x[run.events[-1]] - x0).max()) / max(float(np.abs(run.x).max()), 1e-300)
    residual = max(late, miss)
    if not residual <= REPLAYED:
        raise OrbitError(f"orbit: the replay misses its start by {residual:.3g}; the orbit is not verified", Status.UNDECIDED)
    return run, residual


def describe(orbits: Sequence[Orbit]) -> list[dict[str, object]]:
    """Plain numbers of orbits, for tables and JSON."""
    return [
        {
            "w": o.w, "period": o.period, "levels": o.levels.astype(int).tolist(), "times": o.times.tolist(), "stable": o.stable,
            "symmetric": o.symmetric, "largest_multiplier": float(np.abs(o.multipliers).max(initial=0.0)),
            "attitude_amplitude": o.peak(o.loop.attitude), "flexible_amplitude": o.peak(o.loop.flexible),
            "trigger_amplitude": o.peak(o.loop.C), "duty": o.duty, "pulses": o.pulses, "residual": o.residual,
        }
        for o in orbits
    ]  # fmt: skip
