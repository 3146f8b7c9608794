"""Equations of a periodic orbit of a trigger with a linear plant: residual, exact Jacobian, Newton's method, Floquet multipliers.

The state is carried from switching to switching by matrix exponentials, and its derivatives by everything that is unknown with it.
Used by :mod:`models.periodic_orbits`; signs: see :mod:`models.flexible_loop`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.checked import Array, ModelError, Status
from models.flexible_loop import LinearLoop
from models.modulators import SchmittTrigger

NEWTONS = 60
SOLVED = 1e-8  # residual of the shooting equations, relative, with a step below 1e-9 to the next iterate: long coasting costs digits
TRIVIAL = 1e-5  # distance of one multiplier from 1: the shift in time


class OrbitError(ModelError):
    """No verified periodic orbit was found; ``status`` says why."""

    def __init__(self, message: str, status: Status) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True, eq=False)
class Shooting:
    """The equations of an orbit with a given sequence of levels in z = [x0 (n), times of switchings 2 to N, period]."""

    loop: LinearLoop
    trigger: SchmittTrigger
    bias: float
    levels: Array

    @property
    def thresholds(self) -> Array:
        """Value of the trigger's input at each switching."""
        before = np.roll(self.levels, 1)
        return np.where(self.levels != 0, self.levels * self.trigger.u_on, before * self.trigger.u_off)

    def parts(self, z: Array) -> tuple[Array, Array, float]:
        """State at the first switching, all switching times, period."""
        n = len(self.loop.A)
        return z[:n], np.concatenate([[0.0], z[n:-1]]), float(z[-1])

    def inputs(self, times: Array, period: float) -> tuple[float, Array, Array]:
        """Plant input just after 0, time of each switching's arrival at the plant in [0, period), and in which period it set out."""
        arrival = times + self.loop.delay
        laps = np.floor(arrival / period * (1 + 1e-15))
        arrival = np.maximum(arrival - laps * period, 0.0)
        newest = int(np.argmin(arrival)) if arrival.min() == 0 else int(np.argmax(arrival))
        return self.bias - float(self.levels[newest]), arrival, laps

    def items(self, times: Array, arrival: Array) -> list[tuple[float, int, int]]:
        """(time, 0 for a switching and 1 for its arrival at the plant, number) by time; a switching comes before its own arrival."""
        return sorted([(float(t), 0, i) for i, t in enumerate(times)] + [(float(t), 1, i) for i, t in enumerate(arrival)])

    def equations(self, z: Array) -> tuple[Array, Array]:
        """Residual (n + N,) and its Jacobian, carried along the orbit from switching to switching."""
        loop, n, count = self.loop, len(self.loop.A), len(self.levels)
        x0, times, period = self.parts(z)
        v, arrival, laps = self.inputs(times, period)
        jumps = np.roll(self.levels, 1) - self.levels
        residual, jacobian = np.empty(n + count), np.zeros((n + count, n + count))
        x, now, slope = x0, 0.0, np.eye(n, n + count)  # slope: derivative of the state at a fixed time
        for t, kind, i in [*self.items(times, arrival), (period, 2, 0)]:
            moved, forced = loop.transition(t - now)
            x, slope, now = moved @ x + forced * v, moved @ slope, t
            if kind == 1 and t > 0:  # an arrival at 0 is in the first input already
                late = -loop.B * jumps[i]
                slope[:, -1] -= late * laps[i]
                if i > 0:
                    slope[:, n + i - 1] += late
                v += jumps[i]
            elif kind == 0:
                residual[i], jacobian[i] = loop.C @ x - self.thresholds[i], loop.C @ slope
                if i > 0:
                    jacobian[i, n + i - 1] += loop.C @ (loop.A @ x + loop.B * v)
        residual[count:], jacobian[count:] = x - x0, slope - np.eye(n, n + count)
        jacobian[count:, -1] += loop.A @ x + loop.B * v
        return residual, jacobian


def newton(shooting: Shooting, z: Array) -> Array:
    """Damped Newton iteration; every residual in units of the thresholds or of the states."""
    n, count = len(shooting.loop.A), len(shooting.levels)
    scale = np.concatenate([np.full(count, shooting.trigger.u_on), np.full(n, max(float(np.abs(z[:n]).max()), 1e-12))])
    residual, jacobian = shooting.equations(z)
    for _ in range(NEWTONS):
        size = float(np.abs(residual / scale).max())
        try:
            step = np.linalg.solve(jacobian, residual)
        except np.linalg.LinAlgError:
            raise OrbitError("orbit: the shooting equations are singular here; give another guess", Status.SINGULAR) from None
        if size <= SOLVED and np.abs(step[n:]).max() <= 1e-9 * z[-1] and np.abs(step[:n]).max() <= 1e-9 * scale[-1]:
            return z - step
        for halving in range(12):
            trial = z - step / 2**halving
            times = np.concatenate([[0.0], trial[n:]])
            if not np.isfinite(trial).all() or (np.diff(times) <= 0).any():
                continue
            new, new_jacobian = shooting.equations(trial)
            if np.isfinite(new).all() and (np.abs(new / scale).max() < size or (size < SOLVED and halving == 0)):
                break
        else:
            raise OrbitError(
                f"orbit: Newton's method stops at a residual of {size:.3g}; no orbit with this sequence of switchings is near the guess",
                Status.MAX_ITERATIONS,
            )
        z, residual, jacobian = trial, new, new_jacobian
    raise OrbitError(f"orbit: no convergence in {NEWTONS} iterations; give a better guess", Status.MAX_ITERATIONS)


def floquet(shooting: Shooting, x0: Array, times: Array, period: float) -> tuple[np.ndarray, float]:
    """Multipliers of the linearized flow over one period, switchings on their way through the delay included.

    A deviation dx shifts a switching by -C dx/(C xdot); its arrival moves the state by B times the jump times that shift (saltation).
    """
    loop, n = shooting.loop, len(shooting.loop.A)
    first, arrival, laps = shooting.inputs(times, period)
    jumps = np.roll(shooting.levels, 1) - shooting.levels
    items = shooting.items(times, arrival)
    waiting = int(laps.sum())
    size = n + waiting
    deviation, queue = np.eye(n, size), [np.eye(size)[n + k] for k in range(waiting)]
    v = first - sum(jumps[i] for t, kind, i in items if kind == 1 and t == 0)
    x, now = x0.copy(), 0.0
    for t, kind, i in items:
        moved, forced = loop.transition(t - now)
        x, deviation, now = moved @ x + forced * v, moved @ deviation, t
        if kind == 0:
            rate = float(loop.C @ (loop.A @ x + loop.B * v))
            if rate == 0:
                raise OrbitError("orbit: the trigger's input grazes a threshold; its stability is not defined", Status.UNDECIDED)
            queue.append(-(loop.C @ deviation) / rate)
        else:
            deviation = deviation - np.outer(loop.B * jumps[i], queue.pop(0))
            v += jumps[i]
    moved, _ = loop.transition(period - now)
    monodromy = np.vstack([moved @ deviation, *queue]) if queue else moved @ deviation
    values = np.linalg.eigvals(monodromy)
    own = int(np.argmin(np.abs(values - 1)))
    others = np.delete(values, own)
    trivial = float(np.abs(values[own] - 1))
    if trivial > TRIVIAL * max(1.0, float(np.abs(values).max())):
        raise OrbitError(f"orbit: no multiplier is 1 (nearest: {values[own]:.6g}); the linearization is not verified", Status.UNDECIDED)
    return others[np.argsort(-np.abs(others))], trivial
