"""Time-varying linear-quadratic gains: continuous along a trajectory, discrete, and their exact sensitivity to the weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, frozen
from ocp.gains import Certificate, Gains
from ocp.linearize import Linearization
from ocp.riccati import ACCEPT, jacobi_scale, matrix, packed_places, positive_definite, positive_semidefinite, symmetric
from ocp.sweep import riccati_sweep, run
from ocp.sweep_flow import Dense
from ocp.sweep_grid import Coefficients, NodeData

LOCAL_ACCEPT = 1e-3  # largest local residual; sweeps aim at 1e-8 and report what they reach


class CertificateError(ModelError):
    """Gains were computed but cannot be certified; the message gives the reason and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Variation:
    """A direction in the space of weights; each part (n, n) or (N, n, n), or None for zero.  Qf is (nx, nx)."""

    Q: ArrayLike | None = None
    R: ArrayLike | None = None
    Qf: ArrayLike | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Exact derivatives of time-varying gains with respect to weights.

    Attributes
    ----------
    t : ndarray, shape (N,)
    names : tuple of str, length nw
        ``Q[V]``, ``R[bank]``, ``Qf[h]`` for the diagonal entries, or the names of the variations.
    dK : ndarray, shape (nw, N, nu, nx)
        Derivative of K by the weight (along the variation).
    weight : ndarray, shape (nw,)
        Value of the weight; 1 for a variation.
    """

    t: Array
    names: tuple[str, ...]
    dK: Array
    weight: Array

    @property
    def log_dK(self) -> Array:
        """Change of K for a relative change of the weight, dK / d ln(weight), shape (nw, N, nu, nx)."""
        return self.weight[:, None, None, None] * self.dK


def tvlqr(lin: Linearization, *, Q: ArrayLike, R: ArrayLike, Qf: ArrayLike) -> Gains:
    """Time-varying LQR along a trajectory: minimize dx^T Qf dx at the end + integral of dx^T Q dx + du^T R du.

    -S' = S A + A^T S - S B R^-1 B^T S + Q,  S(t_f) = Qf,  K = R^-1 B^T S;
    -s' = (A - B K)^T s + S c,  s(t_f) = 0,  k = R^-1 B^T s;  u = u0 - k - K (x - x0).

    Parameters
    ----------
    lin : Linearization
        At least 5 nodes; 4 k equal intervals between jumps, a node at a jump stored twice.
    Q : array_like, shape (nx, nx) or (N, nx, nx)
        State weight, symmetric, >= 0.
    R : array_like, shape (nu, nu) or (N, nu, nu)
        Input weight, symmetric, > 0.
    Qf : array_like, shape (nx, nx)
        Terminal weight, symmetric, >= 0.

    Returns
    -------
    Gains
        On the nodes of `lin`; ``certificate.riccati_residual`` is the defect of :func:`ocp.sweep.riccati_sweep`.

    Raises
    ------
    ModelError
        A weight of wrong shape, sign or symmetry, an unsuitable grid, or no certificate (defect above 1e-6, S not
        positive semidefinite), with the reason.

    Source
    ------
    Bryson & Ho, Applied Optimal Control, 1975, sections 5.2-5.3.
    """
    q, r, qf = _weights(lin, Q, R, Qf)
    n = lin.A.shape[-1]
    A, B = lin.A, lin.B
    affine = bool(lin.c.any())
    if affine:
        # One more state, the constant 1, carries the defect: its Riccati row is s, and no second equation is needed.
        A, B, q, qf = (_bordered(v, rows, columns) for v, rows, columns in ((A, 1, 1), (B, 1, 0), (q, 1, 1), (qf, 1, 1)))
        A[:, :n, n] = lin.c
    none = np.zeros((0, *A.shape))
    data = NodeData(lin.t, Coefficients(A, *_input_terms(B, r), np.broadcast_to(q, A.shape), none, none))
    solution = riccati_sweep(data, qf[None])
    S = solution.S[:, :n, :n]
    gain = _solve(r, np.swapaxes(B, 1, 2) @ solution.S)
    k = gain[..., n] if affine else np.zeros(gain.shape[:2])
    certificate = certify(S, solution.defect, solution.scale[:n], solution.local)
    K, taken, flow = gain[..., :n], solution.steps, solution.flow
    steps = (taken.begin[::-1], taken.length[::-1], taken.h[::-1])
    between = Dense(lin.t, *steps, flow.powers[:, ::-1], solution.gap[::-1], B, r, K, k)
    return Gains(lin.t, K, k, S, lin.x0, lin.u0, certificate, lin.states, lin.inputs, between)


def _weights(lin: Linearization, Q: ArrayLike, R: ArrayLike, Qf: ArrayLike) -> tuple[Array, Array, Array]:
    count, n, m = lin.B.shape
    if count == 1:
        raise ModelError("tvlqr: this is the linearization of a point; use lqr, or linearize along a trajectory")
    q = positive_semidefinite("Q", _per_node("Q", Q, count, n), n)
    r = positive_definite("R", _per_node("R", R, count, m), m)
    return q, r, positive_semidefinite("Qf", matrix("Qf", Qf, (n, n)), n)


def _per_node(name: str, value: ArrayLike, count: int, n: int) -> Array:
    out = as_finite(name, value)
    if out.ndim == 0 and n == 1:
        out = out.reshape(1, 1)
    if out.shape not in ((n, n), (count, n, n)):
        raise ModelError(f"{name}: expected shape ({n}, {n}) or, for each of the nodes, ({count}, {n}, {n}), got {out.shape}")
    return out


def _bordered(values: Array, rows: int, columns: int) -> Array:
    pad = [(0, 0)] * (values.ndim - 2) + [(0, rows), (0, columns)]
    return np.pad(values, pad)


def _input_terms(B: Array, r: Array) -> tuple[Array, Array]:
    """L and W with W = B R^-1 B^T = L L^T: the sweep uses L, its check uses W found on its own."""
    bt = np.swapaxes(B, -1, -2)
    return np.swapaxes(_solve(np.asarray(np.linalg.cholesky(r), dtype=np.float64), bt), -1, -2), B @ _solve(r, bt)


def _solve(r: Array, values: Array) -> Array:
    """r^-1 values for values (N, m, n); a constant r is factorized once."""
    if r.ndim == 3:
        return np.asarray(np.linalg.solve(r, values), dtype=np.float64)
    count, m, n = values.shape
    columns = np.moveaxis(values, 0, 1).reshape(m, count * n)
    solved = np.asarray(np.linalg.solve(r, columns), dtype=np.float64)
    return np.moveaxis(solved.reshape(m, count, n), 1, 0)


def certify(S: Array, residual: float, scale: Array, local: float | None = None) -> Certificate:
    """Certificate of swept S (N, n, n), or CertificateError; `scale` (n,) makes the largest S_ii one, `local` is the local residual."""
    ends = S[::-4] if len(S) > 64 else S  # every step of a long sweep, last node included; eigenvalues are the dear part
    low = float(np.linalg.eigvalsh(ends * scale[:, None] * scale).min())
    own = jacobi_scale(ends)
    eigenvalues = np.linalg.eigvalsh(ends * own[..., :, None] * own[..., None, :])
    smallest = eigenvalues[..., 0]
    floor = np.finfo(float).eps * eigenvalues[..., -1]
    with np.errstate(divide="ignore"):
        condition = float(np.where(smallest > floor, eigenvalues[..., -1] / np.where(smallest > floor, smallest, 1.0), np.inf).max())
    if not residual <= ACCEPT:
        raise CertificateError(
            f"no certificate: the Riccati defect is {residual:.3g}, allowed is {ACCEPT:g}; the closed loop or the reference"
            " changes too fast for these nodes: use finer nodes, or lower Qf and Q, or raise R"
        )
    if local is not None and not local <= LOCAL_ACCEPT:
        raise CertificateError(
            f"no certificate: where S is small the Riccati defect is {local:.3g} of it, allowed is {LOCAL_ACCEPT:g}; the gains are wrong"
            " there: use finer nodes, or lower Qf, or raise Q"
        )
    if low < -1e-8:
        raise CertificateError(
            f"no certificate: S has the scaled eigenvalue {low:.3g}, expected >= 0; the weights span too many orders of"
            " magnitude for this horizon: bring Q, Qf and R closer together"
        )
    return Certificate(residual, low, condition, local_residual=local)


def tvlqr_sensitivity(
    lin: Linearization, *, Q: ArrayLike, R: ArrayLike, Qf: ArrayLike, variations: Mapping[str, Variation] | None = None
) -> Sensitivity:
    """Exact derivatives of the gains of :func:`tvlqr` with respect to its weights, by differentiating the sweep.

    Parameters
    ----------
    lin, Q, R, Qf
        As for :func:`tvlqr`.
    variations : mapping of str to Variation, optional
        Directions; default every diagonal entry of Q, R and Qf.  With Q given for each node an entry is shifted at
        all nodes alike, and its ``weight`` is the entry's mean.

    Returns
    -------
    Sensitivity

    Raises
    ------
    ModelError
        As for :func:`tvlqr`; an empty mapping, or a variation of wrong shape.
    """
    q, r, qf = _weights(lin, Q, R, Qf)
    count, n, m = lin.B.shape
    if variations is not None and not variations:
        raise ModelError("variations: the mapping is empty; name at least one direction, or leave it out for all diagonal entries")
    chosen, weight = _entries(lin, q, r, qf) if variations is None else (dict(variations), np.ones(len(variations)))
    zero = {"Q": (n, (count, n, n)), "R": (m, (count, m, m)), "Qf": (n, (n, n))}
    parts: dict[str, Array] = {}
    for part, (size, shape) in zero.items():
        given = [(name, getattr(v, part)) for name, v in chosen.items()]
        stack = [np.zeros(shape) if v is None else symmetric(f"{name}: {part}", v, size) for name, v in given]
        for (name, _), value in zip(given, stack, strict=True):
            if value.shape not in (shape, shape[-2:]):
                raise ModelError(f"variations: {name}: {part}: expected shape {shape[-2:]} or {shape}, got {value.shape}")
        parts[part] = np.stack([np.broadcast_to(v, shape) for v in stack])
    bt = np.swapaxes(lin.B, 1, 2)
    L, W = _input_terms(lin.B, r)
    solved = _solve(r, bt)
    dW = -np.swapaxes(solved, 1, 2) @ parts["R"] @ solved
    data = NodeData(lin.t, Coefficients(lin.A, L, W, np.broadcast_to(q, lin.A.shape), dW, parts["Q"]))
    solution = riccati_sweep(data, np.concatenate([qf[None], parts["Qf"]]))
    K = _solve(r, bt @ solution.S)
    certify(solution.S, solution.defect, solution.scale, solution.local)
    dK = np.linalg.solve(r, bt @ solution.dS - parts["R"] @ K)
    return Sensitivity(lin.t, tuple(chosen), frozen(dK), frozen(weight))


def _entries(lin: Linearization, q: Array, r: Array, qf: Array) -> tuple[dict[str, Variation], Array]:
    n, m = lin.B.shape[1:]
    states = [v.name for v in lin.states] or [f"x{i + 1}" for i in range(n)]
    inputs = [v.name for v in lin.inputs] or [f"u{i + 1}" for i in range(m)]
    chosen: dict[str, Variation] = {}
    weight: list[float] = []
    for part, value, names in (("Q", q, states), ("R", r, inputs), ("Qf", qf, states)):
        for i, name in enumerate(names):
            unit = np.zeros((len(names), len(names)))
            unit[i, i] = 1.0
            chosen[f"{part}[{name}]"] = Variation(**{part: unit})
            weight.append(float(np.mean(value[..., i, i])))
    return chosen, np.array(weight)


@lru_cache(maxsize=32)
def _discrete_steps(n: int, m: int, count: int) -> ca.Function:
    size = n * (n + 1) // 2
    rows, columns = np.triu_indices(n)
    z, d, h = ca.SX.sym("z", size), ca.SX.sym("d", 2 * n * n + n * m + m * m), ca.SX.sym("h")
    S = ca.reshape(z[[int(i) for i in packed_places(n).ravel()]], n, n)
    A, B, Q, R = (ca.reshape(part, *shape) for part, shape in zip(
        ca.vertsplit(d, [0, n * n, n * n + n * m, 2 * n * n + n * m, 2 * n * n + n * m + m * m]),
        ((n, n), (n, m), (n, n), (m, m)), strict=True,
    ))  # fmt: skip
    cross = ca.mtimes([B.T, S, A])
    # Cholesky and substitution: exact, small, and symmetric by construction.
    half = ca.solve(ca.chol(R + ca.mtimes([B.T, S, B])).T, cross)
    before = ca.mtimes([A.T, S, A]) - ca.mtimes(half.T, half) + Q
    upper = [int(i) for i in rows + n * columns]
    step = ca.Function("discrete_riccati_step", [z, d, h], [ca.densify(before)[upper]], ["z", "data", "h"], ["before"])
    return step.mapaccum("discrete_riccati_sweep", count, {"base": -1})


def dtvlqr(
    A: ArrayLike, B: ArrayLike, *, Q: ArrayLike, R: ArrayLike, Qf: ArrayLike, c: ArrayLike | None = None, t: ArrayLike | None = None
) -> Gains:
    """Time-varying LQR of x_{i+1} = A_i x_i + B_i u_i + c_i over N - 1 steps.

    S_i = Q + A^T S A - A^T S B (R + B^T S B)^-1 B^T S A with S = S_{i+1}, S_{N-1} = Qf;
    u_i = -k_i - K_i x_i,  K_i = (R + B^T S B)^-1 B^T S A.

    Parameters
    ----------
    A, B : array_like, shapes (N - 1, n, n), (N - 1, n, m)
    Q, R : array_like, shapes (n, n), (m, m), or with a leading axis N - 1
        Cost of each step; Q >= 0, R > 0.
    Qf : array_like, shape (n, n)
        Cost of the last state, >= 0.
    c : array_like, shape (N - 1, n), optional
        Known disturbance of each step.
    t : array_like, shape (N,), optional
        Times of the states, s; default 0, 1, ..., N - 1.

    Returns
    -------
    Gains
        N nodes; at the last one no control acts and K, k repeat their last value.  The Riccati residual of the
        certificate is the relative difference of each S from the cost of its closed loop,
        Q + K^T R K + (A - B K)^T S_{i+1} (A - B K), computed apart from the sweep.

    Raises
    ------
    ModelError
        Wrong shapes, signs or symmetry, no steps, or no certificate.
    """
    a, b = as_finite("A", A), as_finite("B", B)
    if a.ndim != 3 or a.shape[1] != a.shape[2] or 0 in a.shape:
        raise ModelError(f"A: expected shape (N - 1, n, n) with at least one step, got {a.shape}")
    steps, n, _ = a.shape
    if b.ndim != 3 or b.shape[:2] != (steps, n) or 0 in b.shape:
        raise ModelError(f"B: expected shape ({steps}, {n}, m), got {b.shape}; one matrix for each step of A")
    m = b.shape[2]
    q = positive_semidefinite("Q", _per_node("Q", Q, steps, n), n)
    r = positive_definite("R", _per_node("R", R, steps, m), m)
    qf = positive_semidefinite("Qf", matrix("Qf", Qf, (n, n)), n)
    times = np.arange(steps + 1.0) if t is None else matrix("t", t, (steps + 1,))
    offset = np.zeros((steps, n)) if c is None else matrix("c", c, (steps, n))
    if offset.any():
        a, b, q, qf = (_bordered(v, rows, columns) for v, rows, columns in ((a, 1, 1), (b, 1, 0), (q, 1, 1), (qf, 1, 1)))
        a[:, :n, n], a[:, n, n] = offset, 1.0
    full_q, full_r = np.broadcast_to(q, a.shape), np.broadcast_to(r, (steps, m, m))
    S = _discrete_sweep(a, b, full_q, full_r, qf)
    after, bt = S[1:], np.swapaxes(b, 1, 2)
    K = np.linalg.solve(full_r + bt @ after @ b, bt @ after @ a)
    closed = a - b @ K
    cost = full_q + np.swapaxes(K, 1, 2) @ full_r @ K + np.swapaxes(closed, 1, 2) @ after @ closed
    largest = np.abs(np.diagonal(S, axis1=1, axis2=2)).max(axis=0)
    scale = 1.0 / np.sqrt(np.where(largest > np.finfo(float).tiny, largest, 1.0))
    residual = float(np.abs((cost - S[:-1]) * scale[:, None] * scale).max())
    certificate = certify(S[:, :n, :n], residual, scale[:n])
    k = K[..., n] if offset.any() else np.zeros((steps, m))
    gain, feed = (np.concatenate([v, v[-1:]]) for v in (K[..., :n], k))
    return Gains(times, gain, feed, S[:, :n, :n], np.zeros((steps + 1, n)), np.zeros((steps + 1, m)), certificate)


def _discrete_sweep(a: Array, b: Array, q: Array, r: Array, qf: Array) -> Array:
    steps, n, m = b.shape
    rows, columns = np.triu_indices(n)
    # Column-major blocks, latest step first, as the reshapes of the step function read them.
    data = np.hstack([np.swapaxes(v, 1, 2).reshape(steps, -1) for v in (a, b, q, r)])[::-1]
    out = run(_discrete_steps(n, m, steps), qf[rows, columns], data, np.ones(steps))
    if not np.isfinite(out).all():
        raise ModelError("dtvlqr: the Riccati solution is not finite; an unstable mode out of reach of the input grows past overflow")
    S = np.empty((steps + 1, n, n))
    S[-1] = qf
    S[-2::-1, rows, columns] = out
    S[-2::-1, columns, rows] = out
    return S
