"""Campaigns: identical bytes however they are computed, refusals, damage, resuming, replaying."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from models import native
from models.checked import ModelError
from models.native import NativeWarning, native_available
from ocp import native_flight
from studies import campaign, campaign_flight, campaign_store, campaign_workers
from studies.campaign import Campaign, CampaignError
from studies.campaign_flight import CODES, LOST, VARIABLES, backend_for, prepared
from studies.files import OutputError
from studies.scenario import Scenario

CASES, CHUNK = 22, 5


def small(**changes: Any) -> Scenario:
    return Scenario.default().edit({"campaign.cases": CASES, "campaign.chunk": CHUNK, **{f"campaign.{k}": v for k, v in changes.items()}})


def digest(done: Campaign) -> str:
    return hashlib.sha256(b"".join(name.encode() + done.data[name].tobytes() for name in sorted(done.data))).hexdigest()


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return campaign.run(small(), tmp_path_factory.mktemp("campaign") / "store")


@pytest.fixture
def store(original: Campaign, tmp_path: Path) -> Path:
    shutil.copytree(original.path, tmp_path / "store")
    return tmp_path / "store"


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the chunks that are flown from now on."""
    sizes: list[int] = []
    fly = campaign.fly_drawn

    def counted(scenario: Scenario, drawn: Any, native: Any) -> dict[str, Any]:
        sizes.append(len(drawn))
        return fly(scenario, drawn, native)

    monkeypatch.setattr(campaign, "fly_drawn", counted)
    return sizes


def test_campaign_is_complete_and_plausible(original: Campaign) -> None:
    assert original.complete
    assert original.arrived.all()
    assert np.array_equal(original.cases, np.arange(CASES))
    np.testing.assert_allclose(original.data["final_h"], 10e3, rtol=1e-9)
    length = prepared(original.scenario, "time_varying").reference["s"][-1]
    np.testing.assert_allclose(original.data["final_s"], length + 1e3 * original.data["miss_km"], rtol=1e-12)
    assert 0.1 < np.sqrt(np.mean(original.data["miss_km"] ** 2)) < 3.0


@pytest.mark.parametrize("chunk", [1, 7, 1000])
@pytest.mark.parametrize("design", ["independent", "latin_hypercube", "sobol"])
def test_same_bytes_for_any_chunk(design: str, chunk: int, original: Campaign, tmp_path: Path) -> None:
    if design == "independent":
        first = original
    else:
        first = campaign.run(small(design=design), tmp_path / "first")
        assert digest(first) != digest(original)
    again = campaign.run(small(design=design, chunk=chunk), tmp_path / "again")
    assert digest(again) == digest(first)


def test_same_bytes_in_any_order(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ordered = campaign_workers.here

    def shuffled(todo: Any, call: Callable[[int], Any]) -> Iterator[Any]:
        return ordered([int(i) for i in np.random.default_rng(4).permutation(todo)], call)

    monkeypatch.setattr(campaign_workers, "here", shuffled)
    assert digest(campaign.run(small(), tmp_path / "store")) == digest(original)


@pytest.mark.skipif(not native_available(), reason="no compiler")
def test_compiled_flights_give_the_same_bytes_for_any_chunk(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "backend_for", lambda scenario: "accurate")
    found = {chunk: campaign.run(small(chunk=chunk), tmp_path / str(chunk)) for chunk in (1, 7, 1000)}
    assert len({digest(done) for done in found.values()}) == 1
    for name, values in original.data.items():
        np.testing.assert_allclose(found[7].data[name], values, rtol=1e-9, atol=1e-9)
    assert campaign.replay(tmp_path / "7", 5).same
    (tmp_path / "7" / "markers" / "0.json").unlink()

    def without_compiler(*arguments: Any, **options: Any) -> None:
        warnings.warn("native code: no compiler", NativeWarning, stacklevel=2)

    with monkeypatch.context() as patch:
        patch.setattr(campaign_flight, "simulate_ensemble", without_compiler)
        with pytest.raises(ModelError, match="it is flown by compiled code, which is not to be had here"):
            campaign.run(None, tmp_path / "7", resume=True)
    assert digest(campaign.run(None, tmp_path / "7", resume=True)) == digest(found[1])


@pytest.mark.skipif(not native_available(), reason="no compiler")
def test_compiled_flights_give_the_same_bytes_for_any_lanes_and_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "backend_for", lambda scenario: "accurate")
    found = set()
    for lanes in (4, 8):
        for threads in (1, 2):
            monkeypatch.setattr(native, "BEST_LANES", {native.cpu_target(): lanes})
            monkeypatch.setattr(native, "processors", lambda threads=threads: threads)
            native_flight._compiled.cache_clear()
            found.add(digest(campaign.run(small(chunk=7), tmp_path / f"{lanes}-{threads}")))
    native_flight._compiled.cache_clear()
    assert len(found) == 1


