"""Comparison of allocation methods on one demand history: the recorded pitch demand of the STS-1 case, three axes, or a user's own data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from allocation import attainable, backends, blending, methods
from allocation.compare import COLUMNS, Comparison, Method, compare
from allocation.core import Effectors
from allocation.demand_history import History
from models.checked import ModelError, evaluate, unknown_name
from models.shuttle_aero import orbiter_aero, orbiter_data
from models.thrusters import ThrusterSet, elevons_and_flap, orbiter_jets
from models.units import DEG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from studies.blend_loop import Flight

COST_ELEVON, COST_JETS = 3e-8, 3e-4  # a and b of the quadratic program beside the weight 1 of the error, on moments
ARM = 0.25  # distance of the centre of one elevon's force from the plane of symmetry, in spans (estimated)
AFT = "LR"  # pods that fire in entry: the forward jets are shut
BEYOND = 1.25  # size of the demands on three axes: some of them cannot be met


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """Flight condition at which surfaces are linearized: mach 1, alpha, elevon, flap rad, qbar Pa."""

    mach: float = 6.0
    alpha: float = 35 * DEG
    elevon: float = -10 * DEG
    flap: float = -11.7 * DEG
    qbar: float = 1800.0


def pitch_history(flight: Flight, *, handover: blending.Handover | None = None, every: int = 6, until: float | None = None) -> History:
    """Pitch demand of a recorded flight as a history: elevon control term (rad), all nose-up and all nose-down jets (duty).

    Parameters
    ----------
    flight : Flight
        From :func:`studies.blend_loop.fly`.
    handover : Handover, optional
        Limits of the elevon's control term; those of equation 20.
    every : int
        Control samples from one sample of the history to the next; 6: one jet cycle.
    until : float, optional
        Last time, s; the whole flight unless given.
    """
    h = handover or blending.Handover()
    rows = np.arange(0, len(flight.t), every)
    if until is not None:
        rows = rows[flight.t[rows] <= until]
    qbar, trim, slope, demand = (flight[name][rows] for name in ("qbar", "trim", "slope", "demand"))
    jets = flight.loop.jets
    up, down = (float(m) for m in jets.moments())
    low, high = blending.limits_arrays(qbar, trim, handover=h)
    open_ = (qbar <= h.q2).astype(float) if h.rcs_inhibit_above_q2 else np.ones(len(rows))
    B = np.stack([slope, np.full_like(slope, up), np.full_like(slope, down)], axis=1)[:, None, :]
    effectors = Effectors(
        ("elevon", "jets_up", "jets_down"), B[0], np.array([h.lower, 0.0, 0.0]), np.array([h.upper, 1.0, 1.0]), axes=("M",),
        flow=np.array([0.0, jets.flow_up, jets.flow_down]), unit="N m",
    )  # fmt: skip
    return History(
        effectors=effectors, dt=float(flight.t[every] - flight.t[0]), demand=(slope * demand)[:, None], B=B,
        lower=np.column_stack([low, 0 * low, 0 * low]), upper=np.column_stack([high, open_, open_]),
        context={"demand_rad": demand, "qbar": qbar, "trim": trim}, axis_weight=np.ones((len(rows), 1)),
        effector_weight=np.abs(B[:, 0]) * np.array([COST_ELEVON, COST_JETS, COST_JETS]), name="pitch",
    )  # fmt: skip


def orbiter_effectors(condition: Condition | None = None, *, jets: ThrusterSet | None = None) -> Effectors:
    """Left and right elevon, body flap and jets of the orbiter on three axes (L, M, N in N m), at a flight condition.

    Deflections count from the condition's; limits are what is left to the stops.  Jets: the 20 aft jets that push up, down and sideways
    unless given (in entry the forward ones are shut, and those that push forward serve no axis here).

    Notes
    -----
    The lateral effect of one elevon is strip theory with the normal force at a quarter of the span; see
    :func:`models.thrusters.elevons_and_flap`.
    """
    c = condition or Condition()
    data, aero = orbiter_data(), orbiter_aero()
    reference, actuators = data["reference"], data["actuators"]
    step = 0.5 * DEG
    sides = [aero.at(c.mach, c.alpha, c.elevon + s * step, c.flap) for s in (-1, 1)]
    slope = {k: float(sides[1][k] - sides[0][k]) / (2 * step) for k in ("CL", "CD", "Cm")}
    flap_at = np.clip(np.array([c.flap - step, c.flap + step]), *aero.domain["delta_bf"])
    flap = aero.at(c.mach, c.alpha, c.elevon, flap_at)["Cm"]
    normal = slope["CL"] * np.cos(c.alpha) + slope["CD"] * np.sin(c.alpha)
    axial = slope["CD"] * np.cos(c.alpha) - slope["CL"] * np.sin(c.alpha)
    elevon, body_flap = (np.array(actuators["elevon"]["command_range_deg"]) * DEG, np.array(actuators["body_flap"]["range_deg"]) * DEG)
    surfaces = elevons_and_flap(
        qbar=c.qbar, area=reference["S_ref_m2"], chord=reference["chord_m"], Cm_elevon=slope["Cm"],
        Cm_flap=float(flap[1] - flap[0]) / float(flap_at[1] - flap_at[0]), CN_elevon=normal, CA_elevon=axial, arm=ARM * reference["span_m"],
        elevon=(elevon[0] - c.elevon, elevon[1] - c.elevon), flap=(body_flap[0] - c.flap, body_flap[1] - c.flap),
        rates=(actuators["elevon"]["rate_deg_s"] * DEG, actuators["body_flap"]["rate_deg_s"] * DEG),
    )  # fmt: skip
    every = orbiter_jets()
    chosen = jets or every.pick(
        [n for n, kind in zip(every.names, every.kind, strict=True) if n[0] in AFT and kind == "primary" and n[2] != "A"]
    )
    n = len(chosen)
    return Effectors(
        (*surfaces.names, *chosen.names), np.hstack([surfaces.moments, chosen.effectiveness()[3:]]),
        np.concatenate([surfaces.lower, np.zeros(n)]), np.concatenate([surfaces.upper, np.ones(n)]),
        rate=np.concatenate([surfaces.rate, np.full(n, np.inf)]), axes=("L", "M", "N"), flow=np.concatenate([np.zeros(3), chosen.flow]),
        unit="N m",
    )  # fmt: skip


def three_axis_history(condition: Condition | None = None, *, samples: int = 1000, seed: int = 7) -> History:
    """Demands in roll, pitch and yaw that wander through the attainable set and a little out of it, 60 ms apart, rates limited.

    Each axis is a sum of four sines of 3 to 20 s with random phases, up to :data:`BEYOND` times what the effectors reach on that axis
    alone.  Of the 1000 demands of the usual seed 38 are outside.
    """
    effectors = orbiter_effectors(condition)
    rng = np.random.default_rng(seed)
    t = 0.06 * np.arange(samples)
    periods, phases = rng.uniform(3.0, 20.0, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    waves = np.sin(2 * np.pi * t[:, None, None] / periods + phases).sum(axis=1) / 4
    size = np.minimum(attainable.attainable_set(effectors).reach(np.eye(3)), attainable.attainable_set(effectors).reach(-np.eye(3)))
    return History(effectors=effectors, dt=0.06, demand=BEYOND * waves * size, name="three axes").weighted()


@dataclass(frozen=True, slots=True, eq=False)
class AllocationStudy:
    """Result of :func:`run`: the comparison with its history, and what was changed."""

    comparison: Comparison
    failed: Mapping[str, float | None] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; what a method has no number for is None.

        "methods": each on the samples that it was asked for; "same_samples": all on the samples that the slowest was asked for;
        "remark": :attr:`remark`, unless it is empty.
        """
        history = self.comparison.history
        tables = [
            [
                {key: (None if isinstance(value, str) and key != "method" else value) for key, value in zip(_KEYS, row, strict=True)}
                for row in self.comparison.rows(same=same)
            ]
            for same in (False, True)
        ]
        data: dict[str, Any] = {
            "history": {
                "name": history.name, "samples": len(history), "dt_s": history.dt, "axes": list(history.effectors.axes),
                "effectors": list(history.effectors.names), "failed": dict(self.failed),
            },
            "methods": tables[0], "same_samples": tables[1],
        }  # fmt: skip
        return data | ({"remark": self.remark} if self.remark else {})

    @property
    def remark(self) -> str:
        """What a table of the methods has to say about rates; empty where nothing limits them or every method keeps to them."""
        limited = bool(np.isfinite(self.comparison.history.effectors.rate).any())
        free = any(outcome.name == methods.BOUND for outcome in self.comparison.outcomes)
        return "Every method but the on-off bound keeps to the rates of the surfaces." if limited and free else ""

    def figures(self) -> dict[str, Figure]:
        """Residuals over time; the attainable set with the demands, where the effectors do not change."""
        history = self.comparison.history
        found = {"residuals": self.comparison.plot()}
        if history.B is None and history.lower is None:
            found["attainable"] = attainable.attainable_set(history.effectors).plot(history.demand)
        return found


