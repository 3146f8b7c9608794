"""Constants against their definitions, factors against published equivalents."""

import math

import pytest

from models import units


@pytest.mark.parametrize(
    ("value", "expected", "rel"),
    [
        (units.LBF, 4.4482216152605, 1e-13),  # NIST SP 811, appendix B
        (units.SLUG, 14.59390, 1e-6),
        (units.PSF, 47.88026, 1e-6),
        (units.PSI, 6894.757, 1e-6),
        (units.SLUG_FT3, 515.3788, 1e-6),
        (units.SLUG_FT2, 1.355818, 1e-6),
        (units.FT_LBF, 1.355818, 1e-6),
        (units.KNOT, 0.5144444, 1e-6),
        (units.NMI / units.FT, 6076.115, 1e-6),
        (491.67 * units.RANKINE, 273.15, 1e-14),
        (180 * units.DEG, math.pi, 1e-15),
        (12 * units.INCH, units.FT, 1e-15),
    ],
)
def test_factors_match_published_equivalents(value: float, expected: float, rel: float) -> None:
    assert value == pytest.approx(expected, rel=rel)


def test_gravity_constants_agree_with_each_other() -> None:
    # Somigliana's normal gravity of WGS 84 at the equator is 9.7803253359 m/s2; J2 alone leaves out J4, 15/8 J4 = 3e-6
    r = units.R_EQUATOR_EARTH
    gravity = units.MU_EARTH / r**2 * (1 + 1.5 * units.J2_EARTH) - units.OMEGA_EARTH**2 * r
    assert gravity == pytest.approx(9.7803253359, rel=5e-6)


def test_standard_atmosphere_constants_give_sea_level_density() -> None:
    density = units.P_SEA * units.M_AIR / (units.R_STAR * units.T_SEA)
    assert density == pytest.approx(1.2250, rel=1e-6)


def test_mean_radius_is_that_of_the_reference_ellipsoid() -> None:
    mean = (2 * units.R_EQUATOR_EARTH + 6356752.3142) / 3  # polar radius of WGS 84
    assert mean == pytest.approx(units.R_MEAN_EARTH, rel=2e-6)
