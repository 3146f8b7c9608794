"""Linear parts of jet-control loops: rigid body with lead, flexible modes, jet delay; the loop is closed by a trigger.

The loop everywhere in this workbench: xdot = A x + B (bias - y(t - delay)), s = C x, y = trigger(s) in {-1, 0, 1}; a positive s asks the
jets for negative torque.  Its linear part is G(jw) = C (jw I - A)^-1 B exp(-jw delay), and a describing function N closes it by
1 + N(A) G(jw) = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, as_scalar, frozen
from models.nyquist import LinearPart, state_space


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """One flexible mode as the attitude sees it: gain/((s - pole)(s - conj(pole))), in units of the rigid angular acceleration.

    Attributes
    ----------
    gain : float
        K_a; negative for a mode out of phase with the rigid body.
    pole : complex
        Upper pole of the pair, rad/s: real part <= 0, imaginary part > 0.
    """

    gain: float
    pole: complex

    def __post_init__(self) -> None:
        as_scalar("Mode: gain", self.gain)
        try:
            pole = complex(self.pole)
        except (TypeError, ValueError):
            raise ModelError(f"Mode: pole: expected a complex number, got {self.pole!r}; such as -0.0023 + 0.45j") from None
        if not (math.isfinite(pole.real) and math.isfinite(pole.imag) and pole.imag > 0 and pole.real <= 0):
            raise ModelError(f"Mode: pole = {pole}; expected a stable or undamped pair: real part <= 0, imaginary part > 0")
        object.__setattr__(self, "pole", pole)

    @property
    def frequency(self) -> float:
        """Damped natural frequency, rad/s."""
        return self.pole.imag


FLEXIBLE_001 = (Mode(gain=1.0, pole=-0.0023 + 0.45j),)
"""The appendage of Deng et al. 2016 (paper 001), section 3.1."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearLoop:
    """Linear part of a loop; see the head of this module for the signs.

    Attributes
    ----------
    name : str
    A : ndarray, shape (n, n)
    B, C : ndarray, shape (n,)
        Input column and the row of the trigger's input; C B may differ from zero (lead), a direct feed-through may not be.
    attitude, flexible : ndarray, shape (n,)
        Rows of the attitude and of the part of it that is due to the modes.
    delay : float
        From the trigger's output to the plant's input, s.
    modes : tuple of Mode
    """

    name: str
    A: Array
    B: Array
    C: Array
    attitude: Array
    flexible: Array
    delay: float = 0.0
    modes: tuple[Mode, ...] = ()

    def __post_init__(self) -> None:
        A = as_finite(f"{self.name}: A", self.A)
        if A.ndim != 2 or A.shape[0] != A.shape[1] or A.size == 0:
            raise ModelError(f"{self.name}: A: expected a square matrix, got shape {A.shape}")
        object.__setattr__(self, "A", frozen(A))
        for row in ("B", "C", "attitude", "flexible"):
            value = as_finite(f"{self.name}: {row}", getattr(self, row))
            if value.shape != (len(A),):
                raise ModelError(f"{self.name}: {row}: expected shape ({len(A)},), got {value.shape}; one number for each state")
            object.__setattr__(self, row, frozen(value))
        delay = as_scalar(f"{self.name}: delay", self.delay)
        if delay < 0:
            raise ModelError(f"{self.name}: delay = {delay:.6g} s; expected >= 0")
        object.__setattr__(self, "delay", delay)

    def response(self, w: ArrayLike) -> np.ndarray:
        """G(jw), complex, shape of `w`, with the delay; w in rad/s, not at an undamped pole.

        Raises
        ------
        ModelError
            A frequency that is not finite.
        """
        return np.asarray(self.linear_part()(w))

    def linear_part(self) -> LinearPart:
        """The same for :func:`models.nyquist.intersections`."""
        return state_space(self.A, self.B, self.C, delay=self.delay)

    def with_delay(self, samples: int, sample: float) -> LinearLoop:
        """The same plant with a delay of whole samples: `samples` times `sample` s."""
        return replace(self, delay=whole_delay(samples, sample))

    def transition(self, t: float) -> tuple[Array, Array]:
        """exp(A t) (n, n) and the response (n,) to the unit input held for t s from rest: exact for any A."""
        n = len(self.A)
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = self.A * t, self.B * t
        full = _exponential(block)
        return full[:n, :n], full[:n, n]


def _exponential(block: Array) -> Array:
    """Matrix exponential by scaling, series and squaring: a few microseconds where a general routine takes milliseconds."""
    doublings = max(0, math.ceil(math.log2(max(float(np.abs(block[:-1, :-1]).sum(axis=1).max()), 1e-300) / 0.25)))
    small = block / 2**doublings
    result, term = np.eye(len(block)) + small, small
    for k in range(2, 15):  # terms of the series; the first left out is below 1e-20 of the result
        term = term @ small / k
        result = result + term
    for _ in range(doublings):
        result = result @ result
    return np.asarray(result)


