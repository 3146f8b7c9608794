"""All steady outputs of the sampled modulator for a constant input, with proof: none is missed, and none is there that does not exist.

With r constant the modulator is a piecewise contraction of its state (x, y1, y2) (:mod:`models.census_pieces`).  The whole invariant
interval with all nine histories is pushed through the step until no piece is cut by a threshold.  What is left is a finite graph, each
piece going into one piece; every orbit from any state follows it after finitely many steps, so its cycles are all that can last.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.census_basins import Basin, basins_of
from models.census_pieces import (
    N_LOW,
    OFF_HIGH,
    OFF_LOW,
    ON,
    STEPS,
    WORK,
    Ints,
    Pieces,
    children,
    final_cycles,
    image,
    levels,
    merged,
    parameter_rows,
    smallest_rotation,
    unchanged,
)
from models.checked import Array, Status, as_scalar, frozen
from models.drawing import html_table
from models.modulators import DiscretePWPF

_BORDERS = 20  # of one answer


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """A steady output of the sampled modulator.

    Attributes
    ----------
    word : tuple of int
        Outputs of one period in the lexicographically smallest rotation.
    x : ndarray, shape (period,)
        Input of the trigger at the sample of each output.
    margin : float
        Least distance of x from a threshold that would change its output.
    basin : Basin
        States from which this cycle is reached.
    """

    word: tuple[int, ...]
    x: Array
    margin: float
    basin: Basin

    @property
    def period(self) -> int:
        """Samples in one period."""
        return len(self.word)

    @property
    def mean(self) -> float:
        """Mean output, the duty cycle."""
        return sum(self.word) / len(self.word)

    def state(self, modulator: DiscretePWPF, r: float = 0.0) -> Array:
        """State (x, e, y) of the modulator after which it puts out the word from its first symbol on, shape (3,)."""
        return np.array([self.x[-1], float(modulator.f(r)) - modulator.k * self.word[-2 % self.period], self.word[-1]])

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"word": list(self.word), "period": self.period, "x": self.x.tolist(), "mean": self.mean, "margin": self.margin,
                "basin": self.basin.to_dict()}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """States that cannot be told apart from a threshold: a piece of no more than rounding width that one step cuts.

    Attributes
    ----------
    y1, y2 : int
        Outputs of the last two samples.
    low, high : float
        Interval of x.
    threshold : float
        The threshold that its image meets.
    """

    y1: int
    y2: int
    low: float
    high: float
    threshold: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"y1": self.y1, "y2": self.y2, "x": [self.low, self.high], "threshold": self.threshold}


@dataclass(frozen=True, slots=True, eq=False)
class Census:
    """Steady outputs of a sampled modulator for a constant input.

    Attributes
    ----------
    modulator : DiscretePWPF
    r : float
        The constant demand.
    decided : bool
        True: `cycles` are all there are, from any state.  False: each of them exists, but there may be others, see `reason`.
    cycles : tuple of Cycle
        Sorted by period, then by word.
    reason : str
        Why it is not decided; empty if it is.
    borders : tuple of Border
        Where it is not decided; empty if it is.  At most 20.
    """

    modulator: DiscretePWPF
    r: float
    decided: bool
    cycles: tuple[Cycle, ...]
    reason: str
    borders: tuple[Border, ...]

    @property
    def status(self) -> Status:
        """OK, or UNDECIDED."""
        return Status.OK if self.decided else Status.UNDECIDED

    @property
    def words(self) -> tuple[tuple[int, ...], ...]:
        """Words of the cycles."""
        return tuple(cycle.word for cycle in self.cycles)

    @property
    def quiet(self) -> bool:
        """Proven: from every state the jets end up off."""
        return self.decided and self.words == ((0,),)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        m = self.modulator
        given = {name: getattr(m, name) for name in ("km", "tau_m", "u_on", "h", "k", "delta", "Ts", "dead_low", "dead_high")}
        return {
            "decided": self.decided, "cycles": [cycle.to_dict() for cycle in self.cycles], "borders": [b.to_dict() for b in self.borders],
            "reason": self.reason, "unknown_fraction": max(0.0, 1.0 - sum(c.basin.fraction for c in self.cycles)),
            "r": self.r, "parameters": given, "m": m.m, "n": m.n,
        }  # fmt: skip

    def _repr_html_(self) -> str:
        rows = [(str(list(c.word)), float(c.period), c.mean, c.margin, c.basin.fraction) for c in self.cycles]
        state = "all steady outputs" if self.decided else f"undecided: {self.reason}"
        return f"<p>{state}</p>" + html_table(("word", "period", "mean", "margin", "basin"), rows)


def census(modulator: DiscretePWPF, r: float = 0.0) -> Census:
    """All steady outputs of the sampled modulator for a constant demand.

    Parameters
    ----------
    modulator : DiscretePWPF
        Any parameters that it accepts, n <= 0 (Ts >= 2 tau_m) included.
    r : float
        Demand.

    Returns
    -------
    Census

    Raises
    ------
    ModelError
        A demand that is not finite or beyond 1e100, or Ts so far from 2 tau_m that 1 - |n| < 1e-9.

    Notes
    -----
    All arithmetic is rounded outwards, and every step is widened by 8 units in the last place of the largest state: the answer holds for
    the exact parameters and for the modulator in floating point alike.  An orbit that comes nearer to a threshold than that, about
    1e-13 for ordinary parameters, makes the answer undecided.  Basins are measured without outward rounding, and up to four
    million intervals: what is left belongs to none.

    Source: the recursion of Lu & Zhang 2012 (paper 000), eq 3 and Fig. 7; the proof is this project's.
    """
    demand = as_scalar("census: r", r)
    rows = rows_of(modulator, demand)
    ((_, pieces, after, decided),) = levels(rows)
    final = final_cycles(after)
    heads = np.setdiff1d(final, [len(pieces.low)])
    basins = basins_of(modulator, float(modulator.f(demand)), rows[0], pieces, final, heads, decided=bool(decided[0]))
    cycles = [_cycle(modulator, demand, _outputs(pieces, after, int(head)), basin) for head, basin in zip(heads, basins, strict=True)]
    cycles.sort(key=lambda c: (c.period, c.word))
    if decided[0]:
        return Census(modulator, demand, True, tuple(cycles), "", ())
    return Census(modulator, demand, False, tuple(cycles), _reason(rows, pieces), tuple(_borders(rows, pieces, after)))


def rows_of(modulator: DiscretePWPF, r: float, **other: Any) -> Array:
    """Rows of interval parameters of a modulator; `other` replaces k, f, k_high or f_high, arrays give one row each."""
    f = modulator.f(r)
    slack = 2.0**-50 * (abs(r) + modulator.delta)  # roundings of f(r), large beside f where r and delta cancel
    given: dict[str, Any] = {"k": modulator.k, "f": f - slack, "f_high": f + slack, **other}
    return parameter_rows(km=modulator.km, tau_m=modulator.tau_m, u_on=modulator.u_on, h=modulator.h, Ts=modulator.Ts, **given)


def orbit_of(modulator: DiscretePWPF, word: Iterable[int], r: float = 0.0) -> Array:
    """Trigger inputs x of the one orbit that would have this periodic output, whether or not the trigger gives it, shape (period,).

    x_i = n x_{i-1} + m (2 f(r) - k (y_{i-1} + y_{i-2})), solved for the period.
    """
    y = np.array(list(word), dtype=float)
    drive = modulator.m * (2 * float(modulator.f(r)) - modulator.k * (np.roll(y, 1) + np.roll(y, 2)))
    n, period = modulator.n, len(y)
    x = np.empty(period)
    x[-1] = np.sum(drive * n ** np.arange(period - 1, -1, -1)) / (1 - n**period)
    for i in range(period):
        x[i] = n * x[i - 1] + drive[i]
    return frozen(x)


def margin_of(modulator: DiscretePWPF, word: Iterable[int], x: Array) -> float:
    """Least signed distance of x from the thresholds that bound its output: negative if the trigger would not give the word."""
    y = np.array(list(word))
    before = np.roll(y, 1)
    upper = np.where(before == 1, modulator.u_off, modulator.u_on)
    lower = np.where(before == -1, -modulator.u_off, -modulator.u_on)
    distance = np.where(y == 1, x - upper, np.where(y == -1, lower - x, np.minimum(upper - x, x - lower)))
    return float(distance.min())


def _cycle(modulator: DiscretePWPF, r: float, outputs: list[int], basin: Basin) -> Cycle:
    word = smallest_rotation(outputs)
    x = orbit_of(modulator, word, r)
    return Cycle(word, x, margin_of(modulator, word, x), basin)


def _outputs(pieces: Pieces, after: Ints, head: int) -> list[int]:
    word: list[int] = []
    now = head
    while not word or now != head:
        word.append(int(pieces.y[now]))
        now = int(after[now])
    return word


def _reason(rows: Array, pieces: Pieces) -> str:
    if unchanged(pieces, merged(children(rows, pieces)[0]), 1)[0]:
        return "an orbit meets a threshold as nearly as numbers of double precision can tell; move a parameter slightly"
    return (
        f"given up after {STEPS} steps or {WORK} pieces: the filter forgets so slowly (n = {rows[0, N_LOW]:.9g}) that the orbits are"
        " too long to be told apart; a sample time nearer to 2 tau_m is decided sooner"
    )


def _borders(rows: Array, pieces: Pieces, after: Ints) -> Iterable[Border]:
    """Pieces that have no successor, the narrowest first."""
    cut = np.flatnonzero(after[:-1] == len(pieces.low))
    cut = cut[np.argsort(pieces.high[cut] - pieces.low[cut], kind="stable")][:_BORDERS]
    low, high = image(rows, pieces.of(cut))
    for i, a, b in zip(cut.tolist(), low.tolist(), high.tolist(), strict=True):
        on, off = float(rows[0, ON]), 0.5 * float(rows[0, OFF_LOW] + rows[0, OFF_HIGH])
        y1 = int(pieces.y[i])
        thresholds = (off if y1 == 1 else on, -off if y1 == -1 else -on)
        nearest = min(thresholds, key=lambda t: max(a - t, t - b, 0.0))
        yield Border(y1, int(pieces.history[i] % 3) - 1, float(pieces.low[i]), float(pieces.high[i]), nearest)
