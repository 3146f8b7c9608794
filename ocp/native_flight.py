"""Ensembles in compiled code: the loop over groups, with its stop, runs in SIMD lanes; only the last group is flown again here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from models import native
from models.core import Array, Model, Status
from models.native import Mode, Native
from models.native_loop import CROSSED, RUNNING, NativeLoop, compile_loop
from ocp.flight import Engine, Outcome, begin, conclude
from ocp.stops import Stop


@lru_cache(maxsize=16)
def _compiled(group: ca.Function, model: Model, until: Stop | None, mode: Mode) -> tuple[NativeLoop, Native]:
    """The loop over groups, and one group alone (its end carry) for the last part of each flight."""
    c, p = ca.SX.sym("c", group.size1_in(0)), ca.SX.sym("p", group.size1_in(2))
    nx, nu = len(model.states), len(model.inputs)
    margin = ca.SX(1) if until is None else until.expression(model, c[:nx, :], c[c.shape[0] - nu :, :], p)
    loop = compile_loop(group, ca.Function(f"{model.name}_margin", [c, p], [ca.densify(margin)]), mode=mode)
    outer = [ca.SX.sym(name, group.size1_in(i)) for i, name in enumerate("cqp")]
    end = ca.Function(f"{model.name}_group_end", outer, [group.call(outer)[0]], ["c", "q", "p"], ["c_next"])
    return loop, native.compile(end, mode=mode)


def fly_native(
    engine: Engine, x0: Array, p: Array, until: Stop | None, mode: Mode, *, progress: Callable[[float], None] | None = None
) -> Outcome:
    """As :func:`ocp.flight.fly_to_stop` for many cases, in compiled code.

    Without a compiler the loop falls back to the interpreter with the same results, and says so once.
    """
    total = len(engine.edges) - 1
    c, active, result = begin(engine, x0, p, until)
    if active.size:
        loop, end = _compiled(engine.group, engine.model, until, mode)
        ends = loop.run(c[active], engine.queue(engine.edges[:-1], engine.edges[1:]), p[active])
        running = ends.outcome == RUNNING
        for k in np.flatnonzero(running):
            i = active[k]
            result.t[i], result.c[i], result.group[i] = engine.edges[-1], ends.after[k], total
            if until is None:
                result.status[i] = Status.OK
        ended = ~running
        crossed = ends.outcome[ended] == CROSSED
        conclude(replace(engine, native=end), ends.before[ended], p, active[ended], ends.index[ended], crossed, until, result)
    if progress is not None:
        progress(1.0)
    return result
