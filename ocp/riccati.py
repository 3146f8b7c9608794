"""Algebraic Riccati and Lyapunov equations, each answer with the residual of its own equation."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sla
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, as_finite, frozen

# Weights computed in large units (1e12) carry rounding asymmetry; only the relative size tells it from an error.
SYMMETRY = 1e-8
ACCEPT = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MatrixSolution:
    """Solution of a matrix equation with its proof.

    Attributes
    ----------
    S : ndarray, shape (n, n)
        The symmetric solution.
    residual : float
        Largest element of the equation's residual over the largest element of its terms, both in the coordinates in
        which S has unit diagonal (so that units do not matter).
    eigenvalues : ndarray of complex, shape (n,)
        Closed-loop eigenvalues for a Riccati equation, those of A for a Lyapunov equation.
    """

    S: Array
    residual: float
    eigenvalues: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "S", frozen(self.S))
        eigenvalues = np.array(self.eigenvalues, dtype=complex)
        eigenvalues.flags.writeable = False
        object.__setattr__(self, "eigenvalues", eigenvalues)


def matrix(name: str, value: object, shape: tuple[int | None, ...]) -> Array:
    """Checked float array of the given shape; None leaves a size free, a scalar stands for a (1, 1) matrix."""
    out = as_finite(name, value)
    if out.ndim == 0 and len(shape) == 2:
        out = out.reshape(1, 1)
    fits = out.ndim == len(shape) and all(w is None or w == f for w, f in zip(shape, out.shape, strict=True))
    if not fits or 0 in out.shape:
        wanted = "(" + ", ".join("n" if w is None else str(w) for w in shape) + ")"
        raise ModelError(f"{name}: expected a matrix of shape {wanted}, got {out.shape}; check its rows and columns against A and B")
    return out


def square(name: str, value: object) -> Array:
    """Checked square matrix."""
    out = matrix(name, value, (None, None))
    if out.shape[0] != out.shape[1]:
        raise ModelError(f"{name}: expected a square matrix, got shape {out.shape}; give one row and one column for each state")
    return out


def symmetric(name: str, value: object, n: int) -> Array:
    """Symmetrized (..., n, n) matrix; refuses an asymmetry above 1e-8 of the element's own scale sqrt(|Q_ii Q_jj|)."""
    out = as_finite(name, value)
    if out.ndim < 2:
        out = matrix(name, value, (n, n))
    if out.shape[-2:] != (n, n):
        raise ModelError(f"{name}: expected shape ({n}, {n}), got {out.shape}; one row and one column for each variable")
    flipped = np.swapaxes(out, -1, -2)
    diagonal = np.sqrt(np.abs(np.diagonal(out, axis1=-2, axis2=-1)))
    scale = np.maximum(diagonal[..., :, None] * diagonal[..., None, :], np.maximum(np.abs(out), np.abs(flipped)))
    bad = np.argwhere(np.abs(out - flipped) > SYMMETRY * scale)
    if bad.size:
        at = tuple(int(i) for i in bad[0])
        where = "".join(f"[{i}]" for i in at)
        raise ModelError(
            f"{name}: must be symmetric, but {name}{where} = {out[at]:.6g} and its mirror element is {flipped[at]:.6g};"
            f" give ({name} + {name}^T)/2 if the difference is meant to be rounding"
        )
    return 0.5 * (out + flipped)


def positive_definite(name: str, value: object, n: int) -> Array:
    """Checked symmetric positive definite (..., n, n) matrix; the test is made in coordinates with unit diagonal."""
    out = symmetric(name, value, n)
    low, where = _lowest_eigenvalue(out)
    if low <= n * np.finfo(float).eps:
        raise ModelError(
            f"{name}: must be positive definite, but its smallest eigenvalue is {_raw_lowest(out, where):.6g}"
            f"{_node(where)}; every input needs a positive cost"
        )
    return out


