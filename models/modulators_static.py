"""Static characteristics of modulators: duty cycle against a constant demand, shortest pulse, and advice on parameters.

Sources: Lu & Zhang 2012 (paper 000), eqs 1-2, Table 1, Fig. 3; closed forms derived from the filter's exponentials.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from models.checked import Array, ModelError, as_finite, frozen
from models.modulators import PWM, ContinuousPWPF, DiscretePWPF, PseudoRate, SchmittTrigger
from models.modulators_base import Modulator
from models.modulators_runs import run

_SETTLE = (500, 4000, 100_000)  # samples before the word is looked for: at first, again where it was not found, and at most
_LONGEST = 1000  # samples: longest period that is looked for
_DISTANCE = 1e-11  # least distance from a threshold, relative, at which a word counts as proved

RANGES = {"km": (2.5, 7.5), "tau_m": (0.1, 0.2), "u_on": (0.3, 1.0), "h": (0.2, 0.8)}
"""Recommended parameters (h as a multiple of u_on).  Source: Lu & Zhang 2012 (paper 000), Table 1."""


@dataclass(frozen=True, slots=True, eq=False)
class SampledDuty:
    """Long-run output of a sampled modulator from rest, for each of N constant demands.

    Attributes
    ----------
    r : ndarray, shape (N,)
    fired : ndarray of int, shape (N,)
        Sum of the output over one period.
    period : ndarray of int, shape (N,)
        Samples in one period; 0 where none up to 1000 was found.
    decided : ndarray of bool, shape (N,)
        The period repeats for ever: no number in it comes near a threshold, and the filter forgets.
    duty : ndarray, shape (N,)
        fired/period as a float; the mean of the last samples where there is no period.
    """

    r: Array
    fired: np.ndarray
    period: np.ndarray
    decided: np.ndarray
    duty: Array

    def fraction(self, i: int = 0) -> Fraction:
        """Exact duty cycle of demand i.

        Raises
        ------
        ModelError
            It was not decided.
        """
        if not self.decided[i]:
            raise ModelError(f"duty: r = {self.r[i]:.6g}: the long-run output is not decided; the orbit comes too near a threshold")
        return Fraction(int(self.fired[i]), int(self.period[i]))


def duty(modulator: Modulator, r: ArrayLike) -> Array:
    """Mean output in the long run under a constant demand, from rest; shape of r.

    Continuous PWPF by its closed form: T_on = -tau ln((u_off - a)/(u_on - a)) with a = km (r - 1), T_off = -tau ln((b - u_on)/(b - u_off))
    with b = km r, duty = T_on/(T_on + T_off); 0 for b <= u_on, 1 for a >= u_off.  PWM and Schmitt trigger by their definition; the other
    sampled ones from their orbit (:func:`sampled_duty`).

    Raises
    ------
    ModelError
        A demand that is not a finite number.
    """
    demand = as_finite("duty: r", r)
    if isinstance(modulator, ContinuousPWPF):
        return _pwpf_duty(modulator, demand)
    if isinstance(modulator, PWM):
        width = np.floor(np.minimum(np.abs(demand), 1.0) * modulator.slots + 0.5)
        return np.asarray(np.sign(demand) * np.where(width < modulator.minimum, 0.0, width) / modulator.slots)
    if isinstance(modulator, SchmittTrigger):
        return np.asarray(np.where(np.abs(demand) >= modulator.u_on, np.sign(demand), 0.0))
    return sampled_duty(modulator, demand.reshape(-1)).duty.reshape(demand.shape)


def _pwpf_duty(modulator: ContinuousPWPF, r: Array) -> Array:
    km, u_on, u_off = modulator.km, modulator.u_on, modulator.u_off
    target_on, target_off = km * (np.abs(r) - 1.0), km * np.abs(r)
    pulsing = (target_off > u_on) & (target_on < u_off)
    safe_on, safe_off = np.where(pulsing, target_on, u_off - 1.0), np.where(pulsing, target_off, u_on + 1.0)
    t_on = -np.log((u_off - safe_on) / (u_on - safe_on))
    t_off = -np.log((safe_off - u_on) / (safe_off - u_off))
    value = np.where(pulsing, t_on / (t_on + t_off), np.where(target_off <= u_on, 0.0, 1.0))
    return np.asarray(np.sign(r) * value)


def pseudo_rate_duty(modulator: PseudoRate, r: ArrayLike) -> Array:
    """Duty cycle that a pseudo-rate modulator approaches as its sample time goes to zero, in closed form; shape of r.

    T_on = tau ln((km - r + u_on)/(km - r + u_off)), T_off = tau ln((r - u_off)/(r - u_on)); 0 for r <= u_on, 1 for r - u_off >= km.
    Needs h > 0: without hysteresis both times are zero and their ratio is (r - u_on)/km.
    """
    demand = np.abs(as_finite("duty: r", r))
    km, u_on, u_off = modulator.km, modulator.u_on, modulator.u_off
    pulsing = (demand > u_on) & (demand - u_off < km)
    inside = np.where(pulsing, demand, u_on + 0.5 * km)
    if modulator.h > 0:
        with np.errstate(invalid="ignore", divide="ignore"):
            t_on, t_off = np.log((km - inside + u_on) / (km - inside + u_off)), np.log((inside - u_off) / (inside - u_on))
        share = t_on / (t_on + t_off)
    else:
        share = (inside - u_on) / km
    return np.asarray(np.sign(r) * np.where(pulsing, share, np.where(demand <= u_on, 0.0, 1.0)))


def sampled_duty(modulator: Modulator, r: ArrayLike) -> SampledDuty:
    """Long-run output of a sampled PWPF or pseudo-rate modulator for constant demands, exactly, from the orbit that starts at rest.

    Parameters
    ----------
    modulator : DiscretePWPF or PseudoRate
    r : array_like, shape (N,) or scalar

    Raises
    ------
    ModelError
        Another modulator, or a demand that is not a finite number.

    Notes
    -----
    Other orbits of the same modulator may end in other words: for all of them see :mod:`models.census`.
    """
    if not isinstance(modulator, DiscretePWPF | PseudoRate):
        raise ModelError(f"sampled_duty: expected a DiscretePWPF or PseudoRate, got {type(modulator).__name__}; use duty")
    demand = np.atleast_1d(as_finite("duty: r", r))
    if demand.ndim != 1 or demand.size == 0:
        raise ModelError(f"duty: r: expected shape (N,), got {demand.shape}")
    memory = 40.0 / max(-math.log(max(abs(modulator.n), 1e-300)), 1e-12)  # samples in which the filter forgets its start to rounding
    out = SampledDuty(demand, *(np.zeros(len(demand), dtype=kind) for kind in (int, int, bool, float)))
    todo, z = np.arange(len(demand)), np.zeros((len(demand), 3))
    for settle, longest in ((_SETTLE[0], _LONGEST // 10), (_SETTLE[1], _LONGEST)):  # most words are short and soon there
        samples = int(np.clip(memory, settle, _SETTLE[2]))
        z = run(modulator, np.repeat(demand[todo, None], samples, axis=1), z0=z).z
        last = run(modulator, np.repeat(demand[todo, None], 2 * longest + 2, axis=1), z0=z)
        out.period[todo] = period = _periods(last.y, longest)
        out.fired[todo] = fired = (last.y * (np.arange(last.y.shape[1]) < period[:, None])).sum(axis=1).astype(int)
        margin, moved = _margins(modulator, demand[todo], z, last.y, period)
        forgets = np.abs(modulator.n) ** np.maximum(period, 1)
        left = np.maximum(1 - forgets, 1e-300)  # 0 where the pole is 1 or -1 but for rounding: then nothing is decided
        out.decided[todo] = (period > 0) & (forgets < 1) & (margin > _DISTANCE * modulator.u_on + 2 * moved / left)
        out.duty[todo] = np.where(period > 0, fired / np.maximum(period, 1), last.y.mean(axis=1))
        open_ = ~out.decided[todo]
        todo, z = todo[open_], np.array(last.z)[open_]
        if todo.size == 0:
            break
    return SampledDuty(frozen(demand), out.fired, out.period, out.decided, frozen(out.duty))


def _periods(y: Array, longest: int) -> np.ndarray:
    """Least p up to `longest` with which each row repeats; 0 if none."""
    period = np.zeros(len(y), dtype=int)
    for p in range(1, longest + 1):
        open_ = np.flatnonzero(period == 0)
        if open_.size == 0:
            break
        rows = y[open_]
        period[open_[(rows[:, p:] == rows[:, :-p]).all(axis=1)]] = p
    return period


def _margins(modulator: DiscretePWPF | PseudoRate, r: Array, z: Array, y: Array, period: np.ndarray) -> tuple[Array, Array]:
    """Least distance of the trigger's input from the threshold that counts, and how far it moves from one period to the next."""
    m, n = modulator.m, modulator.n
    if isinstance(modulator, DiscretePWPF):
        before = np.concatenate([z[:, 2:3], y[:, :-1]], axis=1)
        error = modulator.f(r)[:, None] - modulator.k * before
        drive = m * (error + np.concatenate([z[:, 1:2], error[:, :-1]], axis=1))
        signal = lfilter([1.0], [1.0, -n], drive, axis=1, zi=n * z[:, :1])[0]
    else:
        before = np.concatenate([z[:, 1:2], y[:, :-1]], axis=1)
        drive = m * (before + np.concatenate([z[:, 2:3], before[:, :-1]], axis=1))
        signal = r[:, None] - lfilter([1.0], [1.0, -n], drive, axis=1, zi=n * z[:, :1])[0]
    upper = np.where(before > 0, modulator.u_off, modulator.u_on)
    lower = np.where(before < 0, -modulator.u_off, -modulator.u_on)
    margin = np.minimum(np.abs(signal - upper), np.abs(signal - lower)).min(axis=1)
    rows = np.arange(len(r))
    return margin, np.abs(signal[rows, period] - signal[rows, 0])


