"""Density, temperature, pressure and sound speed against geometric altitude: exponential and U.S. Standard Atmosphere 1976."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from models.checked import Array, ModelError, as_finite, evaluate
from models.tables import at_least, at_most, line
from models.units import G0, GAMMA_AIR, M_AIR, P_SEA, R_GEOPOTENTIAL, R_STAR, T_SEA

QUANTITIES = ("density", "temperature", "pressure", "sound_speed")

# Table 4 of the standard: base of each layer (geopotential metres) and its temperature gradient (K per geopotential metre).
_BASES = (0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3)
_GRADIENTS = (-6.5e-3, 0.0, 1.0e-3, 2.8e-3, 0.0, -2.8e-3, -2.0e-3)
_TURBOPAUSE = 86e3  # geometric m: the layers end here
_TOP = 120e3
_GMR = G0 * M_AIR / R_STAR  # K/m: the hydrostatic constant
_STANDARD = "U.S. Standard Atmosphere 1976, NOAA-S/T 76-1562"
_SMOOTH_STEP = 200.0
_AVERAGE_STEP, _AVERAGE_WIDTH = 20.0, 300.0  # m between the nodes of the smooth version


@dataclass(frozen=True, slots=True, eq=False)
class Atmosphere:
    """An atmosphere as four functions of geometric altitude.

    Attributes
    ----------
    name : str
    density, temperature, pressure, sound_speed : casadi.Function
        (h,) m -> kg/m3, K, Pa, m/s; value and derivatives finite at every altitude of a flight, inside the domain or not.
    domain : tuple of float
        Altitudes (low, high) covered by the source, m.  Outside, the functions continue along their tangents at the edge:
        logarithm of density and of pressure (so both are exponentials there), temperature, sound speed.
    source : str
    fit_error : float
        Largest relative deviation from the law that this atmosphere approximates, over all four quantities; 0 if it is that law.
    """

    name: str
    density: ca.Function
    temperature: ca.Function
    pressure: ca.Function
    sound_speed: ca.Function
    domain: tuple[float, float]
    source: str
    fit_error: float = 0.0

    def at(self, h: ArrayLike) -> dict[str, Array]:
        """All four quantities, by name, at altitudes `h` (N,) m.

        Raises
        ------
        ModelError
            NaN, or an altitude outside the domain (the functions themselves continue; this numeric entry does not).
        """
        altitude = np.atleast_1d(as_finite(f"{self.name}: h", h))
        low, high = self.domain
        if altitude.ndim != 1:
            raise ModelError(f"{self.name}: h has shape {altitude.shape}, expected (N,); flatten it")
        beyond = altitude[(altitude < low) | (altitude > high)]
        if beyond.size:
            raise ModelError(
                f"{self.name}: h = {beyond[0]:.8g} m is outside its domain [{low:.8g}, {high:.8g}] m; correct the value or its unit,"
                " or call the CasADi function for the continuation"
            )
        return {name: evaluate(getattr(self, name), altitude[:, None])[0][:, 0] for name in QUANTITIES}


def exponential(*, surface_density: float = 1.225, scale_height: float = 7110.0, sound_speed: float | None = None) -> Atmosphere:
    """Isothermal atmosphere in uniform gravity: rho = surface_density exp(-h/scale_height).

    p = rho g0 scale_height (hydrostatic);  T = g0 scale_height M0/R* (ideal gas);  a = sqrt(gamma g0 scale_height)

    Parameters
    ----------
    surface_density : float
        kg/m3, > 0.
    scale_height : float
        m, > 0.
    sound_speed : float, optional
        m/s, > 0; replaces the last formula.

    Raises
    ------
    ModelError
        A parameter that is not positive and finite.

    Notes
    -----
    Source: the defaults are those of the reference trajectory that Tang & Zhao 2000 (paper 003) is compared with.
    """
    a = math.sqrt(GAMMA_AIR * G0 * max(scale_height, 0.0)) if sound_speed is None else sound_speed
    for name, value in (("surface_density", surface_density), ("scale_height", scale_height), ("sound_speed", a)):
        if not (math.isfinite(value) and value > 0):
            raise ModelError(f"exponential: {name} must be finite and > 0, got {value}; use SI units")
    h = ca.SX.sym("h")
    falling = ca.exp(h * (-1 / scale_height))  # a product: it stands in the innermost loop of every flight
    density, pressure = surface_density * falling, surface_density * G0 * scale_height * falling
    return _atmosphere(
        "exponential", h, (density, ca.SX(scale_height * _GMR), pressure, ca.SX(a)), (-math.inf, math.inf),
        f"exponential: {surface_density:.8g} kg/m3 at the surface, scale height {scale_height:.8g} m",
    )  # fmt: skip


def us76() -> Atmosphere:
    """U.S. Standard Atmosphere 1976: its exact layers to 86 km, cubic splines through the printed values from there to 120 km.

    Below 86 km, with geopotential altitude H = r0 h/(r0 + h) and T linear in H within each layer:
    dp/dH = -rho g0, rho = p M0/(R* T).  Above: log density, log pressure and temperature are natural cubic splines.
    Sound speed is sqrt(gamma p/rho) throughout.

    Notes
    -----
    Source: U.S. Standard Atmosphere 1976, NOAA-S/T 76-1562, tables 2-4, equations 18, 19, 23, 33, 42, 50.

    Density is continuous, its slope jumps at the layer edges (use :func:`us76_smooth` where a derivative or a high-order
    integrator meets the atmosphere).  At 86 km the first printed pressure and density give way to those of the layers,
    from which they differ by rounding (6e-5 at most).  Temperature is the molecular-scale one below 86 km and the kinetic one
    from there up, as in the standard: it falls by 0.08 K at 86 km.  The standard defines no sound speed above 86 km.
    Molecular diffusion makes p/(rho T) depend on altitude above 86 km.
    """
    h = ca.SX.sym("h")
    altitude, temperature_above, pressure_above, density_above = _printed()
    edge = ca.SX(_TURBOPAUSE)
    log_p_edge = float(ca.evalf(_layers(edge)[1]))
    log_rho_edge = float(ca.evalf(_log_density(edge)))
    log_p_up = line("us76_log_p", altitude, values=np.r_[log_p_edge, np.log(pressure_above[1:])], outside="linear", ends="natural")
    log_rho_up = line("us76_log_rho", altitude, values=np.r_[log_rho_edge, np.log(density_above[1:])], outside="linear", ends="natural")
    T_up = line("us76_T", altitude, values=temperature_above, outside="linear", ends="natural")
    # Each part sees an argument held within its own range: neither can put a NaN into the other's derivative.
    below, above = at_most(h, _TURBOPAUSE), at_least(h, _TURBOPAUSE)
    log_p = ca.if_else(h < _TURBOPAUSE, _layers(below)[1], log_p_up(above))
    log_rho = ca.if_else(h < _TURBOPAUSE, _log_density(below), log_rho_up(above))
    T = ca.if_else(h < _TURBOPAUSE, _layers(below)[0], T_up(above))
    a = ca.sqrt(GAMMA_AIR * ca.exp(log_p - log_rho))
    inside = _atmosphere("us76", h, (ca.exp(log_rho), T, ca.exp(log_p), a), (0.0, _TOP), _STANDARD)
    return _continued(inside)


def us76_smooth() -> Atmosphere:
    """U.S. Standard Atmosphere 1976 from 0 to 120 km, twice continuously differentiable at every altitude, outside included.

    Natural cubic splines, nodes every 200 m, of log density, log pressure, temperature and sound speed of :func:`us76`, each
    first averaged over altitude with a Gaussian weight of 300 m standard deviation: the corners at the layer edges become
    curves that the steps of an integrator resolve, and second derivatives (which enter the gains) stay gentle.
    `fit_error` is the largest relative deviation of any of the four from `us76`, on a grid of 10 m.
    """
    exact = us76()
    nodes = np.linspace(0.0, _TOP, round(_TOP / _SMOOTH_STEP) + 1)
    stride = round(_SMOOTH_STEP / _AVERAGE_STEP)
    margin = stride * math.ceil(6 * _AVERAGE_WIDTH / _SMOOTH_STEP)
    fine: Array = _AVERAGE_STEP * np.arange(-margin, stride * (len(nodes) - 1) + margin + 1, dtype=np.float64)
    h = ca.SX.sym("h")
    expressions = []
    for name in QUANTITIES:
        logarithmic = name in ("density", "pressure")
        raw = evaluate(getattr(exact, name), fine[:, None])[0].ravel()
        averaged = gaussian_filter1d(np.log(raw) if logarithmic else raw, _AVERAGE_WIDTH / _AVERAGE_STEP, truncate=6.0)
        ordinates = averaged[margin : len(fine) - margin : stride]
        spline = line(f"us76_smooth_{name}", nodes, values=ordinates, outside="linear", ends="natural")(h)
        expressions.append(ca.exp(spline) if logarithmic else spline)
    smooth = _atmosphere("us76_smooth", h, tuple(expressions), (0.0, _TOP), f"{_STANDARD}; cubic splines every {_SMOOTH_STEP:.0f} m")
    grid = np.linspace(0.0, _TOP, round(_TOP / 10.0) + 1)
    wanted, found = exact.at(grid), smooth.at(grid)
    error = max(float(np.max(np.abs(found[name] / wanted[name] - 1))) for name in QUANTITIES)
    return replace(smooth, fit_error=error)


def dispersion(
    h: ca.SX, *, factor: float | ca.SX, wave_amplitude: float | ca.SX, wave_length: float | ca.SX, wave_phase: float | ca.SX
) -> ca.SX:
    """Multiplier of density: factor (1 + A sin(2 pi h/lambda + phi)).

    Parameters
    ----------
    h : casadi.SX
        Geometric altitude, m.
    factor : float or casadi.SX
        Uniform factor, 1 is nominal.
    wave_amplitude : float or casadi.SX
        A, relative; |A| < 1 keeps density positive.
    wave_length : float or casadi.SX
        lambda, vertical, m, not zero.
    wave_phase : float or casadi.SX
        phi at h = 0, rad.

    Returns
    -------
    casadi.SX
        Scalar, dimensionless.
    """
    return factor * (1 + wave_amplitude * ca.sin(2 * math.pi / wave_length * h + wave_phase))


def _atmosphere(name: str, h: ca.SX, quantities: Sequence[ca.SX], domain: tuple[float, float], source: str) -> Atmosphere:
    density, temperature, pressure, sound_speed = (
        ca.Function(f"{name}_{quantity}", [h], [ca.densify(expression)], ["h"], [quantity])
        for quantity, expression in zip(QUANTITIES, quantities, strict=True)
    )
    return Atmosphere(name, density, temperature, pressure, sound_speed, domain, source)


def _continued(inside: Atmosphere) -> Atmosphere:
    """The same inside its domain; outside along the tangents at the edges."""
    h = ca.SX.sym("h")
    low, high = inside.domain
    not_above = at_most(h, high)
    held = at_least(not_above, low)
    expressions = []
    for name in QUANTITIES:
        logarithmic = name in ("density", "pressure")
        value = getattr(inside, name)(h)
        slope = ca.Function("slope", [h], [ca.jacobian(ca.log(value) if logarithmic else value, h)])
        first, last = (float(evaluate(slope, np.array([edge]))[0][0]) for edge in (low, high))
        beyond = last * (h - not_above) + first * (not_above - held)
        edge_value = getattr(inside, name)(held)
        expressions.append(edge_value * ca.exp(beyond) if logarithmic else edge_value + beyond)
    return _atmosphere(inside.name, h, expressions, inside.domain, inside.source)


def _layers(h: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Molecular-scale temperature, K, and log pressure of the seven layers, as sums over the layers passed.

    Every layer adds its share for the part of it that lies below `h`: no branch, so no derivative of a branch not taken.
    """
    H = R_GEOPOTENTIAL * h / (R_GEOPOTENTIAL + h)
    T_base, T, log_p = T_SEA, ca.SX(T_SEA), ca.SX(math.log(P_SEA))
    tops = (*_BASES[1:], math.inf)
    for base, top, gradient in zip(_BASES, tops, _GRADIENTS, strict=True):
        climbed = ca.fmin(H, top) - base
        if base > 0:
            climbed = ca.fmax(climbed, 0)
        T += gradient * climbed
        log_p -= _GMR / gradient * ca.log1p(gradient / T_base * climbed) if gradient else _GMR / T_base * climbed
        T_base += gradient * (top - base)
    return T, log_p


def _log_density(h: ca.SX) -> ca.SX:
    T, log_p = _layers(h)
    return log_p + math.log(M_AIR / R_STAR) - ca.log(T)


def _printed() -> tuple[Array, Array, Array, Array]:
    """Altitude m, temperature K, pressure Pa, density kg/m3 of the standard's printed table from 86 to 120 km."""
    text = (resources.files("models") / "data" / "us76_upper.csv").read_text(encoding="utf-8")
    rows = list(csv.reader(row for row in text.splitlines() if not row.startswith("#")))
    columns = np.array(rows[1:], dtype=float).T
    return columns[0], columns[1], columns[2], columns[3]
