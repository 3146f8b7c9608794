"""The allocation methods of the workbench, ready to be compared (:func:`allocation.compare.compare`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from allocation import backends, blending, bound, predictive, pseudo_inverse, qp_native
from allocation.compare import Answers, Method, stepwise
from allocation.core import Effectors
from allocation.demand_history import History
from models.checked import Array, ModelError

BOUND = "on-off bound (MILP)"


def own(name: str = "QP (own)") -> Method:
    """Bounded weighted least squares with the own solver: all samples at once, or one after the other where rates limit."""

    def answer(history: History) -> Answers:
        B, low, high, axis, effector = _arrays(history)
        zero = np.zeros(len(history.effectors.names))
        room = np.where(np.isinf(history.effectors.rate), np.inf, history.effectors.rate * history.dt)

        def solve() -> qp_native.Solutions:
            if np.isinf(room).all():
                return qp_native.solve_many(
                    B, history.demand, lower=low, upper=high, axis_weight=axis, effector_weight=effector, preferred=zero
                )
            start = np.clip(0.0, low[0] if low.ndim == 2 else low, high[0] if high.ndim == 2 else high)
            return qp_native.solve_history(
                B, history.demand, lower=low, upper=high, axis_weight=axis, effector_weight=effector, preferred=zero, room=room, start=start
            )

        solve()  # compiles
        began = time.perf_counter()
        found = solve()
        return Answers(found.u, found.kkt, found.solved, time.perf_counter() - began)

    return Method(name, answer)


def backend(solver: str, *, most: int = 0) -> Method:
    """The same quadratic program by one of :func:`allocation.backends.available`, as configured there."""

    def answer(history: History) -> Answers:
        first = history.weights_at(0)
        made = backends.Backend.of(solver, history.at(0).B, axis=first.axis, effector=first.effector, preferred=first.preferred)

        def step(k: int, effectors: Effectors, demand: Array, previous: Array) -> tuple[Array, Array | None, bool]:
            w = history.weights_at(k)
            u, kkt = made.solve(demand, lower=effectors.lower, upper=effectors.upper, B=effectors.B, axis=w.axis, effector=w.effector)
            return u, kkt, bool(kkt.max() <= backends.ACCEPTED)

        return stepwise(history, step, solver)

    return Method(f"QP ({solver})", answer, most)


def pseudo(kind: str = "redistributed", *, groups: Sequence[Sequence[str]] = ()) -> Method:
    """A pseudo-inverse: "weighted", "redistributed", or "daisy chain" with its groups."""
    functions: dict[str, Callable[..., object]] = {"weighted": pseudo_inverse.weighted, "redistributed": pseudo_inverse.redistributed}
    if kind not in (*functions, "daisy chain"):
        raise ModelError(f"pseudo: unknown kind {kind!r}; known: weighted, redistributed, daisy chain")

    def answer(history: History) -> Answers:
        def step(k: int, effectors: Effectors, demand: Array, previous: Array) -> tuple[Array, Array | None, bool]:
            w = history.weights_at(k)
            if kind == "daisy chain":
                found = pseudo_inverse.daisy_chain(effectors, demand, groups=groups, weights=w)
            elif kind == "weighted":
                found = pseudo_inverse.weighted(effectors, demand, weights=w)
            else:
                found = pseudo_inverse.redistributed(effectors, demand, weights=w)
            return found.u, None, True

        if history.B is None and history.lower is None and np.isinf(history.effectors.rate).all() and kind != "daisy chain":
            w = history.weights_at(0)
            began = time.perf_counter()
            method = pseudo_inverse.weighted if kind == "weighted" else pseudo_inverse.redistributed
            u = method(history.effectors, history.demand, weights=w).u
            return Answers(u, np.full((len(u), 3), np.nan), np.ones(len(u), dtype=bool), time.perf_counter() - began)
        return stepwise(history, step, kind)

    return Method("pseudo-inverse" if kind == "weighted" else kind, answer)


def paper_logic(handover: blending.Handover | None = None, *, name: str = "paper logic") -> Method:
    """Equation 20 on a pitch history: effectors (elevon control term, nose-up jets, nose-down jets), context demand_rad, qbar, trim.

    Raises
    ------
    ModelError
        Another number of axes or effectors, or a context that is missing: the logic knows one axis and one surface.
    """
    h = handover or blending.Handover()

    def answer(history: History) -> Answers:
        e = history.effectors
        missing = [key for key in ("demand_rad", "qbar", "trim") if key not in history.context]
        if e.B.shape != (1, 3) or missing:
            raise ModelError(
                f"paper logic: it shares one pitch demand between one elevon term and two jet groups; got {e.B.shape[0]} axes,"
                f" {e.B.shape[1]} effectors" + (f", and no {missing[0]} in the context" if missing else "")
            )
        B, low, high, *_ = _arrays(history)
        rows = np.broadcast_to(B, (len(history), 1, 3))[:, 0]
        began = time.perf_counter()
        elevon, k_blend = blending.share_arrays(*(history.context[key] for key in ("demand_rad", "qbar", "trim")), handover=h)
        moment = k_blend * history.demand[:, 0]
        up, down = np.maximum(moment, 0.0) / rows[:, 1], np.minimum(moment, 0.0) / rows[:, 2]
        u = np.column_stack([elevon, np.minimum(up, 1.0), np.minimum(down, 1.0)])
        seconds = time.perf_counter() - began
        low, high = np.broadcast_to(low, u.shape).copy(), np.broadcast_to(high, u.shape).copy()
        low[:, 1:], high[:, 1:] = e.lower[1:], e.upper[1:]  # when jets may fire is the logic's own decision
        if np.isfinite(e.rate).any():  # the same rates for everyone
            found = stepwise(replace(history, lower=low, upper=high), lambda k, effectors, demand, previous: (u[k], None, True), name)
            return Answers(found.u, found.kkt, found.solved, seconds)
        return Answers(np.clip(u, low, high), np.full((len(u), 3), np.nan), np.ones(len(u), dtype=bool), seconds)

    return Method(name, answer)


def horizon(tradeoff: predictive.Tradeoff | None = None, *, most: int = 0) -> Method:
    """Predictive allocation with the history's own future as a preview; needs effectiveness and limits that do not change."""

    def answer(history: History) -> Answers:
        if history.B is not None or history.lower is not None or history.upper is not None:
            return _moving_horizon(history, tradeoff or predictive.Tradeoff())
        began = time.perf_counter()
        found = predictive.receding_horizon(
            history.effectors, history.demand, dt=history.dt, tradeoff=tradeoff, weights=history.weights_at(0)
        )
        seconds = time.perf_counter() - began
        states = found.status if isinstance(found.status, tuple) else (found.status,)
        return Answers(found.u, np.column_stack(found.kkt), np.array([s.ok for s in states]), seconds)

    return Method("predictive", answer, most)


