"""Ensembles in compiled code: the loop over steps, with the search for the stop inside the last one, runs in SIMD lanes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np

from models.core import Array, Status
from models.native import Mode
from models.native_loop import CROSSED, NONFINITE, REFUSED, NativeLoop, Stopping, compile_loop
from ocp.flight import CODE, Engine, Outcome, conclude


@lru_cache(maxsize=16)
def _compiled(group: ca.Function, margin: ca.Function | None, stopping: Stopping | None, mode: Mode) -> NativeLoop:
    """The loop over groups; without a stop condition under a margin that stays positive."""
    if margin is None:
        c, p = ca.SX.sym("c", group.size1_in(0)), ca.SX.sym("p", group.size1_in(2))
        margin = ca.Function("no_margin", [c, p], [ca.SX(1)])
    return compile_loop(group, margin, stopping=stopping, mode=mode)


def fly_native(engine: Engine, x0: Array, p: Array, mode: Mode, *, progress: Callable[[float], None] | None = None) -> Outcome:
    """As :func:`ocp.flight.fly_to_stop` for many cases, in compiled code.

    Without a compiler the loop falls back to the interpreter with the same results, and says so once.
    """
    loop = _compiled(engine.group, engine.margin, engine.stopping, mode)
    ends = loop.run(engine.start(x0), engine.steps(), p)
    crossed, lost = ends.outcome == CROSSED, ends.outcome == NONFINITE
    edges = np.append(engine.edges, engine.edges[-1])
    t = edges[ends.index] + ends.fraction * (edges[ends.index + 1] - edges[ends.index])
    status = np.full(len(x0), CODE[Status.STOP_NOT_REACHED if engine.stopping is not None else Status.OK])
    finite = np.isfinite(ends.after).all(axis=1)
    status[crossed & finite] = CODE[Status.OK]
    status[ends.outcome == REFUSED] = CODE[Status.OUT_OF_DOMAIN]
    result = Outcome(t, ends.after, ends.index, ends.fraction, status)
    lost = lost | (crossed & ~finite)
    if lost.any():
        cases = np.flatnonzero(lost)
        conclude(engine, ends.before[cases], ends.after[cases], p, cases, ends.index[cases], np.zeros(cases.size, dtype=bool), result)
    if progress is not None:
        progress(1.0)
    return result
