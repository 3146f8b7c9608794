"""Choice of (k, delta) of the sampled modulator: no cycle at rest anywhere near, proven, and the most linear duty cycle there.

The proof is the census with whole intervals for k and delta: a box of the plane in which it finds {0} alone has no other steady output at
any point.  Boxes that it cannot decide are divided.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.census import rows_of
from models.census_map import distinct
from models.census_native import words_of
from models.census_pieces import DECIDED
from models.checked import Array, ModelError, as_finite, frozen
from models.modulators import DiscretePWPF
from models.modulators_runs import run
from models.modulators_static import sampled_duty

Ints = NDArray[np.int64]
PROVEN, REFUTED, OPEN = 1, 0, -1
_DEPTH = 9  # halvings of both sides of a box
_BOXES = 400_000  # at one time
_SETTLE, _COUNT = 600, 3000  # samples before and in a mean output that only ranks candidates


@dataclass(frozen=True, slots=True, eq=False)
class Margin:
    """How far k and delta may move, in multiples of given steps, before there is a cycle at rest.

    Attributes
    ----------
    proven : float
        In the box k +- proven step_k, delta +- proven step_delta every orbit ends with the jets off, proven by interval arithmetic.
    refuted : float
        Somewhere in the box of this size there is a cycle; infinity if none was found up to `most`.
    word : tuple of int or None
        That cycle.
    at : tuple of float or None
        Its (k, delta).
    """

    proven: float
    refuted: float
    word: tuple[int, ...] | None
    at: tuple[float, float] | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; infinity as null."""
        return {"proven": self.proven, "refuted": self.refuted if np.isfinite(self.refuted) else None,
                "word": None if self.word is None else list(self.word), "at": None if self.at is None else list(self.at)}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Linearity:
    """Duty cycle against the demand over [-1, 1].

    Attributes
    ----------
    error : float
        Root mean square of duty - r: the static tracking error.
    slope : float
        Of the best straight line.
    bend : float
        Root mean square distance from that line.
    r, duty : ndarray, shape (N,)
    """

    error: float
    slope: float
    bend: float
    r: Array
    duty: Array


@dataclass(frozen=True, slots=True, eq=False)
class QuietDesign:
    """A modulator without cycles at rest.

    Attributes
    ----------
    modulator : DiscretePWPF
    margin : Margin
        In multiples of the margins asked for: proven >= 1.
    linearity : Linearity
    k, delta : ndarray, shape (N,)
        All candidates.
    proven : ndarray of bool, shape (N,)
        Those that have the margin.
    error : ndarray, shape (N,)
        Static tracking error of these, estimated from 3000 samples; NaN for the others.
    """

    modulator: DiscretePWPF
    margin: Margin
    linearity: Linearity
    k: Array
    delta: Array
    proven: NDArray[np.bool_]
    error: Array


def prove_quiet(modulator: DiscretePWPF, k: tuple[float, float], delta: tuple[float, float]) -> int:
    """Whether every orbit at rest ends with the jets off, for all (k, delta) in a box.

    Returns
    -------
    int
        1 PROVEN; 0 REFUTED: there is a cycle at some point of the box; -1 OPEN after nine halvings of its sides.
    """
    low_high = as_finite("prove_quiet", [*k, *delta])
    if low_high[0] > low_high[1] or low_high[2] > low_high[3] or low_high[0] < 0:
        raise ModelError(f"prove_quiet: expected 0 <= k[0] <= k[1] and delta[0] <= delta[1], got k = {k}, delta = {delta}")
    return int(_states(modulator, low_high[None, :])[0])


