"""The store of a campaign: a zarr group that any xarray reader opens, and one completion marker for each chunk.

A chunk counts only when its marker stands: a small file with the SHA-256 of each variable's numbers, renamed into place after the
numbers. What zarr would fill in for a chunk that is missing is never taken for data.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from models.core import ModelError
from studies import files
from studies.scenario import Scenario

fcntl: Any
try:
    import fcntl
except ImportError:  # no such locks here: nobody is kept from running one campaign twice at a time
    fcntl = None

FORMAT = 1
MARKERS = "markers"
PACKAGES = ("models", "ocp", "studies")  # whose code decides about the numbers
LIBRARIES = ("casadi", "numpy", "scipy")
MISSING = -1  # status of a case that was not computed

Arrays = Mapping[str, np.ndarray]


class CampaignError(ModelError):
    """A store that cannot be written, resumed or read; the text says what is wrong and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """One number of each case: name, unit, what it is; real unless `integer`; further attributes."""

    name: str
    unit: str
    text: str
    integer: bool = False
    about: Mapping[str, Any] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type in the store, little-endian."""
        return np.dtype("<i2" if self.integer else "<f8")


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """Content of a completion marker; `failed` is the reason why a chunk has no results, empty for a good one."""

    sha256: Mapping[str, str]
    failed: str


@dataclass(frozen=True, slots=True, eq=False)
class Store:
    """An open store.

    Attributes
    ----------
    path : Path
    cases, chunk : int
        Cases of the campaign, and of each chunk but the last.
    attributes : mapping
        Of the zarr group: scenario, code, versions, provenance.
    arrays : mapping of zarr arrays
    """

    path: Path
    cases: int
    chunk: int
    attributes: Mapping[str, Any]
    arrays: Mapping[str, Any]

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.cases // self.chunk)

    def bounds(self, chunk: int) -> tuple[int, int]:
        """First case of a chunk and their number."""
        first = chunk * self.chunk
        return first, min(self.chunk, self.cases - first)

    def write(self, chunk: int, arrays: Arrays, *, failed: str = "") -> None:
        """Write a chunk's numbers, then its marker; an interruption in between leaves the chunk uncounted."""
        first, count = self.bounds(chunk)
        if set(arrays) != set(self.arrays) or any(len(a) != count for a in arrays.values()):
            raise CampaignError(f"chunk {chunk}: expected {count} values of each of {sorted(self.arrays)}, got {sorted(arrays)}")
        digests = {}
        for name, array in self.arrays.items():
            values = np.ascontiguousarray(arrays[name], dtype=array.dtype)
            array[first : first + count] = values
            digests[name] = _digest(values)
        _mark(self.path / MARKERS / f"{chunk}.json", {"first": first, "count": count, "failed": failed, "sha256": digests})

    def marks(self) -> dict[int, Mark]:
        """The markers that stand, by chunk; one that cannot be read counts as absent."""
        found = {}
        for entry in os.scandir(self.path / MARKERS):
            match = re.fullmatch(r"(\d{1,9})\.json", entry.name)
            if match and int(match[1]) < self.chunks and (mark := self._mark(int(match[1]))):
                found[int(match[1])] = mark
        return dict(sorted(found.items()))

    def _mark(self, chunk: int) -> Mark | None:
        try:
            content = json.loads((self.path / MARKERS / f"{chunk}.json").read_text(encoding="utf-8"))
            digests, failed = content["sha256"], content["failed"]
        except (ValueError, TypeError, LookupError):
            return None
        first, count = self.bounds(chunk)
        good = (content.get("first"), content.get("count")) == (first, count) and isinstance(digests, dict) and isinstance(failed, str)
        return Mark(digests, failed) if good and set(digests) == set(self.arrays) else None

    def unmark(self, chunk: int) -> None:
        """Take a marker away; the numbers stay until they are written again."""
        (self.path / MARKERS / f"{chunk}.json").unlink(missing_ok=True)

    def altered(self) -> dict[int, str]:
        """Marked chunks whose numbers are missing or are not those that were written: chunk -> name of a variable."""
        marks = self.marks()
        wrong: dict[int, str] = {}
        for name in self.arrays:
            values, unreadable = self._values(name)
            for chunk, mark in marks.items():
                first, count = self.bounds(chunk)
                if chunk in unreadable or _digest(values[first : first + count]) != mark.sha256[name]:
                    wrong.setdefault(chunk, name)
        return wrong

    def read(self, names: Sequence[str] | None = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Case numbers (M,) of all complete chunks and the named variables (all by default) of these cases, proved by the markers.

        Raises
        ------
        CampaignError
            A chunk whose numbers are missing or altered although its marker stands.
        """
        marks, out = self.marks(), {}
        bounds = [self.bounds(chunk) for chunk in marks]
        numbers = np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(a, a + n) for a, n in bounds)])
        for name in self.arrays if names is None else names:
            if name not in self.arrays:
                raise CampaignError(f"{self.path}: has no variable {name!r}; known: {', '.join(self.arrays)}")
            values, unreadable = self._values(name)
            for (chunk, mark), (first, count) in zip(marks.items(), bounds, strict=True):
                if chunk in unreadable or _digest(values[first : first + count]) != mark.sha256[name]:
                    raise CampaignError(
                        f"{self.path}: {name} of chunk {chunk} (cases {first} to {first + count - 1}) is missing or altered;"
                        " run the campaign with --resume to compute it again"
                    )
            out[name] = values[numbers]
        return numbers, out

    def _values(self, name: str) -> tuple[np.ndarray, set[int]]:
        """All values of a variable, and the chunks of it that cannot be read."""
        array = self.arrays[name]
        with contextlib.suppress(ValueError, LookupError, FileNotFoundError):
            return np.asarray(array[:]), set()
        values, unreadable = np.zeros(self.cases, dtype=array.dtype), set()
        for chunk in range(self.chunks):
            first, count = self.bounds(chunk)
            try:
                values[first : first + count] = array[first : first + count]
            except (ValueError, LookupError, FileNotFoundError):
                unreadable.add(chunk)
        return values, unreadable

    def finish(self, *, complete: bool) -> None:
        """Say in the attributes whether every chunk is there."""
        root = self.path / "zarr.json"
        content = json.loads(root.read_text(encoding="utf-8"))
        content["attributes"]["complete"] = complete
        files.write_text(root, json.dumps(content, indent=2) + "\n")

    def sweep(self) -> int:
        """Remove what an interrupted write left behind; return the number of files."""
        litter = [path for path in self.path.rglob("*.partial") if path.is_file()]
        for path in litter:
            path.unlink(missing_ok=True)
        return len(litter)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep the store to this process; the system lets go of it when the process ends, however it ends."""
        with (self.path / MARKERS / "lock").open("a", encoding="utf-8") as stream:
            if fcntl is not None:
                try:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise CampaignError(f"{self.path}: another campaign is writing into it; wait for its end") from None
                except OSError:  # a file system without locks
                    pass
            yield


def create(path: Path, variables: Sequence[Variable], *, cases: int, chunk: int, attributes: Mapping[str, Any]) -> Store:
    """Make an empty store, whole or not at all.

    Raises
    ------
    CampaignError
        The place is not empty.
    """
    import zarr

    target = Path(os.path.abspath(path))
    require_empty(target)
    if target.is_dir():
        target.rmdir()
    # made in memory and written here: zarr writes in several threads, and those that go on after one has failed leave litter
    made: dict[str, Any] = {}
    with files.folder(target) as place:
        memory = zarr.storage.MemoryStore(made)
        content = {**attributes, "format": FORMAT, "cases": cases, "chunk": chunk, "complete": False}
        group = zarr.open_group(memory, mode="w-", zarr_format=3, attributes=content)
        group.create_group(MARKERS)
        for v in variables:
            group.create_array(
                v.name, shape=(cases,), chunks=(min(chunk, cases),), dtype=v.dtype, dimension_names=("case",), compressors=None,
                fill_value=MISSING if v.integer else np.nan, attributes={"units": v.unit, "long_name": v.text, **v.about},
            )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # this part of the format is not in the standard yet, and xarray asks for it
            zarr.consolidate_metadata(memory, zarr_format=3)
        for key, value in sorted(made.items(), key=lambda item: item[0] != "zarr.json"):  # first, by which sweep_around knows the folder
            (place / key).parent.mkdir(exist_ok=True)
            (place / key).write_bytes(value.to_bytes())
    return open_store(Path(path))


def open_store(path: Path) -> Store:
    """Open an existing store.

    Raises
    ------
    CampaignError
        No such store, or a folder that is none.
    """
    import zarr

    if not path.exists():
        raise CampaignError(f"{path}: no such store; give the folder that `reentry campaign --out` wrote")
    try:
        with zarr.config.set({"array.write_empty_chunks": True}):  # a chunk that is written is there, whatever its numbers
            group = zarr.open_group(path, mode="r+" if os.access(path, os.W_OK) else "r", use_consolidated=False)
            attributes = dict(group.attrs)
            arrays = dict(sorted(group.arrays()))
        version, (cases, chunk) = attributes["format"], (int(str(attributes[name])) for name in ("cases", "chunk"))
    except (ValueError, TypeError, LookupError, FileNotFoundError, NotADirectoryError):
        raise CampaignError(f"{path}: is not a campaign store; give the folder that `reentry campaign --out` wrote") from None
    shapes = {name: (a.shape, a.chunks) for name, a in arrays.items()}
    if version != FORMAT or not arrays or cases < 1 or chunk < 1 or set(shapes.values()) != {((cases,), (min(chunk, cases),))}:
        raise CampaignError(
            f"{path}: is a store of another format (found {version!r}, expected {FORMAT}), or its metadata were altered;"
            " start a new campaign"
        )
    if not (path / MARKERS).is_dir():
        raise CampaignError(f"{path}: its folder {MARKERS!r} is missing, so nothing in it can be proved; start a new campaign")
    return Store(path, cases, chunk, attributes, arrays)


def scenario_of(store: Store) -> Scenario:
    """The scenario that a store was made with."""
    return Scenario.parse(str(store.attributes.get("scenario", "")), name=f"{store.path}: scenario")


def holds_anything(path: Path) -> bool:
    """Whether a place is a folder with content; a file there is refused.

    Raises
    ------
    OutputError
        The place is a file or lies below one.
    """
    files.check_folder(path)
    return path.is_dir() and any(path.iterdir())


def require_empty(path: Path) -> None:
    """Refuse a place that holds anything.

    Raises
    ------
    CampaignError
    """
    if holds_anything(path):
        raise CampaignError(
            f"{path}: is not empty; continue a campaign with --resume, or choose a new or empty folder (nothing is ever deleted here)"
        )


def sweep_around(path: Path) -> None:
    """Remove the private folder of a campaign that ended while it was making its store."""
    target = Path(os.path.abspath(path))
    for place in target.parent.glob(f".{target.name[:40]}.*.partial") if target.parent.is_dir() else ():
        if place.is_dir() and ((place / "zarr.json").is_file() or not any(place.iterdir())):
            shutil.rmtree(place, ignore_errors=True)


@lru_cache(maxsize=1)
def code_digest() -> str:
    """SHA-256 over the names and bytes of the source and data files that decide about the numbers."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for path in sorted(_sources(root), key=lambda p: p.relative_to(root).as_posix()):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _sources(root: Path) -> Iterable[Path]:
    for package in PACKAGES:
        yield from (p for p in (root / package).rglob("*") if p.is_file() and "__pycache__" not in p.parts)


def versions() -> dict[str, str]:
    """Versions of the libraries that decide about the last digits."""
    return {name: metadata.version(name) for name in LIBRARIES}


def _digest(values: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def _mark(path: Path, content: Mapping[str, Any]) -> None:
    files.write_text(path, json.dumps(content, indent=1) + "\n")
