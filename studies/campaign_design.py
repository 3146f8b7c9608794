"""Sampling designs of a campaign: any slice of the cases is the same numbers, however the cases are divided into chunks.

Source: Salmon and others 2011, "Parallel random numbers: as easy as 1, 2, 3" (counter-based generators); Owen 1998, "Scrambling
Sobol' and Niederreiter-Xing points"; McKay, Beckman, Conover 1979 (Latin hypercube).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from models.core import Array, Model, ModelError, frozen

if TYPE_CHECKING:
    from studies.scenario_sections import Distributions

Kind = Literal["independent", "latin_hypercube", "sobol"]
# What is drawn, in the order of the columns, with its unit: deviations from the reference flight.
DRAWN = (("V", "m/s"), ("gamma", "rad"), ("density", "1"), ("drag", "1"), ("lift", "1"), ("wave_phase", "rad"))
NAMES = tuple(name for name, _ in DRAWN)

_STREAM = 3  # apart from the streams of the study's own dispersion sets
_BLOCK = 4  # numbers that Philox makes from one value of its counter
_SOBOL_BITS = 30  # scipy's fast_forward takes 32 at most


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """A sampling plan on the open unit cube.

    Attributes
    ----------
    kind : {"independent", "latin_hypercube", "sobol"}
    seed : int
    cases : int
        Of the whole campaign.
    whole : ndarray, shape (cases, d), or None
        The Latin hypercube, which exists only as a whole; the other designs are computed slice by slice.
    """

    kind: Kind
    seed: int
    cases: int
    whole: Array | None

    def slice(self, first: int, count: int) -> Array:
        """Cases first .. first + count - 1, shape (count, d), in (0, 1)."""
        if not (0 <= first and 1 <= count and first + count <= self.cases):
            raise ModelError(f"design: cases {first} to {first + count - 1} are not among 0 to {self.cases - 1}; ask for cases inside")
        if self.whole is not None:
            return self.whole[first : first + count]
        return _independent(self.seed, first, count) if self.kind == "independent" else _sobol(self.seed, first, count)


def design(kind: Kind, *, seed: int, cases: int) -> Design:
    """Sampling plan of a campaign.

    Raises
    ------
    ModelError
        An unknown kind, or more cases than a Sobol sequence has.
    """
    if kind not in get_args(Kind):
        raise ModelError(f"design: found {kind!r}, expected one of {', '.join(get_args(Kind))}")
    if cases < 1:
        raise ModelError(f"design: expected at least 1 case, got {cases}")
    whole = None
    if kind == "latin_hypercube":
        sampler = qmc.LatinHypercube(len(DRAWN), rng=np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, _STREAM)))))
        whole = frozen(_open(sampler.random(cases), 2.0**-53))
    return Design(kind, seed, cases, whole)


def advice(kind: Kind, cases: int) -> str | None:
    """A remark on the number of cases; None where there is nothing to say."""
    if kind == "sobol" and cases & (cases - 1):
        low = 1 << (cases.bit_length() - 1)
        return f"campaign.cases = {cases} is not a power of two, so the Sobol points are not balanced; {low} or {2 * low} would be"
    return None


def _independent(seed: int, first: int, count: int) -> Array:
    """One counter-based generator for the whole campaign, its counter set by the case number."""
    blocks = math.ceil(len(DRAWN) / _BLOCK)  # of each case
    key = np.random.SeedSequence((seed, _STREAM)).generate_state(2, np.uint64)
    numbers = np.random.Generator(np.random.Philox(key=key, counter=blocks * first)).random((count, blocks * _BLOCK))
    return _open(numbers[:, : len(DRAWN)], 2.0**-53)


def _sobol(seed: int, first: int, count: int) -> Array:
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, _STREAM))))
    sequence = qmc.Sobol(len(DRAWN), scramble=True, bits=_SOBOL_BITS, rng=rng)
    if first:
        sequence.fast_forward(first)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a slice is rarely a power of two; the campaign as a whole is remarked on
        return _open(sequence.random(count), 2.0**-_SOBOL_BITS)


def _open(numbers: Array, spacing: float) -> Array:
    """Uniform numbers in [0, 1) moved to the middle of their cells: none lies at the infinite end of a normal law."""
    return np.asarray(np.minimum(numbers + spacing / 2, np.nextafter(1.0, 0.0)))


def deviations(numbers: Array, laws: Distributions) -> Array:
    """Deviations (N, 6) in the order of `DRAWN` from uniform numbers (N, 6), each by the inverse of its distribution function."""
    drawn: dict[str, tuple[Any, float]] = {
        "V": (laws.speed_m_s, 1.0), "gamma": (laws.path_angle_deg, math.pi / 180), "density": (laws.density, 1.0),
        "drag": (laws.drag, 1.0), "lift": (laws.lift, 1.0),
    }  # fmt: skip
    out = np.empty_like(numbers)
    for k, name in enumerate(NAMES):
        if name == "wave_phase":
            out[:, k] = 2 * np.pi * numbers[:, k]
            continue
        law, unit = drawn[name]
        standard = 2 * numbers[:, k] - 1 if law.law == "uniform" else ndtri(numbers[:, k])
        out[:, k] = law.spread * unit * standard
    return out


def dispersed(model: Model, x0: Array, drawn: Array, laws: Distributions) -> tuple[Array, Array]:
    """Initial states (N, nx) and parameters (N, np) of cases with deviations (N, 6)."""
    column = dict(zip(NAMES, drawn.T, strict=True))
    states, params = np.tile(x0, (len(drawn), 1)), np.tile(model.p0, (len(drawn), 1))
    for name in ("V", "gamma"):
        states[:, model.index(name)] += column[name]
    for factor, name in (("rho_factor", "density"), ("CD_factor", "drag"), ("CL_factor", "lift")):
        params[:, model.index(factor)] *= 1 + column[name]
    params[:, model.index("wave_amplitude")] = laws.wave_amplitude
    params[:, model.index("wave_length")] = laws.wave_length_m
    params[:, model.index("wave_phase")] = column["wave_phase"]
    return states, params
