"""Landing guidance by prediction and correction with one reversal of the bank angle: three trajectories and a 2 by 2 system."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca

from models import units
from models.core import Model, ModelError, as_scalar
from models.entry_truth import Servo
from ocp.corrector_onboard import ESTIMATED, Estimators, parameters
from ocp.landing import Guidance, Target
from ocp.laws import sampled
from ocp.predictor import Path, prediction

Memory = dict[str, ca.SX]
Decide = Callable[[ca.SX, "Measured", Memory], tuple[ca.SX, Memory]]


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What a law sees at a sample: navigated state (6,), measured specific force (3,), bank angle and its rate."""

    nav: ca.SX
    force: ca.SX
    bank: ca.SX
    bank_rate: ca.SX


LONGEST = 1500.0  # s, of a prediction
FADING = Estimators(density_s=30.0, lift_s=15.0, wind_s=None)


@dataclass(frozen=True, slots=True)
class OneReversal:
    """The law of Tian 1998 (paper 004) with a fading filter of the density and an estimate of lift over drag.

    bank(t) = bank0(t) (1 + beta): +base before, -base after a linear reversal of `reversal_s` around the time t_n + eps.  Every
    `cycle_s` a base prediction and two trials, of beta and of eps, give the 2 by 2 system (eq. 2.3) for both corrections.

    Attributes
    ----------
    base : float
        l1 = l2 of the base profile, rad.
    reversal_at, reversal_s : float
        t_n, and the duration t2 - t1 centred on it, s.
    cycle_s, sample_s : float
        Time between corrections, and between commands, s.
    margin : float
        Least distance of abs(bank) from 0 and pi, rad.
    trial_beta, trial_eps : float
        Steps of the two trials, 1 and s.
    most_eps : float
        Largest move of the reversal in a cycle, s.
    estimators : Estimators
    steps : int
        Integration steps of a prediction.

    Notes
    -----
    Source: Tian Yucheng, 1998, sections 2 to 4.  The printed eq. 3.2 has lost its signs and takes the cross-range for independent
    of beta; the full system is solved here.  The printed text names the density deviation "and its mean" only: the filter is ours.
    """

    base: float = 45 * units.DEG
    reversal_at: float = 260.0
    reversal_s: float = 30.0
    cycle_s: float = 10.0
    sample_s: float = 1.0
    margin: float = 0.2
    trial_beta: float = 0.02
    trial_eps: float = 1.0
    most_eps: float = 20.0
    estimators: Estimators = FADING
    steps: int = 64

    def __post_init__(self) -> None:
        for name in ("base", "reversal_at", "reversal_s", "cycle_s", "sample_s", "margin", "trial_beta", "trial_eps", "most_eps"):
            if as_scalar(f"OneReversal: {name}", getattr(self, name)) <= 0:
                raise ModelError(f"OneReversal: {name} must be finite and > 0, got {getattr(self, name)}")


ONE_REVERSAL_MEMORY = {
    "beta": 0.0,
    "eps": 0.0,
    "due": 0.0,
    "t_f": 540.0,
    "miss_along": 0.0,
    "miss_right": 0.0,
    "reversals": 0.0,
} | ESTIMATED


def one_reversal_law(
    onboard: Model, target: Target, *, plant: Model, radius: float, servo: Servo, config: OneReversal = OneReversal(),
) -> Guidance:  # fmt: skip
    """The one-reversal law as a sampled law of `plant`.

    Parameters
    ----------
    onboard : Model
        What is assumed on board, such as :func:`models.entry_truth.entry_onboard`.
    target : Target
    plant : Model
        The model that will be flown, such as :func:`models.entry_truth.entry_truth`: its outputs are the sensors.
    radius : float
        Stop, m from the centre.
    servo : Servo
        Whose lag behind a ramp, 1/stiffness, the command leads.
    config : OneReversal

    Returns
    -------
    Guidance
    """
    predict = prediction(onboard, Path(2, config.steps), radius=radius)
    lead = config.sample_s / 2 + 1 / servo.stiffness

    def nodes(beta: ca.SX, eps: ca.SX) -> tuple[ca.SX, ca.SX]:
        middle, half, size = config.reversal_at + eps, config.reversal_s / 2, config.base * (1 + beta)
        return ca.vertcat(middle - half, middle + half), ca.vertcat(size, -size)

    def decide(t: ca.SX, seen: Measured, memory: Memory) -> tuple[ca.SX, Memory]:
        new = dict(memory, **config.estimators.step(onboard, config.sample_s, seen.nav, seen.force, seen.bank, memory))
        p = parameters(onboard, new)
        horizon = ahead(t, memory["t_f"])

        def fall(beta: ca.SX, eps: ca.SX) -> tuple[ca.SX, ca.SX]:
            nothing = [ca.SX(0, 1)] * 4
            end = predict.call([seen.nav, t, horizon, *nodes(beta, eps), p, *nothing], False, True)
            return target.expression(end[0][:3]), end[1]

        beta, eps = memory["beta"], memory["eps"]
        base, t_f = fall(beta, eps)
        J = ca.horzcat(
            (fall(beta + config.trial_beta, eps)[0] - base) / config.trial_beta,
            (fall(beta, eps + config.trial_eps)[0] - base) / config.trial_eps,
        )
        d_beta, d_eps = _correction(config, t, beta, eps, base, J)
        due = t >= memory["due"] - 1e-6
        turned = t + lead > config.reversal_at + eps + config.reversal_s / 2
        new |= {
            "beta": ca.if_else(due, beta + d_beta, beta), "eps": ca.if_else(due, eps + d_eps, eps),
            "due": ca.if_else(due, t + config.cycle_s, memory["due"]), "t_f": t_f, "miss_along": base[0], "miss_right": base[1],
            "reversals": ca.if_else(turned, 1.0, 0.0),
        }  # fmt: skip
        when, what = nodes(new["beta"], new["eps"])
        part = ca.fmax(0, ca.fmin(1, (t + lead - when[0]) / config.reversal_s))
        return what[0] + part * (what[1] - what[0]), new

    return guidance(decide, plant, target, sample=config.sample_s, memory=ONE_REVERSAL_MEMORY, name="one_reversal")