def positive_semidefinite(name: str, value: object, n: int) -> Array:
    """Checked symmetric positive semidefinite (..., n, n) matrix; rounding below 1e-10 of the diagonal is accepted."""
    out = symmetric(name, value, n)
    scale = jacobi_scale(out)
    try:  # a Cholesky factorization of the shifted matrix is several times cheaper than eigenvalues at every node
        np.linalg.cholesky(out * scale[..., :, None] * scale[..., None, :] + 1e-10 * np.eye(n))
        return out
    except np.linalg.LinAlgError:
        low, where = _lowest_eigenvalue(out)
    if low < -1e-10:
        raise ModelError(
            f"{name}: must be positive semidefinite, but its smallest eigenvalue is {_raw_lowest(out, where):.6g}"
            f"{_node(where)}; a negative weight rewards deviation: correct its sign"
        )
    return out


def _lowest_eigenvalue(values: Array) -> tuple[float, tuple[int, ...]]:
    scale = jacobi_scale(values)
    low = np.linalg.eigvalsh(values * scale[..., :, None] * scale[..., None, :])[..., 0]
    where = tuple(int(i) for i in np.unravel_index(int(np.argmin(low)), low.shape)) if low.ndim else ()
    return float(low[where]), where


def _raw_lowest(values: Array, where: tuple[int, ...]) -> float:
    return float(np.linalg.eigvalsh(values[where])[0])


def _node(where: tuple[int, ...]) -> str:
    return f" at node {where[0]}" if where else ""


def jacobi_scale(S: Array) -> Array:
    """Scales d (..., n) that give diag(d) S diag(d) a diagonal of ones (one where S_ii is zero)."""
    diagonal = np.abs(np.diagonal(S, axis1=-2, axis2=-1))
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > np.finfo(float).tiny, diagonal, 1.0)))


def packed_places(n: int) -> np.ndarray:
    """Place (n, n) of each element of a symmetric matrix in its upper triangle, packed row by row."""
    place = np.zeros((n, n), dtype=int)
    rows, columns = np.triu_indices(n)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return place


def riccati_problem(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None
) -> tuple[Array, Array, Array, Array, Array]:
    """Checked (A, B, Q, R, N); Q symmetric, R positive definite, N (n, m) zero when absent."""
    a = square("A", A)
    n = len(a)
    b = matrix("B", B, (n, None))
    m = b.shape[1]
    q = symmetric("Q", matrix("Q", Q, (n, n)), n)
    r = positive_definite("R", matrix("R", R, (m, m)), m)
    cross = np.zeros((n, m)) if N is None else matrix("N", N, (n, m))
    return a, b, q, r, cross


def care(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, *, N: ArrayLike | None = None) -> MatrixSolution:
    """Stabilizing solution of the continuous algebraic Riccati equation.

    A^T S + S A - (S B + N) R^-1 (B^T S + N^T) + Q = 0

    Parameters
    ----------
    A : array_like, shape (n, n)
    B : array_like, shape (n, m)
    Q : array_like, shape (n, n), symmetric
    R : array_like, shape (m, m), symmetric positive definite
    N : array_like, shape (n, m), optional
        Cross weight x^T N u (counted twice in the cost).

    Returns
    -------
    MatrixSolution
        The gain is K = R^-1 (B^T S + N^T); ``eigenvalues`` are those of A - B K.

    Raises
    ------
    ModelError
        Wrong shapes, NaN, asymmetric Q, R not positive definite, or no stabilizing solution.

    Notes
    -----
    Schur solution, then Newton (Kleinman) steps as long as each reduces the residual.
    """
    return _riccati("care", riccati_problem(A, B, Q, R, N), _continuous)


def dare(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, *, N: ArrayLike | None = None) -> MatrixSolution:
    """Stabilizing solution of the discrete algebraic Riccati equation.

    S = A^T S A - (A^T S B + N) (R + B^T S B)^-1 (B^T S A + N^T) + Q

    Parameters, raises and notes as for :func:`care`.

    Returns
    -------
    MatrixSolution
        The gain is K = (R + B^T S B)^-1 (B^T S A + N^T); ``eigenvalues`` are those of A - B K.
    """
    return _riccati("dare", riccati_problem(A, B, Q, R, N), _discrete)


