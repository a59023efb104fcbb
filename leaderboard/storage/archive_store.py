"""Where accepted archives are kept: a folder, or whatever ``fsspec`` reaches."""

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
from rebar_depth_bench.atomic_io import sync
from rebar_depth_bench.errors import InputError


class GoneError(Exception):
    """An archive is not there, though the place is."""


class Archives:
    """Archives by submission id. ``put`` returns when the archive is durable.

    All raise ``OSError`` where the place does not answer or has no room.
    """

    def __init__(self, url: str) -> None:
        """Raise ``InputError`` for a URL that ``fsspec`` cannot reach."""
        self._url = url
        try:
            files, self._root = fsspec.core.url_to_fs(url)
            files.makedirs(self._root, exist_ok=True)
        except Exception as error:  # every filesystem has a tree of errors of its own
            raise InputError(f"{without_password(url)}: archives cannot be kept there: {error}") from None
        self._is_local = isinstance(files, LocalFileSystem)

    @contextmanager
    def _files(self) -> Iterator[Any]:
        """Yield the filesystem as this thread may use it: no two share a connection.

        Whatever goes wrong with it raises ``OSError``: every filesystem has a tree of errors of its own.
        """
        files = fsspec.core.url_to_fs(self._url)[0]
        try:
            yield files
        except FileNotFoundError:
            raise
        except Exception as error:
            files.clear_instance_cache()  # its connection may be dead
            if isinstance(error, OSError):
                raise
            raise OSError(f"{without_password(self._url)}: {type(error).__name__}: {error}") from None

    def put(self, submission_id: str, source: Path) -> None:
        """Take over a file. On the same disk it is renamed, elsewhere copied."""
        if not self._is_local:
            with self._files() as files:
                files.put_file(str(source), self._path(submission_id))
            source.unlink()
            return
        target = Path(self._path(submission_id))
        if source.stat().st_dev == target.parent.stat().st_dev:
            os.utime(source)  # its age counts from now on
            sync(source)
            source.replace(target)
        else:
            shutil.copyfile(source, target)
            sync(target)
            source.unlink()
        sync(target.parent)

    @contextmanager
    def local(self, submission_id: str, scratch: Path) -> Iterator[Path]:
        """Yield the archive as a file of this machine, fetched into ``scratch`` where it is kept elsewhere.

        Raises ``GoneError`` for one that is not there.
        """
        if self._is_local:
            path = Path(self._path(submission_id))
            if not path.is_file():
                if path.parent.is_dir():
                    raise GoneError(submission_id)
                raise OSError(f"{path.parent}: there is no such folder")
            yield path
            return
        fetched = scratch / f"{submission_id}.zip"
        try:
            try:
                with self._files() as files:
                    files.info(self._path(submission_id))  # some have no error of their own for what is not there
                    files.get_file(self._path(submission_id), str(fetched))
            except FileNotFoundError:
                raise GoneError(submission_id) from None
            yield fetched
        finally:
            fetched.unlink(missing_ok=True)

    def delete(self, submission_id: str) -> None:
        """Remove an archive; one that is not there is no error."""
        with suppress(FileNotFoundError), self._files() as files:
            files.info(self._path(submission_id))
            files.rm_file(self._path(submission_id))

    def ids(self) -> set[str]:
        """Return the ids of all archives that are kept."""
        try:
            with self._files() as files:
                files.invalidate_cache()
                found = files.ls(self._root, detail=True)
        except FileNotFoundError:  # where there are no folders, an empty one is none
            return set()
        names = [str(entry["name"]) for entry in found]
        return {Path(name).stem for name in names if name.endswith(".zip")}

    def age_s(self, submission_id: str, now: float) -> float:
        """Return how long ago an archive was written; 0 where the store does not tell."""
        with self._files() as files:
            time_s = written_s(files.info(self._path(submission_id)))
        return 0.0 if time_s is None else now - time_s

    def _path(self, submission_id: str) -> str:
        return f"{self._root}/{submission_id}.zip"


_WRITTEN = ("mtime", "LastModified", "last_modified", "updated", "modify")
"""What filesystems call the time of the last change: local and SFTP, S3, Azure, Google, FTP."""


def written_s(info: Mapping[str, Any]) -> float | None:
    """Return when a file was written, seconds since 1970, by what a filesystem tells of it; None if by nothing."""
    told = next((info[name] for name in _WRITTEN if name in info), None)
    if isinstance(told, str):
        told = _time(told)
    return told.timestamp() if isinstance(told, datetime) else told


def _time(text: str) -> datetime | None:
    """Read ISO 8601 or RFC 3659, YYYYMMDDHHMMSS with a fraction or without; both UTC."""
    plain = re.fullmatch(r"(\d{8})(\d{6})(\.\d+)?", text)
    try:
        told = datetime.fromisoformat(f"{plain[1]}T{plain[2]}" if plain else text)
    except ValueError:
        return None
    return told if told.tzinfo else told.replace(tzinfo=UTC)
