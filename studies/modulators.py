"""Pulse-width pulse-frequency modulation of jets and its limit cycles: duty cycles, tracking, predictions, and the complete census.

Source: Lu & Zhang 2012 (paper 000), sections 1-2, Figs 3-8, Tables 1-4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from models.census import Census, census
from models.census_map import CensusMap, census_map, cycle_border
from models.checked import Array, ModelError, frozen
from models.describing import Prediction, predict
from models.modulators import ContinuousPWPF, DiscretePWPF, dead_band_relay
from models.modulators_runs import run as run_modulator
from models.modulators_static import SampledDuty, duty, sampled_duty
from models.nyquist import LinearPart, rational
from models.sampled_cycles import region

if TYPE_CHECKING:
    from studies.result import StudyResult

CONTINUOUS = ContinuousPWPF()
PAPER = DiscretePWPF()
SCHEMES: Mapping[str, DiscretePWPF] = MappingProxyType({
    "original": PAPER, "a": replace(PAPER, k=0.75), "b": replace(PAPER, delta=0.01),
})  # fmt: skip
CURVES: Mapping[str, DiscretePWPF] = MappingProxyType({
    "h = 0.2, k = 1": replace(PAPER, h=0.2, k=1.0), "h = 0, k = 1": replace(PAPER, k=1.0), "h = 0, k = 0.9": replace(PAPER, k=0.9),
    "h = 0, k = 0.8": PAPER, "h = 0, k = 0.7": replace(PAPER, k=0.7),
})  # fmt: skip
M1, M2 = (1, 0, -1, 0), (1, 1, -1, -1)
WORDS = MappingProxyType({"M_c = 1": M1, "M_c = 2": M2})
FREQUENCIES = (1.0, 2.0, 3.0)  # rad/s, Fig. 4
STRAY_GAIN = 5.2  # beyond the upper limit of M_c = 1, where M_c = 2 is still there
MAP_POINTS = 200
K_MAX = 6.0
NEAR = ((0.7, 1.2), (0.0, 0.06))  # k, delta

Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Demand, pulses and their impulses (integrals), each (N,); impulses in seconds of full thrust."""

    t: Array
    r: Array
    y: Array
    wanted: Array
    given: Array

    @property
    def worst(self) -> float:
        """Largest |difference| of the impulses, s."""
        return float(np.abs(self.given - self.wanted).max())

    @property
    def rms(self) -> float:
        """Root mean square of the difference of the impulses, s."""
        return float(np.sqrt(np.mean((self.given - self.wanted) ** 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Harmonic:
    """Answer to A sin(w t) in the long run: fundamental of the output over that of the demand, delay (s) and mean output."""

    gain: float
    delay: float
    mean: float


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """Where a cycle ends: closed form, and the interval in which the census changes its answer."""

    cycle: str
    parameter: str
    fixed: str
    formula: float
    census: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ModulatorStudy:
    """Result of :func:`run`.

    Attributes
    ----------
    r : ndarray, shape (R,)
        Demands of the duty-cycle curves.
    continuous : ndarray, shape (R,)
    sampled, schemes : mapping of name to SampledDuty
        Figs 3 and 8.
    tracks, scheme_tracks : mapping to Track
        Figs 4 (by frequency) and 8 (by scheme).
    endings : mapping of frequency to Track
        Fig. 5: the demand ends after 5 s.
    predictions : mapping of k to tuple of Prediction
        Fig. 6.
    censuses : mapping of name to Census
    harmonics : mapping of name to Harmonic
        Of 0.8 sin(t), for Fig. 8.
    borders : tuple of Border
        Table 3.
    map, near : CensusMap
        The whole range, and the part around the schemes of Table 4.
    """

    r: Array
    continuous: Array
    sampled: Mapping[str, SampledDuty]
    schemes: Mapping[str, SampledDuty]
    tracks: Mapping[float, Track]
    scheme_tracks: Mapping[str, Track]
    endings: Mapping[float, Track]
    predictions: Mapping[float, tuple[Prediction, ...]]
    censuses: Mapping[str, Census]
    harmonics: Mapping[str, Harmonic]
    borders: tuple[Border, ...]
    map: CensusMap
    near: CensusMap

    def to_dict(self) -> dict[str, Any]:
        """JSON-able result."""
        curves = {
            name: {"duty": found.duty, "period": found.period, "decided": found.decided} for name, found in self.sampled.items()
        }  # fmt: skip
        return {
            "r": self.r, "continuous": self.continuous, "sampled": curves,
            "schemes": {name: found.duty for name, found in self.schemes.items()},
            "impulse_error_s": {
                "fig4": {f"{w:g}": {"max": t.worst, "rms": t.rms} for w, t in self.tracks.items()},
                "fig8": {name: {"max": t.worst, "rms": t.rms} for name, t in self.scheme_tracks.items()},
            },
            "harmonic": {name: {"gain": h.gain, "delay_s": h.delay, "mean": h.mean} for name, h in self.harmonics.items()},
            "fig5": {f"{w:g}": ending_word(t) for w, t in self.endings.items()},
            "predicted": {f"{k:g}": [list(p.mode.word) for p in found if p.predicted] for k, found in self.predictions.items()},
            "census": {name: found.to_dict() for name, found in self.censuses.items()},
            "borders": [
                {"cycle": b.cycle, "parameter": b.parameter, "at": b.fixed, "formula": b.formula, "census": list(b.census)}
                for b in self.borders
            ],
            "map": {
                "k": self.map.k, "delta": self.map.delta, "decided": self.map.decided,
                "words": [list(w) for w in self.map.words], "points": [int(self.map.of(w).sum()) for w in self.map.words],
            },
        }  # fmt: skip

    def result(self) -> StudyResult:
        """Figures, tables and comparisons for the report."""
        from studies.modulators_report import result

        return result(self)


def linear_part(k: float) -> LinearPart:
    """What lies between the relay's output and minus its input, G(z) = k m (z + 1)/(z (z - n)) (eq 11)."""
    return rational([k * PAPER.m, k * PAPER.m], [1.0, -PAPER.n, 0.0], dt=PAPER.Ts)


def ending_word(track: Track) -> list[int]:
    """Least period of the last samples of the output, from its first +1 on; [0] if the jets are off."""
    last = track.y[-120:].astype(int)
    for period in range(1, 61):
        if (last[period:] == last[:-period]).all():
            word = last[-period:].tolist()
            turned = [word[i:] + word[:i] for i in range(period)]
            return max(turned)
    raise ModelError("the output has no period of at most 60 samples at the end; simulate longer")


def run(*, points: int = MAP_POINTS, progress: Progress | None = None) -> ModulatorStudy:
    """Compute everything.

    Parameters
    ----------
    points : int
        Points of the (k, delta) map on each axis, 2 to 2000.
    progress : callable, optional
        ``progress(label, fraction)``.

    Raises
    ------
    ModelError
        A number of points out of range.
    """
    if not isinstance(points, int) or isinstance(points, bool) or not 2 <= points <= 2000:
        raise ModelError(f"modulators: points = {points!r}; expected an integer from 2 to 2000")
    tell = progress or (lambda label, fraction: None)
    r = np.linspace(0.0, 1.0, 501)
    tell("modulators: duty cycles", 0.0)
    sampled = {name: sampled_duty(m, r) for name, m in CURVES.items()}
    schemes = {name: sampled_duty(m, r) for name, m in SCHEMES.items()}
    tell("modulators: census", 0.3)
    one = replace(PAPER, k=1.0)
    censuses = {name: census(m) for name, m in SCHEMES.items()}
    censuses["k = 1"], censuses[f"k = {STRAY_GAIN:g}"] = census(one), census(replace(PAPER, k=STRAY_GAIN))
    borders = _borders()
    tell("modulators: map", 0.5)
    found = census_map(PAPER, np.linspace(0.0, K_MAX, points), np.linspace(0.0, PAPER.u_on / PAPER.km, points))
    near = census_map(PAPER, np.linspace(*NEAR[0], points), np.linspace(*NEAR[1], points))
    tell("modulators: map", 1.0)
    return ModulatorStudy(
        r=frozen(r), continuous=duty(CONTINUOUS, r), sampled=sampled, schemes=schemes,
        tracks={w: _track(PAPER, 0.5, w, seconds=8.0) for w in FREQUENCIES},
        scheme_tracks={name: _track(m, 0.8, 1.0, seconds=13.0) for name, m in SCHEMES.items()},
        endings={w: _track(one, 1.0, w, seconds=20.0, until=5.0) for w in (1.0, 0.5)},
        predictions={k: predict(_of_z(linear_part(k)), dead_band_relay(PAPER.u_on)) for k in (0.5, 0.8, 1.0)},
        censuses=censuses, harmonics={name: harmonic(m, 0.8, 1.0) for name, m in SCHEMES.items()}, borders=borders, map=found, near=near,
    )  # fmt: skip


def _of_z(linear: LinearPart) -> Callable[[complex], complex]:
    return lambda z: complex(linear.transfer(np.array([z]))[0])


def _track(modulator: DiscretePWPF, amplitude: float, w: float, *, seconds: float, until: float = np.inf) -> Track:
    t = modulator.Ts * np.arange(round(seconds / modulator.Ts))
    r = np.where(t < until, amplitude * np.sin(w * t), 0.0)
    y = run_modulator(modulator, r).y
    return Track(frozen(t), frozen(r), y, frozen(modulator.Ts * np.cumsum(r)), frozen(modulator.Ts * np.cumsum(y)))


def harmonic(modulator: DiscretePWPF, amplitude: float, w: float, *, seconds: float = 400.0) -> Harmonic:
    """Least-squares fit of a sine, a cosine and a constant to the answer to a sine, after its first tenth."""
    track = _track(modulator, amplitude, w, seconds=seconds)
    late = len(track.t) // 10
    t, y = track.t[late:], track.y[late:]
    sine, cosine, mean = np.linalg.lstsq(np.stack([np.sin(w * t), np.cos(w * t), np.ones_like(t)], axis=1), y, rcond=None)[0]
    return Harmonic(float(np.hypot(sine, cosine) / amplitude), float(-np.arctan2(cosine, sine) / w), float(mean))


def _borders() -> tuple[Border, ...]:
    """Table 3: each end by the condition on the trigger's inputs, and by a search on the census."""
    found = []
    for name, word in WORDS.items():
        limits = region(PAPER, word)
        low, high = limits.k_range(0.0) or (np.nan, np.nan)
        ends = [(low, (0.5 * low, 1.05 * low))] + ([(high, (0.98 * high, 1.05 * high))] if np.isfinite(high) else [])
        found += [Border(name, "k", "delta = 0", value, cycle_border(PAPER, word, "k", between)) for value, between in ends]
        for k in (1.0, 0.8):
            span = limits.delta_range(k)
            if span is not None:
                between = cycle_border(replace(PAPER, k=k), word, "delta", (0.0, 1.5 * span[1]))
                found.append(Border(name, "delta", f"k = {k:g}", span[1], between))
    return tuple(found)