def ahead(t: ca.SX, t_f: ca.SX) -> ca.SX:
    """Horizon of a prediction, s, with room beyond the last predicted landing; bounded, so that a skip out does not stretch the steps."""
    return ca.fmin(1.15 * ca.fmax(t_f - t, 2.0) + 10.0, LONGEST)


def _correction(config: OneReversal, t: ca.SX, beta: ca.SX, eps: ca.SX, miss: ca.SX, J: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(d_beta, d_eps) that bring the miss to zero in the linear system, within their limits."""
    low, high = config.margin / config.base - 1 - beta, (math.pi - config.margin) / config.base - 1 - beta
    det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    sound = ca.fabs(det) > 1e-6 * (ca.norm_2(J[:, 0]) * ca.norm_2(J[:, 1]) + 1e-9)
    d_eps = ca.if_else(sound, (J[1, 0] * miss[0] - J[0, 0] * miss[1]) / ca.if_else(sound, det, 1.0), 0.0)
    # the reversal cannot begin in the past, and it moves by a bounded amount in a cycle
    begin = config.reversal_at + eps - config.reversal_s / 2 - t
    moved = ca.fmax(ca.fmax(-config.most_eps, -begin), ca.fmin(config.most_eps, d_eps))
    over = begin <= 0
    # with the reversal where it can be, the range is closed by beta alone
    steep = ca.fabs(J[0, 0]) > 1.0
    ranged = ca.if_else(steep, -(miss[0] + J[0, 1] * moved) / ca.if_else(steep, J[0, 0], 1.0), 0.0)
    # after the reversal: the nearest point of beta's line
    nearest = -ca.dot(J[:, 0], miss) / (ca.dot(J[:, 0], J[:, 0]) + 1.0)
    d_beta = ca.fmax(low, ca.fmin(high, ca.if_else(over, nearest, ranged)))
    # with beta at its bound the range is lost, and the reversal alone goes to the nearest point of its own line
    rest = miss + J[:, 0] * d_beta
    alone = -ca.dot(J[:, 1], rest) / (ca.dot(J[:, 1], J[:, 1]) + 1.0)
    alone = ca.fmax(ca.fmax(-config.most_eps, -begin), ca.fmin(config.most_eps, alone))
    moved = ca.if_else(d_beta == ranged, moved, alone)
    return d_beta, ca.if_else(over, 0.0, moved)


def guidance(decide: Decide, plant: Model, target: Target, *, sample: float, memory: Mapping[str, float], name: str) -> Guidance:
    """A law from ``decide(t, measured, memory) -> (command, memory)`` with named memory, reading the sensors of a plant."""
    names = [v.name for v in plant.outputs]
    needed = [f"nav_{axis}" for axis in "xyzuvw"] + [f"force_{axis}" for axis in "xyz"]
    missing = [n for n in needed if n not in names] + [n for n in ("bank", "bank_rate") if n not in [v.name for v in plant.states]]
    if missing:
        raise ModelError(f"{name}: the plant {plant.name} lacks {', '.join(missing)}; use models.entry_truth.entry_truth")

    def step(t: ca.SX, x: ca.SX, y: ca.SX, z: ca.SX, w: ca.SX) -> tuple[ca.SX, ca.SX]:
        told = ca.vertcat(*[y[names.index(n)] for n in needed])
        seen = Measured(told[:6], told[6:], x[plant.index("bank")], x[plant.index("bank_rate")])
        command, new = decide(t, seen, dict(zip(memory, ca.vertsplit(z), strict=True)))
        return command, ca.vertcat(*[new[n] for n in memory])

    law = sampled(step, sample=sample, memory=list(memory.values()), name=name)
    return Guidance(law, plant, tuple(memory), target)
