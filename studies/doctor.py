"""Check of an installation in a few seconds: versions, compiler, and a few numbers that are known from elsewhere."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass

DISTRIBUTION = "reentry-workbench"
_REQUIRED = ("casadi", "numpy", "scipy", "matplotlib", "pydantic", "ruamel-yaml", "rich", "typer", "jinja2", "xarray")
_ALLOCATION = ("osqp", "qpsolvers")  # installed with the workbench; only control allocation calls them
_OPTIONAL = {
    "control": "comparisons with python-control",
    "daqp": "a further quadratic-programming solver",
    "highspy": "a further quadratic-programming solver (HiGHS)",
    "nbclient": "running the notebooks",
}


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """One line of the doctor: what was looked at, whether it is as it must be, and what that means."""

    name: str
    ok: bool
    detail: str


def examine() -> list[Check]:
    """All checks in order; a check that breaks is a failed check with its reason, never an exception."""
    checks = [_python(), *_libraries(), _compiler()]
    numbers: dict[str, Callable[[], list[Check]]] = {
        "CasADi derivative": _derivative,
        "US 1976 density at 30 km": _density,
        "Riccati solution": _riccati,
        "reference N1": _study,
    }
    for name, check in numbers.items():
        checks += _guarded(name, check)
    return checks


def version() -> str:
    """Version of the installed workbench, or a remark that it runs from its source tree."""
    try:
        return importlib.metadata.version(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        return "not installed (source tree)"


def _guarded(name: str, check: Callable[[], list[Check]]) -> list[Check]:
    try:
        return check()
    except Exception as error:
        # any defect of an installation may show here, and the doctor is there to name it
        reason = (str(error).splitlines() or ["no text"])[0]
        return [Check(name, False, f"could not be computed: {type(error).__name__}: {reason}")]


def _python() -> Check:
    ok = sys.version_info >= (3, 11)
    need = "" if ok else "; 3.11 or newer is needed"
    return Check("Python", ok, f"{platform.python_version()} on {platform.system()} {platform.machine()}{need}")


def _libraries() -> list[Check]:
    checks = [Check("workbench", True, version())]
    for name in _REQUIRED:
        found = _installed(name)
        ok = found is not None
        detail = found or f"missing; install it with: pip install {name}"
        if name == "casadi" and found is not None and not found.startswith("3.8."):
            ok, detail = False, f"{found}; 3.8 is needed: pip install 'casadi>=3.8,<3.9'"
        checks.append(Check(name, ok, detail))
    for name in _ALLOCATION:
        found = _installed(name)
        detail = f"{found}; for control allocation" if found else f"missing; install it with: pip install {name}"
        checks.append(Check(name, found is not None, detail))
    for name, purpose in _OPTIONAL.items():
        found = _installed(name)
        checks.append(Check(name, True, found or f"absent; optional, for {purpose}"))
    return checks


def _installed(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _compiler() -> Check:
    names = [os.environ["CC"].split()[0]] if os.environ.get("CC", "").split() else ["cc", "gcc", "clang"]
    for name in names:
        if shutil.which(name):
            return Check("C compiler", True, f"{os.path.basename(name)} found; optional: every result is computed without it too")
    # not a fault: every number comes from the interpreter as well
    return Check("C compiler", True, "none found; optional: every result is computed by the interpreter")


def _compare(found: float, known: float, tolerance: float, unit: str, source: str) -> tuple[bool, str]:
    error = abs(found - known) / abs(known)
    text = f"{found:.6g} {unit}".strip() + f", expected {known:.6g} ({source})"
    return error <= tolerance, f"{text}, relative difference {error:.1e}, allowed {tolerance:.0e}"


def _derivative() -> list[Check]:
    import casadi as ca
    import numpy as np

    from models.checked import evaluate

    x = ca.SX.sym("x")
    slope = ca.Function("doctor_slope", [x], [ca.gradient(ca.exp(ca.sin(x)), x)])
    # d/dx exp(sin x) at 1 by hand: cos(1) exp(sin 1)
    found = float(evaluate(slope, np.array([1.0]))[0][0])
    return [Check("CasADi derivative", *_compare(found, 1.253380767493447, 1e-9, "", "cos(1) exp(sin 1)"))]


def _density() -> list[Check]:
    import numpy as np

    from models.atmosphere import us76
    from models.checked import evaluate

    found = float(evaluate(us76().density, np.array([30e3]))[0][0])
    return [Check("US 1976 density at 30 km", *_compare(found, 1.8410e-2, 1e-4, "kg/m3", "US Standard Atmosphere 1976, table I"))]


def _riccati() -> list[Check]:
    import numpy as np

    from ocp.riccati import care

    S = care(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)).S
    error = float(np.abs(S - np.array([[3**0.5, 1.0], [1.0, 3**0.5]])).max())
    detail = f"double integrator: S differs from [[sqrt 3, 1], [1, sqrt 3]] by {error:.1e}, allowed 1e-10"
    return [Check("Riccati solution", error < 1e-10, detail)]


def _study() -> list[Check]:
    from studies.gains import run
    from studies.scenario import Scenario

    result = run(Scenario.default()).to_dict()
    flight = _compare(float(result["reference"]["t_f_s"]), 547.064, 2e-4, "s", "an independent integration")
    gain = _compare(float(result["time_mean"]["K1"]), -0.62, 0.03, "per g", "printed by Tang & Zhao 2000")
    return [Check("flight time of reference N1", *flight), Check("time mean of K1 of reference N1", *gain)]
