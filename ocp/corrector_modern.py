"""Landing guidance by prediction and correction with several reversals of the bank angle kept in the plan."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from models import units
from models.core import Model, ModelError, as_scalar
from models.entry_truth import Servo
from ocp.corrector import Measured, Memory, ahead, guidance
from ocp.corrector_newton import Bounds, corrected
from ocp.corrector_onboard import ESTIMATED, Estimators, parameters
from ocp.landing import Guidance, Target
from ocp.predictor import Path, prediction

RESERVE_GAIN, RESERVE_RETURN = 0.3, 0.02  # in a sample: rad for each whole by which a limit is exceeded; part of the way back
RESERVES = (15 * units.DEG, 75 * units.DEG)
LEARNING = Estimators()
AFTER = 60.0  # s beyond the predicted landing at which nodes that are not used stand


@dataclass(frozen=True, slots=True)
class SeveralReversals:
    """Plan: abs(bank) = b now, running linearly to a reserve; reversals at t_1 and t_{i+1} = t_i + kappa (t_f - t_i).

    The unknowns b and t_1 follow from one damped Gauss-Newton step on the predicted miss per sample, with a halving line search over
    predicted misses; an unknown that meets its bound stays there and the other is solved again.  Executed reversals drop out of
    the plan, which keeps the cross-range two-sided to the end.

    Attributes
    ----------
    reversals : int
        N.
    kappa : float
        Share of the remaining time between two reversals.
    reserve, reserve_s, reserve_fades_s : float
        abs(bank), rad, reached `reserve_s` before the landing; over the last `reserve_fades_s` before that moment the plan gives
        the reserve up for a constant abs(bank), so that b keeps its authority.
    most : float
        Largest abs(bank), rad.
    sample_s : float
        Time between corrections, which are also the commands, s.
    last_reversal_s : float
        No reversal is planned later than this before the landing, s.
    trust_bank, trust_time : float
        Largest change of b (rad) and t_1 (s) in one correction.
    fractions : tuple of float
        Parts of the Gauss-Newton step that are tried.
    lag : float
        Softness of the servo at the end of a large step, as a further delay, s.
    load_limit, heat_limit : float
        g0 and W/m2 (infinite: none): the reserve is moved while the plan would exceed one of them, the range being kept by b.
    estimators : Estimators
    steps : int
        Integration steps of a prediction.
    """

    reversals: int = 4
    kappa: float = 0.55
    reserve: float = 55 * units.DEG
    reserve_s: float = 100.0
    reserve_fades_s: float = 100.0
    most: float = 150 * units.DEG
    sample_s: float = 2.0
    last_reversal_s: float = 12.0
    trust_bank: float = 0.35
    trust_time: float = 40.0
    fractions: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1)
    lag: float = 0.15
    load_limit: float = math.inf
    heat_limit: float = math.inf
    estimators: Estimators = LEARNING
    steps: int = 48

    def __post_init__(self) -> None:
        if isinstance(self.reversals, bool) or not isinstance(self.reversals, int) or not 0 <= self.reversals <= 12:
            raise ModelError(f"SeveralReversals: reversals must be an integer in 0 to 12, got {self.reversals!r}")
        if not 0 < as_scalar("SeveralReversals: kappa", self.kappa) < 1:
            raise ModelError(f"SeveralReversals: kappa must lie in (0, 1), got {self.kappa}")
        for name in ("reserve", "reserve_s", "reserve_fades_s", "most", "sample_s", "last_reversal_s", "trust_bank", "trust_time"):
            if as_scalar(f"SeveralReversals: {name}", getattr(self, name)) <= 0:
                raise ModelError(f"SeveralReversals: {name} must be finite and > 0, got {getattr(self, name)}")
        for name in ("load_limit", "heat_limit"):
            if not getattr(self, name) > 0:
                raise ModelError(f"SeveralReversals: {name} must be > 0 (infinite: no limit), got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class _Now:
    """Where a plan starts: time, bank angle and rate, side (+1 right), reversals left, predicted landing time; and its reserve."""

    t: ca.SX
    bank: ca.SX
    bank_rate: ca.SX
    side: ca.SX
    left: ca.SX
    t_f: ca.SX
    reserve: ca.SX

    def stacked(self) -> ca.SX:
        """As one column (7,)."""
        return ca.vertcat(self.t, self.bank, self.bank_rate, self.side, self.left, self.t_f, self.reserve)


def several_reversals_law(
    onboard: Model, target: Target, *, plant: Model, radius: float, servo: Servo, config: SeveralReversals = SeveralReversals(),
    start: tuple[float, float, float] = (45 * units.DEG, 150.0, 540.0),
) -> Guidance:  # fmt: skip
    """The law of several reversals as a sampled law of `plant`.

    Parameters
    ----------
    onboard, target, plant, radius : as in :func:`ocp.corrector.one_reversal_law`
    servo : Servo
        Along whose response the plan leads the bank angle through zero.
    config : SeveralReversals
    start : tuple
        First guess of abs(bank), rad, t_1, s, and the landing time, s.

    Returns
    -------
    Guidance
        Memory: b, t_1, side, left, t_f, miss_along, miss_right (predicted, m), reversals (executed), peak_load, peak_heat (predicted).
    """
    path = Path(4 + 2 * config.reversals, config.steps)
    peaks = ("load", "heat")
    exact = prediction(onboard, path, radius=radius, seeds=2, peaks=peaks)
    plain = prediction(onboard, path, radius=radius)
    nodes = _nodes_function(config, servo)

    def decide(t: ca.SX, seen: Measured, memory: Memory) -> tuple[ca.SX, Memory]:
        learned = config.estimators.step(onboard, config.sample_s, seen.nav, seen.force, seen.bank, memory)
        p = parameters(onboard, learned)
        t_f = ca.fmax(memory["t_f"], t + 2)
        executed = ca.logic_and(memory["left"] > 0, memory["t_1"] < t + config.sample_s / 2)
        side = ca.if_else(executed, -memory["side"], memory["side"])
        left = memory["left"] - executed
        t_1 = ca.if_else(executed, memory["t_1"] + config.kappa * (t_f - memory["t_1"]), memory["t_1"])
        now = _Now(t, seen.bank, seen.bank_rate, side, left, t_f, memory["reserve"])
        horizon = ahead(t, t_f)
        nothing, still = [ca.SX(0, 1)] * 4, [ca.SX.zeros(12), ca.SX.zeros(2 * len(onboard.params))]

        def fall(u: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
            T, B, _, _ = nodes.call([u, now.stacked()])
            end = plain.call([seen.nav, t, horizon, T, B, p, *nothing], False, True)
            return target.expression(end[0][:3]), end[1], end[2]

        low = ca.vertcat(0, t + config.sample_s)
        latest = ca.fmax(t_f - config.last_reversal_s, low[1])
        u0 = ca.vertcat(memory["b"], ca.fmax(low[1], ca.fmin(latest, t_1)))
        T, B, dT, dB = nodes.call([u0, now.stacked()])
        end = exact.call([seen.nav, t, horizon, T, B, p, still[0], dT, dB, still[1]], False, True)
        miss, J = _miss_and_slope(target, end[0], end[4])
        bounds = Bounds(low, ca.vertcat(config.most, latest), (config.trust_bank, config.trust_time), (0.2, 10.0))
        u, miss, t_f = corrected(u0, (miss, end[1], end[2]), J, fall, bounds, free=left > 0, fractions=config.fractions)
        later = _profile(config, u[0], t, t_f, now.reserve)
        command = side * later(t + config.sample_s / 2)
        new = learned | {
            "b": later(t + config.sample_s), "t_1": u[1], "side": side, "left": left, "t_f": t_f,
            "miss_along": miss[0], "miss_right": miss[1], "reversals": memory["reversals"] + executed,
            "reserve": _reserve(config, memory["reserve"], end[3]), "peak_load": end[3][0], "peak_heat": end[3][1],
        }  # fmt: skip
        return command, new

    memory = {
        "b": start[0], "t_1": start[1], "side": 1.0, "left": float(config.reversals), "t_f": start[2], "miss_along": 0.0, "miss_right": 0.0,
        "reversals": 0.0, "reserve": config.reserve, "peak_load": 0.0, "peak_heat": 0.0,
    } | ESTIMATED  # fmt: skip
    return guidance(decide, plant, target, sample=config.sample_s, memory=memory, name="several_reversals")


def _miss_and_slope(target: Target, x_f: ca.SX, dx_f: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Predicted miss (2,) and its derivative (2, 2) to the unknowns."""
    r = ca.SX.sym("r", 3)
    miss = target.expression(r)
    both = ca.Function("miss", [r], [miss, ca.jacobian(miss, r)])
    value, by_position = both.call([x_f[:3]])
    return value, by_position @ ca.horzcat(dx_f[0:3], dx_f[6:9])


