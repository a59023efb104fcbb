"""Depth maps by view id, read from a submission archive or from a plain folder of files."""

from __future__ import annotations

import hashlib
import os
from abc import abstractmethod
from contextlib import AbstractContextManager
from pathlib import Path

from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import Problem, SubmissionError, format_shape, printable
from rebar_depth_bench.reading import open_regular
from rebar_depth_bench.submission import EntryError, ExpectedViews, SubmissionMeta, open_submission
from rebar_depth_bench.submission.formats import FORMATS, Depth
from rebar_depth_bench.submission.metadata import DEPTH_SCALE, MAX_METADATA_BYTES, METADATA_NAME, parse_metadata

_FILE_NAME_PATTERN = "<view_id>, or its part after the slash, with one of " + ", ".join(FORMATS)


class DepthSource(AbstractContextManager["DepthSource"]):
    """Depth maps by view id of one method; ``read`` is thread-safe.

    ``method`` is the name of the method that predicted the maps, ``view_ids`` are the sorted ids of the views that
    have a map.
    """

    path: Path
    method: str
    view_ids: tuple[str, ...]

    @abstractmethod
    def read(self, view_id: str) -> Depth:
        """Return planar depth in metres, shape (H, W); values that are not finite or <= 0 mean no depth.

        Raises ``EntryError`` if the map cannot be read or decoded.
        """

    @abstractmethod
    def sha256(self) -> str:
        """Return the hex SHA-256 of all content that ``read`` can return."""


def open_depths(
    path: str | os.PathLike[str], expected: ExpectedViews, png_scale: float | None = None
) -> DepthSource:
    """Open an archive in the submission format, or a folder with one depth file per view.

    The files of a folder are named ``<view_id>`` or only the part after the slash, with the suffix ``.npy``,
    ``.npz``, ``.exr`` or ``.png`` (16-bit). The folder may contain a ``submission.json`` as in an archive, with
    ``method`` (default: the folder's name) and ``depth_scale`` in metres per PNG unit (default: ``png_scale``).
    Views may be missing from a folder; they have no depth. ``expected`` maps every view id that may be requested
    to its (H, W).

    Raises ``SubmissionError`` with all problems that can be detected without decoding a map.
    """
    return FolderDepths(Path(path), expected, png_scale) if Path(path).is_dir() else ArchiveDepths(path, expected)


class ArchiveDepths(DepthSource):
    """Depth maps of a submission archive."""

    def __init__(self, path: str | os.PathLike[str], expected: ExpectedViews) -> None:
        self.path = Path(path)
        self._reader = open_submission(path, expected)
        meta = self._reader.meta
        if meta is None or self._reader.structure_problems:
            problems = list(self._reader.problems())
            self._reader.close()
            raise SubmissionError.from_problems(path, problems)
        self.method = meta.method
        self.view_ids = self._reader.view_ids

    def read(self, view_id: str) -> Depth:
        """Return planar depth in metres, shape (H, W). Raises ``EntryError``."""
        return self._reader.read(view_id)

    def sha256(self) -> str:
        """Return the hex SHA-256 of the archive file."""
        return self._reader.sha256()

    def __exit__(self, *_: object) -> None:
        self._reader.close()


class FolderDepths(DepthSource):
    """Depth maps of a folder. Files with names that match no view are ignored."""

    def __init__(self, path: Path, expected: ExpectedViews, png_scale: float | None) -> None:
        self.path = path
        self._expected = expected
        self._files, file_problems = _find_files(path, expected)
        meta, problems = _folder_metadata(path)
        self._scale = png_scale if meta is None or meta.depth_scale is None else meta.depth_scale
        self.method = printable(path.resolve().name) if meta is None else meta.method
        self.view_ids = tuple(sorted(self._files))
        images = [file.name for file in self._files.values() if file.suffix == ".png"]
        if images and self._scale is None and not problems:
            expected_scale = f"metres per PNG unit, since {len(images)} files are PNG (first {min(images)})"
            problems = [Problem("missing", DEPTH_SCALE, "missing", expected_scale)]
        if file_problems or problems:
            raise SubmissionError.from_problems(path, [*file_problems, *problems])

    def read(self, view_id: str) -> Depth:
        """Return planar depth in metres, shape (H, W). Raises ``EntryError``."""
        file, shape = self._files[view_id], self._expected[view_id]
        name = str(file.relative_to(self.path))
        file_format = FORMATS[file.suffix]
        limit = file_format.max_bytes(shape)
        try:
            with open_regular(file) as stream:
                data = stream.read(limit + 1)
        except OSError as error:
            raise EntryError(Problem("unreadable", name, f"it cannot be read: {error.strerror}")) from error
        if len(data) > limit and file.suffix != ".npy":  # the .npy header gives a more precise error
            found = f"it has more than {limit} bytes"
            raise EntryError(Problem("size", name, found, f"a map of {format_shape(shape)} (H x W)"))
        return file_format.decode(name, memoryview(data), shape, self._scale or 1.0)

    def sha256(self) -> str:
        """Return the hex SHA-256 over the PNG scale and the sorted view ids with the SHA-256 of their files."""
        digest = hashlib.sha256(f"depth_scale {self._scale}\n".encode())
        for view_id in self.view_ids:
            digest.update(f"{view_id} {file_sha256(self._files[view_id])}\n".encode())
        return digest.hexdigest()

    def __exit__(self, *_: object) -> None:
        """Do nothing: files are closed after each read."""


def _find_files(path: Path, expected: ExpectedViews) -> tuple[dict[str, Path], list[Problem]]:
    """Return the depth file of each view, and the problems found while matching them.

    Two or more files for one view are a problem, and so is a folder without any depth file.
    """
    by_stem = {f"{view_id}{suffix}": view_id for view_id in expected for suffix in FORMATS}
    if len({view_id.partition("/")[0] for view_id in expected}) == 1:
        by_stem |= {name.partition("/")[2]: view_id for name, view_id in list(by_stem.items())}
    files_by_view: dict[str, list[Path]] = {}
    for file in sorted(path.glob("*")) + sorted(path.glob("*/*")):
        view_id = by_stem.get(file.relative_to(path).as_posix())
        if view_id is not None:
            files_by_view.setdefault(view_id, []).append(file)
    problems = []
    for view_id, files in files_by_view.items():
        if len(files) > 1:
            listed = ", ".join(file.name for file in files[:4])
            problems.append(Problem("duplicate", view_id, f"{len(files)} files were found ({listed})", "one"))
        problems += [
            Problem("kind", file.relative_to(path).as_posix(), "it is no file", "a regular file or a link to one")
            for file in files
            if not file.is_file()
        ]
    if not files_by_view:
        pattern = f"{_FILE_NAME_PATTERN}, such as {next(iter(expected))}.npy"
        problems = [Problem("missing", "", "no depth file of any view was found", pattern)]
    return {view_id: files[0] for view_id, files in files_by_view.items()}, problems


def _folder_metadata(path: Path) -> tuple[SubmissionMeta | None, list[Problem]]:
    file = path / METADATA_NAME
    if not os.path.lexists(file):
        return None, []
    try:
        with open_regular(file) as stream:
            return parse_metadata(stream.read(MAX_METADATA_BYTES + 1))
    except OSError as error:
        return None, [Problem("unreadable", METADATA_NAME, f"it cannot be read: {error.strerror}")]
