"""Atomic file writes (temporary file in the target's folder, fsync, rename), their errors, and file locks."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rebar_depth_bench.errors import InputError, OutputError

WRITE_ERRORS = frozenset(
    (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.EPIPE)
)
"""Error numbers of failed writes: full, past a quota or size limit, read-only, forbidden, broken, unread pipe."""
NO_SPACE = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS))
"""Those of ``WRITE_ERRORS`` that only writing causes."""
_TEMPORARY_NAME = re.compile(r"\.(.+)\.[a-z0-9_]{8}\.tmp")


def temporary_target(name: str) -> str | None:
    """Return the name of the file that a temporary file of this name was to replace, or None for other names.

    Killed processes leave such files.
    """
    match = _TEMPORARY_NAME.fullmatch(name)
    return match[1] if match else None


@contextmanager
def named_write_errors(target: object) -> Iterator[None]:
    """Raise ``OSError`` of ``WRITE_ERRORS`` in the block as ``OutputError`` that names ``target``."""
    try:
        yield
    except OSError as error:
        if error.errno not in WRITE_ERRORS:
            raise
        raise write_error(target, error) from error


def write_error(target: object, error: OSError) -> OutputError | InputError:
    """Return the error of a failed write to ``target``: ``InputError`` if its name is at fault."""
    kind = OutputError if error.errno in WRITE_ERRORS else InputError
    reason = error.strerror if error.errno is None else os.strerror(error.errno)
    return kind(f"{target}: cannot be written: {reason or error}")


@contextmanager
def atomic_replace(target: Path, mode: int = 0) -> Iterator[Path]:
    """Yield a temporary path in the target's folder; on a clean exit, flush it and rename it to ``target``.

    Missing parent folders are created. The permissions are ``mode``, or for 0, those of a replaced file, or
    of the umask. On an exception the temporary file is removed and an existing ``target`` is left unchanged.
    Raises ``InputError`` if ``target`` is a folder, a device or a pipe, or its name is impossible, and
    ``OutputError`` if it or its folder cannot be written.
    """
    if target.is_dir():
        raise InputError(f"{target}: is a folder, expected the name of a file to write")
    if target.exists() and not target.is_file():  # Renaming would replace a device such as /dev/null.
        raise InputError(f"{target}: is a device or a pipe, expected the name of a file to write")
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode or 0o666))
    except OSError as error:
        raise write_error(target, error) from None
    try:
        with named_write_errors(target):
            yield temporary
            if not mode and target.exists():
                temporary.chmod(stat.S_IMODE(target.stat().st_mode) & 0o777)
            fsync_path(temporary)
            temporary.replace(target)
            fsync_path(target.parent)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


@contextmanager
def scratch_folder(prefix: str = "rebar-") -> Iterator[Path]:
    """Yield an empty temporary folder, which is deleted on exit. Raises ``OutputError`` if there can be none."""
    try:
        folder = tempfile.TemporaryDirectory(prefix=prefix)
    except OSError as error:  # ``tempfile`` reports as a missing folder that none has space.
        message = f"no temporary folder can be made: {error.strerror}; set TMPDIR to a folder with space"
        raise OutputError(message) from None
    with folder as path:
        yield Path(path)


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