@dataclass(frozen=True, slots=True, eq=False)
class _Equation:
    """One Riccati equation: solver, terms that sum to zero, Newton correction, closed loop, stability of its eigenvalues."""

    solve: Callable[[], Array]
    terms: Callable[[Array], tuple[Array, ...]]
    correction: Callable[[Array, Array], Array]
    closed_loop: Callable[[Array], Array]
    stable: Callable[[np.ndarray], bool]


def _continuous(a: Array, b: Array, q: Array, r: Array, cross: Array) -> _Equation:
    def terms(S: Array) -> tuple[Array, ...]:
        g = b.T @ S + cross.T
        sa = S @ a
        return sa, sa.T, -g.T @ np.linalg.solve(r, g), q

    def closed_loop(S: Array) -> Array:
        return np.asarray(a - b @ np.linalg.solve(r, b.T @ S + cross.T), dtype=np.float64)

    return _Equation(
        lambda: np.asarray(sla.solve_continuous_are(a, b, q, r, s=cross)),
        terms,
        lambda S, residual: np.asarray(sla.solve_continuous_lyapunov(closed_loop(S).T, -residual)),
        closed_loop,
        lambda values: bool(values.real.max() < 0),
    )


def _discrete(a: Array, b: Array, q: Array, r: Array, cross: Array) -> _Equation:
    def gain(S: Array) -> Array:
        return np.asarray(np.linalg.solve(r + b.T @ S @ b, b.T @ S @ a + cross.T), dtype=np.float64)

    def terms(S: Array) -> tuple[Array, ...]:
        return -S, a.T @ S @ a, -(a.T @ S @ b + cross) @ gain(S), q

    def closed_loop(S: Array) -> Array:
        return a - b @ gain(S)

    return _Equation(
        lambda: np.asarray(sla.solve_discrete_are(a, b, q, r, s=cross)),
        terms,
        lambda S, residual: np.asarray(sla.solve_discrete_lyapunov(closed_loop(S).T, residual)),
        closed_loop,
        lambda values: bool(np.abs(values).max() < 1),
    )


def _riccati(name: str, problem: tuple[Array, Array, Array, Array, Array], build: Callable[..., _Equation]) -> MatrixSolution:
    """Solve in scaled coordinates: first those that balance A (or give Q a unit diagonal), then those that give S one."""
    a, b, q, r, cross = problem
    e = _power_of_two(jacobi_scale(r))
    balance = _power_of_two(np.asarray(sla.matrix_balance(a, permute=False, separate=True)[1][0]))
    best: tuple[float, Array, np.ndarray, bool] | None = None
    reason = ""
    scales = [balance, _power_of_two(jacobi_scale(q))]
    for _ in range(3):
        if not scales:
            break
        d = scales.pop(0)
        equation = build(
            a * d / d[:, None], b * e / d[:, None], q * d[:, None] * d, r * e[:, None] * e, cross * d[:, None] * e
        )  # fmt: skip
        with warnings.catch_warnings():
            # Ill-conditioning is judged by the residual of the answer, not by the steps towards it.
            warnings.simplefilter("ignore", sla.LinAlgWarning)
            warnings.simplefilter("ignore", RuntimeWarning)
            try:
                S, residual = _refine(equation.solve(), equation.terms, equation.correction)
            except (np.linalg.LinAlgError, ValueError) as error:
                reason = f" ({error})"
                continue
        if not np.isfinite(S).all():
            continue
        eigenvalues = np.linalg.eigvals(equation.closed_loop(S))
        stable = equation.stable(eigenvalues)
        if best is None:
            scales = [d * _power_of_two(jacobi_scale(S))]
        if best is None or (stable, -residual) > (best[3], -best[0]):
            best = (residual, S / d[:, None] / d, eigenvalues, stable)
    if best is None or not best[3]:
        raise ModelError(
            f"{name}: no stabilizing solution was found{reason}; an unstable mode is out of reach of the input,"
            " or a mode on the stability border is not seen by Q: add an actuator, or weight that mode"
        )
    _check_residual(name, best[0])
    return MatrixSolution(best[1], best[0], best[2])


def _power_of_two(scale: Array) -> Array:
    return np.asarray(2.0 ** np.round(np.log2(scale)))  # scaling by powers of two is free of rounding


