"""Per-process work directories for temporary files; those of killed processes are removed at the next start."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import structlog

from rebar_depth_bench.atomic_io import exclusive_lock
from rebar_depth_bench.errors import InputError

_LOG = structlog.get_logger("work_dirs")
_STARTUP_LOCK = "entrance.lock"
_LOCK_MODE = 0o600


@contextmanager
def work_dir(root: Path) -> Iterator[Path]:
    """Yield a new folder below ``root`` for the exclusive use of this process, and remove it at the end.

    The process holds a file lock while it runs, which the kernel releases however the process ends. Folders whose
    lock is free are removed first. Raises ``InputError`` if the folder cannot be created.
    """
    folder = root / secrets.token_hex(8)
    with ExitStack() as stack:
        try:
            root.mkdir(parents=True, exist_ok=True)
            # The new folder is not yet protected by its own lock.
            with exclusive_lock(root / _STARTUP_LOCK, wait=True, mode=_LOCK_MODE):
                _remove_abandoned(root)
                folder.mkdir()
                stack.enter_context(exclusive_lock(_lock_path(folder), wait=True, mode=_LOCK_MODE))
        except OSError as error:
            raise InputError(f"{root}: cannot create a work folder: {error.strerror}") from None
        try:
            yield folder
        finally:
            _remove(folder)


def _remove_abandoned(root: Path) -> None:
    for folder in [path for path in root.iterdir() if path.is_dir()]:
        with suppress(BlockingIOError), exclusive_lock(_lock_path(folder), mode=_LOCK_MODE):
            _remove(folder)
            _LOG.info("abandoned work folder deleted", spool=folder.name)


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    _lock_path(folder).unlink(missing_ok=True)


def _lock_path(folder: Path) -> Path:
    return folder.with_suffix(".lock")
