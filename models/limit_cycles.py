"""Limit cycle of the Schmitt-trigger jet loop in closed form: exact, by describing function, and bounds on the difference.

Loop: attitude error through the lead 1 + tau s into a Schmitt trigger (u_on, u_off), jets of angular acceleration a, plant a/s^2.
With h = u_on - u_off, s = u_on + u_off and the one number kappa = 8 a s tau^2/(pi h^2), both frequencies are functions of kappa alone
in units of h/(s tau):

    exact   Omega(kappa) = (pi^2/8) kappa/(1 + pi kappa/4)
    describing function   z(kappa), the real root of z^3 + z = kappa, where z^2 < s/h

Proofs are in docs/jet_loop.md.  Orbits with flexible modes, delays or disturbances: :mod:`models.periodic_orbits`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, as_scalar, evaluate
from models.modulators import SchmittTrigger

PARAMETERS = ("a", "u_on", "u_off", "tau")
NEWTON_STEPS = 2  # of Theorem 2's bounds: each one from a bound that is 4 % off; two leave 1e-6
ROUNDING = 2e-14  # relative widening of the bounds: they hold for the computed numbers too
SIGN_CHANGE = 1.2445368372888348  # kappa at which the two frequencies are equal; below it the exact one is higher


@dataclass(frozen=True, slots=True, eq=False)
class SymmetricCycle:
    """The exact symmetric limit cycle.

    Attributes
    ----------
    w, period : float
        rad/s, s.
    amplitude : float
        Largest attitude A_T.
    rate : float
        Attitude rate while coasting, r = h/(2 tau).
    switching : float
        |Attitude| at every switching, (u_on + u_off)/2.
    pulse : float
        Duration of one firing, 2 r/a, s.
    duty : float
        Fraction of the time in which a jet fires, 4 r/(a P).
    multiplier : float
        Floquet multiplier over one period, ((r - a tau)/(r + a tau))^2: below one, whatever the parameters.
    """

    w: float
    period: float
    amplitude: float
    rate: float
    switching: float
    pulse: float
    duty: float
    multiplier: float


@dataclass(frozen=True, slots=True, eq=False)
class DescribingCycle:
    """What the describing function predicts.

    Attributes
    ----------
    w : float or None
        rad/s; None where 1 + N(A) G(jw) = 0 has no solution.
    trigger_amplitude, attitude_amplitude : float or None
        Of the trigger's input, and of the attitude: divided by sqrt(1 + (w tau)^2).
    reason : str
        Why there is none; empty if there is one.
    """

    w: float | None
    trigger_amplitude: float | None
    attitude_amplitude: float | None
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyBounds:
    """Bounds on w_exact - w_df without a root of the cubic (Theorem 2).

    Attributes
    ----------
    upper : float
        w_exact - w_df <= upper.
    lower_abs : float
        |w_exact - w_df| >= lower_abs >= 0.
    lower : float
        w_exact - w_df >= lower.
    relative_upper : float
        (w_exact - w_df)/w_df < pi^2/8 - 1 for all parameters; cannot be improved (kappa -> 0).
    """

    upper: float
    lower_abs: float
    lower: float
    relative_upper: float = math.pi**2 / 8 - 1


def exact_frequency(a: Any, u_on: Any, u_off: Any, tau: Any) -> Any:
    """w_T = pi a h tau/(h^2 + 2 a s tau^2), rad/s, of numbers, arrays or symbols (Lemma 1)."""
    h, s = u_on - u_off, u_on + u_off
    return math.pi * a * h * tau / (h**2 + 2 * a * s * tau**2)


def exact_amplitude(a: Any, u_on: Any, u_off: Any, tau: Any) -> Any:
    """A_T = s/2 + r^2/(2 a) with r = h/(2 tau), of numbers, arrays or symbols (Lemma 1)."""
    return (u_on + u_off) / 2 + ((u_on - u_off) / (2 * tau)) ** 2 / (2 * a)


def exact_duty(a: Any, u_on: Any, u_off: Any, tau: Any) -> Any:
    """Firing duty 4 r/(a P) of the exact cycle, of numbers, arrays or symbols."""
    return 2 * (u_on - u_off) / (tau * a) * exact_frequency(a, u_on, u_off, tau) / (2 * math.pi)


def kappa(a: Any, u_on: Any, u_off: Any, tau: Any) -> Any:
    """The one number on which both frequencies depend, 8 a s tau^2/(pi h^2)."""
    return 8 * a * (u_on + u_off) * tau**2 / (math.pi * (u_on - u_off) ** 2)


def describing_frequency(a: Any, u_on: Any, u_off: Any, tau: Any) -> Any:
    """w_DF = z h/(s tau), the real root of z^3 + z = kappa by the hyperbolic form of Cardano's, as casadi.SX (Theorem 1)."""
    root3 = math.sqrt(3)
    z = 2 / root3 * ca.sinh(ca.asinh(1.5 * root3 * kappa(a, u_on, u_off, tau)) / 3)
    return z * (u_on - u_off) / ((u_on + u_off) * tau)


