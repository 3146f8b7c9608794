"""Optimal control of symbolic models: simulation, trim, linearization, gains with certificates, landing at a point."""

from ocp.coordinates import Coordinates, coordinates, transform
from ocp.gains import Certificate, Gains
from ocp.laws import Law, constant, profile, sampled
from ocp.linearize import Linearization, linearize
from ocp.lqr import dlqr, lqi, lqr
from ocp.methods import RK4, RK8, Adaptive
from ocp.riccati import care, dare, dlyapunov, lyapunov
from ocp.schedule import Schedule, best_breakpoints, fit_commands, time_means
from ocp.simulate import Ensemble, simulate, simulate_ensemble
from ocp.stops import Stop, falls_below, first_of, rises_above
from ocp.tracking import Tracker, tracker
from ocp.trajectory import SimulationError, Trajectory
from ocp.trim import OperatingPoint, trim
from ocp.tvlqr import dtvlqr, tvlqr, tvlqr_sensitivity

__all__ = [
    "RK4",
    "RK8",
    "Adaptive",
    "Certificate",
    "Coordinates",
    "Ensemble",
    "Gains",
    "Law",
    "Linearization",
    "OperatingPoint",
    "Schedule",
    "SimulationError",
    "Stop",
    "Tracker",
    "Trajectory",
    "best_breakpoints",
    "care",
    "constant",
    "coordinates",
    "dare",
    "dlqr",
    "dlyapunov",
    "dtvlqr",
    "falls_below",
    "first_of",
    "fit_commands",
    "linearize",
    "lqi",
    "lqr",
    "lyapunov",
    "profile",
    "rises_above",
    "sampled",
    "simulate",
    "simulate_ensemble",
    "time_means",
    "tracker",
    "transform",
    "trim",
    "tvlqr",
    "tvlqr_sensitivity",
]
