"""Tables and *paper | computed* rows of the gain study; no drawing library is loaded here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.result import Comparison, Table

if TYPE_CHECKING:
    from studies.gains import GainsStudy

LABELS = {
    "open_loop": "open loop",
    "time_varying": "K(t)",
    "least_squares": "constants fitted to flown commands, K3 split",
    "time_mean": "time means of K(t), K3 split",
    "paper": "printed constants",
    "paper_unsplit": "printed constants, K3 unsplit",
}


def is_n1(study: GainsStudy) -> bool:
    """True if flight, vehicle, weights and printed gains are those of reference N1, the default scenario."""
    default, own = type(study.scenario)(), study.scenario
    same = all(getattr(own, part) == getattr(default, part) for part in ("planet", "atmosphere", "reference", "weights", "guidance"))
    ratios = ("lift_to_drag", "ballistic_coefficient_kg_m2")
    return same and all(getattr(own.vehicle, key) == getattr(default.vehicle, key) for key in ratios)


def reference_table(study: GainsStudy) -> Table:
    """The reference flight in numbers."""
    s, found = study.scenario, study.to_dict()["reference"]
    rows: list[list[Any]] = [
        ["lift to drag ratio", s.vehicle.lift_to_drag, ""],
        ["ballistic coefficient", s.vehicle.ballistic_coefficient_kg_m2, "kg/m²"],
        ["bank angle", s.reference.bank_deg, "deg"],
        ["entry: altitude", s.reference.altitude_m / 1e3, "km"],
        ["entry: speed", s.reference.speed_m_s, "m/s"],
        ["entry: path angle", s.reference.path_angle_deg, "deg"],
        ["flight time", found["t_f_s"], "s"],
        ["range", found["range_m"] / 1e3, "km"],
        ["speed at the end", found["final_speed_m_s"], "m/s"],
        ["path angle at the end", found["final_path_angle_deg"], "deg"],
        ["peak axial load", found["peak_axial_g"], "g0"],
        ["peak load", found["peak_load_g"], "g0"],
        ["time of the peak", found["peak_time_s"], "s"],
    ]
    return Table(f"Reference flight {s.vehicle.name}", ["quantity", "value", "unit"], rows)


def gain_table(study: GainsStudy, times: Sequence[float] | None = None) -> Table:
    """Gains at given times, or at about ten times of the flight and at the split of K3."""
    end = float(study.synthesis.reference.t[-1])
    if times is None:
        step = 10 ** math.floor(math.log10(end / 5))
        step *= next(k for k in (5, 2, 1) if end / (k * step) >= 5)
        chosen = set(np.arange(0.0, end, step).tolist()) | {end}
        split = study.scenario.guidance.split_s
        times = sorted(chosen | ({split} if 0 < split < end else set()))
    values = -study.synthesis.guidance.at(times).K[:, 0]
    values[np.abs(values) < 1e-12 * np.abs(study.synthesis.K).max(axis=0)] = 0.0  # rounding of the interpolation
    rows = [[t, *(float(v) for v in row)] for t, row in zip(times, values, strict=True)]
    return Table(
        "Feedback gains K(t)", ["time [s]", "K1 [1/g0]", "K2 [s/m]", "K3 [1/m]", "K4 [s/m]"], rows,
        "Sign of the paper: correction of CL/CD cos(bank) = K1 dn_x + K2 dhdot + K3 ds + K4 dsdot.",
    )  # fmt: skip


def miss_table(study: GainsStudy) -> Table:
    """rms, 95th percentile and maximum of the range error."""
    rows: list[list[Any]] = []
    for name, flights in study.closed_loop.items():
        for schedule, m in flights.items():
            numbers = [m.rms, m.p95, m.worst] if len(m.km) else [None, None, None]
            rows.append([name, LABELS[schedule], *numbers, len(m.km), len(m.failed)])
    seed = study.scenario.dispersions.seed
    return Table(
        "Range errors of the dispersed closed loops",
        ["set", "schedule", "rms [km]", "95 % [km]", "largest [km]", "arrived", "failed"], rows,
        f"Independent uniform dispersions, seed {seed}, command every {study.scenario.guidance.sample_s:g} s, feedback above "
        f"{study.scenario.guidance.gate_load_g:g} g0, perfect navigation. Where the largest error is many times the 95 % value, a few "
        "cases in which the lift saturates dominate the rms.",
    )  # fmt: skip


def certificate_table(study: GainsStudy) -> Table:
    """The proofs of the synthesis."""
    c = study.certificate()
    rows: list[list[Any]] = [
        [
            "Riccati defect, guidance coordinates",
            c["riccati_residual"],
            "per interval, against an independent integration at half the step",
        ],
        ["Riccati defect, state coordinates", c["riccati_residual_state_route"], "the same for the second route"],
        ["difference of the two routes", c["routes_difference"], "relative to the largest magnitude of each gain"],
        ["terminal gain against its closed form", c["terminal_gain_error"], "K(t_f) = -R⁻¹H'F"],
        ["smallest eigenvalue of scaled S", c["min_eig_S"], "must not be negative"],
        ["condition number of scaled S", c["cond_S"], "worst node"],
        ["condition number of scaled M", c["coordinate_condition_max"], "worst node; singular only where the load or the speed vanishes"],
    ]
    return Table("Certificate of the synthesis", ["proof", "value", "meaning"], rows)


def sensitivity_table(study: GainsStudy) -> Table:
    """Relative sensitivities."""
    rows: list[list[Any]] = []
    for name, row in study.to_dict()["sensitivity"].items():
        rows.append([name.replace("Qf", "F"), *row.values()])
    return Table(
        "Relative sensitivity of the gains to the weights", ["weight", "K1", "K2", "K3", "K4"], rows,
        "Time mean of |dK/d ln(weight)| over the time mean of |K|. The paper finds K not very sensitive to F and Q. "
        "The sum over all weights of dK/d ln(weight) is zero: a common factor changes no gain.",
    )  # fmt: skip


def comparisons(study: GainsStudy) -> list[Comparison]:
    """Printed constants beside the computed time means."""
    printed, means = study.scenario.guidance.paper_gains, study.time_mean
    units = {"K1": "1/g0", "K2": "s/m", "K3a": "1/m", "K3b": "1/m", "K4": "s/m"}
    split = study.scenario.guidance.split_s
    words = {"K3a": f", t < {split:g} s", "K3b": f", t ≥ {split:g} s"}
    why = "printed to two digits, from the authors' own unpublished reference flight"
    if not is_n1(study):
        why = "this scenario is not reference N1: another flight or other weights have other gains"
    rows = []
    for key, unit in units.items():
        value = means[key]
        if value is not None:
            rows.append(Comparison(f"{key[:2]}{words.get(key, '')}", float(getattr(printed, key)), value, unit, why, 0.03))
    sensitivity = study.to_dict()["sensitivity"]
    strongest = max((max(row.values()), name) for name, row in sensitivity.items() if name.startswith("Q["))
    rows.append(Comparison(
        "sensitivity to Q relative to R", "“not very sensitive”", strongest[0] / max(sensitivity["R[lift_ratio]"].values()), "1",
        f"largest relative sensitivity to an entry of Q ({strongest[1]}) over the largest to R", None,
    ))  # fmt: skip
    return rows
