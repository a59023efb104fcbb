"""A submission archive, checked against the views of a dataset and read one view at a time."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Self

from rebar_depth_bench.errors import EntryError
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.submission.entries import ExpectedViews, lay_out, size_limit
from rebar_depth_bench.submission.formats import FORMATS, Depth
from rebar_depth_bench.submission.metadata import METADATA_NAME, MetadataError, SubmissionMeta, parse_metadata
from rebar_depth_bench.submission.zip_directory import ByteSource, DirectoryError, FileSource, read_directory
from rebar_depth_bench.submission.zip_entries import CheckedEntry, check_entries, has_bad_name, read_data


@dataclass(frozen=True, slots=True)
class _Inspection:
    """What can be known without decoding a view; ``views`` are those whose entries are sound so far."""

    problems: tuple[str, ...]
    views: Mapping[str, CheckedEntry] = field(default_factory=dict)
    meta: SubmissionMeta | None = None


class SubmissionReader:
    """An open archive. Made by ``open_submission``; a context manager.

    ``read`` may be called from many threads at once. The file must not be written to while it is open.
    """

    def __init__(self, path: str | os.PathLike[str], expected: ExpectedViews) -> None:
        self.path = Path(path)
        self._expected = dict(expected)
        self._source: FileSource | None = None
        self._inspection = self._open()

    def _open(self) -> _Inspection:
        problem = _file_problem(self.path)
        if problem:
            return _Inspection((problem,))
        try:
            self._source = FileSource(self.path)
        except OSError as error:
            return _Inspection((f"the file cannot be opened: {error.strerror}, expected a readable zip archive",))
        try:
            return _inspect(self._source, self._expected)
        except (DirectoryError, EOFError) as error:
            return _Inspection((str(error),))

    @property
    def structure_problems(self) -> tuple[str, ...]:
        """Everything wrong with the archive that shows without decoding a view, in a fixed order."""
        return self._inspection.problems

    @property
    def meta(self) -> SubmissionMeta | None:
        """What ``submission.json`` declares; None if it is missing or refused."""
        return self._inspection.meta

    @property
    def view_ids(self) -> tuple[str, ...]:
        """The views whose entries have no structural problem, sorted."""
        return tuple(sorted(self._inspection.views))

    def read(self, view_id: str) -> Depth:
        """Return the predicted depth of a view: metres, (H, W), float16, float32 or float64.

        A stored ``.npy`` comes as a read-only view on the file where its alignment allows; everything
        else is a new array. Raises ``EntryError``.
        """
        scale = self.meta.depth_scale if self.meta else None
        if scale is None and self._suffix(view_id) == ".png":
            raise EntryError(f"{view_id}.png: {METADATA_NAME} has no depth_scale, expected metres per PNG unit")
        return self._decode(view_id, scale or 1.0)

    def problems(self, progress: Progress = silent) -> Iterator[str]:
        """Yield every problem: those of the structure, then those of decoding each view in sorted order."""
        yield from self.structure_problems
        scale = self.meta.depth_scale if self.meta else None
        for done, view_id in enumerate(self.view_ids, start=1):
            progress(f"checking {self.path.name}", done, len(self.view_ids))
            try:
                self._decode(view_id, scale or 1.0)
            except EntryError as error:
                yield error.problem

    def sha256(self) -> str:
        """Return the hex SHA-256 of the very file that is read."""
        if self._source is None:
            raise ValueError(f"{self.path}: the submission is closed")
        return self._source.sha256()

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        if self._source is not None:
            self._source.close()
            self._source = None

    def _suffix(self, view_id: str) -> str:
        checked = self._inspection.views.get(view_id)
        if checked is None:
            raise EntryError(f"{view_id}: no sound entry was found, expected one of {', '.join(FORMATS)}")
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

    Raises nothing for a bad archive: the reader's ``structure_problems`` say what is wrong with it.
    """
    return SubmissionReader(path, expected)


def check_archive(path: str | os.PathLike[str], expected: ExpectedViews, progress: Progress = silent) -> list[str]:
    """Return every problem of an archive, each entry decoded; an empty list means it can be scored."""
    with open_submission(path, expected) as reader:
        return list(reader.problems(progress))


def _file_problem(path: Path) -> str | None:
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        reason = "it does not exist" if isinstance(error, FileNotFoundError) else str(error)
        return f"the file cannot be read: {reason}, expected a zip archive"
    if stat.S_ISDIR(status.st_mode):
        return "the path is a directory, expected a zip archive"
    if not stat.S_ISREG(status.st_mode):
        return "the path is not a regular file, expected a zip archive"
    return None if status.st_size else "the file is empty (0 bytes), expected a zip archive"


def _inspect(source: ByteSource, expected: ExpectedViews) -> _Inspection:
    # Junk of macOS doubles the count; beyond some room for a list of strangers nothing useful is left to say.
    directory = read_directory(source, max_entries=4 * len(expected) + 1024)
    checked = check_entries(source, directory, lambda name: size_limit(name, expected))
    well_named = [item for item in checked if not has_bad_name(item.entry)]
    layout = lay_out([item.entry.name for item in well_named], expected)
    meta, meta_problems = _read_meta(source, well_named[layout.metadata] if layout.metadata is not None else None)
    sound = {view: well_named[index] for view, index in layout.views.items() if not well_named[index].problems}
    problems = (
        *(problem for item in checked for problem in item.problems),
        *layout.problems,
        *meta_problems,
        *_scale_problems(meta, sound),
    )
    return _Inspection(problems, sound, meta)


def _read_meta(source: ByteSource, checked: CheckedEntry | None) -> tuple[SubmissionMeta | None, list[str]]:
    if checked is None or checked.problems:
        return None, []
    try:
        return parse_metadata(bytes(read_data(source, checked))), []
    except EntryError as error:
        return None, [error.problem]
    except MetadataError as error:
        return None, [f"{METADATA_NAME}: {problem}" for problem in error.problems]


def _scale_problems(meta: SubmissionMeta | None, views: Mapping[str, CheckedEntry]) -> list[str]:
    images = sorted(item.entry.name for item in views.values() if item.entry.name.endswith(".png"))
    if meta is None or meta.depth_scale is not None or not images:
        return []
    return [
        f"{METADATA_NAME}: depth_scale is missing, expected metres per PNG unit, "
        f"since {len(images)} entries are PNG (first {images[0]})"
    ]
