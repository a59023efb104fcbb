"""Folders for files under way, one for each process; the next that starts clears what a killed one left."""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import structlog

from rebar_depth_bench.errors import InputError

_LOG = structlog.get_logger("spool")
_ENTRANCE = "entrance.lock"


@contextmanager
def own_spool(root: Path) -> Iterator[Path]:
    """Yield a new folder below ``root`` that is this process's alone, and remove it at the end.

    A lock says that its process lives; the kernel lets go of it however the process ends. Folders without a living
    process are removed first. Raises ``InputError`` where no folder can be made.
    """
    folder = root / secrets.token_hex(8)
    try:
        root.mkdir(parents=True, exist_ok=True)
        with _locked(root / _ENTRANCE):  # nobody clears between the folder and its lock
            _clear(root)
            folder.mkdir()
            life = os.open(_lock_of(folder), os.O_RDWR | os.O_CREAT, 0o600)
            fcntl.flock(life, fcntl.LOCK_EX)
    except OSError as error:
        raise InputError(f"{root}: files cannot be kept there: {error.strerror}") from None
    try:
        yield folder
    finally:
        _remove(folder)
        os.close(life)


def _clear(root: Path) -> None:
    for folder in [path for path in root.iterdir() if path.is_dir()]:
        descriptor = os.open(_lock_of(folder), os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        else:
            _remove(folder)
            _LOG.info("cleared", spool=folder.name)
        finally:
            os.close(descriptor)


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    _lock_of(folder).unlink(missing_ok=True)


def _lock_of(folder: Path) -> Path:
    return folder.with_suffix(".lock")


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