@cache
def closed_forms() -> ca.Function:
    """All closed forms as one function: p (a, u_on, u_off, tau) -> w_exact, A_exact, w_df, A_df_trigger, margin, lower, upper, lower_abs.

    margin > 0 where the describing function has an intersection; the values that depend on it mean nothing elsewhere.
    """
    p = ca.SX.sym("p", 4)
    a, u_on, u_off, tau = ca.vertsplit(p)
    h, s = u_on - u_off, u_on + u_off
    w_exact, w_df = exact_frequency(a, u_on, u_off, tau), describing_frequency(a, u_on, u_off, tau)
    A_df = 0.5 * ca.sqrt((1 + (w_df * tau) ** 2) * (s**2 + (h / (w_df * tau)) ** 2))
    margin = 0.25 * math.pi * u_on * ca.sqrt(h / s) - a * tau**2
    unit, number = h / (s * tau), kappa(a, u_on, u_off, tau)
    high = number / ca.sqrt(1 + number ** (4 / 3))
    for _ in range(NEWTON_STEPS):
        high = (2 * high**3 + number) / (1 + 3 * high**2)
    low = number / (1 + high**2)
    slack = ROUNDING * (w_exact + unit * high)
    upper, lower = w_exact - unit * low + slack, w_exact - unit * high - slack
    lower_abs = ca.fmax(0, ca.fmax(lower, -upper))
    outputs = [w_exact, exact_amplitude(a, u_on, u_off, tau), w_df, A_df, margin, lower, upper, lower_abs]
    names = ["w_exact", "A_exact", "w_df", "A_df_trigger", "margin", "lower", "upper", "lower_abs"]
    return ca.Function("jet_loop_closed_forms", [p], outputs, ["p"], names)


def closed_form_table(parameters: ArrayLike) -> dict[str, Array]:
    """The closed forms for many loops at once.

    Parameters
    ----------
    parameters : array_like, shape (N, 4)
        Rows (a, u_on, u_off, tau) with a, tau > 0 and 0 <= u_off < u_on.

    Returns
    -------
    dict of ndarray, shape (N,)
        By the names of the outputs of :func:`closed_forms`; ``w_df``, ``A_df_trigger`` and the bounds are NaN where margin <= 0.

    Raises
    ------
    ModelError
    """
    rows = np.atleast_2d(as_finite("parameters", parameters))
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise ModelError(f"parameters: expected shape (N, 4) for {PARAMETERS}, got {rows.shape}")
    bad = np.flatnonzero((rows[:, 0] <= 0) | (rows[:, 3] <= 0) | (rows[:, 2] < 0) | (rows[:, 1] <= rows[:, 2]))
    if bad.size:
        raise ModelError(f"parameters: row {bad[0]}: {rows[bad[0]].tolist()}; expected a > 0, tau > 0 and 0 <= u_off < u_on")
    function = closed_forms()
    table = {function.name_out(i): value[:, 0] for i, value in enumerate(evaluate(function, rows))}
    missing = table["margin"] <= 0
    for name in ("w_df", "A_df_trigger", "lower", "upper", "lower_abs"):
        table[name] = np.where(missing, math.nan, table[name])
    return table


def symmetric_cycle(trigger: SchmittTrigger, *, a: float, tau: float) -> SymmetricCycle:
    """The exact symmetric limit cycle of the rigid loop (Lemma 1).

    It exists for all a, tau > 0 and 0 <= u_off < u_on, is the only periodic motion with jets firing, and attracts every start but those
    that come to rest inside the dead zone.

    Parameters
    ----------
    trigger : SchmittTrigger
    a : float
        Angular acceleration of the jets, > 0.
    tau : float
        Lead, s, > 0.

    Raises
    ------
    ModelError
        A nonpositive number, or u_off = u_on: then r = 0 and nothing but chatter is left.

    Notes
    -----
    Source: Deng et al. 2016 (paper 001), Lemma 1.
    """
    acceleration, lead = _positive(a, tau)
    if trigger.h == 0:
        raise ModelError(
            f"u_off = u_on = {trigger.u_on:.6g}: without hysteresis the coasting rate (u_on - u_off)/(2 tau) is zero and there is no"
            " limit cycle but chatter at the threshold; lower u_off"
        )
    values = (acceleration, trigger.u_on, trigger.u_off, lead)
    w, r = float(exact_frequency(*values)), trigger.h / (2 * lead)
    return SymmetricCycle(
        w=w, period=2 * math.pi / w, amplitude=float(exact_amplitude(*values)), rate=r, switching=(trigger.u_on + trigger.u_off) / 2,
        pulse=2 * r / acceleration, duty=float(exact_duty(*values)),
        multiplier=((r - acceleration * lead) / (r + acceleration * lead)) ** 2,
    )  # fmt: skip


