"""Where accepted archives are kept: a folder, or whatever ``fsspec`` reaches."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import fsspec
from fsspec.implementations.local import LocalFileSystem

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.files import sync


class Archives:
    """Archives by submission id. ``put`` returns when the archive is durable."""

    def __init__(self, url: str) -> None:
        """Raise ``InputError`` for a URL that ``fsspec`` cannot reach."""
        try:
            self._files, self._root = fsspec.core.url_to_fs(url)
            self._files.makedirs(self._root, exist_ok=True)
        except (ValueError, ImportError, OSError) as error:
            raise InputError(f"{url}: archives cannot be kept there: {error}") from None
        self._is_local = isinstance(self._files, LocalFileSystem)

    def put(self, submission_id: str, source: Path) -> None:
        """Take over a file. On the same disk it is renamed, elsewhere copied."""
        if not self._is_local:
            self._files.put_file(str(source), self._path(submission_id))
            source.unlink()
            return
        target = Path(self._path(submission_id))
        sync(source)
        if source.stat().st_dev == target.parent.stat().st_dev:
            source.replace(target)
        else:
            part = target.with_suffix(".part")
            shutil.copyfile(source, part)
            sync(part)
            part.replace(target)
            source.unlink()
        sync(target.parent)

    @contextmanager
    def local(self, submission_id: str, scratch: Path) -> Iterator[Path]:
        """Yield the archive as a file of this machine, fetched into ``scratch`` where it is kept elsewhere."""
        if self._is_local:
            yield Path(self._path(submission_id))
            return
        fetched = scratch / f"{submission_id}.zip"
        try:
            self._files.get_file(self._path(submission_id), str(fetched))
            yield fetched
        finally:
            fetched.unlink(missing_ok=True)

    def delete(self, submission_id: str) -> None:
        """Remove an archive; one that is not there is no error."""
        with suppress(FileNotFoundError):
            self._files.rm_file(self._path(submission_id))

    def ids(self) -> set[str]:
        """Return the ids of all archives that are kept."""
        found = self._files.ls(self._root, detail=False)
        return {Path(name).stem for name in found if name.endswith(".zip")}

    def age_s(self, submission_id: str, now: float) -> float:
        """Return how long ago an archive was written; 0 where the store does not tell."""
        told = self._files.info(self._path(submission_id))
        return now - told["mtime"] if "mtime" in told else 0.0

    def _path(self, submission_id: str) -> str:
        return f"{self._root}/{submission_id}.zip"
