"""Cases of the blending study: stress, single dispersions and random ones, and how they go together with changes of the user's own."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from models.checked import Array, ModelError, as_scalar, as_vector, unknown_name
from models.units import DEG, INCH
from studies.blend_design import START
from studies.blend_loop import BlendLoop

STRESS = 2 * DEG
SINGLES: Mapping[str, Mapping[str, float]] = {
    "nominal": {},
    "stress +2 deg": {"stress": STRESS},
    "stress -2 deg": {"stress": -STRESS},
    "Cm +20 %": {"Cm_factor": 1.2},
    "Cm -20 %": {"Cm_factor": 0.8},
    "elevon +20 %": {"elevon_factor": 1.2},
    "elevon -20 %": {"elevon_factor": 0.8},
    "CL +20 %": {"CL_factor": 1.2},
    "CL -20 %": {"CL_factor": 0.8},
    "CD +20 %": {"CD_factor": 1.2},
    "CD -20 %": {"CD_factor": 0.8},
    "c.g. 2 in aft": {"cg_aft": 2 * INCH},
    "c.g. 2 in forward": {"cg_aft": -2 * INCH},
    "wind x 0.5": {"wind_factor": 0.5},
    "wind x 1.5": {"wind_factor": 1.5},
    "one of six nose-up jets lost": {"up_share": 5 / 6},
    "Cm +20 %, elevon -20 %": {"Cm_factor": 1.2, "elevon_factor": 0.8},
}
SPREAD: Mapping[str, tuple[float, float]] = {
    "Cm_factor": (0.8, 1.2), "elevon_factor": (0.8, 1.2), "CL_factor": (0.8, 1.2), "CD_factor": (0.8, 1.2),
    "cg_aft": (-2 * INCH, 2 * INCH), "wind_factor": (0.5, 1.5),
}  # fmt: skip


def combined(changes: Mapping[str, float], more: Mapping[str, float]) -> dict[str, float]:
    """Changes with those of a case on top: factors and shares are multiplied, shifts of the centre of mass added, all else replaced.

    Parameters
    ----------
    changes, more : mapping of str to float
        By name, as :meth:`studies.blend_loop.BlendLoop.parameters` takes them.
    """
    found = dict(changes)
    for name, value in more.items():
        if _multiplies(name):
            found[name] = changes.get(name, 1.0) * value
        elif name == "cg_aft":
            found[name] = changes.get(name, 0.0) + value
        else:
            found[name] = value
    return found


def _multiplies(name: str) -> bool:
    return name.endswith(("_factor", "_share"))


def split(loop: BlendLoop, changes: Mapping[str, float] | None) -> tuple[Array, dict[str, float]]:
    """Start of the flight (nx,) and changed parameters, out of changes that may name both.

    Raises
    ------
    ModelError
        A name that is neither a parameter nor an initial state, a number that is not finite, a start outside its range.
    """
    known = (*loop.params, *START)
    given = {}
    for name, value in (changes or {}).items():
        if name not in known:
            raise ModelError(unknown_name("blend: parameters and initial states", name, known))
        given[name] = as_scalar(f"blend: {name}", value)
    x0 = np.array([given.pop(name, value) for name, value in START.items()])
    return as_vector("blend: start", x0, loop.model.states), given


def single_parameters(loop: BlendLoop, changes: Mapping[str, float] | None = None) -> dict[str, Array]:
    """Parameters (np,) of each of ``SINGLES`` on top of changed parameters.

    Raises
    ------
    ModelError
        A value that leaves its range in one of the cases.
    """
    given = dict(changes or {})
    found = {}
    for name, more in SINGLES.items():
        try:
            found[name] = loop.parameters(combined(given, more))
        except ModelError as error:
            raise ModelError(f"blend: single case {name!r} on top of the changes: {error}") from None
    return found


def check_cases(cases: int) -> None:
    """Refuse a number of random dispersions that is none.

    Raises
    ------
    ModelError
        Not a whole number, or less than 0.
    """
    if isinstance(cases, bool) or not isinstance(cases, int) or cases < 0:
        raise ModelError(f"blend: cases: expected a whole number, 0 or more, got {cases!r}")


def dispersed(loop: BlendLoop, cases: int, *, seed: int, changes: Mapping[str, float] | None = None) -> Array:
    """Parameters of random dispersions: everything of ``SPREAD`` uniform and independent.

    Parameters
    ----------
    loop : BlendLoop
    cases : int
    seed : int
        Case i is the same for any number of cases.
    changes : mapping, optional
        Changed parameters, which the dispersions are on top of (:func:`combined`).

    Returns
    -------
    ndarray, shape (cases, np)

    Raises
    ------
    ModelError
        A number of cases that is none, a changed parameter that leaves its range at an end of its spread.
    """
    check_cases(cases)
    given = dict(changes or {})
    p = np.tile(loop.parameters(given), (cases, 1))
    draws = np.random.Generator(np.random.Philox(seed)).random((cases, len(SPREAD)))
    for j, (name, ends) in enumerate(SPREAD.items()):
        for end in ends:
            try:
                loop.parameters(combined(given, {name: end}))
            except ModelError as error:
                raise ModelError(f"blend: dispersions of {name} on top of the changes: {error}") from None
        drawn = ends[0] + (ends[1] - ends[0]) * draws[:, j]
        column = p[:, loop.params.index(name)]
        p[:, loop.params.index(name)] = column * drawn if _multiplies(name) else column + drawn
    return p
