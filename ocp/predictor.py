"""Prediction of the landing point with its exact derivatives: fixed steps that compile, and CVODES with forward sensitivities.

The bank angle runs in straight lines between nodes (T_k, B_k) and is held before the first and after the last one.  Every
node is a restart point of the integration: a step over a kink would be wrong by tens of metres, and its derivative by tens of
per cent.  At the stop radius the landing point moves with the time of arrival, dr = S - v (up . S)/(up . v).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca

from models.core import Model, ModelError, as_scalar, unknown_name
from ocp.methods import RK4, RK8, butcher, runge_kutta

NEVER = 1e9  # s: end of the line after the last node
GUESSES = 5  # Newton steps to the stop inside the last integration step


@dataclass(frozen=True, slots=True)
class Path:
    """How a prediction is integrated.

    Attributes
    ----------
    nodes : int
        Nodes of the bank profile, >= 1.
    steps : int
        Equal steps from the start to the horizon, >= 1; the nodes take one more each.
    order : {4, 8}
        Classical Runge-Kutta, or the twelve stages of order 8 of Dormand and Prince.
    """

    nodes: int
    steps: int
    order: int = 4

    def __post_init__(self) -> None:
        for name in ("nodes", "steps"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ModelError(f"Path: {name} must be an integer >= 1, got {value!r}")
        if self.order not in (4, 8):
            raise ModelError(f"Path: order must be 4 or 8, got {self.order!r}")


@lru_cache(maxsize=32)
def prediction(model: Model, path: Path, *, radius: float, seeds: int = 0, peaks: tuple[str, ...] = ()) -> ca.Function:
    """Flight from a state to a distance from the centre, with directional derivatives, as one function of fixed steps.

    Parameters
    ----------
    model : Model
        States x, y, z, u, v, w in planet-fixed axes; input bank.
    path : Path
    radius : float
        Stop, m.
    seeds : int
        Number m of directions in which derivatives are taken.
    peaks : tuple of str
        Outputs of the model whose greatest values on the way are wanted.

    Returns
    -------
    casadi.Function
        (x (6,), t, horizon, T (K,), B (K,), p (np,), dx (6 m,), dT (K m,), dB (K m,), dp (np m,)) ->
        (x_f (6,), t_f, landed, peak (len(peaks),), dx_f (6 m,), dt_f (m,)).
        T are times, s, not decreasing, those before t are past; B in rad; seeds are stacked by direction.  `horizon` s is the
        time over which the equal steps are laid; `landed` is 1 if the stop is met within it, else 0 and x_f is what the last
        step gives.  `peak` are the greatest values at the ends of steps, at least 0.

    Raises
    ------
    ModelError
        A model with other states or inputs.
    """
    check_model(model, radius)
    if isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 0:
        raise ModelError(f"prediction: seeds must be an integer >= 0, got {seeds!r}")
    indices = tuple(_output(model, name) for name in peaks)
    np_, m, n = len(model.params), seeds, path.nodes
    sizes = {"x": 6, "t": 1, "horizon": 1, "T": n, "B": n, "p": np_, "dx": 6 * m, "dT": n * m, "dB": n * m, "dp": np_ * m}
    given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    step, last = _step(model, path, radius, m, indices)
    state = ca.vertcat(given["x"], given["t"], ca.SX.zeros(2 + len(peaks)), given["dx"], ca.SX.zeros(m))
    fixed = ca.vertcat(given["horizon"] / path.steps, given["T"], given["B"], given["p"], given["dT"], given["dB"], given["dp"])
    state = repeated(step, path.steps + n, state, fixed)
    results = last.call([state, fixed], False, True)
    return ca.Function(
        f"{model.name}_landing", list(given.values()), results, list(given), ["x_f", "t_f", "landed", "peak", "dx_f", "dt_f"]
    )


def repeated(step: ca.Function, count: int, state: ca.SX, fixed: ca.SX) -> ca.SX:
    """``step(state, fixed) -> state`` called `count` times, by calls of calls, so that neither graph nor code grows with the count."""
    while count > 1:
        block, rest = divmod(count, 8)
        for _ in range(rest):
            state = step.call([state, fixed], False, True)[0]
        s, f = ca.SX.sym("s", state.numel()), ca.SX.sym("f", fixed.numel())
        inner = s
        for _ in range(8):
            inner = step.call([inner, f], False, True)[0]
        step, count = ca.Function(f"{step.name()}8", [s, f], [inner], ["state", "fixed"], ["next"]), block
    for _ in range(count):
        state = step.call([state, fixed], False, True)[0]
    return state


def _step(model: Model, path: Path, radius: float, m: int, peaks: tuple[int, ...]) -> tuple[ca.Function, ca.Function]:
    """(one step, the last step to the stop) of the state [x, t, segment, landed, peaks, dx, dt]."""
    np_, n = len(model.params), path.nodes
    state, fixed = ca.SX.sym("state", 9 + len(peaks) + 7 * m), ca.SX.sym("fixed", 1 + 2 * n + np_ + m * (2 * n + np_))
    x, t, segment, landed, peak, dx, dt = _split(state, [6, 1, 1, 1, len(peaks), 6 * m, m])
    h, T, B, p, dT, dB, dp = _split(fixed, [1, n, n, np_, n * m, n * m, np_ * m])
    line = _line(segment, T, B)
    tangents = [ca.vertcat(*_line(segment, dT[i * n : (i + 1) * n], dB[i * n : (i + 1) * n], end=0.0)) for i in range(m)]
    rk = _runge_kutta(model, path.order)

    def moved(duration: ca.SX, d_duration: list[ca.SX]) -> tuple[ca.SX, list[ca.SX]]:
        arguments = ca.vertcat(x, t, duration, *line, p)
        symbol = ca.SX.sym("a", arguments.numel())
        result = rk(symbol)
        outs, seeds = [result], []
        for i in range(m):
            seed = ca.SX.sym(f"s{i}", arguments.numel())
            outs.append(ca.jtimes(result, symbol, seed))
            seeds.append(seed)
        both = ca.Function("moved", [symbol, *seeds], outs)
        values = [ca.vertcat(dx[6 * i : 6 * i + 6], dt[i], d_duration[i], tangents[i], dp[i * np_ : (i + 1) * np_]) for i in range(m)]
        out = both.call([arguments, *values])
        return out[0], out[1:]

    remaining = line[1] - t
    meets = remaining <= h * (1 + 1e-9)
    duration = ca.if_else(meets, ca.fmax(remaining, 0), h)
    # the grid moves with the nodes: the derivatives hold at the moved time, whose own derivative is dt; a node in the past moves nothing
    moves = ca.logic_and(meets, remaining >= 0)
    new, d_new = moved(duration, [ca.if_else(moves, tangents[i][1] - dt[i], 0) for i in range(m)])
    over = ca.logic_or(landed > 0, ca.norm_2(new[:3]) <= radius)
    t_new = ca.if_else(meets, ca.fmax(line[1], t), t + duration)
    d_time = [ca.if_else(moves, tangents[i][1], dt[i]) for i in range(m)]
    kept = ca.vertcat(x, t, segment, dx, dt)
    gone = ca.vertcat(new, t_new, segment + meets, *d_new, *d_time)
    y = model.out(x, line[2] + _slope(line) * (t - line[0]), p)
    after = ca.if_else(over, kept, gone)
    following = ca.vertcat(after[:8], over, *[ca.fmax(peak[i], y[k]) for i, k in enumerate(peaks)], after[8:])
    step = ca.Function(f"{model.name}_step{m}", [state, fixed], [following], ["state", "fixed"], ["next"])

    tau = _time_to(rk, x, t, line, p, radius, h)
    end, d_end = moved(tau, [ca.SX(0)] * m)
    up, v = end[:3] / ca.norm_2(end[:3]), end[3:]
    arrival = [-ca.dot(up, d[:3]) / ca.dot(up, v) for d in d_end]
    force = model.rhs(end, line[2] + _slope(line) * (t + tau - line[0]), p)
    dx_f = ca.vertcat(*[d + force * a for d, a in zip(d_end, arrival, strict=True)]) if m else ca.SX(0, 1)
    dt_f = ca.vertcat(*[dt[i] + arrival[i] for i in range(m)]) if m else ca.SX(0, 1)
    last = ca.Function(f"{model.name}_last{m}", [state, fixed], [end, t + tau, landed, peak, dx_f, dt_f])
    return step, last


def _runge_kutta(model: Model, order: int) -> ca.Function:
    """(x, t, duration, T_k, T_k+1, B_k, B_k+1, p) stacked -> x after one step along the bank line."""
    coefficients = butcher(RK4() if order == 4 else RK8())
    a = ca.SX.sym("a", 12 + len(model.params))
    x, t, duration, line, p = a[:6], a[6], a[7], [a[8], a[9], a[10], a[11]], a[12:]
    slope = _slope(line)

    def rate(sigma: ca.SX, state: ca.SX) -> ca.SX:
        return model.rhs(state, line[2] + slope * (t + sigma * duration - line[0]), p)

    return ca.Function("rk", [a], [runge_kutta(rate, x, duration, ca.SX(0), 1.0, coefficients)])


def _slope(line: list[ca.SX]) -> ca.SX:
    # two nodes at one time are a jump of the bank angle, which takes no step
    return (line[3] - line[2]) / ca.fmax(line[1] - line[0], 1e-6)


def _line(segment: ca.SX, T: ca.SX, B: ca.SX, *, end: float = NEVER) -> list[ca.SX]:
    """[T_k, T_k+1, B_k, B_k+1] of the segment: 0 before the first node, n after the last."""
    n = T.numel()
    times, banks = [T[0] - end, *ca.vertsplit(T), T[n - 1] + end], [B[0], *ca.vertsplit(B), B[n - 1]]

    def chosen(values: list[ca.SX], shift: int) -> ca.SX:
        return sum((ca.if_else(segment == k, values[k + shift], 0) for k in range(n + 1)), ca.SX(0))

    return [chosen(times, 0), chosen(times, 1), chosen(banks, 0), chosen(banks, 1)]


def _time_to(rk: ca.Function, x: ca.SX, t: ca.SX, line: list[ca.SX], p: ca.SX, radius: float, h: ca.SX) -> ca.SX:
    """Time from x to the stop radius by Newton's method, at most one step (two where the flight has not come so far)."""
    X, D, A = ca.SX.sym("x", 6), ca.SX.sym("d"), ca.SX.sym("a", 6 + p.numel())  # A: t, line, p, h
    end = rk(ca.vertcat(X, A[0], D, A[1:5], A[5:-1]))
    distance = ca.norm_2(end[:3])
    closer = D - (distance - radius) / ca.fmin(ca.dot(end[:3], end[3:]) / distance, -1.0)
    newton = ca.Function(f"{rk.name()}_newton", [X, D, A], [ca.fmin(ca.fmax(closer, 0), 2 * A[-1])])
    tau, rest = ca.SX(0), ca.vertcat(t, *line, p, h)
    for _ in range(GUESSES):
        tau = newton.call([x, tau, rest], False, True)[0]
    return tau


def _split(vector: ca.SX, sizes: list[int]) -> list[ca.SX]:
    out, first = [], 0
    for size in sizes:
        out.append(vector[first : first + size, :])
        first += size
    return out


def _output(model: Model, name: str) -> int:
    names = [v.name for v in model.outputs]
    if name not in names:
        raise ModelError(unknown_name(f"prediction: output of {model.name}", name, names))
    return names.index(name)


def check_model(model: Model, radius: float) -> None:
    """Refuse a model that does not fly in planet-fixed axes, and a radius that is none."""
    if [v.name for v in model.states] != ["x", "y", "z", "u", "v", "w"] or [v.name for v in model.inputs] != ["bank"]:
        raise ModelError(
            f"prediction: {model.name} has states {[v.name for v in model.states]} and inputs {[v.name for v in model.inputs]},"
            " expected x y z u v w and bank; use models.entry_cartesian or entry_onboard"
        )
    if as_scalar("prediction: radius", radius) <= 0:
        raise ModelError(f"prediction: radius must be > 0 m, got {radius}")
