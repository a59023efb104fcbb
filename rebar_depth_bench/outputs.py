"""Outputs that users name: files, links to files, devices, pipes and open descriptors such as ``/dev/stdout``.

A file is replaced atomically; of a link, the file that it points to. Devices, pipes and descriptors are written
through and never replaced.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from rebar_depth_bench.atomic_io import atomic_replace, scratch_folder, write_bytes, write_error
from rebar_depth_bench.errors import InputError

STANDARD_OUTPUT = Path("/dev/stdout")
"""Path that ``-`` stands for."""
_MAX_LINKS = 40
"""Number of links in a row that Linux follows."""


def open_descriptor(path: Path) -> int | None:
    """Return the descriptor of this process that a path or link names, as ``/dev/fd/63`` does, or None.

    Opening such a path again would start at the beginning of a file, and fails for a socket.
    """
    for _ in range(_MAX_LINKS):
        folder = os.path.realpath(path.parent)
        if folder in (f"/proc/{os.getpid()}/fd", "/dev/fd") and path.name.isdecimal():
            return int(path.name)
        if not path.is_symlink():
            return None
        path = path.parent / path.readlink()
    return None


def is_standard_output(path: Path) -> bool:
    """Return whether a path names the standard output of this process."""
    return open_descriptor(path) == 1


def is_stream(path: Path) -> bool:
    """Return whether a path names an open descriptor, a device or a pipe: anything but a file or a folder."""
    return open_descriptor(path) is not None or (path.exists() and not path.is_file() and not path.is_dir())


def link_target(path: Path) -> Path:
    """Return the file that a symbolic link points to, which may be missing; any other path unchanged.

    Raises ``InputError`` for links that form a loop.
    """
    if not path.is_symlink():
        return path
    target = Path(os.path.realpath(path))
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
    elif is_standard_output(target):
        _write_standard_output(data)
    else:
        with _opened_stream(target) as stream:
            stream.write(data)


@contextmanager
def output_file(target: Path) -> Iterator[Path]:
    """Yield the path of an empty file to write; on a clean exit, its content becomes that of the output.

    Raises as ``write_output`` does.
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
    """Yield a descriptor, device or pipe open for writing. Raises as ``write_error`` does."""
    sys.stdout.flush()  # Its text comes first if the target is standard output.
    descriptor = open_descriptor(target)
    try:
        with target.open("wb") if descriptor is None else os.fdopen(os.dup(descriptor), "wb") as stream:
            yield stream
    except OSError as error:
        raise write_error(target, error) from error


def _write_standard_output(data: bytes) -> None:
    if hasattr(sys.stdout, "buffer"):
        sys.stdout.flush()
        sys.stdout.buffer.write(data)
    else:  # A program that runs the command in its own process may have replaced it.
        sys.stdout.write(data.decode())
    sys.stdout.flush()
