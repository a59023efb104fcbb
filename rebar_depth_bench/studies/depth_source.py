"""Depth maps by view, from a submission archive or from a plain folder of files: read the same way by a study."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import SubmissionError, show_shape
from rebar_depth_bench.submission import EntryError, ExpectedViews, SubmissionMeta, open_submission
from rebar_depth_bench.submission.formats import FORMATS, Depth
from rebar_depth_bench.submission.metadata import METADATA_NAME, MetadataError, parse_metadata

_NAMES = "<view_id>, or its part after the slash, with one of " + ", ".join(FORMATS)


class DepthSource(Protocol):
    """Depth maps by view id; a context manager. ``read`` may be called from many threads at once."""

    path: Path

    @property
    def method(self) -> str:
        """Who made the maps."""

    @property
    def view_ids(self) -> tuple[str, ...]:
        """The views that have a map, sorted."""

    def read(self, view_id: str) -> Depth:
        """Return planar depth in metres, (H, W); not finite or <= 0: none. Raises ``EntryError``."""

    def sha256(self) -> str:
        """Return the hex SHA-256 of everything that may be read."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_depths(
    path: str | os.PathLike[str], expected: ExpectedViews, png_scale: float | None = None
) -> DepthSource:
    """Open an archive in the submission format, or a folder with one depth file a view.

    A folder holds ``<view_id>`` or only the part after the slash, as ``.npy``, ``.npz``, ``.exr`` or 16-bit
    ``.png``. It may hold a ``submission.json`` as an archive does, with ``method`` (else the folder's name) and
    ``depth_scale``, metres per PNG unit (else ``png_scale``). Views may be missing from a folder: they have no
    depth. ``expected`` has the (H, W) of every view that may be asked for.

    Raises ``SubmissionError`` with everything that shows without decoding a map.
    """
    return FolderDepths(Path(path), expected, png_scale) if Path(path).is_dir() else ArchiveDepths(path, expected)


class ArchiveDepths:
    """The maps of a submission archive."""

    def __init__(self, path: str | os.PathLike[str], expected: ExpectedViews) -> None:
        self.path = Path(path)
        self._reader = open_submission(path, expected)
        meta = self._reader.meta
        if meta is None or self._reader.structure_problems:
            problems = list(self._reader.problems())
            self._reader.close()
            raise SubmissionError(str(path), problems)
        self.method = meta.method
        self.view_ids = self._reader.view_ids

    def read(self, view_id: str) -> Depth:
        """Return planar depth in metres, (H, W). Raises ``EntryError``."""
        return self._reader.read(view_id)

    def sha256(self) -> str:
        """Return the hex SHA-256 of the archive's file."""
        return self._reader.sha256()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()


@dataclass(frozen=True)
class _Found:
    files: Mapping[str, Path]
    problems: tuple[str, ...]


class FolderDepths:
    """The maps of a folder. Files of other names are left alone."""

    def __init__(self, path: Path, expected: ExpectedViews, png_scale: float | None) -> None:
        self.path = path
        self._expected = expected
        found = _find_files(path, expected)
        meta, problems = _folder_metadata(path)
        self._scale = png_scale if meta is None or meta.depth_scale is None else meta.depth_scale
        self._files = found.files
        self.method = path.resolve().name if meta is None else meta.method
        self.view_ids = tuple(sorted(found.files))
        images = [file.name for file in found.files.values() if file.suffix == ".png"]
        if images and self._scale is None and not problems:
            problems = [
                f"{METADATA_NAME}: no depth_scale, expected metres per PNG unit, since {len(images)} files "
                f"are PNG (first {min(images)})"
            ]
        if found.problems or problems:
            raise SubmissionError(str(path), [*found.problems, *problems])

    def read(self, view_id: str) -> Depth:
        """Return planar depth in metres, (H, W). Raises ``EntryError``."""
        file, shape = self._files[view_id], self._expected[view_id]
        name = str(file.relative_to(self.path))
        kind = FORMATS[file.suffix]
        limit = kind.max_bytes(shape)
        try:
            with file.open("rb") as stream:
                data = stream.read(limit + 1)
        except OSError as error:
            raise EntryError(f"{name}: it cannot be read: {error.strerror}") from error
        if len(data) > limit and file.suffix != ".npy":  # that one's header says more than its size
            raise EntryError(
                f"{name}: it has more than {limit} bytes, expected a map of {show_shape(shape)} (H x W)"
            )
        return kind.decode(name, memoryview(data), shape, self._scale or 1.0)

    def sha256(self) -> str:
        """Return the hex SHA-256 over the view ids and the files' own digests, sorted, and the PNG scale."""
        digest = hashlib.sha256(f"depth_scale {self._scale}\n".encode())
        for view_id in self.view_ids:
            digest.update(f"{view_id} {file_sha256(self._files[view_id])}\n".encode())
        return digest.hexdigest()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing stays open."""


def _find_files(path: Path, expected: ExpectedViews) -> _Found:
    """Find the one file of every view: two of one view are a problem, none at all is one too."""
    by_stem = {f"{view_id}{suffix}": view_id for view_id in expected for suffix in FORMATS}
    if len({view_id.partition("/")[0] for view_id in expected}) == 1:
        by_stem |= {name.partition("/")[2]: view_id for name, view_id in list(by_stem.items())}
    claims: dict[str, list[Path]] = {}
    for file in sorted(path.glob("*")) + sorted(path.glob("*/*")):
        view_id = by_stem.get(file.relative_to(path).as_posix())
        if view_id is not None and file.is_file():
            claims.setdefault(view_id, []).append(file)
    problems = [
        f"{view_id}: {len(files)} files were found ({', '.join(file.name for file in files[:4])}), expected one"
        for view_id, files in claims.items()
        if len(files) > 1
    ]
    if not claims:
        problems = [f"no depth file of any view was found, expected {_NAMES}, such as {next(iter(expected))}.npy"]
    return _Found({view_id: files[0] for view_id, files in claims.items()}, tuple(problems))


def _folder_metadata(path: Path) -> tuple[SubmissionMeta | None, list[str]]:
    file = path / METADATA_NAME
    if not file.exists():
        return None, []
    try:
        return parse_metadata(file.read_bytes()), []
    except OSError as error:
        return None, [f"{METADATA_NAME}: it cannot be read: {error.strerror}"]
    except MetadataError as error:
        return None, [f"{METADATA_NAME}: {problem}" for problem in error.problems]
