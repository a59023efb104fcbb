"""Archive storage, one file ``<submission id>.zip`` per submission; files of uploads; lock of a state folder."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.system import exclusive_lock, fsync_path
from rebar_depth_bench.base.writing import atomic_replace, write_error
from rebar_depth_bench.data.files import file_sha256

FILE_MODE = 0o600


class ArchiveNotFoundError(Exception):
    """Raised when an archive does not exist although the folder does."""


class ArchiveStore:
    """Storage of submission archives by submission id. Methods raise ``OSError`` if the folder is unusable."""

    def __init__(self, folder: Path, *, create: bool = True) -> None:
        """Create the folder, which machines may share. Raises the errors of ``make_folder``."""
        self._folder = folder
        if create:
            make_folder(folder, "the archive storage")

    def put(self, submission_id: str, source: Path) -> None:
        """Move a file into the storage; durable on return. It is renamed on the same disk and copied otherwise."""
        target = self.file(submission_id)
        if source.stat().st_dev == self._folder.stat().st_dev:
            os.utime(source)  # Its age counts from now.
            fsync_path(source)
            source.replace(target)
            fsync_path(self._folder)
        else:
            with atomic_replace(target, FILE_MODE) as temporary:
                shutil.copyfile(source, temporary)
            source.unlink()

    def path(self, submission_id: str) -> Path:
        """Return the path of an archive. Raises ``ArchiveNotFoundError`` if the archive does not exist."""
        path = self.file(submission_id)
        if path.is_file():
            return path
        if self._folder.is_dir():
            raise ArchiveNotFoundError(submission_id)
        raise OSError(f"{self._folder}: the folder does not exist")

    def delete(self, submission_id: str) -> None:
        """Delete an archive; a missing archive is not an error."""
        self.file(submission_id).unlink(missing_ok=True)

    def ids(self) -> set[str]:
        """Return the ids of all stored archives, none if the folder does not exist."""
        return {path.stem for path in self._folder.glob("*.zip")}

    def age_s(self, submission_id: str) -> float:
        """Return the age of an archive in seconds; 0 if it was deleted since it was listed."""
        with suppress(FileNotFoundError):
            return time.time() - self.file(submission_id).stat().st_mtime
        return 0.0

    def delete_leftovers(self, age_s: float) -> None:
        """Delete the temporary files of copies that were killed: those that have not changed for ``age_s``."""
        for path in self._folder.glob(".*.zip.*.tmp"):
            with suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime >= age_s:
                    path.unlink()

    def file(self, submission_id: str) -> Path:
        """Return the place of an archive, which may not exist."""
        return self._folder / f"{submission_id}.zip"


def make_folder(folder: Path, name: str) -> None:
    """Create a folder with mode 0700 unless it exists. Raises the errors of ``write_error``."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(f"{name} {folder}", error) from None


def archive_problem(path: Path, row: tuple[str, int], hashed: bool) -> str | None:
    """Return how a file differs from the archive of ``row`` (SHA-256, size in bytes), or None."""
    try:
        if (size := path.stat().st_size) != row[1]:
            return f"has {size} bytes, expected {row[1]}"
        return "has another SHA-256 than its row" if hashed and file_sha256(path) != row[0] else None
    except OSError as error:
        return "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"


@contextmanager
def state_lock(folder: Path, *, alone: bool = False) -> Iterator[None]:
    """Hold a lock on a state folder, shared or ``alone``, which the kernel releases however the process ends.

    Every command but ``check`` holds a shared one, and a backup holds one alone on its target. Raises
    ``InputError`` if another process holds a lock that excludes this one.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError:
            user = "a server, a worker or another command uses it" if alone else "a backup is being written to it"
            raise InputError(f"{folder}: {user}; end that first") from None
        yield
    finally:
        os.close(descriptor)


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
