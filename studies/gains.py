"""Optimal feedback gains of longitudinal entry guidance: synthesis, proof, and dispersed closed-loop flights.

Source: Tang & Zhao 2000 (paper 003).  Gains are shown in the paper's sign, U = K X with X = [n_x, hdot, s, sdot], which is
-K M^-1 of the workbench's own u = u0 - K (x - x0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from models.core import Array, ModelError, as_finite
from ocp.tvlqr import Sensitivity, tvlqr_sensitivity
from studies import schedules
from studies.guidance import Miss
from studies.schedules import Progress
from studies.synthesis import NAMES, Synthesis, certified, peaks, terminal_gain, weights

if TYPE_CHECKING:
    from studies.result import StudyResult
    from studies.scenario import Scenario


@dataclass(frozen=True, slots=True, eq=False)
class GainsStudy:
    """Result of :func:`run`; ``closed_loop`` maps set -> schedule -> Miss and is empty without dispersions."""

    scenario: Scenario
    synthesis: Synthesis
    sensitivity: Sensitivity
    peak: Mapping[str, float]
    closed_loop: Mapping[str, Mapping[str, Miss]]
    at: Array
    remarks: tuple[str, ...] = ()

    @property
    def time_mean(self) -> dict[str, float | None]:
        """Time means of the ungated gains over the whole flight; K3 before (a) and after (b) ``guidance.split_s``."""
        plan = schedules.means(self.scenario, self.synthesis)
        first, last = plan.K[0], plan.K[-1]
        inside = self.scenario.guidance.split_s < self.synthesis.reference.t[-1]
        return {
            "K1": float(first[0]), "K2": float(first[1]), "K3a": float(first[2]), "K3b": float(last[2]) if inside else None,
            "K4": float(first[3]),
        }  # fmt: skip

    @property
    def failed(self) -> list[tuple[str, int, str]]:
        """(set and schedule, case number, reason) of the cases that gave no result."""
        return [
            (f"{group}, {schedule}", number, reason)
            for group, flights in self.closed_loop.items()
            for schedule, miss in flights.items()
            for number, reason in miss.failed
        ]

    def certificate(self) -> dict[str, float | None]:
        """The proofs of the synthesis, as plain numbers; None where a condition number is infinite."""
        a, b, to = self.synthesis.guidance.certificate, self.synthesis.state.certificate, self.synthesis.to
        closed = terminal_gain(self.scenario, self.synthesis.lin)
        found = {
            "riccati_residual": a.riccati_residual,
            "min_eig_S": a.min_eig_S,
            "cond_S": a.cond_S,
            "riccati_residual_state_route": b.riccati_residual,
            "routes_difference": self.synthesis.routes_difference,
            "terminal_gain_error": float(np.abs(self.synthesis.K_state_route[-1] - closed).max() / np.abs(closed).max()),
            "coordinate_condition_min": float(to.condition.min()),
            "coordinate_condition_max": float(to.condition.max()),
            "step_s": self.synthesis.step,
        }
        return {key: value if math.isfinite(value) else None for key, value in found.items()}

    def to_dict(self) -> dict[str, Any]:
        """JSON-able result."""
        reference = self.synthesis.reference
        gains = -self.synthesis.guidance.at(self.at).K[:, 0]
        closed = {
            group: {
                name: {"rms_km": m.rms, "p95_km": m.p95, "max_km": m.worst, "arrived": len(m.km), "failed": len(m.failed)}
                if len(m.km)
                else {"rms_km": None, "p95_km": None, "max_km": None, "arrived": 0, "failed": len(m.failed)}
                for name, m in flights.items()
            }
            for group, flights in self.closed_loop.items()
        }
        result = {
            "reference": {
                "t_f_s": float(reference.t[-1]), "range_m": float(reference["s"][-1]), "final_speed_m_s": float(reference["V"][-1]),
                "final_path_angle_deg": math.degrees(reference["gamma"][-1]), **self.peak,
            },
            "t_s": self.at.tolist(),
            "K": {name: gains[:, i].tolist() for i, name in enumerate(NAMES)},
            "units": {"K1": "1/g0", "K2": "s/m", "K3": "1/m", "K4": "s/m"},
            "time_mean": self.time_mean,
            "paper": self.scenario.guidance.paper_gains.model_dump(),
            "certificate": self.certificate(),
            "sensitivity": sensitivity_table(self),
        }  # fmt: skip
        if self.remarks:
            result["remarks"] = list(self.remarks)
        if closed:
            result["closed_loop"] = closed
            result["failed"] = [{"flight": f, "case": n, "reason": r} for f, n, r in self.failed]
        return result

    def summary(self) -> list[tuple[str, float, str]]:
        """Headline numbers of the synthesis as (label, value, unit)."""
        reference, means = self.synthesis.reference, self.time_mean
        rows = [
            ("flight time", float(reference.t[-1]), "s"),
            ("range", float(reference["s"][-1]) / 1e3, "km"),
            ("peak axial load", self.peak["peak_axial_g"], "g0"),
            ("peak load", self.peak["peak_load_g"], "g0"),
        ]
        units = {"K1": "1/g0", "K2": "s/m", "K3a": "1/m", "K3b": "1/m", "K4": "s/m"}
        rows += [(f"mean {name}", value, units[name]) for name, value in means.items() if value is not None]
        proof = self.certificate()
        rows += [
            ("Riccati defect (certified)", proof["riccati_residual"] or 0.0, "1"),
            ("smallest eigenvalue of scaled S", proof["min_eig_S"] or 0.0, "1"),
            ("difference of the two routes", proof["routes_difference"] or 0.0, "1"),
        ]
        return rows

    def figures(self) -> dict[str, Any]:
        """Figures by name (matplotlib)."""
        from studies.gains_report import figures

        return {item.name: item.figure for item in figures(self)}

    def result(self) -> StudyResult:
        """Figures, tables and comparisons for the report."""
        from studies.gains_report import result

        return result(self)


def sensitivity_table(study: GainsStudy) -> dict[str, dict[str, float]]:
    """Per weight and gain: time mean of |dK/d ln(weight)| over the time mean of |K|."""
    t, K = study.synthesis.reference.t, study.synthesis.K
    change = np.trapezoid(np.abs(study.sensitivity.log_dK[:, :, 0, :]), t, axis=1) / np.trapezoid(np.abs(K), t, axis=0)
    return {
        name: {gain: float(change[i, j]) for j, gain in enumerate(NAMES)} for i, name in enumerate(study.sensitivity.names)
    }  # fmt: skip


def run(scenario: Scenario, *, dispersions: int = 0, at: ArrayLike | None = None, progress: Progress | None = None) -> GainsStudy:
    """Synthesize the gains of a scenario and, on request, fly dispersed cases.

    Parameters
    ----------
    scenario : Scenario
    dispersions : int
        Cases in each set; 0 for none.
    at : array_like, shape (M,), optional
        Times at which the gains are reported, s, inside the reference flight; default: all nodes.
    progress : callable, optional
        ``progress(label, fraction)``.

    Raises
    ------
    ModelError
        The reference does not reach its stop altitude, a time outside the flight, no certificate.
    """
    if isinstance(dispersions, bool) or not isinstance(dispersions, int) or dispersions < 0:
        raise ModelError(f"dispersions: expected a whole number of cases, 0 or more, got {dispersions!r}")
    synthesis = certified(scenario)
    reference = synthesis.reference
    nodes = reference.t[np.concatenate([[True], np.diff(reference.t) > 0])]
    times = nodes if at is None else np.atleast_1d(as_finite("at", at))
    if times.ndim != 1:
        raise ModelError(f"at: expected times of shape (M,), got {times.shape}; give a flat list")
    if times.size == 0:
        raise ModelError("at: the list of times is empty; give at least one time, or leave it out for all nodes")
    if times.min() < 0 or times.max() > reference.t[-1]:
        bad = times[(times < 0) | (times > reference.t[-1])][0]
        raise ModelError(f"at: {bad:.9g} s is outside the reference flight [0, {reference.t[-1]:.9g}] s; choose times inside it")
    Q, R, F = weights(scenario)
    sensitivity = tvlqr_sensitivity(synthesis.lin, Q=Q, R=R, Qf=F)
    remarks = list(synthesis.remarks)
    if np.abs(reference["gamma"]).max() > 0.5 * math.pi:
        remarks.append(
            "the reference flies past the vertical, where a planar entry with trimmed lift means little; raise the stop altitude"
        )
    flown: dict[str, dict[str, Miss]] = {}
    if dispersions:
        flown, more = schedules.fly_dispersed(scenario, synthesis, dispersions, progress)
        remarks += more
    return GainsStudy(scenario, synthesis, sensitivity, peaks(reference), flown, times, tuple(remarks))
