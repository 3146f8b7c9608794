"""Compiled C code in a private cache: one compiler driver, entries named by content, every byte checked before it is loaded.

An entry is one file: the SHA-256 of key and library, then the library.  What is loaded is a private copy of the bytes that were
checked, under a name that is never used again: the loader of the system answers a known name with what it loaded before.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import itertools
import json
import os
import platform
import shutil
import stat
import sys
import tempfile
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import casadi as ca

from models.native_compiler import COMPILE_TIME, Compiler, NotCompiledError, compiled, compiler, cpu_target, warn_once

fcntl: Any
try:
    import fcntl
except ImportError:  # no such locks here: two processes may then compile the same function, each under its own name
    fcntl = None

FORMAT = "1"  # changes when an old entry must not be read any more
LIMIT = 512 * 2**20  # bytes of the cache
DIGEST = 32
_serial = itertools.count()
_loaded: weakref.WeakValueDictionary[str, Library] = weakref.WeakValueDictionary()


class Library:
    """A loaded library; it is unloaded with the last reference to it."""

    def __init__(self, path: Path) -> None:
        self._handle = ctypes.CDLL(str(path))
        if not sys.platform.startswith("win"):
            import _ctypes

            weakref.finalize(self, _ctypes.dlclose, self._handle._handle)

    def entry(self, name: str) -> Any:
        """The C function `name`."""
        return getattr(self._handle, name)


def load(source: str, flags: tuple[str, ...]) -> Library:
    """The library compiled from `source`, from the cache where it holds it unharmed.

    Raises
    ------
    NotCompiledError
        No compiler, a compiler that fails, no room on any disk, a library that cannot be loaded.
    """
    cc = compiler()
    material = [FORMAT, source, flags, cc.command, cc.version, ca.CasadiMeta.version(), sys.platform, platform.machine(), cpu_target()]
    key = hashlib.sha256(json.dumps(material).encode()).hexdigest()
    library = _loaded.get(key)
    if library is not None:
        return library
    reason = ""
    try:
        library = _through_cache(cache_folder(), key, source, flags, cc)
    except (OSError, _UnsafeFolderError) as error:
        reason = f"native code: the cache cannot be used ({error}); compiling without it. Set REENTRY_CACHE to a private folder"
    if library is None:
        try:
            with tempfile.TemporaryDirectory(prefix="reentry-native-") as folder:
                library = _load_bytes(Path(folder), compiled(Path(folder), source, flags, cc))
        except OSError as error:
            if "undefined symbol" in str(error):
                raise NotCompiledError(f"the compiled code cannot be loaded: {error}") from None
            raise NotCompiledError(
                f"there is no place to compile and load in ({error}); free some disk space, or set TMPDIR to a disk that may execute"
            ) from None
        warn_once(reason)
    _loaded[key] = library
    return library


class _UnsafeFolderError(Exception):
    """Others could have written there."""


def cache_folder() -> Path:
    """Folder of compiled code, made if need be, private to the user.

    REENTRY_CACHE of the environment names another one.

    Raises
    ------
    OSError
        It cannot be made.
    """
    named = os.environ.get("REENTRY_CACHE")
    if named:
        folder = Path(named)
    elif sys.platform == "darwin":
        folder = Path.home() / "Library" / "Caches" / "reentry-workbench" / "native"
    elif sys.platform.startswith("win"):
        folder = Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "reentry-workbench" / "native"
    else:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "reentry-workbench" / "native"
    folder.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    _require_private(folder)
    return folder


def _require_private(folder: Path) -> None:
    status = os.lstat(folder)
    if not stat.S_ISDIR(status.st_mode):
        raise _UnsafeFolderError(f"{folder} is a link or a file, not a folder")
    if hasattr(os, "getuid"):
        if status.st_uid != os.getuid():
            raise _UnsafeFolderError(f"{folder} belongs to another user")
        if status.st_mode & 0o022:
            raise _UnsafeFolderError(f"others may write in {folder}; chmod 700 it after deleting what it holds")


def _through_cache(folder: Path, key: str, source: str, flags: tuple[str, ...], cc: Compiler) -> Library:
    path = folder / f"{key}.lib"
    data = _checked_bytes(path, key)
    if data is None:
        with _lock(folder / f"{key}.lock"):
            data = _checked_bytes(path, key)  # another process may have made it meanwhile
            if data is None:
                data = _build(folder, path, key, source, flags, cc)
    with suppress(OSError):
        os.utime(path)  # the least recently used go first
    place = _private_place(folder)
    try:
        return _load_bytes(place, data)
    except OSError:  # written well and yet no library, or no execution here: nothing to keep
        path.unlink(missing_ok=True)
        raise
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _build(folder: Path, path: Path, key: str, source: str, flags: tuple[str, ...], cc: Compiler) -> bytes:
    _sweep(folder)
    place = _private_place(folder)
    try:
        data = compiled(place, source, flags, cc)
        entry = place / "entry"
        with open(os.open(entry, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(hashlib.sha256(key.encode() + data).digest() + data)
        os.replace(entry, path)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return data


def _load_bytes(place: Path, data: bytes) -> Library:
    copy = place / f"reentry-{os.getpid()}-{time.time_ns()}-{next(_serial)}.so"
    copy.write_bytes(data)
    copy.chmod(0o700)
    return Library(copy)


def _checked_bytes(path: Path, key: str) -> bytes | None:
    """The library of an entry, or None if there is none or it is not what was written; a harmed one is removed."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise
        _refuse(path, "it is a link")
        return None
    try:
        status = os.fstat(handle)
        why = ""
        if not stat.S_ISREG(status.st_mode):
            why = "it is no file"
        elif hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
            why = "others could have written it"
        else:
            with open(handle, "rb", closefd=False) as file:
                content = file.read()
    finally:
        os.close(handle)
    if why:
        _refuse(path, why)
        return None
    data = content[DIGEST:]
    if hashlib.sha256(key.encode() + data).digest() != content[:DIGEST]:
        _refuse(path, "its bytes are not those that were written")
        return None
    return data


