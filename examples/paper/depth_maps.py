"""Depth maps that the scripts read: of a submission archive, or of a folder with one file per view."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from outputs import only_config
from rebar_depth_bench.base.errors import EntryError, InputError, SubmissionError, printable
from rebar_depth_bench.base.names import config_of, split_of
from rebar_depth_bench.base.reading import FileSource
from rebar_depth_bench.captures.views import is_capture, open_capture
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.scoring.result import DatasetIdentity
from rebar_depth_bench.scoring.truth import verified_views
from rebar_depth_bench.submission import ExpectedViews, SubmissionReader
from rebar_depth_bench.submission.declaration import METADATA_NAME, parse_metadata
from rebar_depth_bench.submission.entries import FORMATS
from rebar_depth_bench.submission.maps import Depth
from rebar_depth_bench.submission.zip import read_entries

_MAX_SHAPE, _MAX_ENTRIES = (1024, 4096), 100_000
"""Bounds of views that an archive may hold but that are not read, and of the number of its entries."""


_METRES = "the paper's errors are those of depth in metres"


@dataclass(frozen=True, eq=False)
class DepthMaps:
    """Depth maps of one method by view id; ``read`` returns planar depth in metres, shape (H, W)."""

    path: Path
    method: str
    view_ids: tuple[str, ...]
    read: Callable[[str], Depth]
    sha256: str


@contextmanager
def open_maps(
    path: str | Path,
    expected: ExpectedViews,
    png_scale: float | None = None,
    optional: Iterable[str] | None = None,
) -> Iterator[DepthMaps]:
    """Open a submission archive, or a folder of files ``<view_id>`` or ``<part after the slash>``.

    ``expected`` holds the (H, W) of each view. Views may be missing from a folder, unless ``optional`` names those
    that may be, of which none is read. The ``submission.json`` of a folder, if any, states ``method`` and, for
    16-bit PNG, ``depth_scale`` (default: ``png_scale``, metres per unit). Raises ``SubmissionError`` with all
    problems of an archive.
    """
    if Path(path).is_dir():
        yield _folder_maps(Path(path), expected, png_scale, complete=optional is not None)
        return
    present = _entry_stems(Path(path)).intersection(() if optional is None else optional)
    with SubmissionReader(path, {**expected, **dict.fromkeys(present, _MAX_SHAPE)}) as reader:
        problems = [problem for problem in reader.problems() if problem.where.rpartition(".")[0] not in present]
        problems += [] if reader.meta is None else reader.meta.kind_problems(_METRES)
        if reader.meta is None or problems:
            raise SubmissionError.from_problems(path, problems)
        yield DepthMaps(Path(path), reader.meta.method, reader.view_ids, reader.read, reader.sha256())


def _entry_stems(archive: Path) -> set[str]:
    """Return the entry names of an archive without suffix; none of a file that is no sound archive."""
    with suppress(OSError, ValueError, EOFError, EntryError), closing(FileSource(archive)) as source:
        entries = read_entries(source, _MAX_ENTRIES, lambda _: None)
        return {entry.name.rpartition(".")[0] for entry in entries}
    return set()


def _folder_maps(folder: Path, expected: ExpectedViews, png_scale: float | None, complete: bool) -> DepthMaps:
    method, scale = printable(folder.resolve().name), png_scale
    if (folder / METADATA_NAME).exists():
        meta, problems = parse_metadata((folder / METADATA_NAME).read_bytes())
        problems += [] if meta is None else meta.kind_problems(_METRES)
        if meta is None or problems:
            raise SubmissionError.from_problems(folder, problems)
        method, scale = meta.method, meta.depth_scale or png_scale
    files: dict[str, Path] = {}
    for view_id in sorted(expected):
        names = [f"{stem}{suffix}" for stem in (view_id, view_id.partition("/")[2]) for suffix in FORMATS]
        found = [name for name in names if (folder / name).is_file()]
        if len(found) > 1:
            raise SubmissionError(f"{folder}: view {view_id} has the files {', '.join(found)}, expected one")
        if found:
            files[view_id] = folder / found[0]
    if not files:
        example = f"{next(iter(expected))}.npy"
        raise SubmissionError(f"{folder}: no depth file of any view was found, expected files such as {example}")
    if complete and (missing := sorted(expected.keys() - files.keys())):
        raise SubmissionError(f"{folder}: {len(missing)} views have no file, among them {missing[0]}")
    if scale is None and any(file.suffix == ".png" for file in files.values()):
        raise SubmissionError(f"{folder}: has PNG files, expected their depth_scale in {METADATA_NAME}")

    def read(view_id: str) -> Depth:
        file = files[view_id]
        try:
            data = memoryview(file.read_bytes())
            return FORMATS[file.suffix].decode(file.name, data, expected[view_id], scale or 1.0)
        except EntryError as error:
            raise SubmissionError.from_problems(folder, error.problems) from None

    digest = hashlib.sha256(f"depth_scale {scale}\n".encode())
    for view_id, file in files.items():
        digest.update(f"{view_id} {file_sha256(file)}\n".encode())
    return DepthMaps(folder, method, tuple(files), read, digest.hexdigest())


def masked(depth_m: Depth, near_m: float, far_m: float) -> Depth:
    """Return a map, as float32 or float64, with NaN where it is not finite, not > 0 or out of range."""
    if depth_m.dtype == np.float16:
        depth_m = depth_m.astype(np.float32)  # In float16 the ends of the range would be rounded.
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth_m) & (depth_m > 0) & (depth_m >= near_m) & (depth_m <= far_m)
    return np.where(valid, depth_m, np.nan)


@dataclass(frozen=True, eq=False)
class Data:
    """Capture, or config of a dataset folder: (H, W) of the views to score, and of all that archives may hold.

    ``dataset`` is the identity of a dataset folder, ``camera`` describes the camera of a capture.
    """

    name: str
    views: ExpectedViews
    archive_views: ExpectedViews
    config: DatasetConfig | None = None
    dataset: DatasetIdentity | None = None
    camera: str | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of all views to score."""
        return next(iter(self.views.values()))

    def open_maps(self, path: str) -> AbstractContextManager[DepthMaps]:
        """Open depth maps of the views; archives may hold those of other configs too."""
        return open_maps(path, self.views if Path(path).is_dir() else self.archive_views)

    def of_split(self, sources: Sequence[DepthMaps]) -> Data:
        """Return the data restricted to the split of the maps. Raises ``InputError`` if they have several."""
        if self.config is None or not self.config.has_splits:
            return self
        view_ids = [view_id for source in sources for view_id in source.view_ids]
        splits = {split for name in view_ids if config_of(name) == self.config.name and (split := split_of(name))}
        if len(splits) != 1:
            found = ", ".join(sorted(splits)) or "none"
            raise InputError(f"config {self.config.name}: the splits of the maps are {found}, expected one")
        config = self.config.of_split(*splits)
        views = dict.fromkeys(config.view_ids, config.grid)
        return replace(self, name=f"{self.name} ({config.scenes[0].split})", views=views, config=config)

    def frames(self, exact: bool) -> Iterator[tuple[str, Depth | None]]:
        """Yield each view with its exact depth in metres, verified; with None if not ``exact`` or unknown."""
        if self.config is None or not exact:
            yield from ((view_id, None) for view_id in self.views)
            return
        for view_id, (left,), _ in verified_views(self.config):
            yield view_id, left.depth_m


def open_data(path: str, wanted: str | None) -> Data:
    """Return the capture, or the config ``wanted`` of the dataset folder or its only one."""
    if is_capture(path) and wanted is None:
        capture = open_capture(path)
        views = capture.expected_views()
        return Data(f"capture {capture.config}", views, views, camera=capture.describe_camera())
    folder = open_folder(path)
    config = only_config(path, [*folder.config_by_name.values()], wanted)
    of_config = dict.fromkeys(config.view_ids, config.grid)
    dataset = DatasetIdentity(folder.digest, folder.version)
    return Data(f"config {config.name}", of_config, folder.expected_views(), config, dataset)


def labelled(sources: Sequence[DepthMaps], reserved: str) -> dict[str, DepthMaps]:
    """Return the maps by unique label: the method, with file name and number where it is not unique."""
    by_label: dict[str, DepthMaps] = {}
    methods = [source.method for source in sources]
    for source in sources:
        is_unique = methods.count(source.method) == 1 and not source.method.startswith(reserved)
        label = source.method if is_unique else f"{source.method} ({source.path.name})"
        copies = sum(known.partition(" #")[0] == label for known in by_label)
        by_label[f"{label} #{copies + 1}" if copies else label] = source
    return by_label