_KEYS = ("method", "rms", "worst", "propellant_kg", "pulses", "travel_deg", "worst_kkt", "unsolved", "us_per_solve", "samples")
assert len(_KEYS) == len(COLUMNS)


def run(
    history: History,
    *,
    chosen: Sequence[str | Method] | None = None,
    failed: Mapping[str, float | None] | Iterable[str] = (),
    priority: Mapping[str, float] | None = None,
    cost: Mapping[str, float] | None = None,
    slow: int = 200,
    bound_samples: int = 100,
) -> AllocationStudy:
    """Compare methods on a history.

    Parameters
    ----------
    history : History
        From :func:`pitch_history`, :func:`three_axis_history`, or a user's own.
    chosen : sequence of str or Method, optional
        Names from :func:`known_methods`, or methods of the user's own (:func:`allocation.compare.user_method`); all unless given.
    failed : names, or mapping name -> jammed command
    priority, cost : mapping, optional
        Of axes and effectors; see :func:`allocation.qp.weights_for`.  They replace the weights of the history.
    slow, bound_samples : int
        Samples for back ends and predictive method, and for the mixed-integer bound.
    """
    broken = dict(failed) if isinstance(failed, Mapping) else dict.fromkeys(failed)
    asked = history.failed(broken) if broken else history
    if priority or cost:
        asked = asked.weighted(priority=priority, cost=cost)
    known = known_methods(asked, slow=slow, bound_samples=bound_samples)
    picked: list[Method] = []
    for item in chosen if chosen is not None else known:
        if isinstance(item, Method):
            picked.append(item)
        elif item in known:
            picked.append(known[item])
        else:
            raise ModelError(unknown_name("allocate: method", item, known))
    return AllocationStudy(compare(asked, picked), broken)


