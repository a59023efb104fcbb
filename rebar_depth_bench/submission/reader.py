"""Submission reader: validation against the views of a dataset, and decoding of one view at a time."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Self

from rebar_depth_bench.errors import EntryError, Problem
from rebar_depth_bench.parallel import Progress, silent
from rebar_depth_bench.reading import ByteSource, FileSource
from rebar_depth_bench.submission.declaration import DEPTH_SCALE, SubmissionMeta, parse_metadata
from rebar_depth_bench.submission.entries import FORMATS, ExpectedViews, match_entries, max_entry_bytes
from rebar_depth_bench.submission.maps import Depth
from rebar_depth_bench.submission.zip import (
    CheckedEntry,
    DirectoryError,
    check_entries,
    has_unsafe_name,
    read_data,
    read_directory,
)


@dataclass(frozen=True, slots=True)
class _Inspection:
    """Result of the structural checks, which decode no view; ``views`` has the entries without problems."""

    problems: tuple[Problem, ...]
    views: Mapping[str, CheckedEntry] = field(default_factory=dict)
    meta: SubmissionMeta | None = None


class SubmissionReader:
    """Open submission archive, created by ``open_submission``; a context manager that closes the file.

    ``read`` is thread-safe. The file must not be written to while it is open.
    """

    def __init__(self, path: str | os.PathLike[str], expected: ExpectedViews) -> None:
        self.path = Path(path)
        self._expected = expected
        self._source: FileSource | None = None
        self._inspection = self._open()

    def _open(self) -> _Inspection:
        problem = _file_problem(self.path)
        if problem:
            return _Inspection((problem,))
        try:
            self._source = FileSource(self.path)
        except OSError as error:
            found = f"the file cannot be opened: {error.strerror}"
            return _Inspection((Problem("invalid", "", found, "a readable zip archive"),))
        try:
            return _inspect(self._source, self._expected)
        except DirectoryError as error:
            return _Inspection(error.problems)
        except EOFError as error:
            return _Inspection((Problem("damaged", "", str(error)),))

    @property
    def structure_problems(self) -> tuple[Problem, ...]:
        """Problems that are detected without decoding a view, in a fixed order."""
        return self._inspection.problems

    @property
    def meta(self) -> SubmissionMeta | None:
        """Metadata from ``submission.json``; None if it is missing or invalid."""
        return self._inspection.meta

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Sorted ids of the views whose entries have no structural problem."""
        return tuple(sorted(self._inspection.views))

    def read(self, view_id: str) -> Depth:
        """Return the predicted planar depth of a view in metres: (H, W), float16, float32 or float64.

        A stored ``.npy`` entry is returned as a read-only view on the mapped file where its alignment allows; all
        other entries are returned as new arrays. Raises ``EntryError`` if the entry is missing or invalid, and
        ``ValueError`` if the reader is closed.
        """
        scale = self.meta.depth_scale if self.meta else None
        if scale is None and self._suffix(view_id) == ".png":
            raise EntryError(Problem("missing", DEPTH_SCALE, "missing", f"metres per unit of {view_id}.png"))
        return self._decode(view_id, scale or 1.0)

    def problems(self, progress: Progress = silent) -> Iterator[Problem]:
        """Yield all problems: structural ones first, then decoding errors of each view in sorted order."""
        yield from self.structure_problems
        scale = self.meta.depth_scale if self.meta else None
        for done, view_id in enumerate(self.view_ids, start=1):
            progress(f"checking {self.path.name}", done, len(self.view_ids))
            try:
                self._decode(view_id, scale or 1.0)
            except EntryError as error:
                yield error.problem

    def sha256(self) -> str:
        """Return the hex SHA-256 of the open file. Raises ``ValueError`` if the reader is closed."""
        if self._source is None:
            raise ValueError(f"{self.path}: the submission is closed")
        return self._source.sha256()

    def close(self) -> None:
        """Close the file; arrays that were already returned stay valid."""
        if self._source is not None:
            self._source.close()
            self._source = None

    def _suffix(self, view_id: str) -> str:
        checked = self._inspection.views.get(view_id)
        if checked is None:
            raise EntryError(
                Problem("missing", view_id, "no valid entry was found", f"one of {', '.join(FORMATS)}")
            )
        return PurePosixPath(checked.entry.name).suffix

    def _decode(self, view_id: str, scale: float) -> Depth:
        decode = FORMATS[self._suffix(view_id)].decode
        checked, source = self._inspection.views[view_id], self._source
        if source is None:
            raise ValueError(f"{self.path}: the submission is closed")
        return decode(checked.entry.name, read_data(source, checked), self._expected[view_id], scale)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_submission(path: str | os.PathLike[str], expected: ExpectedViews) -> SubmissionReader:
    """Open an archive and check its structure; ``expected`` has every view of the dataset folder.

    An invalid archive raises no error: its problems are in ``structure_problems`` of the reader.
    """
    return SubmissionReader(path, expected)


def check_archive(
    path: str | os.PathLike[str], expected: ExpectedViews, progress: Progress = silent
) -> list[Problem]:
    """Return all problems of an archive, including decoding errors of each entry; empty if it can be scored."""
    with open_submission(path, expected) as reader:
        return list(reader.problems(progress))


def _file_problem(path: Path) -> Problem | None:
    expected = "a zip archive"
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError):
            return Problem("missing", "", "the file does not exist", expected)
        return Problem("unreadable", "", f"the file cannot be read: {error}", expected)
    if stat.S_ISDIR(status.st_mode):
        return Problem("kind", "", "the path is a directory", expected)
    if not stat.S_ISREG(status.st_mode):
        return Problem("kind", "", "the path is not a regular file", expected)
    return None if status.st_size else Problem("syntax", "", "the file is empty (0 bytes)", expected)


def _inspect(source: ByteSource, expected: ExpectedViews) -> _Inspection:
    # Archives made by macOS have twice the number of entries. The remaining margin lets unknown entries be listed
    # by name; with more of them a list would be of no use.
    directory = read_directory(source, max_entries=4 * len(expected) + 1024)
    checked = check_entries(source, directory, lambda name: max_entry_bytes(name, expected))
    well_named = [item for item in checked if not has_unsafe_name(item.entry)]
    matched = match_entries([item.entry.name for item in well_named], expected)
    meta, meta_problems = _read_meta(
        source, well_named[matched.metadata] if matched.metadata is not None else None
    )
    valid_views = {
        view: well_named[index] for view, index in matched.views.items() if not well_named[index].problems
    }
    problems = (
        *(problem for item in checked for problem in item.problems),
        *matched.problems,
        *meta_problems,
        *_scale_problems(meta, valid_views),
    )
    return _Inspection(problems, valid_views, meta)


def _read_meta(
    source: ByteSource, checked: CheckedEntry | None
) -> tuple[SubmissionMeta | None, Sequence[Problem]]:
    if checked is None or checked.problems:
        return None, []
    try:
        return parse_metadata(bytes(read_data(source, checked)))
    except EntryError as error:
        return None, error.problems


def _scale_problems(meta: SubmissionMeta | None, views: Mapping[str, CheckedEntry]) -> list[Problem]:
    images = sorted(item.entry.name for item in views.values() if item.entry.name.endswith(".png"))
    if meta is None or meta.depth_scale is not None or not images:
        return []
    because = f"because {len(images)} entries are PNG (first {images[0]})"
    return [Problem("missing", DEPTH_SCALE, "missing", f"metres per PNG unit, {because}")]