def _refuse(path: Path, why: str) -> None:
    warn_once(f"native code: the cache entry {path.name[:12]} was not used because {why}; it is compiled again")
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _private_place(folder: Path) -> Path:
    return Path(tempfile.mkdtemp(prefix=f".build-{platform.node()}-{os.getpid()}-", dir=folder))


def _sweep(folder: Path) -> None:
    """Remove what killed processes left, and the least recently used entries beyond the limit."""
    now = time.time()
    entries = []
    for path in folder.iterdir():
        with suppress(OSError):
            status = os.lstat(path)
            if path.name.startswith(".build-"):
                host, _, pid = path.name[len(".build-") :].rsplit("-", 1)[0].rpartition("-")
                if now - status.st_mtime > 2 * COMPILE_TIME or (host == platform.node() and not _alive(pid)):
                    shutil.rmtree(path, ignore_errors=True)
            elif path.suffix == ".lock":
                _drop_lock(path)
            elif path.suffix == ".lib":
                entries.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= LIMIT:
            break
        path.unlink(missing_ok=True)
        total -= size


def _drop_lock(path: Path) -> None:
    """Remove a lock that nobody holds; who waits for it finds its file gone and makes a new one."""
    if fcntl is None:
        return
    handle = os.open(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
    finally:
        os.close(handle)


def _alive(pid: str) -> bool:
    try:
        os.kill(int(pid), 0)
    except (ValueError, ProcessLookupError):
        return False
    except OSError:
        return True
    return True


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold `path` as a lock; the system lets go of it when its process dies.  After the longest compile time, go on without."""
    if fcntl is None:
        yield
        return
    handle = -1
    deadline = time.monotonic() + 2 * COMPILE_TIME
    try:
        while time.monotonic() < deadline:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(handle)
                handle = -1
                time.sleep(0.02)
                continue
            except OSError:  # a file system without locks
                break
            with suppress(OSError):
                if os.fstat(handle).st_ino == os.stat(path).st_ino:
                    break
            os.close(handle)  # the holder before us removed the file that we opened
            handle = -1
        yield
    finally:
        if handle >= 0:
            with suppress(OSError):
                os.unlink(path)
            os.close(handle)
