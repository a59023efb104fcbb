"""Submission reader: validation against the views of a dataset, and decoding of one view at a time."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from pathlib import Path, PurePosixPath

import numpy as np

from rebar_depth_bench.base.errors import EntryError, Problem
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import FileSource
from rebar_depth_bench.submission.declaration import DEPTH_SCALE, METADATA_NAME, SubmissionMeta, parse_metadata
from rebar_depth_bench.submission.entries import (
    FORMATS,
    ExpectedViews,
    is_system_file,
    match_entries,
    max_entry_bytes,
)
from rebar_depth_bench.submission.maps import Depth
from rebar_depth_bench.submission.zip import ZipEntry, read_data, read_entries


class SubmissionReader(AbstractContextManager["SubmissionReader"]):
    """Open submission archive; a context manager that closes the file.

    ``expected`` has every view of the dataset folder. An invalid archive raises no error: ``structure_problems``
    are those that are detected without decoding a view, in a fixed order. ``meta`` is the content of
    ``submission.json``, None if that is missing or invalid. ``view_ids`` are the sorted ids of the views whose
    entries have no structural problem. ``notes`` say which entries are ignored. ``read`` is thread-safe. The file
    must not be written to while it is open.
    """

    def __init__(self, path: str | os.PathLike[str], expected: ExpectedViews) -> None:
        self.path = Path(path)
        self.meta: SubmissionMeta | None = None
        self.notes: tuple[str, ...] = ()
        self._expected = expected
        self._entries: dict[str, ZipEntry] = {}
        self._source: FileSource | None = None
        try:
            self._source = FileSource(self.path)
            self.structure_problems = tuple(self._inspect(self._source))
        except FileNotFoundError:
            self.structure_problems = (Problem("missing", "", "the file does not exist", "a zip archive"),)
        except OSError as error:
            found = f"the file cannot be read: {error.strerror or error}"
            self.structure_problems = (Problem("unreadable", "", found, "a zip archive"),)
        except EntryError as error:
            self.structure_problems = error.problems
        except EOFError as error:
            self.structure_problems = (Problem("damaged", "", str(error)),)
        self.view_ids = tuple(sorted(self._entries))

    def _inspect(self, source: FileSource) -> Iterator[Problem]:
        """Read the directory and the metadata, and yield their problems. Raises ``EntryError`` or ``EOFError``."""
        # Archives made by macOS have twice the number of entries. The remaining margin lets unknown entries be
        # listed by name; with more of them a list would be of no use.
        max_entries = 4 * len(self._expected) + 1024
        entries = read_entries(source, max_entries, lambda name: max_entry_bytes(name, self._expected))
        for entry in entries:
            yield from entry.problems
        named = [entry for entry in entries if all(problem.code != "name" for problem in entry.problems)]
        used = [entry for entry in named if not is_system_file(entry.name, self._expected)]
        if ignored := len(named) - len(used):
            files = "__MACOSX, ._* and .DS_Store"
            self.notes = (f"{self.path}: entries that macOS adds are ignored: {ignored} ({files})",)
        matched, problems = match_entries([entry.name for entry in used], self._expected)
        yield from problems
        sound = {key: used[index] for key, index in matched.items() if not used[index].problems}
        metadata = sound.pop(METADATA_NAME, None)
        self._entries = sound
        if metadata is None:
            return
        try:
            self.meta, problems = parse_metadata(bytes(read_data(source, metadata)))
        except EntryError as error:
            problems = [error.problem]
        yield from problems
        images = sorted(entry.name for entry in sound.values() if entry.name.endswith(".png"))
        if images and self.meta is not None and self.meta.depth_scale is None:
            because = f"because {len(images)} entries are PNG (first {images[0]})"
            yield Problem("missing", DEPTH_SCALE, "missing", f"metres per PNG unit, {because}")

    def read(self, view_id: str) -> Depth:
        """Return the predicted planar depth of a view in metres: (H, W), float16, float32 or float64.

        Of predictions that are not metric, it is what the kind says. A value of 0 of a PNG is returned as NaN. The
        array may be read-only. Raises ``EntryError`` if the entry is missing or invalid, and ``ValueError`` if the
        reader is closed.
        """
        if self._source is None:
            raise ValueError(f"{self.path}: the submission is closed")
        entry = self._entries.get(view_id)
        if entry is None:
            found, expected = "no valid entry was found", f"one of {', '.join(FORMATS)}"
            raise EntryError(Problem("missing", view_id, found, expected))
        suffix = PurePosixPath(entry.name).suffix
        scale = self.meta.depth_scale if self.meta else None
        data = read_data(self._source, entry)
        depth_m = FORMATS[suffix].decode(entry.name, data, self._expected[view_id], scale or 1.0)
        if scale is None and suffix == ".png":
            raise EntryError(Problem("missing", DEPTH_SCALE, "missing", f"metres per unit of {entry.name}"))
        return np.where(depth_m == 0, np.nan, depth_m) if suffix == ".png" else depth_m

    def problems(self, progress: Progress = silent) -> Iterator[Problem]:
        """Yield all problems: structural ones first, then decoding errors of each view in sorted order."""
        yield from self.structure_problems
        for done, view_id in enumerate(self.view_ids, start=1):
            progress(f"checking {self.path.name}", done, len(self.view_ids))
            try:
                self.read(view_id)
            except EntryError as error:
                if error.problem.where != DEPTH_SCALE:  # It is a structural problem, too.
                    yield error.problem

    def sha256(self) -> str:
        """Return the hex SHA-256 of the open file. Raises ``ValueError`` if the reader is closed."""
        if self._source is None:
            raise ValueError(f"{self.path}: the submission is closed")
        return self._source.sha256()

    def __exit__(self, *_: object) -> None:
        """Close the file; arrays that were already returned stay valid."""
        if self._source is not None:
            self._source.close()
            self._source = None


def read_metadata(path: Path) -> SubmissionMeta | None:
    """Return the content of ``submission.json`` of an archive of any views; None if it is missing or invalid."""
    try:
        with closing(FileSource(path)) as source:
            entries = read_entries(source, sys.maxsize, lambda name: max_entry_bytes(name, {}))
            found = [entry for entry in entries if entry.name == METADATA_NAME and not entry.problems]
            return parse_metadata(bytes(read_data(source, found[0])))[0] if found else None
    except (EntryError, EOFError, OSError):
        return None
