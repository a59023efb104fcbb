"""Writing of files: atomic replacement (temporary file, fsync, rename), and outputs that users name."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from rebar_depth_bench.base.errors import InputError, OutputError
from rebar_depth_bench.base.system import fsync_path

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
    if target.exists() and not target.is_file():  # Renaming would replace a device such as /dev/null.
        found = "is a folder" if target.is_dir() else "is a device or a pipe"
        raise InputError(f"{target}: {found}, expected the name of a file to write")
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    process = os.getpid()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode or 0o666))
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
        if os.getpid() == process:  # The file is not that of a process that was forked meanwhile and ends.
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


def write_bytes(target: Path, content: bytes) -> None:
    """Write ``content`` to ``target`` atomically."""
    with atomic_replace(target) as temporary:
        temporary.write_bytes(content)


def write_text(target: Path, content: str) -> None:
    """Write ``content`` to ``target`` atomically, as UTF-8."""
    write_bytes(target, content.encode())


# Outputs that users name: standard output, files, links, devices and pipes. A file, or the file that a link points
# to, is replaced atomically. Whatever else exists is written in place and never replaced.

STANDARD_OUTPUT = Path("/dev/stdout")
"""Path that ``-`` stands for."""


def is_stream(path: Path) -> bool:
    """Return whether a path names standard output, a device or a pipe: anything but a file or a folder."""
    return path == STANDARD_OUTPUT or (path.exists() and not path.is_file() and not path.is_dir())


def link_target(path: Path) -> Path:
    """Return the file that a symbolic link points to, which may be missing; any other path unchanged.

    Raises ``InputError`` for links that form a loop.
    """
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_symlink():
        raise InputError(f"{path}: its links form a loop, expected the name of a file to write")
    return target


def write_output(target: Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8, to an output.

    Raises ``InputError`` if the name is at fault, ``OutputError`` if the machine cannot write, and
    ``BrokenPipeError`` if nobody reads standard output.
    """
    data = content.encode() if isinstance(content, str) else content
    if not is_stream(target):
        write_bytes(link_target(target), data)
    elif target == STANDARD_OUTPUT and not hasattr(sys.stdout, "buffer"):
        sys.stdout.write(data.decode())  # A program that runs the command in its own process has replaced it.
    else:
        with _opened_stream(target) as stream:
            stream.write(data)


@contextmanager
def output_file(target: Path) -> Iterator[Path]:
    """Yield the path of an empty file to write; on a clean exit, its content becomes that of the output.

    Raises the errors of ``write_output``.
    """
    if not is_stream(target):
        with atomic_replace(link_target(target)) as temporary:
            yield temporary
        return
    with scratch_folder() as folder:
        temporary = folder / "output"
        yield temporary
        with temporary.open("rb") as content, _opened_stream(target) as stream:
            shutil.copyfileobj(content, stream)


@contextmanager
def _opened_stream(target: Path) -> Iterator[BinaryIO]:
    """Yield standard output, or a device or pipe that is opened for writing."""
    if target == STANDARD_OUTPUT:
        sys.stdout.flush()  # Text that was printed comes first.
        yield sys.stdout.buffer
        sys.stdout.flush()
        return
    try:
        with target.open("wb") as stream:
            yield stream
    except OSError as error:
        raise write_error(target, error) from error
