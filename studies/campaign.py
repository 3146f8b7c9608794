"""Dispersion campaigns: very many dispersed flights in chunks, stored as they come, resumed after any interruption, replayed by number.

The numbers of a case depend on the scenario and its number alone: not on the chunks, their order, or who computes them.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from models.core import Array
from studies import campaign_store, campaign_workers
from studies.campaign_design import NAMES, Design, advice, design, deviations
from studies.campaign_flight import LOST, MEANINGS, STATES, VARIABLES, Backend, backend_for, fly_drawn, fly_remote, prepared, trajectory
from studies.campaign_store import CampaignError, Store, scenario_of
from studies.provenance import collect
from studies.scenario import Scenario

if TYPE_CHECKING:
    import xarray

    from ocp.trajectory import Trajectory
    from studies.result import StudyResult

__all__ = ["Campaign", "CampaignError", "Replay", "load", "replay", "run"]

Progress = Callable[[int, int], None]
_NO_RESULT = ("t_f", "miss_km", *(f"final_{name}" for name, _ in STATES))


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """Results of a campaign, proved by their markers.

    Attributes
    ----------
    path : Path
        The store.
    scenario : Scenario
    cases : ndarray of int, shape (M,)
        Numbers of the cases that were computed; M < ``scenario.campaign.cases`` for a partial campaign.
    data : mapping of ndarray, shape (M,)
        ``draw_*``, ``final_*``, ``t_f``, ``miss_km``, ``status``.
    failed_chunks : mapping
        Chunk -> reason, for chunks that killed their workers.
    lost : str
        Why the workers were lost before the end; empty otherwise.
    notes : tuple of str
        Remarks for people.
    """

    path: Path
    scenario: Scenario
    cases: np.ndarray
    data: Mapping[str, np.ndarray]
    failed_chunks: Mapping[int, str]
    lost: str = ""
    notes: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether every chunk was computed."""
        return len(self.cases) == self.scenario.campaign.cases and not self.failed_chunks

    @property
    def arrived(self) -> np.ndarray:
        """Mask of the cases that met their stop condition, shape (M,)."""
        return np.asarray(self.data["status"] == 0)

    @property
    def failed(self) -> list[tuple[str, int, str]]:
        """(campaign, case number, reason) of the cases that gave no result."""
        return self.first_failures(len(self.cases))

    def first_failures(self, count: int) -> list[tuple[str, int, str]]:
        """As :attr:`failed`, at most `count` of them."""
        name = f"campaign, {self.scenario.campaign.schedule}"
        return [(name, int(self.cases[i]), self.reason(int(i))) for i in np.flatnonzero(~self.arrived)[:count]]

    def reason(self, index: int) -> str:
        """Why the case at an index of `cases` failed."""
        code = int(self.data["status"][index])
        if code != LOST:
            return MEANINGS.get(code, f"status {code}")
        chunk = int(self.cases[index]) // self.scenario.campaign.chunk
        return (
            f"WORKER_LOST: {self.failed_chunks.get(chunk, 'its worker died')}; fly it alone: {self.replay_command(int(self.cases[index]))}"
        )

    def replay_command(self, case: int) -> str:
        """Command line that flies one case again."""
        return f"reentry campaign replay {shlex.quote(str(self.path))} {case}"

    def to_xarray(self) -> xarray.Dataset:
        """The proved results as a dataset over the coordinate ``case``."""
        import xarray

        about = {v.name: {"units": v.unit, "long_name": v.text} for v in VARIABLES}
        return xarray.Dataset(
            {name: ("case", values, about[name]) for name, values in self.data.items()}, coords={"case": self.cases},
            attrs={"scenario": self.scenario.to_yaml(), "complete": self.complete},
        )  # fmt: skip

    def result(self) -> StudyResult:
        """Statistics, figures and worst cases for the report."""
        from studies.campaign_report import result

        return result(self)


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """One case flown again.

    Attributes
    ----------
    case : int
    drawn, stored, flown : mapping of float
        Its deviations; its results in the store (none if it was never computed); its results now.
    same : bool
        Whether results and draws are the stored ones, bit for bit; False without stored results.
    changed : tuple of str
        What differs between this installation and the one that wrote the store.
    trajectory : Trajectory or None
        None for a case that cannot start.
    """

    case: int
    drawn: Mapping[str, float]
    stored: Mapping[str, float]
    flown: Mapping[str, float]
    same: bool
    changed: tuple[str, ...]
    trajectory: Trajectory | None


