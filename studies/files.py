"""Files written whole or not at all: a private name first, then one rename. An older good file is never left half replaced."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path


class OutputError(ValueError):
    """An output path that cannot be meant: the text names the path and what to do."""


def write_text(path: str | Path, text: str) -> Path:
    """Write UTF-8 text whole; see :func:`write_bytes`."""
    return write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, content: bytes) -> Path:
    """Write a file whole: the old content stays until the new one is complete on the disk.

    Folders that are missing are made, and removed again if the file cannot be written.

    Raises
    ------
    OutputError
        The path is a folder, or a part of it is a file.
    OSError
        The disk is full or the place cannot be written.
    """
    target = Path(path)
    if target.is_dir():
        raise OutputError(f"{target}: is a folder, expected a file name; add the name of the file")
    with _parents(target.parent):
        handle, name = tempfile.mkstemp(prefix=f".{target.name[:40]}.", suffix=".partial", dir=target.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            _ordinary_mode(name, 0o666)
            os.replace(name, target)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(name)
            raise
    return target


@contextlib.contextmanager
def folder(path: str | Path) -> Iterator[Path]:
    """Private folder to fill; at the end of the block its files appear under `path`, or none of them if the block failed.

    Files that are already in `path` under other names stay; nothing is ever deleted there.

    Raises
    ------
    OutputError
        `path`, or a part of it, is a file.
    OSError
        The disk is full or the place cannot be written.
    """
    target = Path(os.path.abspath(path))
    check_folder(target)
    # beside or inside the target, so that the last step is a rename on the same disk
    home = target if target.is_dir() else target.parent
    with _parents(home):
        staging = Path(tempfile.mkdtemp(prefix=f".{target.name[:40] or 'out'}.", suffix=".partial", dir=home))
        try:
            yield staging
            if target.is_dir():
                _move_into(staging, target)
            else:
                _ordinary_mode(staging, 0o777)
                os.rename(staging, target)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


@contextlib.contextmanager
def replace_folder(path: str | Path) -> Iterator[Path]:
    """As :func:`folder`, but the new folder takes the place of an older one, of which nothing stays.

    Whether the older one may be lost is for the caller to decide. After a failure it is as it was.

    Raises
    ------
    OutputError
        `path`, or a part of it, is a file.
    OSError
        The disk is full or the place cannot be written.
    """
    target = Path(os.path.abspath(path))  # "." has no name to build a neighbour from
    check_folder(target)
    with _parents(target.parent):
        staging = Path(tempfile.mkdtemp(prefix=f".{target.name[:40]}.", suffix=".partial", dir=target.parent))
        old = staging.with_suffix(".old")
        try:
            yield staging
            _ordinary_mode(staging, 0o777)
            if target.is_dir():
                os.rename(target, old)
            os.rename(staging, target)
        finally:
            if old.is_dir() and not target.exists():
                os.rename(old, target)
            shutil.rmtree(staging, ignore_errors=True)
            shutil.rmtree(old, ignore_errors=True)


def check_folder(path: str | Path) -> None:
    """Refuse an output folder that is a file or lies below one.

    Raises
    ------
    OutputError
    """
    target = Path(path)
    for part in (target, *target.parents):
        if part.is_dir():
            return
        if part.exists():
            what = "is a file" if part == target else f"lies below the file {part}"
            raise OutputError(f"{target}: {what}, expected a folder; choose another folder")


def _move_into(staging: Path, target: Path) -> None:
    sources = [source for source in sorted(staging.rglob("*")) if not source.is_dir()]
    for source in sources:
        goal = target / source.relative_to(staging)
        if goal.is_dir() or any(part.is_file() for part in goal.parents):
            raise OutputError(f"{goal}: a folder stands where a file is to be written, or the reverse; choose another folder")
    for source in sources:
        goal = target / source.relative_to(staging)
        goal.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, goal)


@contextlib.contextmanager
def _parents(path: Path) -> Iterator[None]:
    """Make missing folders; take them away again if the block fails."""
    check_folder(path)
    missing = [part for part in (path, *path.parents) if not part.exists()]
    made: list[Path] = []
    try:
        for part in reversed(missing):
            part.mkdir(exist_ok=True)
            made.append(part)
        yield
    except BaseException:
        for part in reversed(made):
            with contextlib.suppress(OSError):  # not empty: somebody else uses it by now
                part.rmdir()
        raise


def _ordinary_mode(path: str | Path, mode: int) -> None:
    """Give the private file the permissions that any new file of this user has."""
    mask = os.umask(0)
    os.umask(mask)
    os.chmod(path, mode & ~mask)