def _reserve(config: SeveralReversals, reserve: ca.SX, peaks: ca.SX) -> ca.SX:
    """The reserve for the next plan: range being kept by b, less bank late means less load, and more bank late means less heating."""
    if not (math.isfinite(config.load_limit) or math.isfinite(config.heat_limit)):
        return reserve
    reserve = reserve + RESERVE_RETURN * (config.reserve - reserve)
    for value, limit, sign in ((peaks[0], config.load_limit, -1), (peaks[1], config.heat_limit, 1)):
        if math.isfinite(limit):
            reserve = reserve + sign * RESERVE_GAIN * ca.fmax(0, value / limit - 1)
    return ca.fmax(RESERVES[0], ca.fmin(RESERVES[1], reserve))


def _profile(config: SeveralReversals, b: ca.SX, t: ca.SX, t_f: ca.SX, reserve: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """abs(bank) as a function of time."""
    span = ca.fmax(t_f - config.reserve_s - t, 1e-3)
    weight = ca.fmax(0, ca.fmin(1, (t_f - t - config.reserve_s) / config.reserve_fades_s))
    end = weight * reserve + (1 - weight) * b
    return lambda tau: b + (end - b) * ca.fmax(0, ca.fmin(1, (tau - t) / span))


def _nodes_function(config: SeveralReversals, servo: Servo) -> ca.Function:
    """(u = [b, t_1], now (7,)) -> nodes T, B of the bank angle, and their derivatives to u stacked by direction."""
    u = ca.SX.sym("u", 2)
    symbols = [ca.SX.sym(name) for name in ("t", "bank", "bank_rate", "side", "left", "t_f", "reserve")]
    T, B = _nodes(config, servo, u, _Now(*symbols))
    slopes = [ca.vec(ca.densify(ca.jacobian(value, u))) for value in (T, B)]
    return ca.Function("nodes", [u, ca.vertcat(*symbols)], [T, B, *slopes])


def _nodes(config: SeveralReversals, servo: Servo, u: ca.SX, now: _Now) -> tuple[ca.SX, ca.SX]:
    """The plan as nodes: from the present bank angle to b, through every reversal that is left, and on beyond the landing."""
    size = _profile(config, u[0], now.t, now.t_f, now.reserve)
    wanted = now.side * u[0]
    delay, duration = ramp(servo, ca.fabs(wanted - now.bank))
    # a servo that is already under way starts without delay
    delay = (delay + config.lag) * ca.fmax(0, 1 - now.bank_rate * ca.sign(wanted - now.bank) / servo.rate)
    T, B = [now.t, now.t + delay, now.t + delay + duration], [now.bank, now.bank, wanted]
    when, side = u[1], now.side
    for i in range(config.reversals):
        planned = now.left > i
        delay, duration = ramp(servo, 2 * size(when))
        begin = ca.fmax(ca.if_else(planned, when + delay + config.lag, now.t_f + AFTER - 10 + i), T[-1])
        after = ca.if_else(planned, -side, side)
        T += [begin, begin + ca.if_else(planned, duration, 0)]
        B += [side * size(when), after * size(when)]
        when, side = when + config.kappa * (now.t_f - when), after
    T.append(ca.fmax(now.t_f + AFTER, T[-1] + 1))
    B.append(side * size(T[-1]))
    return ca.vertcat(*T), ca.vertcat(*B)


def ramp(servo: Servo, angle: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(delay, duration) s of the straight line at the limit of rate with the same integral as the servo's S-curve through `angle` rad."""
    duration = angle / servo.rate
    # without the limit of rate the S-curve is two parabolas over 2 sqrt(angle/acceleration) s
    short = ca.sqrt(ca.fmax(angle, 1e-9) / servo.acceleration) - duration / 2
    return ca.if_else(angle > servo.rate**2 / servo.acceleration, servo.rate / servo.acceleration / 2, short), duration
