"""Atomic file writes (temporary file in the target's folder, fsync, rename) and file locks."""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rebar_depth_bench.errors import InputError

_TEMPORARY_NAME = re.compile(r"\.(.+)\.[a-z0-9_]{8}\.tmp")


def temporary_target(name: str) -> str | None:
    """Return the name of the file that a temporary file of this name was to replace, or None for other names.

    Killed processes leave such files.
    """
    match = _TEMPORARY_NAME.fullmatch(name)
    return match[1] if match else None


@contextmanager
def atomic_replace(target: Path) -> Iterator[Path]:
    """Yield a temporary path in the target's folder; on a clean exit, flush it and rename it to ``target``.

    Missing parent folders are created. On an exception the temporary file is removed and an existing ``target`` is
    left unchanged. Raises ``InputError`` if ``target`` is a folder, a device or a pipe, or its folder cannot be
    written.
    """
    if target.is_dir():
        raise InputError(f"{target}: is a folder, expected the name of a file to write")
    if target.exists() and not target.is_file():  # Renaming would replace a device such as /dev/null.
        raise InputError(f"{target}: is a device or a pipe, expected the name of a file to write")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror}") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        fsync_path(temporary)
        temporary.replace(target)
        fsync_path(target.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def fsync_path(path: Path) -> None:
    """Flush the content of a file or folder to disk (fsync)."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def exclusive_lock(path: Path, *, wait: bool = False, mode: int = 0o666) -> Iterator[None]:
    """Hold an exclusive lock on a folder, or on a file that is created with ``mode`` if it does not exist.

    The kernel releases the lock however the process ends. Raises ``BlockingIOError`` if another process holds it,
    unless ``wait`` is set.
    """
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT, mode)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def write_bytes(target: Path, content: bytes) -> None:
    """Write ``content`` to ``target`` atomically."""
    with atomic_replace(target) as temporary:
        temporary.write_bytes(content)


def write_text(target: Path, content: str) -> None:
    """Write ``content`` to ``target`` atomically, as UTF-8."""
    write_bytes(target, content.encode())
