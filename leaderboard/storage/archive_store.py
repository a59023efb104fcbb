"""Archive storage, one file ``<submission id>.zip`` per submission; files of uploads; lock of a state folder."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from rebar_depth_bench.base.errors import InputError, StorageError, escape_text
from rebar_depth_bench.base.system import exclusive_lock, fsync_path
from rebar_depth_bench.base.writing import atomic_replace, write_error
from rebar_depth_bench.data.files import file_sha256

FILE_MODE = 0o600
MARKER = "leaderboard-id"
"""Name of the file in the archive folder that holds the id of the database (``BoardModel.board_id``).

A folder that is not mounted, or of another leaderboard, is recognised by it."""
COPY_AGE_S = 3600.0
"""Time without a change after which an unfinished copy of an archive belongs to no process, in seconds."""


class ArchiveNotFoundError(Exception):
    """Raised when an archive does not exist although the folder is the right one."""


class ArchiveStore:
    """Storage of submission archives by submission id.

    Every method raises ``StorageError`` unless the folder has the marker of the database with the id ``board_id``,
    and ``OSError`` if the folder is unusable.
    """

    def __init__(self, folder: Path, board_id: str) -> None:
        self._folder, self._board_id = folder, board_id

    def initialise(self, rows: Mapping[str, tuple[str, int] | None]) -> None:
        """Create the folder, and the marker while there are no archives, neither in it nor in ``rows``.

        ``rows`` are those of ``archive_rows``. Otherwise the folder stays as it is. Raises the errors of
        ``make_folder``.
        """
        if any(rows.values()) or any(self._folder.glob("*.zip")) or (self._folder / MARKER).exists():
            return
        make_folder(self._folder, "the archive storage")
        with atomic_replace(self._folder / MARKER, FILE_MODE) as temporary:
            temporary.write_text(f"{self._board_id}\n")

    def check(self) -> None:
        """Raise ``StorageError`` unless the folder has the marker of the database."""
        try:
            found = (self._folder / MARKER).read_text(errors="replace").strip()
        except FileNotFoundError:
            raise StorageError(
                f"{self._folder}: has no file {MARKER} with the id {self._board_id}, expected the folder of this "
                "leaderboard's archives; mount it, or name it with --archives"
            ) from None
        if found != self._board_id:
            raise StorageError(
                f"{self._folder}: belongs to the database with the id {escape_text(found)}, expected "
                f"{self._board_id}; name the right database with --db or --state-dir, or folder with --archives"
            )

    def put(self, submission_id: str, source: Path) -> None:
        """Move a file into the storage; durable on return. It is renamed on the same disk and copied otherwise."""
        target = self.file(submission_id)
        fsync_path(source)
        try:
            source.replace(target)
        except OSError as error:
            if error.errno != errno.EXDEV:  # Another disk, or another mount of the same one.
                raise
            with atomic_replace(target, FILE_MODE) as temporary:
                shutil.copyfile(source, temporary)
            source.unlink()
        else:
            fsync_path(self._folder)

    def file(self, submission_id: str) -> Path:
        """Return the place of an archive, which may not exist."""
        self.check()
        return self._folder / f"{submission_id}.zip"

    def path(self, submission_id: str) -> Path:
        """Return the path of an archive. Raises ``ArchiveNotFoundError`` if the archive does not exist."""
        path = self.file(submission_id)
        if not path.is_file():
            raise ArchiveNotFoundError(submission_id)
        return path

    def delete(self, submission_id: str) -> None:
        """Delete an archive; a missing archive is not an error."""
        self.file(submission_id).unlink(missing_ok=True)

    def ids(self) -> set[str]:
        """Return the ids of all stored archives."""
        self.check()
        return {path.stem for path in self._folder.glob("*.zip")}

    def finish_deletions(self, rows: Mapping[str, tuple[str, int] | None], copy_age_s: float = COPY_AGE_S) -> None:
        """Delete what killed processes left: archives whose row in ``rows`` says deleted, and unfinished copies.

        Archives without a row stay, and copies that have changed in the last ``copy_age_s`` seconds.
        """
        for submission_id in self.ids() & {name for name, row in rows.items() if row is None}:
            self.delete(submission_id)
        for path in self._folder.glob(".*.zip.*.tmp"):
            with suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime >= copy_age_s:
                    path.unlink()


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