def minimum_pulse(modulator: Modulator) -> float:
    """Shortest time for which a jet fires under a constant demand, s.

    Continuous PWPF: -tau ln(1 - h/km) at the edge of the dead zone (eq 2), infinite for h >= km.  Pseudo-rate: the same of its lag, but
    at least one sample.  Sampled PWPF: one sample.  PWM: its minimum, at least one sample.  Schmitt trigger: 0, it has no clock.

    Source: Lu & Zhang 2012 (paper 000), eq 2 (10.26 ms for its values; printed 10.3).
    """
    if isinstance(modulator, ContinuousPWPF):
        return _lag_pulse(modulator.tau_m, modulator.h, modulator.km)
    if isinstance(modulator, PseudoRate):
        return max(modulator.Ts, _lag_pulse(modulator.tau_m, modulator.h, modulator.km))
    if isinstance(modulator, DiscretePWPF):
        return modulator.Ts
    if isinstance(modulator, PWM):
        return max(1.0, modulator.minimum) * modulator.Ts
    if isinstance(modulator, SchmittTrigger):
        return 0.0
    raise ModelError(f"minimum_pulse: unknown modulator {type(modulator).__name__}")


def _lag_pulse(tau: float, h: float, km: float) -> float:
    return -tau * math.log1p(-h / km) if h < km else math.inf