def _moving_horizon(history: History, tradeoff: predictive.Tradeoff) -> Answers:
    """A new horizon problem for each sample, with the effectors of that moment."""
    H = tradeoff.horizon
    ahead = np.vstack([history.demand, np.repeat(history.demand[-1:], H, axis=0)])
    owed = np.zeros(history.demand.shape[1])

    def step(k: int, effectors: Effectors, demand: Array, previous: Array) -> tuple[Array, Array | None, bool]:
        nonlocal owed
        now = history.at(k)
        made = predictive.planner(now, dt=history.dt, tradeoff=tradeoff, weights=history.weights_at(k))
        plan = made.plan(ahead[k : k + H], np.clip(previous, now.lower, now.upper), owed)
        u = np.clip(plan.u[0], effectors.lower, effectors.upper)
        owed = owed + demand - effectors.B @ u
        return u, np.array(plan.kkt), plan.status.ok

    return stepwise(history, step, "predictive")


def on_off_bound(*, most: int = 100, time_limit: float = 1.0, shortest: float = 1.0, opposed: bool = False) -> Method:
    """What jets that are on or off for each cycle by itself could do at best, by a mixed-integer program, on `most` samples.

    Each effector with a flow is one switch, so a group of jets fires whole.  Cycles know nothing of each other: nothing fires for a
    demand of less than half of what one switch gives, however long it lasts.

    Parameters
    ----------
    most : int
        Samples that it is asked for.
    time_limit : float
        s, for each sample.
    shortest : float
        Shortest pulse, in parts of the cycle; 1: on or off for the whole cycle.
    opposed : bool
        Let jets fire against each other; see :func:`allocation.bound.on_off`.
    """

    def answer(history: History) -> Answers:
        def step(k: int, effectors: Effectors, demand: Array, previous: Array) -> tuple[Array, Array | None, bool]:
            found = bound.on_off(
                effectors, demand, weights=history.weights_at(k), shortest=shortest, opposed=opposed, time_limit=time_limit
            )
            return found.allocation.u, None, found.allocation.ok

        free = replace(history, effectors=replace(history.effectors, rate=np.inf))  # type: ignore[arg-type]
        return stepwise(free, step, "on-off bound")

    return Method(BOUND, answer, most)


def standard(*, solvers: Sequence[str] | None = None, slow: int = 200, bound_samples: int = 100) -> list[Method]:
    """Every method that any history can be given to: own solver, all installed back ends, pseudo-inverses, predictive, on-off bound.

    Parameters
    ----------
    solvers : sequence of str, optional
        Back ends; all that are installed unless given.
    slow : int
        Samples for each back end and the predictive method.
    bound_samples : int
        Samples for the mixed-integer bound; 0 leaves it out.
    """
    chosen = backends.available() if solvers is None else tuple(solvers)
    found = [own(), *(backend(s, most=slow) for s in chosen), pseudo("weighted"), pseudo("redistributed"), horizon(most=slow)]
    return found + ([on_off_bound(most=bound_samples)] if bound_samples else [])


def _arrays(history: History) -> tuple[Array, Array, Array, Array, Array]:
    """B, lower, upper, axis weights, effector weights: constant, or one for each sample."""
    e, w = history.effectors, history.weights_at(0)
    return (
        e.B if history.B is None else history.B, e.lower if history.lower is None else history.lower,
        e.upper if history.upper is None else history.upper,
        w.axis if history.axis_weight is None else history.axis_weight,
        w.effector if history.effector_weight is None else history.effector_weight,
    )  # fmt: skip
