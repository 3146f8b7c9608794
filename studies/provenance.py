"""Where a result comes from: versions, machine type, date, commit, scenario digest. No name of a person, machine or folder."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from models.checked import ModelError

_LIBRARIES = ("casadi", "numpy", "scipy", "osqp", "matplotlib")
_DISTRIBUTION = "reentry-workbench"


def collect(scenario: object, seed: int) -> dict[str, Any]:
    """What is needed to run a study again, and nothing that identifies the user or the computer.

    Parameters
    ----------
    scenario : Scenario or mapping
        Only its digest is kept: equal digests mean equal settings.
    seed : int
        Seed of the random dispersions.

    Returns
    -------
    dict
        Plain values: package, commit (where known), date_utc, python, one entry for each library, platform, cpu_count,
        seed, scenario_sha256.

    Raises
    ------
    ModelError
        A scenario that is no mapping and has no ``model_dump``, or a seed that is no integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise ModelError(f"provenance: seed must be an integer, got {seed!r}")
    facts: dict[str, Any] = {"package": _version(_DISTRIBUTION) or "source tree"}
    commit = _commit(Path(__file__).resolve().parent)
    if commit:
        facts["commit"] = commit
    facts["date_utc"] = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
    facts["python"] = f"{platform.python_version()} ({platform.python_implementation()})"
    facts.update({name: version for name in _LIBRARIES if (version := _version(name)) is not None})
    # platform.platform() is avoided: a kernel release may carry the name of its builder.
    facts["platform"] = f"{platform.system()} {platform.machine()}"
    facts["cpu_count"] = _cpu_count()
    facts["seed"] = seed
    facts["scenario_sha256"] = _digest(scenario)
    return facts


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _cpu_count() -> int:
    """Processors this process may use: fewer than the machine has, in a container."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _digest(scenario: object) -> str:
    if hasattr(scenario, "model_dump"):
        content = scenario.model_dump(mode="json")
    elif isinstance(scenario, Mapping):
        content = dict(scenario)
    else:
        raise ModelError(f"provenance: expected a Scenario or a mapping, got {type(scenario).__name__}")
    try:
        text = json.dumps(content, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelError(
            f"provenance: the scenario cannot be written as JSON ({error}); use finite numbers, text, lists and mappings"
        ) from None
    return hashlib.sha256(text.encode()).hexdigest()


def _commit(package: Path) -> str | None:
    """Commit of the source tree, marked when files were changed; None for an installed package or without git."""
    top = _git(package, "rev-parse", "--show-toplevel")
    # An installed package may lie inside another project's repository: that commit would say nothing.
    if top is None or Path(top).resolve() != package.parent:
        return None
    head = _git(package, "rev-parse", "--verify", "HEAD")
    if head is None:
        return None
    changed = _git(package, "status", "--porcelain", "--untracked-files=no")
    return head[:12] + (" with local changes" if changed else "")


def _git(folder: Path, *command: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", str(folder), *command], capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
