"""Physical constants with their sources, and factors from other units to SI.

Everything inside the workbench is SI and radians.  A factor is one unit expressed in SI, so data come in by
multiplication, ``5.0 * FT`` metres, and go out to a plot by division, ``h / NMI`` nautical miles.
"""

from __future__ import annotations

import math

# --- Earth -------------------------------------------------------------------------------------------------------
#: Standard acceleration of gravity, m/s2 (CGPM 1901, exact).
G0 = 9.80665
#: Gravitational parameter of the Earth with its atmosphere, m3/s2 (WGS 84, NIMA TR8350.2, 2000; IERS Conventions).
MU_EARTH = 3.986004418e14
#: Second zonal harmonic, unnormalized, dimensionless (EGM96: -sqrt(5) C20).
J2_EARTH = 1.08262668e-3
#: Equatorial radius, m (WGS 84, exact).
R_EQUATOR_EARTH = 6378137.0
#: Mean radius, m (IUGG mean radius 6371.0 km).
R_MEAN_EARTH = 6371e3
#: Rotation rate, rad/s (WGS 84).
OMEGA_EARTH = 7.292115e-5

# --- U.S. Standard Atmosphere 1976 (NOAA-S/T 76-1562), tables 2 to 4 ------------------------------------------------
#: Gas constant as adopted by the standard, J/(kmol K); not today's 8314.46.
R_STAR = 8314.32
#: Mean molar mass of air at sea level, kg/kmol.
M_AIR = 28.9644
#: Radius of the geopotential conversion, m.
R_GEOPOTENTIAL = 6356766.0
#: Ratio of specific heats.
GAMMA_AIR = 1.4
#: Sea-level temperature, K.
T_SEA = 288.15
#: Sea-level pressure, Pa.
P_SEA = 101325.0

# --- Factors: one unit in SI --------------------------------------------------------------------------------------
#: Degree, rad.
DEG = math.pi / 180
#: International foot, m (exact, 1959).
FT = 0.3048
#: Inch, m (exact).
INCH = 0.0254
#: International nautical mile, m (exact, 1929).
NMI = 1852.0
#: Kilometre, m.
KM = 1000.0
#: Knot, m/s.
KNOT = NMI / 3600
#: Avoirdupois pound, kg (exact, 1959).
LBM = 0.45359237
#: Pound-force, N.
LBF = LBM * G0
#: Slug, kg: the mass that one pound-force accelerates by one foot per second squared.
SLUG = LBF / FT
#: Slug foot squared (moment of inertia), kg m2.
SLUG_FT2 = SLUG * FT**2
#: Foot pound-force (torque), N m.
FT_LBF = FT * LBF
#: Pound-force per square foot, Pa.
PSF = LBF / FT**2
#: Pound-force per square inch, Pa.
PSI = LBF / INCH**2
#: Slug per cubic foot, kg/m3.
SLUG_FT3 = SLUG / FT**3
#: Degree Rankine, K.
RANKINE = 5 / 9
