"""The STS-1 case of the blending study: command, wind, trimmed reference flight, gains, and the loop put together."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from allocation import blending
from models import wind as winds
from models.atmosphere import us76_smooth
from models.core import Model, Var, define
from models.entry import SPHERE
from models.modulators import DiscretePWPF
from models.pitch_jets import pitch_jets
from models.shuttle import aerodynamics, air_flow, orbiter, orbiter_longitudinal, to_path
from models.shuttle_aero import orbiter_aero
from models.shuttle_trim import trim_elevon
from models.tables import line
from models.units import DEG
from models.wind import Wind
from ocp import constant, linearize, simulate
from ocp.methods import RK4
from ocp.pitch_law import PitchGains, PitchWeights, pitch_gains
from ocp.trajectory import Trajectory
from studies.blend_loop import BlendLoop, LoopSettings
from studies.blend_methods import allocator

START = {"V": 2000.0, "gamma": 0.0, "h": 75e3, "s": 0.0, "theta": 5 * DEG, "q": 0.0, "delta_e": 0.0, "delta_bf": -11.7 * DEG}
RISE_S, FIRST, SCHEDULE = 40.0, 5 * DEG, {2.5: 12.0, 3.0: 15.0, 5.0: 28.0, 6.0: 35.0}
STRESS_CENTRE_S, STRESS_WIDTH_S = 66.0, 14.0
WEIGHTS = PitchWeights(alpha=1.5 * DEG, rate=2.0 * DEG, integral=4.0 * DEG, acceleration=1.5 * DEG)


def alpha_command() -> ca.Function:
    """Angle of attack to fly: smoothstep from 5 deg to a schedule of Mach number over 40 s; the one of paper 000's figure 11 is lost.

    (t, mach, stress) -> rad; `stress` is the amplitude A of A sin(2 pi s) sin^2(pi s)/0.65, s = (t - 66)/14 in [0, 1].
    """
    t, mach, stress = ca.SX.sym("t"), ca.SX.sym("mach"), ca.SX.sym("stress")
    schedule = line("alpha_schedule", list(SCHEDULE), values=[DEG * a for a in SCHEDULE.values()], ends="flat")
    part = ca.fmin(ca.fmax(t / RISE_S, 0.0), 1.0)
    rise = part**2 * (3 - 2 * part)
    s = ca.fmin(ca.fmax((t - STRESS_CENTRE_S) / STRESS_WIDTH_S, 0.0), 1.0)
    extra = stress * ca.sin(2 * math.pi * s) * ca.sin(math.pi * s) ** 2 / 0.65
    value = FIRST + (schedule(mach) - FIRST) * rise + extra
    return ca.Function("alpha_command", [t, mach, stress], [value], ["t", "mach", "stress"], ["alpha"])


@lru_cache(maxsize=1)
def tail_wind() -> Wind:
    """The wind of ``models/data/winds_gram95_like.csv``: eastward, largest 60 m/s."""
    text = (resources.files("models") / "data" / "winds_gram95_like.csv").read_text(encoding="utf-8")
    rows = list(csv.reader(row for row in text.splitlines() if not row.startswith("#")))
    columns = np.array(rows[1:], dtype=float).T
    source = "CIRA-86 January zonal mean at 40 N, scaled to a maximum of 60 m/s; see models/data/winds_gram95_like.csv"
    return winds.from_table(1e3 * columns[0], columns[rows[0].index("u_recommended")], name="winter_40N", source=source)


def trimmed_glide(command: ca.Function, *, wind: Wind) -> Model:
    """Translation alone, the angle of attack as commanded and the elevon at its trim: the flight that the gains are designed along.

    States V, gamma, h, s and a clock; outputs are what the full model needs at the same point: theta, delta_e, mach, qbar.
    """
    body, aero, air = orbiter(), orbiter_aero(), us76_smooth()
    numbers = np.linspace(2.2, 7.2, 51)
    angles = np.array([float(command(RISE_S, m, 0.0)) for m in numbers])
    trim = line("trim_schedule", numbers, values=trim_elevon(numbers, angles, delta_bf=START["delta_bf"]).elevon)

    def point(x: Any, p: Any) -> tuple[Any, Any, Any]:
        still = _with(x, theta=0.0, q=0.0, delta_e=0.0, delta_bf=START["delta_bf"])
        flow = air_flow(still, p, air=air, wind=wind)
        alpha = command(x.clock, flow.mach, 0.0)
        at = _with(still, theta=alpha - flow.alpha, delta_e=trim(flow.mach))
        return at, flow, aerodynamics(at, p, air_flow(at, p, air=air, wind=wind), body=body, aero=aero)

    def rhs(x: Any, u: Any, p: Any) -> dict[str, Any]:
        at, _, forces = point(x, p)
        along, normal = to_path(at, forces.body_x, forces.body_z)
        radius = SPHERE.radius + x.h
        g, turn = SPHERE.mu / radius**2, x.V * ca.cos(x.gamma) / radius
        return {
            "V": along / body.mass - g * ca.sin(x.gamma),
            "gamma": normal / (body.mass * x.V) - g * ca.cos(x.gamma) / x.V + turn,
            "h": x.V * ca.sin(x.gamma), "s": SPHERE.radius * turn, "clock": ca.SX(1.0),
        }  # fmt: skip

    def out(x: Any, u: Any, p: Any) -> dict[str, Any]:
        at, flow, _ = point(x, p)
        return {"theta": at.theta, "delta_e": at.delta_e, "mach": flow.mach, "qbar": flow.qbar}

    full = orbiter_longitudinal(body, aero=aero, atmosphere=air, wind=wind)
    params = {v: float(value) for v, value in zip(full.params, full.p0, strict=True)}
    states = (*full.states[:4], Var("clock", "s", 100.0))
    outputs = tuple(full.states[full.index(n)] for n in ("theta", "delta_e")) + full.outputs[:2]
    return define("trimmed_glide", rhs, states=states, params=params, outputs=outputs, out=out, source=full.source)


def _with(x: Any, **changes: Any) -> Any:
    return SimpleNamespace(**(vars(x) | changes))


def reference_flight(*, duration_s: float = 300.0, step_s: float = 0.25) -> Trajectory:
    """The trimmed glide of the STS-1 case."""
    model = trimmed_glide(alpha_command(), wind=tail_wind())
    x0 = [START[n] for n in ("V", "gamma", "h", "s")] + [0.0]
    return simulate(model, constant(), x0=x0, t_max=duration_s, method=RK4(step=step_s))


def design(reference: Trajectory, model: Model, *, weights: PitchWeights = WEIGHTS) -> PitchGains:
    """Gains scheduled with Mach and qbar from the Jacobians of the full model along the reference, after the command's rise."""
    step = max(1, round(1.0 / (reference.t[1] - reference.t[0])))
    nodes = np.flatnonzero(reference.t >= RISE_S)[::step]
    zero = np.zeros(len(nodes))
    known = {n: reference[n][nodes] for n in ("V", "gamma", "h", "s", "theta", "delta_e")}
    known |= {"q": zero, "delta_bf": zero + START["delta_bf"]}
    x = np.column_stack([known[v.name] for v in model.states])
    u = np.column_stack([known["delta_e"], known["delta_bf"], zero, zero])
    mach, qbar = reference["mach"][nodes], reference["qbar"][nodes]
    grid_mach = np.linspace(np.floor(10 * mach.min()) / 10, np.ceil(10 * mach.max()) / 10, 11)
    return pitch_gains(
        linearize(model, x=x, u=u), mach=mach, qbar=qbar, weights=weights, grid_mach=grid_mach, grid_qbar=np.geomspace(10.0, 3e4, 9)
    )