def lyapunov(A: ArrayLike, Q: ArrayLike) -> MatrixSolution:
    """Solution of the continuous Lyapunov equation A S + S A^T + Q = 0.

    Parameters
    ----------
    A : array_like, shape (n, n)
    Q : array_like, shape (n, n), symmetric

    Returns
    -------
    MatrixSolution
        ``eigenvalues`` are those of A; S >= 0 if they are stable and Q >= 0.

    Raises
    ------
    ModelError
        Two eigenvalues of A add to zero (no unique solution), wrong shapes, asymmetric Q.
    """
    a = square("A", A)
    q = symmetric("Q", matrix("Q", Q, a.shape), len(a))
    eigenvalues = np.linalg.eigvals(a)
    gaps = np.abs(eigenvalues[:, None] + eigenvalues[None, :])
    _check_unique("lyapunov", gaps, np.abs(eigenvalues).max(), eigenvalues, "add to zero")

    def terms(S: Array) -> tuple[Array, ...]:
        product = a @ S
        return product, product.T, q

    S, residual = _refine(
        np.asarray(sla.solve_continuous_lyapunov(a, -q)), terms, lambda S, res: np.asarray(sla.solve_continuous_lyapunov(a, -res))
    )
    _check_residual("lyapunov", residual)
    return MatrixSolution(S, residual, eigenvalues)


def dlyapunov(A: ArrayLike, Q: ArrayLike) -> MatrixSolution:
    """Solution of the discrete Lyapunov equation A S A^T - S + Q = 0.

    Parameters and returns as for :func:`lyapunov`; raises ModelError where two eigenvalues of A multiply to one.
    """
    a = square("A", A)
    q = symmetric("Q", matrix("Q", Q, a.shape), len(a))
    eigenvalues = np.linalg.eigvals(a)
    gaps = np.abs(eigenvalues[:, None] * eigenvalues[None, :] - 1.0)
    _check_unique("dlyapunov", gaps, max(1.0, float(np.abs(eigenvalues).max())), eigenvalues, "multiply to one")

    def terms(S: Array) -> tuple[Array, ...]:
        return a @ S @ a.T, -S, q

    S, residual = _refine(
        np.asarray(sla.solve_discrete_lyapunov(a, q)), terms, lambda S, res: np.asarray(sla.solve_discrete_lyapunov(a, res))
    )
    _check_residual("dlyapunov", residual)
    return MatrixSolution(S, residual, eigenvalues)


def relative_residual(S: Array, terms: tuple[Array, ...]) -> float:
    """Largest element of the sum of `terms` over the largest element of any of them, both scaled to unit diagonal of S."""
    d = jacobi_scale(S)
    weight = d[:, None] * d[None, :]
    largest = max(float(np.abs(term * weight).max()) for term in terms)
    total = float(np.abs(np.sum(terms, axis=0) * weight).max())
    return total / largest if largest > 0 else 0.0


def _refine(S: Array, terms: Callable[[Array], tuple[Array, ...]], correction: Callable[[Array, Array], Array]) -> tuple[Array, float]:
    S = 0.5 * (S + S.T)
    best = relative_residual(S, terms(S))
    for _ in range(3):
        try:
            trial = S + correction(S, np.sum(terms(S), axis=0))
        except np.linalg.LinAlgError:
            break
        trial = 0.5 * (trial + trial.T)
        residual = relative_residual(trial, terms(trial))
        if not (np.isfinite(trial).all() and residual < best):
            break
        S, best = trial, residual
    return S, best


def _check_residual(name: str, residual: float) -> None:
    if not residual <= ACCEPT:
        raise ModelError(
            f"{name}: the relative residual of the equation is {residual:.3g}, allowed is {ACCEPT:g};"
            " the problem is too badly conditioned: rescale the states and weights"
        )


def _check_unique(name: str, gaps: Array, scale: float, eigenvalues: np.ndarray, what: str) -> None:
    i, j = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
    if gaps[i, j] <= 1e-13 * max(float(scale), np.finfo(float).tiny):
        raise ModelError(
            f"{name}: no unique solution, since the eigenvalues {eigenvalues[i]:.6g} and {eigenvalues[j]:.6g} of A {what}; use a stable A"
        )
