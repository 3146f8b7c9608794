"""The Riccati equation as the linear flow of its Hamiltonian: the check of a sweep, and S at any time.

[X; Y]' = [[A, -W], [-Q, -A^T]] [X; Y],  S = Y X^-1.  The flow does not know how large S is, so a heavy terminal weight, which
makes S fall within a tiny part of a step, needs no small steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from models.checked import Array, frozen
from ocp.sweep_grid import NodeData, Steps, interpolated, lagrange, placed

# Butcher 1964 (J. Austral. Math. Soc. 4, 179): six stages, order five, abscissae 0 1/4 1/4 1/2 3/4 1.
STAGE = (0, 1, 1, 2, 3, 4)
ROWS = ((), (1 / 4,), (1 / 8, 1 / 8), (0, -1 / 2, 1), (3 / 16, 0, 0, 9 / 16), (-3 / 7, 2 / 7, 12 / 7, -12 / 7, 8 / 7))
WEIGHTS = (7 / 90, 0, 32 / 90, 12 / 90, 32 / 90, 7 / 90)


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """Columns [X; Y] of two half steps, from X = diag(d), Y = S diag(d) at the later end: d is free, and gives S unit diagonal.

    Attributes
    ----------
    known : ndarray, shape (6, nb, 2 n, n)
        Values, then rates times the duration of the step, at 0 (the later end), 1/2 and 1.
    inverse, S : ndarray, shape (nb, n, n)
        Of X at 1, and S there.
    d : ndarray, shape (nb, n)
    """

    known: Array
    inverse: Array
    S: Array
    d: Array


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """The columns of a check between its values, as polynomials of degree five.

    Attributes
    ----------
    powers : ndarray, shape (6, nb, 2 n, n)
        Of the part of the step, 0 at the later end.
    X, Y, inverse, S : ndarray, shape (5, nb, n, n)
        At 0, 1/4, ..., 1; the inverse of X.
    d : ndarray, shape (nb, n)
    """

    powers: Array
    X: Array
    Y: Array
    inverse: Array
    S: Array
    d: Array

    @property
    def loop(self) -> Array:
        """Closed loop from the begin of each step to its end, (nb, n, n)."""
        return self.d[:, :, None] * self.inverse[-1]


def _symmetric(value: Array) -> Array:
    return np.asarray(0.5 * (value + np.swapaxes(value, -1, -2)))


def _inverse(X: Array) -> Array:
    """Inverses of X (..., n, n), NaN where there is none; rows are brought to one size first, so that units do not matter."""
    size = np.abs(X).max(axis=-1)
    good = (np.isfinite(size) & (size > 0)).all(axis=-1)
    scaled = X / np.where(good[..., None], size, 1.0)[..., :, None]
    scaled[~good] = np.eye(X.shape[-1])
    try:
        found = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:  # one of them is singular to the last bit
        good &= np.linalg.slogdet(scaled)[0] != 0
        scaled[~good] = np.eye(X.shape[-1])
        found = np.linalg.inv(scaled)
    found /= size[..., None, :]
    found[~good] = np.nan
    return np.asarray(found, dtype=np.float64)


def unit_scale(size: Array, floor: Array | float = 0.0) -> Array:
    """1/sqrt of a diagonal, not below `floor`; one where both are zero."""
    held = np.maximum(size, floor)
    return np.asarray(1.0 / np.sqrt(np.where(held > np.finfo(float).tiny, held, 1.0)))


def runge_kutta(rate: Callable[[int, Array], Array], y: Array, h: Array) -> tuple[Array, Array]:
    """y after a step h (nb,) of the axis before the last two, and the rate at its start."""
    stages: list[Array] = []
    width = h[:, None, None]
    for row, j in zip(ROWS, STAGE, strict=True):
        value = y
        for a, k in zip(row, stages, strict=True):
            value = value + (width * a) * k if a else value
        stages.append(rate(j, value))
    return np.asarray(y + width * sum((w * k for w, k in zip(WEIGHTS, stages, strict=True) if w), np.zeros(1))), stages[0]


@lru_cache(maxsize=1)
def _hermite() -> Array:
    """Powers (6, 6) of the quintic from its values, then its slopes, at 0, 1/2 and 1: whole numbers."""
    powers, at = np.arange(6), np.array([0.0, 0.5, 1.0])[:, None]
    slope = np.zeros((3, 6))
    slope[:, 1:] = powers[1:] * at ** powers[:-1]
    return np.asarray(np.round(np.linalg.inv(np.vstack([at**powers, slope]))))


def check(steps: Steps, S: Array, floor: Array) -> Check:
    """Two half steps from S (nb, n, n) at the later end of each step; `floor` (n,) holds the scales where S vanishes."""
    c, n = steps.values, S.shape[-1]
    H = np.empty((*c.A.shape[:-2], 2 * n, 2 * n))
    H[..., :n, :n], H[..., :n, n:], H[..., n:, :n], H[..., n:, n:] = -c.A, c.W, c.Q, np.swapaxes(c.A, -1, -2)
    d = unit_scale(np.abs(np.diagonal(S, axis1=1, axis2=2)), floor)
    start = np.concatenate([np.eye(n) * d[:, None, :], S * d[:, None, :]], axis=1)
    centre, early = runge_kutta(lambda j, y: H[:, j] @ y, start, 0.5 * steps.h)
    end, middle = runge_kutta(lambda j, y: H[:, 4 + j] @ y, centre, 0.5 * steps.h)
    width = steps.h[:, None, None]
    known = np.stack([start, centre, end, width * early, width * middle, width * (H[:, 8] @ end)])
    last = _inverse(end[:, :n])
    return Check(known, last, _symmetric(end[:, n:] @ last), d)


def flow(found: Check) -> Flow:
    """A check with its polynomials."""
    n = found.d.shape[1]
    powers = np.tensordot(_hermite(), found.known, 1)
    XY = np.tensordot(np.linspace(0.0, 1.0, 5)[:, None] ** np.arange(6), powers, 1)
    X, Y = XY[:, :, :n], XY[:, :, n:]
    inverse = _inverse(X)
    return Flow(powers, X, Y, inverse, _symmetric(Y @ inverse), found.d)


def first_order(at: Flow, A: Array, W: Array, Q: Array) -> Array:
    """X^-T g X^-1 is the rate at which changes A, W, Q (..., 5, nb, n, n) of the coefficients drive S; this is g (..., 5, nb, n, n)."""
    X, Y, Xt, Yt = at.X, at.Y, np.swapaxes(at.X, -1, -2), np.swapaxes(at.Y, -1, -2)
    mixed = Yt @ A @ X
    return np.asarray(Xt @ Q @ X + mixed + np.swapaxes(mixed, -1, -2) - Yt @ W @ Y)


def interpolation_change(data: NodeData, steps: Steps, at: Flow) -> Array:
    """Change of S at the begin of each step (nb, n, n) when halved steps take cubics in place of quintics; zero for whole ones."""
    out = np.zeros(at.S.shape[1:])
    cut = steps.length < 4.0
    if cut.any():
        coarse, fine = placed(data, steps.begin[cut], steps.length[cut], points=5, width=4).values, steps.values
        part = Flow(at.powers[:, cut], at.X[:, cut], at.Y[:, cut], at.inverse[:, cut], at.S[:, cut], at.d[cut])
        change = [np.swapaxes(b - a[cut][:, ::2], 0, 1) for a, b in ((fine.A, coarse.A), (fine.W, coarse.W), (fine.Q, coarse.Q))]
        last = part.inverse[-1]
        out[cut] = np.abs(np.swapaxes(last, 1, 2) @ first_order(part, *change) @ last).max(axis=0) * steps.h[cut][:, None, None]
    return out


@lru_cache(maxsize=1)
def _partial_sums() -> Array:
    """Weights (5, 5): integrals from 0 to 0, 1/4, ..., 1 from the values there, by the quartic through them."""
    at, powers = np.linspace(0.0, 1.0, 5)[:, None], np.arange(5)
    return np.asarray(at ** (powers + 1) / (powers + 1) @ np.linalg.inv(at**powers))


def tangent_drive(steps: Steps, at: Flow) -> Array:
    """Integrals of the drive by dW and dQ over the parts 0, 1/4, ..., 1 of each step, (nw, 5, nb, n, n), in the columns of the flow."""
    dW, dQ = (np.swapaxes(v[:, :, ::2], 1, 2) for v in (steps.values.dW, steps.values.dQ))
    g = first_order(at, np.zeros_like(at.S), dW, dQ)
    return np.asarray(np.einsum("qp,wpbij->wqbij", _partial_sums(), g) * steps.h[:, None, None])


@dataclass(frozen=True, slots=True, eq=False)
class Dense:
    """Gains at any time: S from the flow that certified it, B and R by polynomials of degree five within a segment.

    Attributes
    ----------
    t : ndarray, shape (N,)
    begin, length, h : ndarray, shape (nb,)
        Steps in rising time: node index and s at which each begins, intervals and s that it lasts.
    powers, gap : ndarray, shapes (6, nb, 2 n, n), (nb, n, n)
        Flow, and what S at the begin of a step has beyond it: it fades towards the later end.
    B, R : ndarray, shapes (N, n, nu), (N, nu, nu) or (nu, nu)
    K, k : ndarray, shapes (N, nu, nx), (N, nu)
        On the nodes.  With n = nx + 1 the last state is the constant one, whose gain is k.
    """

    t: Array
    begin: Array
    length: Array
    h: Array
    powers: Array
    gap: Array
    B: Array
    R: Array
    K: Array
    k: Array

    def __post_init__(self) -> None:
        for name in ("t", "begin", "length", "h", "powers", "gap", "B", "R", "K", "k"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def made(self, t: Array, K: Array, k: Array) -> bool:
        """Whether these are the gains of this sweep."""
        return all(np.array_equal(a, b) for a, b in ((t, self.t), (K, self.K), (k, self.k)))

    def at(self, times: Array) -> tuple[Array, Array]:
        """K (M, nu, nx) and k (M, nu) at times within the nodes; at a jump after it."""
        later = self.begin + self.length
        node = np.ceil(later).astype(int)
        end = self.t[node] - (node - later) * (self.h / self.length)  # a node to the last bit: S may change fast after it
        i = np.minimum(np.searchsorted(end, times, side="right"), len(end) - 1)
        back = np.clip((end[i] - times) / self.h[i], 0.0, 1.0)
        n = self.powers.shape[-1]
        XY = np.einsum("mp,pmij->mij", back[:, None] ** np.arange(6), self.powers[:, i])
        S = _symmetric(XY[:, n:] @ _inverse(XY[:, :n])) + back[:, None, None] * self.gap[i]
        matrix = lagrange(self.t, later[i] - self.length[i] * back, 6)
        B = interpolated(matrix, self.B)
        R = interpolated(matrix, self.R) if self.R.ndim == 3 else self.R
        gain = np.asarray(np.linalg.solve(R, np.swapaxes(B, 1, 2) @ S), dtype=np.float64)
        nx = self.K.shape[2]
        return gain[..., :nx], gain[..., nx] if n > nx else np.zeros(gain.shape[:2])
