"""The flights of a campaign: the one place that flies its cases, the same in this process and on a worker."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from models.core import Array, ModelError, Status
from models.native import NativeWarning, native_available, shared_by
from ocp.laws import Law
from ocp.methods import RK4
from ocp.simulate import NATIVE_FROM, simulate, simulate_ensemble
from ocp.stops import Stop, falls_below
from ocp.trajectory import Trajectory
from studies import guidance, schedules
from studies.campaign_design import DRAWN, dispersed
from studies.campaign_store import MISSING, Variable, code_digest
from studies.scenario import Scenario
from studies.synthesis import certified

Backend = Literal["accurate", "off"]  # compiled code that gives the same bits for any batch, or CasADi's interpreter
LOST = 100  # status of the cases of a chunk whose worker died
CODES = {status: number for number, status in enumerate(Status)}
MEANINGS = {**{number: status.name for status, number in CODES.items()}, LOST: "WORKER_LOST"}

# as the climate and forecast conventions write codes
_FLAGS = {"flag_values": [MISSING, *MEANINGS], "flag_meanings": " ".join(["NOT_COMPUTED", *MEANINGS.values()])}
STATES = (("V", "m/s"), ("gamma", "rad"), ("h", "m"), ("s", "m"))
VARIABLES = (
    *(Variable(f"draw_{name}", unit, f"deviation of {name} that was drawn") for name, unit in DRAWN),
    *(Variable(f"final_{name}", unit, f"{name} at the end") for name, unit in STATES),
    Variable("t_f", "s", "time of the end"),
    Variable("miss_km", "km", "downrange at the stop minus that of the reference; not a number for a case that did not arrive"),
    Variable("status", "1", "outcome of the case, 0 where it met its stop condition", True, _FLAGS),
)


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """What all cases share: reference flight, guidance law, stop condition, latest time."""

    reference: Trajectory
    law: Law
    until: Stop
    t_max: float
    method: RK4


@lru_cache(maxsize=4)
def prepared(scenario: Scenario, schedule: str) -> Prepared:
    """Reference and guidance of a scenario, synthesized once in each process."""
    synthesis = certified(scenario)
    step = schedules.flight_step(scenario)
    onward = guidance.continued(synthesis.reference, step)
    if schedule == "time_varying":  # needs no flights to fit constants to
        plan: guidance.GainsAt = guidance.interpolated(synthesis.reference.t, synthesis.K)
    else:
        plans, remarks = schedules.plans(scenario, synthesis, onward)
        if schedule not in plans:
            raise ModelError(f"campaign.schedule: {schedule!r} cannot be flown here: {'; '.join(remarks)}; choose another schedule")
        plan = plans[schedule]
    law = schedules.law_of(scenario, onward, plan, schedule)
    return Prepared(
        synthesis.reference, law, falls_below("h", scenario.reference.stop_altitude_m), float(onward.t[-1]), RK4(step=step)
    )  # fmt: skip


def fly_chunk(scenario: Scenario, schedule: str, states: Array, params: Array, *, native: Backend) -> dict[str, np.ndarray]:
    """Fly cases from states (N, nx) with parameters (N, np) and return final_*, t_f, miss_km, status, each of shape (N,).

    A case that fails keeps its last good state, its time and its status; its miss is not a number.  Who flies it is chosen once for
    a whole campaign, so that its numbers do not depend on the chunks.

    Raises
    ------
    ModelError
        The campaign is flown by compiled code, and this machine cannot compile.
    """
    shared = prepared(scenario, schedule)
    with warnings.catch_warnings():
        warnings.simplefilter("error", NativeWarning)  # the interpreter in its place would give other last digits
        try:
            flown = simulate_ensemble(
                shared.reference.model, shared.law, x0=states, p=params, until=shared.until, t_max=shared.t_max, method=shared.method,
                native=native,
            )  # fmt: skip
        except NativeWarning as reason:
            raise ModelError(
                f"campaign: it is flown by compiled code, which is not to be had here ({reason}); continue it on a machine with a compiler"
            ) from None
    out: dict[str, np.ndarray] = {f"final_{name}": np.asarray(flown[name]) for name, _ in STATES}
    out["t_f"] = np.asarray(flown.t)
    out["miss_km"] = np.where(flown.ok, (flown["s"] - shared.reference["s"][-1]) / 1e3, np.nan)
    out["status"] = np.array([CODES[status] for status in flown.status], dtype=np.int16)
    return out


def backend_for(scenario: Scenario) -> Backend:
    """Compiled code for a campaign that is worth it, where it can be had; else the interpreter."""
    if scenario.campaign.cases < NATIVE_FROM or not native_available():
        return "off"
    shared = prepared(scenario, scenario.campaign.schedule)
    try:
        fly_chunk(scenario, scenario.campaign.schedule, shared.reference.x[:1], shared.reference.p[None], native="accurate")
    except ModelError:
        return "off"
    return "accurate"


def cases_of(scenario: Scenario, drawn: Array) -> tuple[Array, Array]:
    """Initial states (N, nx) and parameters (N, np) of cases with drawn deviations (N, 6)."""
    reference = prepared(scenario, scenario.campaign.schedule).reference
    return dispersed(reference.model, reference.x[0], drawn, scenario.campaign.distributions)


def fly_drawn(scenario: Scenario, drawn: Array, native: Backend) -> dict[str, np.ndarray]:
    """Fly the cases with drawn deviations (N, 6); see :func:`fly_chunk`."""
    states, params = cases_of(scenario, drawn)
    return fly_chunk(scenario, scenario.campaign.schedule, states, params, native=native)


def fly_remote(text: str, drawn: Array, native: Backend, code: str, tasks: int) -> dict[str, np.ndarray]:
    """As :func:`fly_drawn` on a worker: from the scenario's text, with the code of the one who asks, beside `tasks` - 1 others.

    Raises
    ------
    ModelError
        The worker runs other code.
    """
    if code_digest() != code:
        raise ModelError(
            f"campaign: a worker runs other code (SHA-256 {code_digest()[:12]}) than this process ({code[:12]});"
            " install the same version of this package on all workers"
        )
    with shared_by(tasks):
        return fly_drawn(Scenario.parse(text), drawn, native)


def trajectory(scenario: Scenario, drawn: Array) -> Trajectory | None:
    """One case with drawn deviations (1, 6), with all its nodes; None for a case that cannot start."""
    shared = prepared(scenario, scenario.campaign.schedule)
    states, params = cases_of(scenario, drawn)
    try:
        return simulate(
            shared.reference.model, shared.law, x0=states[0], p=params[0], until=shared.until, t_max=shared.t_max, method=shared.method,
            throw=False,
        )  # fmt: skip
    except ModelError:  # outside the valid range of a variable, as its status says
        return None