@lru_cache(maxsize=8)
def _model_and_gains(jets: int, weights: PitchWeights) -> tuple[Model, PitchGains]:
    model = orbiter_longitudinal(wind=tail_wind(), jets=pitch_jets(jets))
    return model, design(reference_flight(), model, weights=weights)


def sts1_loop(
    method: str | ca.Function = "paper", *, jets: int = 6, handover: blending.Handover | None = None, modulator: DiscretePWPF | None = None,
    settings: LoopSettings | None = None, weights: PitchWeights = WEIGHTS,
) -> BlendLoop:  # fmt: skip
    """The closed loop of the STS-1 case.

    Parameters
    ----------
    method : str or casadi.Function
        A name of :data:`studies.blend_methods.METHODS`, or any function with the inputs and outputs of :func:`allocation.blending.paper`.
    jets : {2, 4, 6}
        Aft jets in each direction.
    handover : Handover, optional
        Dynamic pressures of the hand-over and limits; the paper's 1000 and 2500 Pa.
    modulator : DiscretePWPF, optional
        Default: the paper's scheme b (k = 0.8, delta = 0.01).
    settings : LoopSettings, optional
        Its q1 and q2 are replaced by those of the hand-over.
    weights : PitchWeights
    """
    hand, times = handover or blending.Handover(), settings or LoopSettings()
    model, gains = _model_and_gains(jets, weights)
    return BlendLoop(
        model=model, vehicle=orbiter(), aero=orbiter_aero(), jets=pitch_jets(jets), gains=gains, command=alpha_command(),
        allocator=method if isinstance(method, ca.Function) else allocator(method, hand),
        modulator=modulator or DiscretePWPF(k=0.8, delta=0.01),
        settings=replace(times, q1=hand.q1, q2=hand.q2),
    )  # fmt: skip