def test_who_flies_depends_on_the_whole_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    assert backend_for(small()) == "off"
    monkeypatch.setenv("REENTRY_NATIVE", "off")
    assert backend_for(small(cases=10**6)) == "off"


def test_xarray_reads_the_store(original: Campaign) -> None:
    with xarray.open_zarr(original.path) as data:
        assert set(data.data_vars) == {v.name for v in VARIABLES}
        for name, values in original.data.items():
            assert data[name].values.tobytes() == values.tobytes()
            assert data[name].attrs["units"]
        assert data.attrs["complete"] is True
        assert Scenario.parse(data.attrs["scenario"]) == original.scenario
        assert len(data.attrs["code_sha256"]) == 64
        codes = dict(zip(data.status.attrs["flag_meanings"].split(), data.status.attrs["flag_values"], strict=True))
    assert {status.name: number for status, number in CODES.items()}.items() <= codes.items()
    assert original.to_xarray().miss_km.values.tobytes() == original.data["miss_km"].tobytes()


def test_progress_counts_cases(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    campaign.run(small(), tmp_path / "store", progress=lambda done, total: seen.append((done, total)))
    assert seen == [(0, 22), (5, 22), (10, 22), (15, 22), (20, 22), (22, 22)]


# Refusals.


def test_a_place_with_content_is_refused_and_kept(store: Path, tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="is not empty; continue a campaign with --resume"):
        campaign.run(small(), store)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    for resume in (False, True):
        with pytest.raises(CampaignError, match="is not empty" if not resume else "is not a campaign store"):
            campaign.run(small(), tmp_path / "mine", resume=resume)
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"
    with pytest.raises(OutputError, match="is a file"):
        campaign.run(small(), tmp_path / "mine" / "letter.txt")
    assert digest(campaign.load(store))


def test_an_empty_folder_is_taken(original: Campaign, tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    assert digest(campaign.run(small(), tmp_path / "store")) == digest(original)
    assert [entry.name for entry in tmp_path.iterdir()] == ["store"]


def test_a_scenario_that_cannot_be_flown_leaves_no_store(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="reference flight"):
        campaign.run(small().edit({"reference.t_max_s": 20.0}), tmp_path / "store")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("key", "value", "shown"),
    [
        ("campaign.seed", 3, "campaign.seed is 20000503 in the store and 3 now"),
        ("campaign.design", "sobol", "campaign.design is 'independent' in the store and 'sobol' now"),
        ("campaign.cases", 23, "campaign.cases is 22 in the store and 23 now"),
        ("campaign.chunk", 6, "campaign.chunk is 5 in the store and 6 now"),
        ("campaign.distributions.lift.spread", 0.2, "campaign.distributions.lift.spread is 0.1 in the store and 0.2 now"),
        ("vehicle.lift_to_drag", 0.26, "vehicle.lift_to_drag is 0.25 in the store and 0.26 now"),
    ],
)
def test_resume_with_another_scenario_names_the_difference(store: Path, key: str, value: Any, shown: str) -> None:
    with pytest.raises(CampaignError) as caught:
        campaign.run(small().edit({key: value}), store, resume=True)
    assert f"{store}: cannot be resumed: {shown}; use" in str(caught.value)


def test_resume_with_other_code_or_libraries_names_the_difference(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_store, "code_digest", lambda: "f" * 64)
    known = campaign_store.versions()
    monkeypatch.setattr(campaign_store, "versions", lambda: {**known, "casadi": "9.9"})
    with pytest.raises(CampaignError, match=r"the code has SHA-256 .* and ffffffffffff now; casadi is .* and 9.9 now"):
        campaign.run(None, store, resume=True)


def test_code_digest_sees_every_source_file() -> None:
    names = {path.name for path in campaign_store._sources(Path(campaign.__file__).resolve().parent.parent)}
    assert {"entry.py", "simulate.py", "flight.py", "guidance.py", "campaign.py", "campaign_design.py"} <= names


def test_a_store_in_use_is_refused(store: Path) -> None:
    place = campaign_store.open_store(store)
    with place.locked(), pytest.raises(CampaignError, match="another campaign is writing"):
        campaign.run(None, store, resume=True)


# Interruptions.


def test_interrupt_keeps_complete_chunks_and_resume_adds_the_rest(
    original: Campaign, tmp_path: Path, flown: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    write = campaign_store._mark

    def interrupted(path: Path, content: Any) -> None:
        if content["first"] == 15:
            raise KeyboardInterrupt
        write(path, content)

    monkeypatch.setattr(campaign_store, "_mark", interrupted)
    with pytest.raises(KeyboardInterrupt):
        campaign.run(small(), tmp_path / "store")
    monkeypatch.setattr(campaign_store, "_mark", write)
    part = campaign.load(tmp_path / "store")
    assert (part.complete, list(part.cases)) == (False, list(range(15)))
    with xarray.open_zarr(tmp_path / "store") as data:
        assert data.attrs["complete"] is False
    flown.clear()
    assert digest(campaign.run(small(), tmp_path / "store", resume=True)) == digest(original)
    assert flown == [5, 2]
    flown.clear()
    assert digest(campaign.run(None, tmp_path / "store", resume=True)) == digest(original)
    assert flown == []


def test_resume_starts_a_campaign_and_sweeps_litter(original: Campaign, tmp_path: Path) -> None:
    half = tmp_path / ".store.abcdef.partial"  # a store that was being made when its campaign was killed
    half.mkdir()
    (half / "zarr.json").write_text("{}")
    (tmp_path / ".store.ghijkl.partial").mkdir()  # killed before its first file
    done = campaign.run(small(), tmp_path / "store", resume=True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["store"]
    litter = [done.path / "t_f" / "c" / "0.123.partial", done.path / "markers" / ".3.json.x.partial"]
    for path in litter:
        path.write_bytes(b"x")
    assert digest(campaign.run(None, tmp_path / "store", resume=True)) == digest(original)
    assert not any(path.exists() for path in litter)


# Damage.


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[11] ^= 4
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("damage", [flip, cut, Path.unlink])
@pytest.mark.parametrize("name", ["miss_km", "draw_V"])
def test_damage_is_an_error_and_resume_repairs_it(
    original: Campaign, store: Path, flown: list[int], damage: Callable[[Path], None], name: str
) -> None:
    damage(store / name / "c" / "2")
    for call in (lambda: campaign.load(store), lambda: campaign.replay(store, 0)):
        with pytest.raises(CampaignError, match=rf"{name} of chunk 2 \(cases 10 to 14\) is missing or altered; run .* --resume"):
            call()
    flown.clear()
    done = campaign.run(None, store, resume=True)
    assert flown == [5]
    assert done.notes == (f"chunk 2 was missing or altered ({name}) and is computed again",)
    assert digest(done) == digest(original)


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"sha256": {}, "failed": ""}', '{"first": 10, "count": 4, "failed": "", "sha256": {}}']
)
def test_a_damaged_marker_does_not_count(original: Campaign, store: Path, content: str) -> None:
    (store / "markers" / "2.json").write_text(content)
    assert list(campaign.load(store).cases) == [*range(10), *range(15, 22)]
    assert digest(campaign.run(None, store, resume=True)) == digest(original)


def test_damaged_metadata_is_an_error(store: Path, tmp_path: Path) -> None:
    text = (store / "zarr.json").read_text()
    for damaged in (text[:100], json.dumps({**json.loads(text), "attributes": {}}), text.replace('"cases": 22', '"cases": 24')):
        (store / "zarr.json").write_text(damaged)
        with pytest.raises(CampaignError, match=r"is not a campaign store|of another format"):
            campaign.load(store)
    with pytest.raises(CampaignError, match="no such store"):
        campaign.load(tmp_path / "none")


# Failures and replay.


def test_a_chunk_without_result_is_recorded_and_tried_again(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fly = campaign_workers.here

    def poisoned(todo: Any, call: Callable[[int], Any]) -> Iterator[Any]:
        for outcome in fly(todo, call):
            yield campaign_workers.Outcome(2, None, "its worker died 3 times") if outcome.chunk == 2 else outcome

    monkeypatch.setattr(campaign_workers, "here", poisoned)
    done = campaign.run(small(), tmp_path / "store")
    assert not done.complete
    assert [(number, reason.split(";")[0]) for _, number, reason in done.failed] == [
        (case, "WORKER_LOST: its worker died 3 times") for case in range(10, 15)
    ]
    assert "reentry campaign replay" in done.failed[0][2]
    assert (done.data["status"][10:15] == LOST).all()
    assert np.isnan(done.data["t_f"][10:15]).all()
    assert (tmp_path / "store" / "miss_km" / "c" / "2").is_file()  # written, although it holds fill values only
    assert np.array_equal(done.data["draw_V"], original.data["draw_V"])
    again = campaign.replay(tmp_path / "store", 11)
    assert (again.same, again.stored, again.flown["miss_km"]) == (False, {}, original.data["miss_km"][11])
    monkeypatch.setattr(campaign_workers, "here", fly)
    assert digest(campaign.run(None, tmp_path / "store", resume=True)) == digest(original)


@pytest.mark.parametrize("design", ["independent", "latin_hypercube", "sobol"])
def test_replay_gives_the_stored_bits(design: str, tmp_path: Path) -> None:
    laws = {"distributions.density.law": "normal", "distributions.density.spread": 0.9, "distributions.wave_amplitude": 0.1}
    done = campaign.run(small(design=design, **laws), tmp_path / "store")
    outside = np.flatnonzero(~done.arrived)
    if design == "independent":
        assert outside.size  # a density factor of a wide normal law may be negative: such a case is refused, the others stand
        assert done.reason(int(outside[0])) == "OUT_OF_DOMAIN"
        assert np.isnan(done.data["miss_km"][outside]).all()
    for case in (0, 13, 21):
        again = campaign.replay(tmp_path / "store", case)
        assert again.same
        assert again.changed == ()
        assert again.flown["t_f"] == done.data["t_f"][case]
        assert (again.trajectory is not None) == done.arrived[case]
        if again.trajectory is not None:
            assert again.trajectory.t[-1] == done.data["t_f"][case]
            assert again.trajectory["s"][-1] == done.data["final_s"][case]


def test_replay_refuses_and_notices(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for case in (-1, 22):
        with pytest.raises(CampaignError, match="give a number from 0 to 21"):
            campaign.replay(store, case)
    fly = campaign.fly_drawn

    def moved(*arguments: Any) -> dict[str, Any]:
        return {name: np.nextafter(values, 1e9) if values.dtype == float else values for name, values in fly(*arguments).items()}

    monkeypatch.setattr(campaign, "fly_drawn", moved)
    assert not campaign.replay(store, 3).same


def test_result_for_the_report(original: Campaign, tmp_path: Path) -> None:
    found = original.result()
    assert [item.name for item in found.figures] == ["distribution", "convergence", "scatter"]
    miss = original.data["miss_km"]
    assert found.data["rms_km"]["value"] == pytest.approx(np.sqrt(np.mean(miss**2)), rel=1e-12)
    assert found.data["worst"][0]["case"] == int(np.argmax(np.abs(miss)))
    assert found.data["worst"][0]["V"] == original.data["draw_V"][np.argmax(np.abs(miss))]
    assert len(found.tables[1].rows) == 20


def test_wrong_workers_are_refused(tmp_path: Path) -> None:
    for workers, scheduler in ((-1, None), (2, "tcp://127.0.0.1:1")):
        with pytest.raises(CampaignError, match="workers: found"):
            campaign.run(small(), tmp_path / "store", workers=workers, scheduler=scheduler)