def describing_cycle(trigger: SchmittTrigger, *, a: float, tau: float) -> DescribingCycle:
    """Solution of 1 + N(A) G(jw) = 0 in closed form (Theorem 1).

    Parameters
    ----------
    trigger : SchmittTrigger
    a, tau : float
        As in :func:`symmetric_cycle`.

    Notes
    -----
    Source: Deng et al. 2016 (paper 001), Theorem 1, derived again: w^3 + (h/(s tau))^2 w = 8 a h/(pi s^2 tau), and
    A^2 = (1 + (w tau)^2) (s^2 + (h/(w tau))^2)/4; A >= u_on asks for a tau^2 < (pi/4) u_on sqrt(h/s).
    """
    acceleration, lead = _positive(a, tau)
    if trigger.h == 0:
        return DescribingCycle(None, None, None, "without hysteresis N(A) is real, and with lead G(jw) is never negative real")
    table = closed_form_table([acceleration, trigger.u_on, trigger.u_off, lead])
    limit = 0.25 * math.pi * trigger.u_on * math.sqrt(trigger.h / (trigger.u_on + trigger.u_off))
    if table["margin"][0] <= 0:
        reason = (
            f"the describing function has no intersection: a tau^2 = {acceleration * lead**2:.6g} must be below"
            f" (pi/4) u_on sqrt((u_on - u_off)/(u_on + u_off)) = {limit:.6g}; the harmonic that balances the phase is smaller than u_on."
            " The exact limit cycle exists all the same"
        )
        return DescribingCycle(None, None, None, reason)
    w, A = float(table["w_df"][0]), float(table["A_df_trigger"][0])
    return DescribingCycle(w, A, A / math.hypot(1.0, w * lead), "")


def frequency_bounds(trigger: SchmittTrigger, *, a: float, tau: float) -> FrequencyBounds | None:
    """Theorem 2: bounds on w_exact - w_df; None where there is no w_df."""
    acceleration, lead = _positive(a, tau)
    if trigger.h == 0:
        return None
    table = closed_form_table([acceleration, trigger.u_on, trigger.u_off, lead])
    if table["margin"][0] <= 0:
        return None
    return FrequencyBounds(*(float(table[name][0]) for name in ("upper", "lower_abs", "lower")))


@cache
def _gradients() -> ca.Function:
    p = ca.SX.sym("p", 4)
    outputs = [closed_forms()(p)[i] for i in (0, 1, 2)]
    return ca.Function("jet_loop_gradients", [p], [ca.gradient(value, p) for value in outputs], ["p"], ["w_exact", "A_exact", "w_df"])


def sensitivities(trigger: SchmittTrigger, *, a: float, tau: float) -> dict[str, dict[str, float]]:
    """Exact derivatives of w_exact, A_exact and, where it exists, w_df by a, u_on, u_off and tau, from CasADi.

    Returns
    -------
    dict
        ``{"w_exact": {"a": ..., "u_on": ..., "u_off": ..., "tau": ...}, ...}``.
    """
    symmetric_cycle(trigger, a=a, tau=tau)  # refuses what has no cycle
    gradients = evaluate(_gradients(), np.array([a, trigger.u_on, trigger.u_off, tau], dtype=float))
    found = {
        name: dict(zip(PARAMETERS, map(float, value), strict=True))
        for name, value in zip(("w_exact", "A_exact", "w_df"), gradients, strict=True)
    }
    if describing_cycle(trigger, a=a, tau=tau).w is None:
        del found["w_df"]
    return found


def _positive(a: object, tau: object) -> tuple[float, float]:
    values = as_scalar("a", a), as_scalar("tau", tau)
    for name, value, text in zip(("a", "tau"), values, ("the angular acceleration of the jets", "the lead, s"), strict=True):
        if value <= 0:
            raise ModelError(f"{name} = {value:.6g}; expected > 0: {text}")
    return values
