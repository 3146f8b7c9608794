"""A disk that is full at any write of a campaign: an error of the machine, no litter, and the same bytes once there is room."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from studies import campaign, cli
from studies.campaign import Campaign, CampaignError
from studies.scenario import Scenario

CASES, CHUNK = 7, 4
SCENARIO = Scenario.default().edit({"campaign.cases": CASES, "campaign.chunk": CHUNK})


def digest(done: Campaign) -> str:
    return hashlib.sha256(b"".join(name.encode() + done.data[name].tobytes() for name in sorted(done.data))).hexdigest()


class Disk:
    """Counts what needs room below a folder: files opened for writing, renames, new folders; full from the k-th on."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.full_at, self.lasting, self.count = str(folder), 0, True, 0
        self.lock = threading.Lock()  # zarr writes in threads of its own
        patch.setattr(io, "open", self.guarded(io.open, lambda file, mode="r", *_: set(mode) & set("wxa+")))
        patch.setattr(os, "open", self.guarded(os.open, lambda file, flags, *_, **__: flags & (os.O_WRONLY | os.O_RDWR)))
        for name in ("replace", "rename", "mkdir"):
            patch.setattr(os, name, self.guarded(getattr(os, name), lambda *_, **__: True))

    def guarded(self, real: Callable[..., Any], writes: Callable[..., Any]) -> Callable[..., Any]:
        def call(file: Any, *arguments: Any, **options: Any) -> Any:
            if isinstance(file, (str, os.PathLike)) and os.fspath(file).startswith(self.folder) and writes(file, *arguments):
                with self.lock:
                    self.count += 1
                    full = self.full_at and (self.count == self.full_at or (self.lasting and self.count > self.full_at))
                if full:
                    raise OSError(errno.ENOSPC, "No space left on device", os.fspath(file))
            return real(file, *arguments, **options)

        return call

    def filled(self, at: int, *, lasting: bool = True) -> None:
        self.count, self.full_at, self.lasting = 0, at, lasting


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return campaign.run(SCENARIO, tmp_path_factory.mktemp("campaign") / "store")


def full_at_each_write(original: Campaign, place: Path, monkeypatch: pytest.MonkeyPatch, *, stride: int) -> int:
    """Number of moments at which the disk was full."""
    disk = Disk(place, monkeypatch)
    disk.filled(0)
    campaign.run(SCENARIO, place / "counted")
    writes = disk.count
    assert writes > 40
    stopped = 0
    for lasting in (True, False):
        for k in range(1, writes + 1, stride):
            home = place / f"{lasting}{k}"
            disk.filled(0)
            home.mkdir()
            disk.filled(k, lasting=lasting)
            said = None
            try:
                campaign.run(SCENARIO, home / "store")
            except OSError as error:
                said = error
            disk.filled(0)
            if said is not None:
                assert said.errno == errno.ENOSPC
                assert str(home) in str(said.filename)
                stopped += 1
            if (home / "store").exists():
                part = campaign.load(home / "store")
                for name, values in part.data.items():
                    assert values.tobytes() == original.data[name][part.cases].tobytes()
            assert {entry.name for entry in home.iterdir()} <= {"store"}, k
            again = campaign.run(SCENARIO, home / "store", resume=True)
            assert again.complete
            assert digest(again) == digest(original), k
            assert not list(home.rglob("*.partial")), k
            shutil.rmtree(home)
    return stopped


def test_a_disk_that_is_full_at_a_write_costs_no_number(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert full_at_each_write(original, tmp_path, monkeypatch, stride=10) > 10


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_disk_that_is_full_at_any_write_costs_no_number(original: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert full_at_each_write(original, tmp_path, monkeypatch, stride=1) > 100


def test_the_command_ends_with_4_and_names_the_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    disk = Disk(tmp_path, monkeypatch)
    disk.filled(60)
    code = cli.main(["campaign", "--out", str(tmp_path / "store"), "--cases", str(CASES), "--set", f"campaign.chunk={CHUNK}"])
    said = capsys.readouterr().err
    assert code == 4
    assert f"reentry: the machine refused: {tmp_path}" in said
    assert "No space left on device" in said
    assert "Traceback" not in said


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no permissions of this kind here")
def test_a_place_that_cannot_be_written_is_an_error_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: Any, *arguments: Any, **options: Any) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied", os.fspath(path))

    with monkeypatch.context() as patch:
        patch.setattr(os, "mkdir", refused)
        with pytest.raises(PermissionError):
            campaign.run(SCENARIO, tmp_path / "store")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(CampaignError, match="no such store"):
        campaign.load(tmp_path / "store")