def quiet_margin(modulator: DiscretePWPF, *, step_k: float = 0.01, step_delta: float = 0.001, most: float = 1000.0) -> Margin:
    """Largest box around (k, delta) without a cycle at rest, to one per cent, from below by proof and from above by a cycle in it.

    Parameters
    ----------
    modulator : DiscretePWPF
    step_k, step_delta : float
        Shape of the box, >= 0 and not both 0.  It is cut off at k = 0; delta below zero is as delta above, mirrored.
    most : float
        Size at which the search stops.
    """
    steps = as_finite("quiet_margin", [step_k, step_delta])
    if (steps < 0).any() or not steps.any():
        raise ModelError(f"quiet_margin: step_k = {step_k:.6g}, step_delta = {step_delta:.6g}; expected >= 0 and not both 0")
    state = {size: int(_states(modulator, _box(modulator, steps, size))[0]) for size in (0.0, most)}
    if state[0.0] != PROVEN:
        word, at = _cycle_near(modulator, steps, 0.0)
        return Margin(0.0, 0.0, word, at)
    if state[most] == PROVEN:
        return Margin(most, float("inf"), None, None)
    low, high = 0.0, most
    while high - low > 0.01 * high and high > 1e-9 * most:
        size = 0.5 * (low + high) if low > 0.01 * high else 0.1 * high
        if _states(modulator, _box(modulator, steps, size))[0] == PROVEN:
            low = size
        else:
            high = size
    for size in high * 1.005 ** np.arange(1, 200):
        word, at = _cycle_near(modulator, steps, float(size))
        if word is not None:
            return Margin(low, float(size), word, at)
    return Margin(low, float("inf"), None, None)


def linearity(modulator: DiscretePWPF, *, demands: int = 81) -> Linearity:
    """Static characteristic from rest over r in [-1, 1], and how far it is from a straight line."""
    r = np.linspace(-1.0, 1.0, demands)
    duty = sampled_duty(modulator, r).duty
    slope, offset = np.polyfit(r, duty, 1)
    bend = float(np.sqrt(np.mean((duty - slope * r - offset) ** 2)))
    return Linearity(float(np.sqrt(np.mean((duty - r) ** 2))), float(slope), bend, frozen(r), frozen(duty))


def design_quiet(
    modulator: DiscretePWPF, *, k: tuple[float, float] = (0.3, 1.5), delta: tuple[float, float] | None = None,
    margin_k: float = 0.01, margin_delta: float = 0.001, points: tuple[int, int] = (61, 26), demands: int = 41,
) -> QuietDesign:  # fmt: skip
    """The (k, delta) of least static tracking error among those that keep a proven margin from every cycle at rest.

    Parameters
    ----------
    modulator : DiscretePWPF
        The other parameters.
    k, delta : (float, float)
        Range of the search; delta from 0 to a quarter of its upper bound u_on/km unless given.
    margin_k, margin_delta : float
        The box around the answer in which no cycle may exist.
    points : (int, int)
        Grid of candidates.
    demands : int
        Constant demands in [-1, 1] of which the error is measured.

    Raises
    ------
    ModelError
        No candidate has the margin.

    Notes
    -----
    The proof is complete (interval arithmetic over the box); the best of the grid is not the best of the plane.
    Source: the choice of schemes a and b in Lu & Zhang 2012 (paper 000), section 2.2, made by rule.
    """
    k_range = _range("k", k)
    d_range = _range("delta", delta if delta is not None else (0.0, 0.25 * modulator.u_on / modulator.km))
    gains, offsets = (a.ravel() for a in np.meshgrid(np.linspace(*k_range, points[0]), np.linspace(*d_range, points[1]), indexing="ij"))
    steps = as_finite("design_quiet: margins", [margin_k, margin_delta])
    if (steps < 0).any():
        raise ModelError(f"design_quiet: margins {margin_k:.6g} and {margin_delta:.6g}; expected >= 0")
    boxes = np.stack([np.maximum(gains - margin_k, 0), gains + margin_k, offsets - margin_delta, offsets + margin_delta], axis=1)
    proven = _states(modulator, boxes) == PROVEN
    if not proven.any():
        raise ModelError(
            f"design_quiet: no (k, delta) in k = {k_range}, delta = {d_range} keeps the margin ({margin_k:.6g}, {margin_delta:.6g}) from"
            " every cycle; widen the range, or ask for a smaller margin"
        )
    error = np.full(len(gains), np.nan)
    error[proven] = _errors(modulator, gains[proven], offsets[proven], demands)
    best = int(np.nanargmin(error))
    chosen = replace(modulator, k=float(gains[best]), delta=float(offsets[best]))
    margin = quiet_margin(chosen, step_k=margin_k, step_delta=margin_delta) if steps.any() else Margin(0.0, 0.0, None, None)
    return QuietDesign(chosen, margin, linearity(chosen), frozen(gains), frozen(offsets), proven, frozen(error))


