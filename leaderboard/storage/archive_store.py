"""Archive storage, one file ``<submission id>.zip`` per submission, and the files of unfinished uploads."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from rebar_depth_bench.atomic_io import exclusive_lock, fsync_path
from rebar_depth_bench.errors import InputError


class ArchiveNotFoundError(Exception):
    """Raised when an archive does not exist although the folder does."""


class ArchiveStore:
    """Storage of submission archives by submission id. Methods raise ``OSError`` if the folder is unusable."""

    def __init__(self, folder: Path) -> None:
        """Create the folder, which machines may share. Raises ``InputError`` if that is not possible."""
        self._folder = folder
        make_folder(folder, "the archive storage")

    def put(self, submission_id: str, source: Path) -> None:
        """Move a file into the storage; durable on return. It is renamed on the same disk and copied otherwise."""
        target = self._file(submission_id)
        if source.stat().st_dev == self._folder.stat().st_dev:
            os.utime(source)  # Its age counts from now.
            fsync_path(source)
            source.replace(target)
        else:
            shutil.copyfile(source, target)
            fsync_path(target)
            source.unlink()
        fsync_path(self._folder)

    def path(self, submission_id: str) -> Path:
        """Return the path of an archive. Raises ``ArchiveNotFoundError`` if the archive does not exist."""
        path = self._file(submission_id)
        if path.is_file():
            return path
        if self._folder.is_dir():
            raise ArchiveNotFoundError(submission_id)
        raise OSError(f"{self._folder}: the folder does not exist")

    def delete(self, submission_id: str) -> None:
        """Delete an archive; a missing archive is not an error."""
        self._file(submission_id).unlink(missing_ok=True)

    def ids(self) -> set[str]:
        """Return the ids of all stored archives."""
        return {path.stem for path in self._folder.iterdir() if path.suffix == ".zip"}

    def age_s(self, submission_id: str, now: float) -> float:
        """Return the age of an archive in seconds at Unix time ``now``."""
        return now - self._file(submission_id).stat().st_mtime

    def _file(self, submission_id: str) -> Path:
        return self._folder / f"{submission_id}.zip"


def make_folder(folder: Path, name: str) -> None:
    """Create a folder with mode 0700 unless it exists. Raises ``InputError`` if that is not possible."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot access {name}: {error.strerror}") from None


@contextmanager
def upload_file(spool: Path) -> Iterator[IO[bytes]]:
    """Yield a new file in ``spool`` for an upload, and delete it at the end unless it was moved.

    This process holds a lock on it, which the kernel releases however the process ends.
    """
    with exclusive_lock(spool, wait=True):  # Otherwise it could be deleted before it is locked.
        file = tempfile.NamedTemporaryFile(dir=spool, suffix=".upload", delete=False)  # noqa: SIM115
        fcntl.flock(file, fcntl.LOCK_EX)
    with file:
        try:
            yield file
        finally:
            Path(file.name).unlink(missing_ok=True)


def delete_abandoned_uploads(spool: Path) -> None:
    """Delete the files of uploads to processes that were killed, which no process holds a lock on."""
    with exclusive_lock(spool, wait=True):
        for path in spool.glob("*.upload"):
            with suppress(BlockingIOError), exclusive_lock(path):
                path.unlink()
