"""Reference flight of a scenario and its optimal feedback gains, by two routes that must agree.

Source: Tang & Zhao 2000 (paper 003).  Gains are shown in the paper's sign, U = K X with X = [n_x, hdot, s, sdot], which is
-K M^-1 of the workbench's own u = u0 - K (x - x0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from models.atmosphere import exponential, us76_smooth
from models.core import Array, ModelError
from models.entry import Planet, entry_planar
from models.vehicles import from_ratios
from ocp.coordinates import Coordinates, coordinates, transform
from ocp.gains import Gains
from ocp.laws import constant
from ocp.linearize import Linearization, linearize
from ocp.methods import RK8
from ocp.simulate import simulate
from ocp.stops import falls_below
from ocp.trajectory import SimulationError, Trajectory
from ocp.tvlqr import tvlqr
from studies.guidance import MEASURED

if TYPE_CHECKING:
    from studies.scenario import Scenario

NAMES = ("K1", "K2", "K3", "K4")


@dataclass(frozen=True, slots=True, eq=False)
class Synthesis:
    """Gains along one reference, by both routes.

    Attributes
    ----------
    reference : Trajectory
    lin : Linearization
        In guidance coordinates X.
    to : Coordinates
        M = dX/dx and its rate.
    guidance, state : Gains
        Route A in X with Q, F, R; route B in x with M'QM, M'FM, R.
    K : ndarray, shape (N, 4)
        Route A in the paper's sign.
    K_state_route : ndarray, shape (N, 4)
        Route B carried to X: -K_x M^-1.
    step : float
        Integration step of the reference, s.
    remarks : tuple of str
        What fell short of the study's own aims (Riccati defect 1e-8, routes to 1e-5); usually empty.
    """

    reference: Trajectory
    lin: Linearization
    to: Coordinates
    guidance: Gains
    state: Gains
    K: Array
    K_state_route: Array
    step: float = math.nan
    remarks: tuple[str, ...] = ()

    @property
    def routes_difference(self) -> float:
        """Largest difference of the two routes, relative to the largest magnitude of each gain."""
        return float((np.abs(self.K - self.K_state_route).max(axis=0) / np.abs(self.K).max(axis=0)).max())


def build_reference(scenario: Scenario, *, step: float | None = None) -> Trajectory:
    """The reference flight of a scenario, to its stop altitude; `step` in s replaces ``numerics.step_s``."""
    s = scenario
    air = exponential(surface_density=s.atmosphere.surface_density_kg_m3, scale_height=s.atmosphere.scale_height_m)
    vehicle = from_ratios(
        s.vehicle.name, ballistic_coefficient=s.vehicle.ballistic_coefficient_kg_m2, lift_to_drag=s.vehicle.lift_to_drag
    )  # fmt: skip
    model = entry_planar(
        vehicle, atmosphere=us76_smooth() if s.atmosphere.model == "us76_smooth" else air,
        planet=Planet(mu=s.planet.gravitational_parameter_m3_s2, radius=s.planet.radius_m),
    )  # fmt: skip
    ref = s.reference
    x0 = model.state(V=ref.speed_m_s, gamma=math.radians(ref.path_angle_deg), h=ref.altitude_m, s=0.0)
    law = constant(lift_ratio=s.vehicle.lift_to_drag * math.cos(math.radians(ref.bank_deg)))
    until = falls_below("h", ref.stop_altitude_m)
    try:
        return simulate(model, law, x0=x0, until=until, t_max=ref.t_max_s, method=RK8(step=step or s.numerics.step_s))
    except SimulationError as error:
        h = error.trajectory["h"]
        hint = "it skips out or stays aloft: steepen reference.path_angle_deg, raise reference.bank_deg, or allow more reference.t_max_s"
        if h[-1] < ref.altitude_m:
            hint = "allow more reference.t_max_s, or steepen reference.path_angle_deg"
        raise ModelError(f"reference flight: {error}  Greatest altitude {h.max():.6g} m; {hint}") from None


def weights(scenario: Scenario) -> tuple[Array, Array, Array]:
    """(Q, R, F) of the scenario: diag(1/scale^2)."""
    w = scenario.weights
    return np.diag(1 / np.square(w.state)), np.array([[1 / w.control**2]]), np.diag(1 / np.square(w.terminal))


def synthesize(scenario: Scenario, reference: Trajectory) -> Synthesis:
    """Gains along a reference, in guidance coordinates and in state coordinates."""
    Q, R, F = weights(scenario)
    to = coordinates(reference, MEASURED)
    lin_x = linearize(reference)
    lin = transform(lin_x, to)
    by_guidance = tvlqr(lin, Q=Q, R=R, Qf=F)
    Mt = np.swapaxes(to.M, 1, 2)
    by_state = tvlqr(lin_x, Q=Mt @ Q @ to.M, R=R, Qf=Mt[-1] @ F @ to.M[-1])
    K_state: Array = -np.linalg.solve(Mt, np.swapaxes(by_state.K, 1, 2))[:, :, 0].astype(np.float64)
    return Synthesis(reference, lin, to, by_guidance, by_state, -by_guidance.K[:, 0], K_state)


DEFECT, ROUTES, HALVINGS = 1e-8, 1e-5, 3


def certified(scenario: Scenario) -> Synthesis:
    """Reference and gains, with steps halved up to three times until the Riccati defects are below 1e-8 and the routes agree to 1e-5.

    A tabulated atmosphere needs it: its second derivative enters the guidance coordinates.  If the aims are not met, the best
    certified synthesis stands, with a remark.

    Raises
    ------
    ModelError
        No step gives a certificate; the message names the keys of the scenario that help.
    """
    best: Synthesis | None = None
    refused: ModelError | None = None
    for halvings in range(HALVINGS + 1):
        step = scenario.numerics.step_s / 2**halvings
        reference = build_reference(scenario, step=step)
        try:
            found = replace(synthesize(scenario, reference), step=step)
        except ModelError as error:
            refused = error
            continue
        if best is None or _shortfall(found) < _shortfall(best):
            best = found
        if _shortfall(best) <= 1:
            return best
    if best is None:
        keys = "weights.terminal, weights.state, weights.control (a larger scale is a smaller weight), numerics.step_s"
        raise ModelError(f"synthesis: {refused}; the keys that help: {keys}") from None
    defect = max(g.certificate.riccati_residual for g in (best.guidance, best.state))
    remark = (
        f"the Riccati defect is {defect:.2g} (aim {DEFECT:g}) and the two routes differ by {best.routes_difference:.2g} (aim {ROUTES:g})"
        f" at a step of {best.step:g} s; a smaller numerics.step_s helps"
    )
    return replace(best, remarks=(remark,))


def _shortfall(found: Synthesis) -> float:
    """At most 1 where both aims are met."""
    defects = [g.certificate.riccati_residual / DEFECT for g in (found.guidance, found.state)]
    return max(*defects, found.routes_difference / ROUTES)


def terminal_gain(scenario: Scenario, lin: Linearization) -> Array:
    """Closed form at the end, K(t_f) = -R^-1 H'F, shape (4,)."""
    _, R, F = weights(scenario)
    gain: Array = -np.linalg.solve(R, lin.B[-1].T @ F)[0]
    return gain


def peaks(reference: Trajectory) -> dict[str, float]:
    """Peak loads and the time of the axial peak, found between the nodes to 1e-3 s."""
    t = reference.t
    k = int(np.argmin(reference["n_x"]))
    low, high = t[max(k - 2, 0)], t[min(k + 2, len(t) - 1)]
    fine = reference.at(np.linspace(low, high, max(5, int((high - low) / 1e-3) + 1)))
    best = int(np.argmin(fine["n_x"]))
    return {
        "peak_axial_g": float(-fine["n_x"][best]),
        "peak_load_g": float(max(fine["load"].max(), reference["load"].max())),
        "peak_time_s": float(fine.t[best]),
    }