def _range(name: str, values: tuple[float, float]) -> tuple[float, float]:
    ends = as_finite(f"design_quiet: {name}", values)
    if ends.shape != (2,) or not 0 <= ends[0] <= ends[1]:
        raise ModelError(f"design_quiet: {name}: expected 0 <= low <= high, got {values}")
    return float(ends[0]), float(ends[1])


def _box(modulator: DiscretePWPF, steps: Array, size: float) -> Array:
    """[k_low, k_high, delta_low, delta_high] as one row."""
    dk, dd = steps * size
    return np.array([[max(modulator.k - dk, 0.0), modulator.k + dk, modulator.delta - dd, modulator.delta + dd]])


def _states(modulator: DiscretePWPF, boxes: Array) -> Ints:
    """PROVEN, REFUTED or OPEN for each box [k_low, k_high, delta_low, delta_high], shape (B,)."""
    state = np.full(len(boxes), PROVEN)
    owner, open_boxes = np.arange(len(boxes)), boxes
    for depth in range(_DEPTH + 1):
        quiet, cycling = _judged(modulator, open_boxes)
        middle = 0.5 * (open_boxes[:, [0, 2]] + open_boxes[:, [1, 3]])
        centre = np.stack([middle[:, 0], middle[:, 0], middle[:, 1], middle[:, 1]], axis=1)
        cycling[~quiet] |= _judged(modulator, centre[~quiet])[1]
        state[owner[cycling]] = REFUTED
        left = ~quiet & (state[owner] == PROVEN)
        if not left.any():
            return state
        owner, open_boxes, middle = np.repeat(owner[left], 4), open_boxes[left], middle[left]
        if depth == _DEPTH or len(owner) > _BOXES:
            break
        (a, b, c, d), (m, n) = open_boxes.T, middle.T
        quarters = [np.stack(part, axis=1) for part in ((a, m, c, n), (m, b, c, n), (a, m, n, d), (m, b, n, d))]
        open_boxes = np.stack(quarters, axis=1).reshape(-1, 4)
    state[owner[state[owner] == PROVEN]] = OPEN
    return state


def _judged(modulator: DiscretePWPF, boxes: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(no cycle but {0} at any point, a cycle at every point) of each box."""
    if not len(boxes):
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    rows = rows_of(modulator, 0.0, k=boxes[:, 0], k_high=boxes[:, 1], f=boxes[:, 2], f_high=boxes[:, 3])
    found = words_of(rows)
    first = found.symbols[found.first]
    fires = (found.period > 1) | (first != 0)
    cycling = np.zeros(len(boxes), dtype=bool)
    cycling[found.point[fires]] = True
    return (found.outcome == DECIDED) & ~cycling, cycling


def _cycle_near(modulator: DiscretePWPF, steps: Array, size: float) -> tuple[tuple[int, ...] | None, tuple[float, float] | None]:
    """A cycle on the border of the box of this size, and its (k, delta)."""
    k_low, k_high, d_low, d_high = _box(modulator, steps, size)[0]
    along = np.linspace(0.0, 1.0, 65)
    ks, ds = k_low + (k_high - k_low) * along, d_low + (d_high - d_low) * along
    gains = np.concatenate([ks, ks, np.full(65, k_low), np.full(65, k_high)])
    offsets = np.concatenate([np.full(65, d_low), np.full(65, d_high), ds, ds])
    found = words_of(rows_of(modulator, 0.0, k=gains, f=offsets, f_high=None))
    words, which = distinct(found)
    for cycle, number in enumerate(which):
        if words[number] != (0,):
            point = found.point[cycle]
            return words[number], (float(gains[point]), float(offsets[point]))
    return None, None


def _errors(modulator: DiscretePWPF, gains: Array, offsets: Array, demands: int) -> Array:
    """Static tracking error of each (k, delta) from the mean of some thousand samples, shape (N,)."""
    r = np.linspace(-1.0, 1.0, demands)
    out = np.empty(len(gains))
    for i, (k, delta) in enumerate(zip(gains.tolist(), offsets.tolist(), strict=True)):
        chosen = replace(modulator, k=k, delta=delta)
        y = run(chosen, np.repeat(r[:, None], _SETTLE + _COUNT, axis=1)).y
        out[i] = np.sqrt(np.mean((y[:, _SETTLE:].mean(axis=1) - r) ** 2))
    return out