@dataclass(frozen=True, slots=True)
class Advice:
    """One remark on a parameter: which, its value, the recommended range (None: no range), and why."""

    parameter: str
    value: float
    recommended: tuple[float, float] | None
    reason: str

    def __str__(self) -> str:
        within = "" if self.recommended is None else f" (recommended {self.recommended[0]:.4g} to {self.recommended[1]:.4g})"
        return f"{self.parameter} = {self.value:.6g}{within}: {self.reason}"


_REASONS = {
    "km": ("the dead zone u_on/km becomes wide", "the jets switch more often for the same demand and use more propellant"),
    "tau_m": ("the jets switch more often and use more propellant", "the pulses lag behind the demand"),
    "u_on": ("noise and small demands fire the jets", "the dead zone u_on/km becomes wide"),
    "h": ("pulses become very short", "the duty cycle is less linear and the shortest pulse longer"),
}


def advice(modulator: ContinuousPWPF | DiscretePWPF) -> tuple[Advice, ...]:
    """Remarks on the parameters of a PWPF modulator, each with its reason; empty if there is nothing to say.

    Source: Lu & Zhang 2012 (paper 000), Table 1 and section 1.
    """
    if not isinstance(modulator, ContinuousPWPF | DiscretePWPF):
        raise ModelError(f"advice: expected a ContinuousPWPF or DiscretePWPF, got {type(modulator).__name__}")
    found = []
    sampled = isinstance(modulator, DiscretePWPF)
    for name, (low, high) in RANGES.items():
        if name == "h" and sampled and modulator.h == 0:
            continue  # the sample time already keeps pulses long; the paper itself ends with h = 0
        scale = modulator.u_on if name == "h" else 1.0
        value = getattr(modulator, name)
        if not low * scale * (1 - 1e-12) <= value <= high * scale * (1 + 1e-12):
            reason = _REASONS[name][0 if value < low * scale else 1]
            found.append(Advice(name, value, (low * scale, high * scale), reason))
    if modulator.km <= modulator.u_on:
        found.append(Advice("km", modulator.km, None, f"at most u_on = {modulator.u_on:.6g}: even a full demand does not fire the jets"))
    return (*found, *(_sampled_advice(modulator) if isinstance(modulator, DiscretePWPF) else ()))


def _sampled_advice(modulator: DiscretePWPF) -> list[Advice]:
    found = []
    if modulator.Ts >= 2 * modulator.tau_m:
        reason = f"at least 2 tau_m = {2 * modulator.tau_m:.4g} s: the filter's pole n = {modulator.n:.4g} is not positive, it alternates"
        found.append(Advice("Ts", modulator.Ts, None, reason))
    if modulator.h > 0 and modulator.Ts > _lag_pulse(modulator.tau_m, modulator.h, modulator.km):
        pulse = 1e3 * _lag_pulse(modulator.tau_m, modulator.h, modulator.km)
        reason = (
            f"a sample of {1e3 * modulator.Ts:.4g} ms is longer than the pulse of {pulse:.4g} ms it asks for: only linearity is lost; use 0"
        )
        found.append(Advice("h", modulator.h, None, reason))
    if modulator.delta >= modulator.u_on / modulator.km:
        reason = f"at least u_on/km = {modulator.u_on / modulator.km:.4g}: the jets fire without a demand"
        found.append(Advice("delta", modulator.delta, None, reason))
    if modulator.k == 0:
        found.append(Advice("k", 0.0, None, "without feedback the output is not modulated: a relay behind a filter"))
    return found