def known_methods(history: History, *, slow: int = 200, bound_samples: int = 100) -> dict[str, Method]:
    """Methods by the name that the command line uses, those that fit the history."""
    found = {"qp": methods.own()}
    found |= {name: methods.backend(name, most=slow) for name in backends.available()}
    found |= {"pseudo": methods.pseudo("weighted"), "redistributed": methods.pseudo("redistributed")}
    surfaces = [n for n, jet in zip(history.effectors.names, history.effectors.jets, strict=True) if not jet]
    jets = [n for n, jet in zip(history.effectors.names, history.effectors.jets, strict=True) if jet]
    if surfaces and jets:
        found["daisy"] = methods.pseudo("daisy chain", groups=(surfaces, jets))
    found["predictive"] = methods.horizon(most=slow)
    if bound_samples:
        found["bound"] = methods.on_off_bound(most=bound_samples)
    if "demand_rad" in history.context:
        found = {"paper": methods.paper_logic(), "literal": _literal()} | found
    return found


def _literal() -> Method:
    return methods.paper_logic(blending.Handover(rcs_inhibit_above_q2=False), name="equation 20 as printed")


def recorded_pitch_history(*, until: float | None = 120.0) -> History:
    """Pitch demand of the nominal STS-1 flight with the paper's logic, one sample for each jet cycle, up to `until` s."""
    from studies.blend_design import START, sts1_loop
    from studies.blend_loop import fly

    loop = sts1_loop("paper")
    return pitch_history(fly(loop, np.array(list(START.values()))), until=until)


HISTORIES: Mapping[str, Callable[[], History]] = {"blend": recorded_pitch_history, "three-axis": three_axis_history}


def difference_figure(*, slope: float = -2e6, up: float = 266761.0, down: float = -253326.0) -> Figure:
    """Where and why equation 20 and the quadratic program differ: below half a degree of demand.

    Left: delivered moment over the demanded one.  Right: duty of the jets.  Solid: equation 20 as printed; dashed: quadratic program.

    Parameters
    ----------
    slope : float
        dM/d delta_e, N m/rad.
    up, down : float
        Moments of all nose-up and nose-down jets, N m.
    """
    from allocation.qp import blend
    from models.drawing import new_figure

    literal = blending.Handover(rcs_inhibit_above_q2=False)
    logic, program = blending.paper(literal), blend(literal)
    demand = np.linspace(0.005, 1.0, 400) * DEG
    one = np.ones((len(demand), 1))
    figure = new_figure(9.0, 3.6)
    left, right = figure.subplots(1, 2)
    for qbar, trim, color in ((1015.0, 0.0, "C0"), (1030.0, 0.0, "C1"), (2600.0, 0.0, "C2")):
        columns = (demand[:, None], qbar * one, trim * one, slope * one, up * one, down * one, 0 * one)
        for function, line, name in ((logic, "-", "equation 20"), (program, "--", "QP")):
            elevon, duty = evaluate(function, *columns)[:2]
            moment = slope * elevon + np.where(duty > 0, duty * up, -duty * down)
            left.plot(demand / DEG, moment[:, 0] / (slope * demand), color + line, label=f"{name}, {qbar:.0f} Pa")
            right.plot(demand / DEG, np.abs(duty[:, 0]), color + line)
    left.axvline(0.5, color="0.6", lw=0.8)
    right.axvline(0.5, color="0.6", lw=0.8)
    left.set_ylabel("delivered / demanded moment")
    right.set_ylabel("duty of the jets")
    for ax in (left, right):
        ax.set_xlabel("demand [deg of elevon]")
    left.legend(fontsize="small")
    return figure


def without_rates(history: History) -> History:
    """The same history with effectors that move at any speed."""
    return replace(history, effectors=replace(history.effectors, rate=np.full(len(history.effectors.names), np.inf)))
