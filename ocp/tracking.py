"""Reference flight and its optimal gains as one CasADi function: fly to the stop, then sweep flight and Riccati equation back together.

The function is a composition of fixed-step integrations without branches, so it is cheap to call again with another start,
parameter or weight, exact to differentiate, and can be compiled.  It flies a constant input; :func:`ocp.tvlqr` takes any
reference, node by node.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import DOP853
from scipy.sparse import csr_array

from models.core import Array, Model, ModelError, Var, as_scalar, as_vector, evaluate, frozen
from ocp.coordinates import map_function
from ocp.gains import UNCERTIFIED, Certificate, Gains
from ocp.methods import runge_kutta
from ocp.riccati import jacobi_scale, matrix, packed_places, positive_definite, positive_semidefinite
from ocp.stops import Stop
from ocp.tvlqr import CertificateError
from ocp.tvlqr import certify as certified

TABLEAU = (DOP853.A, DOP853.B, DOP853.C)
GRADING = 1.5
RESOLUTION = 1e-6  # of the nominal values: allowed difference between the ends found with the two kinds of steps
POLISH = 8  # Newton steps on the stop time; quadratic, so that the last ones do not move it


@dataclass(frozen=True, slots=True, eq=False)
class Tracker:
    """A model, a stop condition and a grid, made into functions by :func:`tracker`.

    Attributes
    ----------
    model : Model
    until : Stop
    search : float
        Step of the search for the stop, s.
    forward_steps, steps : int
        Steps of the search, and of the sweep (equal, from the stop back to the start).
    states : tuple of Var
        What the gains multiply: the model's states, or the measured quantities.
    function : casadi.Function
        (x0, u, p, Q, R_inverse, Qf), weights as upper triangles row by row -> (t_f, margin at t_f, resolution, Z, Zdot), latest node first:
        Z and Zdot (nx + nS + nu nx, steps + 1) hold states, upper triangle of S and gains (row by row), and their rates.
    half : casadi.Function
        ([x; S], d) -> (the same one step earlier, by two half steps; x and gains at half the step), d = [h; u; p; Q; R_inverse]: the
        independent check.
    nodes : ndarray, shape (steps + 1,)
        Times of the sweep's nodes as parts of t_f.
    dense : tuple of ndarray and two csr_array
        Times (parts of t_f) of the gains, and the weights of node values and of t_f times the rates there: polynomials of degree 7
        through four neighbouring nodes.
    middle : the same for the middles of the steps, where the check looks at the interpolation.
    """

    model: Model
    until: Stop
    search: float
    forward_steps: int
    steps: int
    states: tuple[Var, ...]
    function: ca.Function
    half: ca.Function
    nodes: Array
    dense: tuple[Array, csr_array, csr_array]
    middle: tuple[Array, csr_array, csr_array]

    def __call__(
        self, x0: ArrayLike, u: ArrayLike, *, Q: ArrayLike, R: ArrayLike, Qf: ArrayLike,
        p: Mapping[str, float] | ArrayLike | None = None, certify: bool = True,
    ) -> Gains:  # fmt: skip
        """Fly from x0 (nx,) with the constant input u (nu,) and synthesize the gains about that flight.

        Parameters
        ----------
        Q, Qf : array_like, shape (nx, nx)
            Weights of the deviation in flight and at the end, in the tracker's coordinates, symmetric, >= 0.
        R : array_like, shape (nu, nu)
            Weight of the input, symmetric, > 0.
        certify : bool
            Check every step of the sweep (flight and S) by an independent integration at half the step, and the interpolation between
            nodes at its middle; ``riccati_residual`` is the largest of these defects, S and K relative to their largest values,
            states to the larger of these and ``Var.nominal``.  Without it the certificate is ``UNCERTIFIED``.

        Returns
        -------
        Gains
            On ``steps refine + 1`` nodes from 0 to the stop, closer together towards the end, where gains change fast.

        Raises
        ------
        ModelError
            Bad weights or start, a stop that is not reached, a flight that its steps do not resolve (search and sweep end apart
            by more than 1e-6 of the nominal values), no certificate.
        """
        model, n = self.model, len(self.states)
        start, held = as_vector("x0", x0, model.states), as_vector("u", u, model.inputs)
        params = as_vector("p", model.parameters(p), model.params)
        r = positive_definite("R", matrix("R", R, (len(held), len(held))), len(held))
        q, qf = (positive_semidefinite(name, matrix(name, v, (n, n)), n) for name, v in (("Q", Q), ("Qf", Qf)))
        inverse: Array = np.linalg.inv(r).astype(np.float64)
        packed = [start, held, params, _upper(q), _upper(inverse), _upper(qf)]
        t_f, margin, resolution, swept, rates = _called(self.function, packed)
        duration = float(t_f[0, 0])
        if not abs(float(margin[0, 0])) < 1e-9:
            limit = self.search * self.forward_steps
            raise ModelError(
                f"tracker: STOP_NOT_REACHED: {self.until.text()} was not met by {limit:.6g} s from x0 {start.tolist()};"
                " change the start, or build the tracker with a longer t_max"
            )
        if not (np.isfinite(swept).all() and np.isfinite(rates).all()):
            raise ModelError("tracker: NONFINITE: the sweep left the numbers; take more steps, or bring Q, Qf and R closer together")
        if not float(resolution[0, 0]) <= RESOLUTION:
            raise CertificateError(
                f"tracker: the flight is not resolved: with the steps of the search and of the sweep its end differs by"
                f" {float(resolution[0, 0]):.2g} of the nominal values, allowed is {RESOLUTION:g}; take a smaller search step or more steps"
            )
        d = np.concatenate([held, params, packed[3], packed[4]])
        return self._gains(duration, held, params, d, swept[::-1], rates[::-1], certify)

    def _gains(self, duration: float, held: Array, params: Array, d: Array, nodes: Array, rates: Array, certify: bool) -> Gains:
        nx, nu = len(self.model.states), len(held)
        n_z = nx + nx * (nx + 1) // 2
        z = self.dense[1] @ nodes + duration * (self.dense[2] @ rates)
        t = duration * self.dense[0]
        x, S, K = z[:, :nx], _full(z[:, nx:n_z], nx), z[:, n_z:].reshape(len(t), nu, nx)
        proof = UNCERTIFIED
        if certify:
            proof = self._proof(duration, d, nodes, self.middle[1] @ nodes + duration * (self.middle[2] @ rates))
        x, S, K = self._measured(x, S, K, held, params)
        return Gains(t, K, np.zeros((len(t), nu)), S, x, np.repeat(held[None], len(t), axis=0), proof, self.states, self.model.inputs)

    def _proof(self, duration: float, d: Array, nodes: Array, middle: Array) -> Certificate:
        nx = len(self.model.states)
        n_z = nx + nx * (nx + 1) // 2
        S = _full(nodes[:, nx:n_z], nx)
        scale = 1.0 / np.sqrt(np.maximum(np.abs(np.diagonal(S, axis1=1, axis2=2)).max(axis=0), np.finfo(float).tiny))
        size = np.maximum(np.abs(nodes[:, :nx]).max(axis=0), [v.nominal for v in self.model.states])
        steps = np.column_stack([duration * np.diff(self.nodes), np.repeat(d[None], self.steps, axis=0)])
        again, between = evaluate(self.half, nodes[1:, :n_z], steps)
        largest = np.maximum(np.abs(nodes[:, n_z:]).max(axis=0), np.finfo(float).tiny)
        defects = (
            np.abs(_full(again[:, nx:], nx) - S[:-1]) * scale[:, None] * scale,
            np.abs(again[:, :nx] - nodes[:-1, :nx]) / size,
            np.abs(between[:, :nx] - middle[:, :nx]) / size,
            np.abs(between[:, nx:] - middle[:, n_z:]) / largest,
        )
        own = jacobi_scale(S[:-1])
        local = np.abs(_full(again[:, nx:], nx) - S[:-1]) * own[:, :, None] * own[:, None, :]
        return certified(S, max(float(part.max()) for part in defects), scale, float(local.max()))

    def _measured(self, x: Array, S: Array, K: Array, held: Array, params: Array) -> tuple[Array, Array, Array]:
        if self.states == self.model.states:
            return x, S, K
        names = tuple(v.name for v in self.states)
        y, m, _ = evaluate(map_function(self.model, names), x, np.repeat(held[None], len(x), axis=0), params)
        nominal = [np.array([v.nominal for v in variables]) for variables in (self.model.states, self.states)]
        condition = np.linalg.cond(m * nominal[0] / nominal[1][:, None])
        if not condition.max() < 1e14:
            raise ModelError(f"tracker: SINGULAR: {names} do not determine the state everywhere along the flight; choose other quantities")
        inverse = np.linalg.inv(m)
        return y, np.swapaxes(inverse, 1, 2) @ S @ inverse, K @ inverse


def tracker(
    model: Model, *, until: Stop, steps: int = 120, refine: int = 8, search: float = 8.0, t_max: float = 1200.0,
    measured: tuple[str, ...] | None = None,
) -> Tracker:  # fmt: skip
    """Build the function of a reference flight with its gains.

    Parameters
    ----------
    model : Model
        With symbolic (SX) equations.
    until : Stop
        A single condition on a state or output.
    steps : int
        Steps of the sweep (order 8), at least 3.
    refine : int
        Nodes of the gains for each step of the sweep.
    search : float
        Step of the forward flight, s; also of order 8.  The stop is looked for at its ends: two crossings within one go unseen.
    t_max : float
        Longest flight, s.
    measured : tuple of str, optional
        Names of nx states and outputs that the gains multiply and the weights weigh, instead of the states.

    Raises
    ------
    ModelError
        More than one stop condition, unknown names, not positive numbers.
    """
    if len(until.conditions) != 1:
        raise ModelError(f"tracker: expected one stop condition, got {until.text()}; choose one")
    for name, value, least in (("steps", steps, 3), ("refine", refine, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ModelError(f"tracker: {name}: expected a whole number, at least {least}, got {value!r}")
    search, t_max = as_scalar("tracker: search", search), as_scalar("tracker: t_max", t_max)
    if not 0 < search < t_max or t_max / search > 1e5:
        raise ModelError(f"tracker: expected 0 < search < t_max <= 1e5 search, got search {search:g} s and t_max {t_max:g} s")
    measured = None if measured is None else tuple(measured)
    names = measured or tuple(v.name for v in model.states)
    if len(names) != len(model.states):
        raise ModelError(f"tracker: measured: expected {len(model.states)} names, one for each state, got {len(names)}: {names}")
    count = int(np.ceil(t_max / search))
    grid = _graded(steps)
    function, half = _functions(model, until, steps, float(search), count, measured)
    known = {v.name: v for v in (*model.outputs, *model.states)}
    states = model.states if measured is None else tuple(known[n] for n in names)
    return Tracker(model, until, float(search), count, steps, states, function, half, grid, _dense(steps, refine), _dense(steps, 1, 0.5))


@lru_cache(maxsize=16)
def _functions(
    model: Model, until: Stop, steps: int, search: float, count: int, measured: tuple[str, ...] | None
) -> tuple[ca.Function, ca.Function]:
    nx, nu, n_p = len(model.states), len(model.inputs), len(model.params)
    n_s, n_r = nx * (nx + 1) // 2, nu * (nu + 1) // 2
    back, half, terminal, rates = _sweep_steps(model, measured)
    margin = _margin(model, until)
    flow, forward = _forward_steps(model, margin)
    polish = _polish(model, margin, search)

    x0, u, p = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("p", n_p)
    q, r, qf = ca.MX.sym("Q", n_s), ca.MX.sym("R_inverse", n_r), ca.MX.sym("Qf", n_s)
    flown = forward.mapaccum(count)(ca.vertcat(x0, 0), ca.repmat(ca.vertcat(search, u, p), 1, count))[:, -1]
    x_end, tau, left = polish(flown[:nx], ca.vertcat(u, p))
    t_f = search * flown[nx] + tau
    # flown again on the sweep's own grid: each step back starts from these states, so that nothing grows backwards
    lengths = t_f * ca.DM(np.diff(_graded(steps))).T
    x = flow.mapaccum(steps)(x0, ca.vertcat(lengths, ca.repmat(ca.vertcat(u, p), 1, steps)))
    resolution = ca.norm_inf((x[:, -1] - x_end) / ca.fmax(ca.fabs(x_end), ca.DM([v.nominal for v in model.states])))
    d = ca.vertcat(u, p, q, r)
    latest = list(range(steps - 1, -1, -1))
    S_f = terminal(x[:, -1], qf, ca.vertcat(0, d))
    S, seen = back.mapaccum(steps)(S_f, ca.vertcat(x[:, latest], lengths[:, latest], ca.repmat(d, 1, steps)))
    first = rates(ca.vertcat(x0, S[:, -1]), ca.vertcat(0, d))
    states = ca.vertcat(ca.horzcat(x[:, latest], x0), ca.horzcat(S_f, S))
    swept = ca.vertcat(states, ca.horzcat(seen[: nu * nx, :], first[: nu * nx]))
    changes = ca.horzcat(seen[nu * nx :, :], first[nu * nx :])
    outputs = [t_f, left, resolution, ca.densify(swept), ca.densify(changes)]
    arguments, names = [x0, u, p, q, r, qf], ["x0", "u", "p", "Q", "R_inverse", "Qf"]
    whole = ca.Function(f"{model.name}_tracking", arguments, outputs, names, ["t_f", "margin", "resolution", "Z", "Zdot"])
    return whole, half


def _sweep_steps(model: Model, measured: tuple[str, ...] | None) -> tuple[ca.Function, ...]:
    """Step back (S, [x; d]) -> (S, seen); the same by half steps, (z, d) -> (z, middle); end (x_f, Qf, d) -> S_f; seen (z, d).

    z = [x; S], seen = [K; zdot; Kdot] at the node from which the step starts.
    """
    nx, nu, n_p = len(model.states), len(model.inputs), len(model.params)
    n_s, n_r = nx * (nx + 1) // 2, nu * (nu + 1) // 2
    x, z, d = ca.SX.sym("x", nx), ca.SX.sym("z", nx + n_s), ca.SX.sym("d", 1 + nu + n_p + n_s + n_r)
    h, u, p, q, r = ca.vertsplit(d, [0, 1, 1 + nu, 1 + nu + n_p, 1 + nu + n_p + n_s, 1 + nu + n_p + n_s + n_r])
    f = model.rhs(x, u, p)
    A, B = ca.jacobian(f, x), ca.jacobian(f, u)
    M = map_function(model, measured)(x, u, p)[1] if measured else ca.SX.eye(nx)
    linear = ca.Function("linear", [x, d], [f, A, B, ca.mtimes([M.T, _square(q, nx), M])])
    inverse = _square(r, nu)

    def rate(_sigma: ca.SX, state: ca.SX) -> ca.SX:
        f_, A_, B_, Q_ = linear(state[:nx], d)
        S = _square(state[nx:], nx)
        SA, SB = ca.mtimes(S, A_), ca.mtimes(S, B_)
        return ca.vertcat(f_, _packed(-SA - SA.T + ca.mtimes([SB, inverse, SB.T]) - Q_))

    def gain(state: ca.SX) -> ca.SX:
        return ca.vec(ca.mtimes([inverse, linear(state[:nx], d)[2].T, _square(state[nx:], nx)]).T)

    whole = runge_kutta(rate, z, -h, ca.SX(0), 0.0, TABLEAU)
    middle = runge_kutta(rate, z, -h / 2, ca.SX(0), 0.0, TABLEAU)
    halves = runge_kutta(rate, middle, -h / 2, ca.SX(0), 0.0, TABLEAU)
    options = {"cse": True}
    qf = ca.SX.sym("qf", n_s)
    end = _packed(ca.mtimes([M.T, _square(qf, nx), M]))
    gains, z_rate = gain(z), rate(ca.SX(0), z)
    seen = ca.vertcat(gains, z_rate, ca.jtimes(gains, z, z_rate))
    return (
        ca.Function(f"{model.name}_back", [z[nx:], ca.vertcat(z[:nx], d)], [whole[nx:], seen], options),
        ca.Function(f"{model.name}_back_half", [z, d], [halves, ca.vertcat(middle[:nx], gain(middle))], options),
        ca.Function(f"{model.name}_terminal", [x, qf, d], [end], options),
        ca.Function(f"{model.name}_seen", [z, d], [seen], options),
    )


def _margin(model: Model, until: Stop) -> ca.Function:
    """(x, u, p) -> margin in the scale of the condition, positive before the stop."""
    x, u, p = (ca.SX.sym(n, model.rhs.size1_in(i)) for i, n in enumerate("xup"))
    return ca.Function("margin", [x, u, p], [until.expression(model, x, u, p)])


def _forward_steps(model: Model, margin: ca.Function) -> tuple[ca.Function, ca.Function]:
    """Plain step (x, [h; u; p]) -> x; step of the search ([x; k], [H; u; p]) -> the same, unchanged where it would cross the stop."""
    nx, nu, n_p = len(model.states), len(model.inputs), len(model.params)
    c, d = ca.SX.sym("c", nx + 1), ca.SX.sym("d", 1 + nu + n_p)
    u, p = d[1 : 1 + nu], d[1 + nu :]
    ahead = runge_kutta(lambda _, x: model.rhs(x, u, p), c[:nx], d[0], ca.SX(0), 0.0, TABLEAU)
    flies_on = margin(ahead, u, p) > 0
    plain = ca.Function("forward", [c[:nx], d], [ahead], {"cse": True})
    return plain, ca.Function("search", [c, d], [ca.vertcat(ca.if_else(flies_on, ahead, c[:nx]), c[nx] + flies_on)], {"cse": True})


def _polish(model: Model, margin: ca.Function, search: float) -> ca.Function:
    """(x before the stop, [u; p]) -> (x at the stop, time to it, margin left) by Newton steps on the time, clipped to one search step."""
    nx, nu, n_p = len(model.states), len(model.inputs), len(model.params)
    x, d, tau = ca.SX.sym("x", nx), ca.SX.sym("d", nu + n_p), ca.SX.sym("tau")
    u, p = d[:nu], d[nu:]
    there = runge_kutta(lambda _, state: model.rhs(state, u, p), x, tau, ca.SX(0), 0.0, TABLEAU)
    state = ca.SX.sym("state", nx)
    value = margin(state, u, p)
    slope = ca.Function("slope", [state, d], [value, ca.jtimes(value, state, model.rhs(state, u, p))])
    m, m_rate = slope(there, d)
    step = ca.Function("polish", [tau, x, d], [ca.fmin(ca.fmax(tau - m / m_rate, 0), search)])
    x_, d_ = ca.MX.sym("x", nx), ca.MX.sym("d", nu + n_p)
    time: ca.MX = ca.MX(0.5 * search)
    for _ in range(POLISH):
        time = step(time, x_, d_)
    end = ca.Function("end", [tau, x, d], [there, m])(time, x_, d_)
    return ca.Function("stop", [x_, d_], [end[0], time, end[1]])


def _square(packed: ca.SX, n: int) -> ca.SX:
    place = packed_places(n)
    return ca.reshape(packed[[int(i) for i in place.ravel()]], n, n) if n else ca.SX(0, 0)


def _packed(square: ca.SX) -> ca.SX:
    n = square.shape[0]
    return ca.vertcat(*[square[i, j] for i in range(n) for j in range(i, n)])


@lru_cache(maxsize=16)
def _triangle(n: int) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.triu_indices(n)
    return rows, columns


def _upper(values: Array) -> Array:
    return np.asarray(values)[_triangle(len(values))]


def _called(function: ca.Function, arguments: list[Array]) -> list[Array]:
    """Outputs of a function of columns, each (columns, rows), through buffers: conversions would cost a fifth of the call."""
    handle: Any = function  # CasADi's own stubs miss the Python form of the buffer calls
    buffer, run = handle.buffer()
    given = [np.ascontiguousarray(a, dtype=np.float64) for a in arguments]
    results = [np.empty(function.size_out(i)[::-1]) for i in range(function.n_out())]
    for i, array in enumerate(given):
        if array.size != function.numel_in(i):
            raise ModelError(f"{function.name()}: {function.name_in(i)}: expected {function.numel_in(i)} numbers, got {array.size}")
        buffer.set_arg(i, array.data)
    for i, result in enumerate(results):
        buffer.set_res(i, result.data)
    run()
    return results


def _full(packed: Array, n: int) -> Array:
    return packed[:, packed_places(n)]


def _graded(steps: int) -> Array:
    """Nodes (steps + 1,) in [0, 1], closer together towards 1."""
    return 1.0 - np.linspace(1.0, 0.0, steps + 1) ** GRADING


@lru_cache(maxsize=16)
def _dense(steps: int, refine: int, offset: float = 0.0) -> tuple[Array, csr_array, csr_array]:
    """Times in [0, 1], `refine` to a step, and the weights of node values and rates there: confluent interpolation on four nodes.

    With an offset the times lie at that part of every step instead, and the end is left out.
    """
    grid = _graded(steps)
    times = (grid[:-1, None] + np.diff(grid)[:, None] * (np.arange(refine) + offset) / refine).ravel()
    first = np.clip(np.repeat(np.arange(steps), refine) - 1, 0, steps - 3)
    if offset == 0.0:
        times, first = np.append(times, 1.0), np.append(first, steps - 3)
    columns = first[:, None] + np.arange(4)
    width = grid[columns[:, 3]] - grid[columns[:, 0]]  # of each stencil: its unit, for the condition of the 8 by 8 systems
    nodes = (grid[columns] - grid[columns[:, :1]]) / width[:, None] - 0.5
    at = (times - grid[columns[:, 0]]) / width - 0.5
    powers = np.arange(8)
    # rows: conditions on the 8 coefficients of a polynomial; its value at a time is a combination of the conditions
    slopes = powers * nodes[:, :, None] ** np.maximum(powers - 1, 0)
    conditions = np.concatenate([nodes[:, :, None] ** powers, slopes], axis=1)
    weight = np.linalg.solve(np.swapaxes(conditions, 1, 2), (at[:, None] ** powers)[:, :, None])[:, :, 0]
    pointer, shape = 4 * np.arange(len(times) + 1), (len(times), steps + 1)
    values, rates = weight[:, :4], weight[:, 4:] * width[:, None]
    return frozen(times), *(csr_array((w.ravel(), columns.ravel(), pointer), shape=shape) for w in (values, rates))