def run(
    scenario: Scenario | None, store: str | Path, *, resume: bool = False, workers: int = 0, scheduler: str | None = None,
    progress: Progress | None = None,
) -> Campaign:  # fmt: skip
    """Fly the campaign of a scenario into a store, or what is left of it.

    Parameters
    ----------
    scenario : Scenario or None
        None: that of the store (with `resume`), or the default one.
    store : path
        New or empty folder; with `resume` also the store of an interrupted campaign of the same settings and the same code.
    resume : bool
        Chunks that are complete are not computed again.
    workers : int
        Worker processes of this machine; 0: this process.
    scheduler : str, optional
        Address of a running dask scheduler, such as ``"tcp://host:8786"``.
    progress : callable, optional
        ``progress(cases done, cases)``.

    Returns
    -------
    Campaign
        All complete chunks.  ``lost`` tells of workers that went away.

    Raises
    ------
    CampaignError
        A place that is not empty, a store of other settings or code, a store in use.
    ModelError
        No reference flight or no certified gains for this scenario.
    OSError
        The disk is full or cannot be written.
    """
    if workers < 0 or (workers and scheduler):
        raise CampaignError(f"workers: found {workers} beside scheduler {scheduler!r}; give a number >= 0, or a scheduler, not both")
    path = Path(store)
    place, wanted, notes = _opened(path, scenario, resume)
    with place.locked():
        if resume:
            place.sweep()
            notes += _damage(place)
        marks = place.marks()
        todo = [chunk for chunk in range(place.chunks) if chunk not in marks or marks[chunk].failed]
        lost = ""
        if todo:
            try:
                _fill(place, wanted, todo, workers, scheduler, _counter(place, todo, progress))
            except campaign_workers.WorkersLostError as error:
                lost = str(error)
        if not lost and not place.attributes["complete"]:
            place.finish(complete=not any(mark.failed for mark in place.marks().values()))
        return _campaign(place, wanted, lost=lost, notes=notes)


def load(store: str | Path) -> Campaign:
    """Read a campaign, whole or partial.

    Raises
    ------
    CampaignError
        No store, or a chunk that is missing or altered although it was completed.
    """
    place = campaign_store.open_store(Path(store))
    return _campaign(place, scenario_of(place))


def replay(store: str | Path, case: int) -> Replay:
    """Fly one case of a campaign again and compare it with the store.

    Raises
    ------
    CampaignError
        No store, no such case, a damaged chunk.
    """
    place = campaign_store.open_store(Path(store))
    scenario = scenario_of(place)
    if not 0 <= case < place.cases:
        raise CampaignError(f"replay: case {case} is not in the campaign; give a number from 0 to {place.cases - 1}")
    drawn = deviations(_design_of(scenario).slice(case, 1), scenario.campaign.distributions)
    numbers, data = place.read()
    row = np.flatnonzero(numbers == case)
    stored = {name: values[row[0]].item() for name, values in data.items()} if row.size else {}
    flown = {name: values[0].item() for name, values in fly_drawn(scenario, drawn, _backend(place)).items()}
    now = {**{f"draw_{name}": float(value) for name, value in zip(NAMES, drawn[0], strict=True)}, **flown}
    lost = stored.get("status") == LOST
    same = bool(stored) and not lost and all(np.array_equal(stored[name], now[name], equal_nan=True) for name in now)
    names = {f"draw_{name}" for name in NAMES}
    return Replay(
        case, {name: now[name] for name in now if name in names}, {k: v for k, v in stored.items() if k not in names and not lost}, flown,
        same, tuple(_differences(place, scenario)), trajectory(scenario, drawn),
    )  # fmt: skip


def _opened(path: Path, scenario: Scenario | None, resume: bool) -> tuple[Store, Scenario, tuple[str, ...]]:
    """The store, new or continued, its scenario, and remarks."""
    if resume:
        campaign_store.sweep_around(path)
    if resume and campaign_store.holds_anything(path):
        place = campaign_store.open_store(path)
        wanted = scenario or scenario_of(place)
        if different := _differences(place, wanted):
            raise CampaignError(
                f"{path}: cannot be resumed: {'; '.join(different)}; use the store's own settings (leave the scenario out) and code,"
                " or start anew with another --out"
            )
    else:
        wanted = scenario or Scenario.default()
        campaign_store.require_empty(path)
        prepared(wanted, wanted.campaign.schedule)  # a scenario that cannot be flown leaves no store
        c = wanted.campaign
        place = campaign_store.create(path, VARIABLES, cases=c.cases, chunk=c.chunk, attributes=_attributes(wanted))
    note = advice(wanted.campaign.design, wanted.campaign.cases)
    return place, wanted, (note,) if note else ()