def whole_delay(samples: int, sample: float) -> float:
    """Delay of `samples` sampling periods of `sample` s each."""
    if isinstance(samples, bool) or not isinstance(samples, (int, np.integer)) or samples < 0:
        raise ModelError(f"delay: samples = {samples!r}; expected a whole number >= 0")
    period = as_scalar("delay: sample", sample)
    if period < 0 or (samples > 0 and period == 0):
        raise ModelError(f"delay: sample = {period:.6g} s; expected > 0: the sampling period of the jet computer")
    return int(samples) * period


def jet_plant(a: float, *, tau: float, modes: Sequence[Mode] = (), samples: int = 0, sample: float = 0.0) -> LinearLoop:
    """Attitude plant with lead: G(s) = (1 + tau s) a [1/s^2 + sum_i gain_i/((s - p_i)(s - conj p_i))] exp(-s samples sample).

    States: attitude and rate of the rigid body, then deflection and rate of each mode (as they appear in the attitude).

    Parameters
    ----------
    a : float
        Angular acceleration of the jets, Tc/I, rad/s2 (or the unit of the thresholds per s2), > 0.
    tau : float
        Lead, s, >= 0: rate feedback over attitude feedback.
    modes : sequence of Mode
    samples, sample : int, float
        Delay of whole samples, and their period in s.

    Raises
    ------
    ModelError

    Notes
    -----
    Source: Deng et al. 2016 (paper 001), eqs 3 and 13.
    """
    acceleration, lead = as_scalar("a", a), as_scalar("tau", tau)
    if acceleration <= 0:
        raise ModelError(f"a = {acceleration:.6g}; expected > 0: the angular acceleration of the jets in the sense of the command")
    if lead < 0:
        raise ModelError(f"tau = {lead:.6g} s; expected >= 0")
    kinds = tuple(modes)
    wrong = next((mode for mode in kinds if not isinstance(mode, Mode)), None)
    if wrong is not None:
        raise ModelError(f"modes: expected Mode values, got {wrong!r}; such as Mode(gain=1.0, pole=-0.0023 + 0.45j)")
    n = 2 + 2 * len(kinds)
    A, B, attitude, rate, flexible = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    A[0, 1], B[1], attitude[0], rate[1] = 1.0, acceleration, 1.0, 1.0
    for k, mode in enumerate(kinds):
        i = 2 + 2 * k
        A[i, i + 1], A[i + 1, i], A[i + 1, i + 1] = 1.0, -(abs(mode.pole) ** 2), 2 * mode.pole.real
        B[i + 1] = acceleration * mode.gain
        attitude[i], rate[i + 1], flexible[i] = 1.0, 1.0, 1.0
    name = "flexible plant" if kinds else "rigid plant"
    return LinearLoop(name, A, B, attitude + lead * rate, attitude, flexible, whole_delay(samples, sample), kinds)


def from_control(system: Any, *, samples: int = 0, sample: float = 0.0) -> LinearLoop:
    """A single-input single-output linear part given from outside, lead included: its output is the trigger's input.

    Parameters
    ----------
    system : object
        python-control ``StateSpace`` or ``TransferFunction``, scipy.signal systems, or a tuple (A, B, C) or (numerator, denominator).
    samples, sample : int, float
        Delay of whole samples, and their period in s.

    Raises
    ------
    ModelError
        Another kind of system, several inputs or outputs, a sampled system, a direct feed-through.
    """
    step = getattr(system, "dt", None)
    if step not in (None, 0, 0.0):
        raise ModelError(f"linear part: expected a system in continuous time, got one sampled at {step!r} s")
    A, B, C, D = _matrices(system)
    A, B, C, D = (as_finite(f"linear part: {name}", value) for name, value in zip("ABCD", (A, B, C, D), strict=True))
    if B.size != len(A) or C.size != len(A) or D.size > 1:
        raise ModelError(f"linear part: expected one input and one output, got B {B.shape}, C {C.shape}, D {D.shape}")
    if D.size and abs(float(D.ravel()[0])) > 0:
        raise ModelError(f"linear part: feed-through D = {float(D.ravel()[0]):.6g}; expected 0: a relay around it has no defined output")
    row = C.ravel()
    return LinearLoop("linear part", A, B.ravel(), row, row, np.zeros(len(A)), whole_delay(samples, sample))


def _matrices(system: Any) -> tuple[Any, Any, Any, Any]:
    """(A, B, C, D) of whatever is known to be a linear system."""
    from scipy.signal import tf2ss

    if isinstance(system, tuple) and len(system) == 3:
        return (*system, 0.0)
    if isinstance(system, tuple) and len(system) == 2:
        return tuple(tf2ss(*(as_finite("linear part: polynomial", part) for part in system)))
    if all(hasattr(system, name) for name in "ABCD"):
        return system.A, system.B, system.C, system.D
    if hasattr(system, "num") and hasattr(system, "den"):
        num, den = (np.asarray(part[0][0] if isinstance(part, list) or np.ndim(part) > 1 else part) for part in (system.num, system.den))
        return tuple(tf2ss(num, den))
    raise ModelError(f"linear part: expected a state space, a transfer function or matrices (A, B, C), got {type(system).__name__}")
