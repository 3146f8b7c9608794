"""Files are written whole or not at all, whatever step fails."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from studies import files


@pytest.mark.parametrize("writer", ["write", "folder", "replace_folder"])
def test_failure_at_any_step_leaves_the_old_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, writer: str) -> None:
    place = tmp_path / "out"

    def write(text: str, where: Path) -> None:
        if writer == "write":
            files.write_text(where / "a.txt", text)
            return
        with getattr(files, writer)(where) as private:
            (private / "a.txt").write_text(text)

    write("old", place)
    steps = {"write": ["fsync", "replace"], "folder": ["replace"], "replace_folder": ["rename"]}[writer]
    for step in steps:
        for error in (OSError(errno.ENOSPC, "full"), KeyboardInterrupt()):
            with monkeypatch.context() as patch:

                def fail(*arguments: Any, error: BaseException = error) -> None:
                    raise error

                patch.setattr(files.os, step, fail)
                with pytest.raises(type(error)):
                    write("new", place)
                if writer == "write":
                    with pytest.raises(type(error)):
                        write("new", tmp_path / "x" / "y")
            assert (place / "a.txt").read_text() == "old"
            assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.txt", "out"]
    with pytest.raises(FileNotFoundError), files.folder(tmp_path / "x" / "y") as private:
        (private / "b.txt").write_text((private / "none").read_text())
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.txt", "out"]
    write("new", place)
    assert (place / "a.txt").read_text() == "new"


def test_second_rename_fails_and_the_old_report_comes_back(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    place = tmp_path / "out"
    with files.replace_folder(place) as private:
        (private / "a.txt").write_text("old")
    rename, calls = os.rename, []

    def second_fails(source: Any, goal: Any) -> None:
        calls.append(source)
        if len(calls) == 2:
            raise OSError(errno.EIO, "broken")
        rename(source, goal)

    monkeypatch.setattr(files.os, "rename", second_fails)
    with pytest.raises(OSError, match="broken"), files.replace_folder(place):
        pass
    assert (place / "a.txt").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_files_get_ordinary_permissions(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    ordinary = (tmp_path / "plain").stat().st_mode
    assert files.write_text(tmp_path / "written", "x").stat().st_mode == ordinary
    with pytest.raises(files.OutputError, match="is a folder"):
        files.write_text(tmp_path, "x")