def _attributes(scenario: Scenario) -> dict[str, Any]:
    c = scenario.campaign
    return {
        "title": f"dispersion campaign of {scenario.vehicle.name}, study {c.study}, schedule {c.schedule}",
        "scenario": scenario.to_yaml(), "study": c.study, "schedule": c.schedule, "design": c.design, "seed": c.seed,
        "native": backend_for(scenario),
        "code_sha256": campaign_store.code_digest(), "versions": campaign_store.versions(), "provenance": collect(scenario, c.seed),
    }  # fmt: skip


def _differences(place: Store, scenario: Scenario) -> list[str]:
    """What keeps a store from being continued with a scenario, this code and these libraries, each with both values."""
    there, here = _flat(scenario_of(place).to_dict()), _flat(scenario.to_dict())
    found = [f"{key} is {there[key]!r} in the store and {value!r} now" for key, value in here.items() if there[key] != value]
    digest, now = str(place.attributes.get("code_sha256")), campaign_store.code_digest()
    if digest != now:
        found.append(f"the code has SHA-256 {digest[:12]} in the store and {now[:12]} now")
    versions = place.attributes.get("versions", {})
    now_here = campaign_store.versions()
    return found + [f"{name} is {versions.get(name)} in the store and {v} now" for name, v in now_here.items() if versions.get(name) != v]


def _backend(place: Store) -> Backend:
    """Who flies the cases of a store."""
    return "accurate" if place.attributes.get("native") == "accurate" else "off"


def _flat(values: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in values.items():
        out.update(_flat(value, f"{above}{key}.") if isinstance(value, dict) else {above + key: value})
    return out


def _design_of(scenario: Scenario) -> Design:
    c = scenario.campaign
    return design(c.design, seed=c.seed, cases=c.cases)


def _damage(place: Store) -> tuple[str, ...]:
    """Take away the markers of chunks that are not as they were written, so that these are computed again."""
    notes = []
    for chunk, name in place.altered().items():
        place.unmark(chunk)
        notes.append(f"chunk {chunk} was missing or altered ({name}) and is computed again")
    return tuple(notes)


def _fill(
    place: Store, scenario: Scenario, todo: Sequence[int], workers: int, scheduler: str | None, finished: Callable[[int], None]
) -> None:
    """Compute and store chunks; each is complete in the store before the next one is reported."""
    plan, laws, native = _design_of(scenario), scenario.campaign.distributions, _backend(place)

    def drawn(chunk: int) -> Array:
        return deviations(plan.slice(*place.bounds(chunk)), laws)

    with ExitStack() as stack:
        if workers or scheduler:
            client = stack.enter_context(campaign_workers.client_of(workers, scheduler))
            text, code = scenario.to_yaml(), campaign_store.code_digest()
            outcomes = campaign_workers.on_workers(client, todo, lambda chunk, tasks: (fly_remote, text, drawn(chunk), native, code, tasks))
        else:
            outcomes = campaign_workers.here(todo, lambda chunk: fly_drawn(scenario, drawn(chunk), native))
        for outcome in outcomes:
            draws = {f"draw_{name}": column for name, column in zip(NAMES, drawn(outcome.chunk).T, strict=True)}
            results = outcome.arrays if outcome.arrays is not None else _nothing(place.bounds(outcome.chunk)[1])
            place.write(outcome.chunk, {**draws, **results}, failed=outcome.failed)
            finished(outcome.chunk)


def _counter(place: Store, todo: Sequence[int], progress: Progress | None) -> Callable[[int], None]:
    """Reports the cases that are done, chunk by chunk; those of earlier runs at once."""
    done = place.cases - sum(place.bounds(chunk)[1] for chunk in todo)

    def finished(chunk: int) -> None:
        nonlocal done
        done += place.bounds(chunk)[1]
        if progress is not None:
            progress(done, place.cases)

    if progress is not None:
        progress(done, place.cases)
    return finished


def _nothing(count: int) -> dict[str, np.ndarray]:
    """Results of cases that have none."""
    return {**{name: np.full(count, np.nan) for name in _NO_RESULT}, "status": np.full(count, LOST)}


def _campaign(place: Store, scenario: Scenario, *, lost: str = "", notes: tuple[str, ...] = ()) -> Campaign:
    failed = {chunk: mark.failed for chunk, mark in place.marks().items() if mark.failed}
    cases, data = place.read()
    return Campaign(place.path, scenario, cases, data, failed, lost, notes)
