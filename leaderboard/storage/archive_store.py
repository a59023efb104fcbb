"""Archive storage in a local folder or any other filesystem that ``fsspec`` supports."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from leaderboard.redact import without_password
from rebar_depth_bench.atomic_io import fsync_path
from rebar_depth_bench.errors import InputError


class ArchiveNotFoundError(Exception):
    """Raised when an archive does not exist although its storage is available."""


class ArchiveStore:
    """Storage of submission archives by submission id.

    All methods raise ``OSError`` if the storage is unavailable or full.
    """

    def __init__(self, url: str) -> None:
        """Create the folder ``url``. Raises ``InputError`` if ``fsspec`` cannot access it."""
        self._url = url
        try:
            files, self._root = fsspec.core.url_to_fs(url)
            files.makedirs(self._root, exist_ok=True)
        except Exception as error:  # Each filesystem raises its own exception types.
            raise InputError(f"{without_password(url)}: cannot access the archive storage: {error}") from None
        self._is_local = isinstance(files, LocalFileSystem)

    @contextmanager
    def _filesystem(self) -> Iterator[Any]:
        """Yield the filesystem for use in this thread; threads do not share a connection.

        Errors of the filesystem, whose exception types differ, are raised as ``OSError``.
        """
        files = fsspec.core.url_to_fs(self._url)[0]
        try:
            yield files
        except FileNotFoundError:
            raise
        except Exception as error:
            files.clear_instance_cache()  # Its connection may be broken.
            if isinstance(error, OSError):
                raise
            raise OSError(f"{without_password(self._url)}: {type(error).__name__}: {error}") from None

    def put(self, submission_id: str, source: Path) -> None:
        """Move a file into the storage; durable on return.

        It is renamed on the same disk and copied otherwise.
        """
        if not self._is_local:
            with self._filesystem() as files:
                files.put_file(str(source), self._path(submission_id))
            source.unlink()
            return
        target = Path(self._path(submission_id))
        if source.stat().st_dev == target.parent.stat().st_dev:
            os.utime(source)  # Its age counts from now.
            fsync_path(source)
            source.replace(target)
        else:
            shutil.copyfile(source, target)
            fsync_path(target)
            source.unlink()
        fsync_path(target.parent)

    @contextmanager
    def local_copy(self, submission_id: str, scratch: Path) -> Iterator[Path]:
        """Yield the path of the archive on this machine, downloaded into ``scratch`` if the storage is remote.

        Raises ``ArchiveNotFoundError`` if the archive does not exist.
        """
        if self._is_local:
            path = Path(self._path(submission_id))
            if not path.is_file():
                if path.parent.is_dir():
                    raise ArchiveNotFoundError(submission_id)
                raise OSError(f"{path.parent}: the folder does not exist")
            yield path
            return
        fetched = scratch / f"{submission_id}.zip"
        try:
            try:
                with self._filesystem() as files:
                    # Not all filesystems raise FileNotFoundError in get_file.
                    files.info(self._path(submission_id))
                    files.get_file(self._path(submission_id), str(fetched))
            except FileNotFoundError:
                raise ArchiveNotFoundError(submission_id) from None
            yield fetched
        finally:
            fetched.unlink(missing_ok=True)

    def delete(self, submission_id: str) -> None:
        """Delete an archive; a missing archive is not an error."""
        with suppress(FileNotFoundError), self._filesystem() as files:
            files.info(self._path(submission_id))
            files.rm_file(self._path(submission_id))

    def ids(self) -> set[str]:
        """Return the ids of all stored archives."""
        try:
            with self._filesystem() as files:
                files.invalidate_cache()
                entries = files.ls(self._root, detail=True)
        except FileNotFoundError:  # Object stores have no empty folders.
            return set()
        names = [str(entry["name"]) for entry in entries]
        return {Path(name).stem for name in names if name.endswith(".zip")}

    def age_s(self, submission_id: str, now: float) -> float:
        """Return the age of an archive in seconds at Unix time ``now``; 0 if the filesystem does not report it."""
        with self._filesystem() as files:
            time_s = modified_s(files.info(self._path(submission_id)))
        return 0.0 if time_s is None else now - time_s

    def _path(self, submission_id: str) -> str:
        return f"{self._root}/{submission_id}.zip"


_MODIFIED_KEYS = ("mtime", "LastModified", "last_modified", "updated", "modify")
"""Keys of the modification time in ``info``: local and SFTP, S3, Azure, Google, FTP."""


def modified_s(info: Mapping[str, Any]) -> float | None:
    """Return the modification time (Unix timestamp) from a filesystem's ``info``, or None if it has none."""
    value = next((info[name] for name in _MODIFIED_KEYS if name in info), None)
    if isinstance(value, str):
        value = _parse_time(value)
    return value.timestamp() if isinstance(value, datetime) else value


def _parse_time(text: str) -> datetime | None:
    """Parse a time in ISO 8601 or RFC 3659 (YYYYMMDDHHMMSS[.F]); UTC if it has no offset. None if invalid."""
    rfc_3659 = re.fullmatch(r"(\d{8})(\d{6})(\.\d+)?", text)
    try:
        parsed = datetime.fromisoformat(f"{rfc_3659[1]}T{rfc_3659[2]}" if rfc_3659 else text)
    except ValueError:
        return None
    return parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)
