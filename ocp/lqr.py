"""Time-invariant linear-quadratic gains: continuous, discrete, and with integral action; each with its certificate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

import numpy as np
import scipy.linalg as sla
from numpy.typing import ArrayLike

from models.checked import Array, ModelError, Status, Var, unknown_name
from ocp.gains import Certificate, Gains
from ocp.linearize import Linearization
from ocp.riccati import MatrixSolution, care, dare, jacobi_scale, matrix, positive_definite, positive_semidefinite, riccati_problem

RANK = 1e-10  # smallest relative singular value of the Popov-Belevitch-Hautus matrix of a mode that counts as reached
BORDER = 1e-8  # relative distance from the stability border within which a mode counts as lying on it


class NotStabilizable(ModelError):
    """No stabilizing gain exists; the message names the mode and the state that dominates it."""

    status = Status.NOT_STABILIZABLE


def lqr(plant: Linearization | ArrayLike, B: ArrayLike | None = None, *, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None = None) -> Gains:
    """Infinite-horizon LQR: minimize the integral of dx^T Q dx + 2 dx^T N du + du^T R du.

    K = R^-1 (B^T S + N^T) with S of :func:`ocp.riccati.care`;  u = u0 - K (x - x0).

    Parameters
    ----------
    plant : Linearization or array_like, shape (nx, nx)
        A point linearization, or the matrix A with `B` beside it.
    B : array_like, shape (nx, nu), optional
        Only with a matrix A.
    Q : array_like, shape (nx, nx)
        State weight, symmetric, >= 0.
    R : array_like, shape (nu, nu)
        Input weight, symmetric, > 0.
    N : array_like, shape (nx, nu), optional
        Cross weight; Q - N R^-1 N^T must be >= 0.

    Returns
    -------
    Gains
        N = 1 node; ``certificate.spectral_abscissa`` is that of A - B K, 1/s.

    Raises
    ------
    ModelError
        A weight of wrong shape, sign or symmetry; a trajectory in place of a point; a point that is no equilibrium.
    NotStabilizable
        A mode that the input does not reach, or a mode on the imaginary axis that the weights do not see.

    Source
    ------
    Anderson & Moore, Optimal Control: Linear Quadratic Methods, 1990, chapter 3.
    """
    return _regulator(_point("lqr", plant, B), Q, R, N, discrete=False)


def dlqr(plant: Linearization | ArrayLike, B: ArrayLike | None = None, *, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None = None) -> Gains:
    """Infinite-horizon LQR of x_{i+1} = A x_i + B u_i: minimize the sum of x^T Q x + 2 x^T N u + u^T R u.

    K = (R + B^T S B)^-1 (B^T S A + N^T) with S of :func:`ocp.riccati.dare`.

    Parameters, returns and raises as for :func:`lqr`; A and B are those of one sample.
    ``certificate.spectral_abscissa`` is the logarithm of the spectral radius, per step (negative: stable).
    """
    return _regulator(_point("dlqr", plant, B), Q, R, N, discrete=True)


def lqi(
    plant: Linearization | ArrayLike,
    B: ArrayLike | None = None,
    *,
    C: ArrayLike | None = None,
    outputs: Sequence[str] | None = None,
    Q: ArrayLike,
    R: ArrayLike,
    N: ArrayLike | None = None,
) -> Gains:
    """LQR with integral action: the state is extended by z, z' = y - y_ref for the chosen outputs y = C x + D u.

    u = u0 - K_x (x - x0) - K_z z,  K = [K_x K_z].

    Parameters
    ----------
    plant, B, R
        As for :func:`lqr`.
    C : array_like, shape (nz, nx), optional
        Rows that give the outputs to integrate (without feedthrough).
    outputs : sequence of str, optional
        Names of outputs of the model of a Linearization; their rows of C and D are used.  Give `C` or `outputs`;
        with neither, all outputs of the Linearization.
    Q : array_like, shape (nx + nz, nx + nz)
        Weight of [x, z], symmetric, >= 0; every integral needs a positive weight.
    N : array_like, shape (nx + nz, nu), optional

    Returns
    -------
    Gains
        On the extended state [x, z]; its S is (1, nx + nz, nx + nz) and x0 of the integrals is zero.

    Raises
    ------
    ModelError
        As for :func:`lqr`; both `C` and `outputs`, or an unknown output.
    NotStabilizable
        As for :func:`lqr`; at the eigenvalue zero it means that the input cannot hold these outputs at their
        references (too many outputs, or a zero at the origin).
    """
    lin = _point("lqi", plant, B)
    rows, feedthrough, chosen = _integrated(lin, plant, C, outputs)
    n, m, nz = lin.A.shape[1], lin.B.shape[2], len(rows)
    A = np.block([[lin.A[0], np.zeros((n, nz))], [rows, np.zeros((nz, nz))]])
    extended_b = np.vstack([lin.B[0], feedthrough])
    matrix("Q", Q, (n + nz, n + nz))
    gains = _regulator(Linearization.from_matrices(A, extended_b), Q, R, N, discrete=False, names=_state_names(lin) + chosen)
    x0 = np.concatenate([lin.x0, np.zeros((1, nz))], axis=1)
    states, inputs = _variables(lin, chosen)
    return Gains(gains.t, gains.K, np.zeros((1, m)), gains.S, x0, lin.u0, gains.certificate, states, inputs)


def _point(name: str, plant: Linearization | ArrayLike, B: ArrayLike | None) -> Linearization:
    if not isinstance(plant, Linearization):
        if B is None:
            raise ModelError(f"{name}: B is missing; give A and B, or a Linearization")
        return Linearization.from_matrices(plant, B)
    if B is not None:
        raise ModelError(f"{name}: B comes from the Linearization; leave it out")
    if len(plant.t) != 1:
        raise ModelError(f"{name}: expected the linearization of a point, got {len(plant.t)} nodes; use tvlqr along a trajectory")
    return plant


def _state_names(lin: Linearization) -> list[str]:
    return [v.name for v in lin.states] or [f"x{i + 1}" for i in range(lin.A.shape[1])]


def _integrated(
    lin: Linearization, plant: Linearization | ArrayLike, C: ArrayLike | None, outputs: Sequence[str] | None
) -> tuple[Array, Array, list[str]]:
    """Rows of C and D of the integrated outputs, and names for the integrals."""
    n, m = lin.A.shape[1], lin.B.shape[2]
    if C is not None:
        if outputs is not None:
            raise ModelError("lqi: both C and outputs are given; choose one of them")
        rows = matrix("C", np.atleast_2d(np.asarray(C)), (None, n))
        return rows, np.zeros((len(rows), m)), [f"integral_{i + 1}" for i in range(len(rows))]
    if not isinstance(plant, Linearization):
        raise ModelError("lqi: C is missing; give the rows of the outputs to integrate, shape (nz, nx)")
    known = [v.name for v in lin.model.outputs] if lin.model is not None else [f"y{i + 1}" for i in range(lin.C.shape[1])]
    wanted = known if outputs is None else list(outputs)
    if not wanted:
        raise ModelError("lqi: there is no output to integrate; give C or outputs")
    for name in wanted:
        if name not in known:
            raise ModelError(unknown_name("lqi: outputs", name, known))
    index = [known.index(name) for name in wanted]
    return lin.C[0][index], lin.D[0][index], [f"integral_{name}" for name in wanted]


def _variables(lin: Linearization, integrals: list[str]) -> tuple[tuple[Var, ...], tuple[Var, ...]]:
    if lin.model is None:
        return (), ()
    units = {f"integral_{v.name}": v for v in lin.model.outputs}
    extra = []
    for name in integrals:
        of = units.get(name)
        unit = "" if of is None else ("s" if of.unit == "1" else f"{of.unit} s")
        extra.append(Var(name, unit or "s", of.nominal if of else 1.0, text="integral" if of is None else f"integral of {of.name}"))
    return lin.model.states + tuple(extra), lin.model.inputs


def _regulator(
    lin: Linearization, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None, *, discrete: bool, names: list[str] | None = None
) -> Gains:
    a, b, q, r, cross = riccati_problem(lin.A[0], lin.B[0], Q, R, N)
    n, m = b.shape
    positive_semidefinite("Q", q, n)
    positive_definite("R", r, m)
    if cross.any():
        remainder = q - cross @ np.linalg.solve(r, cross.T)
        positive_semidefinite("Q - N R^-1 N^T", 0.5 * (remainder + remainder.T), n)
    _check_equilibrium(lin, discrete)
    check_modes(a, b, q, r, cross, names=names or _state_names(lin), discrete=discrete)
    solution = (dare if discrete else care)(a, b, q, r, N=cross)
    S = solution.S
    step = b.T @ S @ b if discrete else np.zeros((m, m))
    K = np.asarray(np.linalg.solve(r + step, (b.T @ S @ a if discrete else b.T @ S) + cross.T), dtype=np.float64)
    states, inputs = _variables(lin, [])
    return Gains(lin.t, K[None], np.zeros((1, m)), S[None], lin.x0, lin.u0, _certificate(solution, discrete), states, inputs)


def _certificate(solution: MatrixSolution, discrete: bool) -> Certificate:
    d = jacobi_scale(solution.S)
    eigenvalues = np.linalg.eigvalsh(solution.S * d[:, None] * d)
    low, high = float(eigenvalues[0]), float(eigenvalues[-1])
    if low < -1e-8:
        raise ModelError(f"no certificate: S has the scaled eigenvalue {low:.3g}, expected >= 0; bring the weights closer together")
    condition = high / low if low > np.finfo(float).eps * high else float("inf")
    poles = solution.eigenvalues
    if discrete:
        radius = float(np.abs(poles).max())
        abscissa = float(np.log(max(radius, np.finfo(float).tiny)))
    else:
        abscissa = float(poles.real.max())
    return Certificate(solution.residual, low, condition, abscissa)


def _check_equilibrium(lin: Linearization, discrete: bool) -> None:
    if discrete or lin.model is None:
        return
    nominal = np.array([v.nominal for v in lin.model.states])
    relative = np.abs(lin.c[0]) / nominal
    worst = int(np.argmax(relative))
    if relative[worst] > 1e-6:
        var = lin.model.states[worst]
        raise ModelError(
            f"lqr: the point is not an equilibrium: d{var.name}/dt = {lin.c[0, worst]:.6g} {var.unit}/s, expected 0;"
            " trim first, or give the rate of the reference as xdot to linearize"
        )


def check_modes(A: Array, B: Array, Q: Array, R: Array, N: Array, *, names: Sequence[str], discrete: bool) -> None:
    """Popov-Belevitch-Hautus test of every mode that matters, in balanced coordinates.

    Parameters
    ----------
    A, B, Q, R, N : ndarray
        Checked matrices of a regulator problem.
    names : sequence of str, length nx
    discrete : bool
        Border of stability: the unit circle in place of the imaginary axis.

    Raises
    ------
    NotStabilizable
        Names the mode by its eigenvalue and the state that dominates it.
    """
    balanced, scaling = sla.matrix_balance(A, permute=False, separate=True)
    d = np.asarray(scaling[0])
    inputs = B / d[:, None]
    for eigenvalue in np.linalg.eigvals(balanced):
        if _growth(eigenvalue, balanced, discrete) >= -BORDER:
            state = _hidden(balanced, inputs, eigenvalue)
            if state is not None:
                _refuse(eigenvalue, names[state], "is not reached by any input", "add an actuator, or leave that state out")
    # With a cross weight the cost sees the mode of A - B R^-1 N^T through Q - N R^-1 N^T.
    shifted = (A - B @ np.linalg.solve(R, N.T)) * (d[None, :] / d[:, None])
    seen = (Q - N @ np.linalg.solve(R, N.T)) * (d[:, None] * d[None, :])
    for eigenvalue in np.linalg.eigvals(shifted):
        if abs(_growth(eigenvalue, shifted, discrete)) <= BORDER:
            state = _hidden(shifted.T, seen, eigenvalue)
            if state is not None:
                border = "unit circle" if discrete else "imaginary axis"
                _refuse(eigenvalue, names[state], f"lies on the {border} and is not seen by Q", "give that state a positive weight")


def _growth(eigenvalue: complex, A: Array, discrete: bool) -> float:
    if discrete:
        return float(abs(eigenvalue) - 1.0)
    size = float(np.abs(A).max())
    return float(eigenvalue.real / size) if size > 0 else 0.0


def _hidden(A: Array, B: Array, eigenvalue: complex) -> int | None:
    """Index of the state that dominates the mode if [A - eigenvalue I, B] loses rank, else None."""
    n = len(A)
    size = float(np.abs(A).max()) or 1.0
    columns = np.abs(B).max(axis=0)
    used = B[:, columns > 0] / columns[columns > 0] * size
    pencil = np.hstack([A - eigenvalue * np.eye(n), used])
    # Rank does not depend on the scale of a row; a row of rounding alone must not be blown up to one.
    rows = np.maximum(np.abs(pencil).max(axis=1), 1e-13 * size)
    left, singular, _ = np.linalg.svd(pencil / rows[:, None], full_matrices=True)
    if singular[n - 1] > RANK:
        return None
    vector = np.abs(left[:, n - 1]) / rows * rows.max()
    floored = np.where(np.abs(left[:, n - 1]) > 1e-6, vector, 0.0)
    return int(np.argmax(floored))


def _refuse(eigenvalue: complex, state: str, what: str, remedy: str) -> NoReturn:
    text = f"{eigenvalue.real:.6g}" if abs(eigenvalue.imag) <= 1e-12 * abs(eigenvalue) else f"{eigenvalue:.6g}"
    raise NotStabilizable(f"the mode with eigenvalue {text}, dominated by the state {state}, {what}; {remedy}")
