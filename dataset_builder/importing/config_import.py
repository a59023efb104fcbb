"""Import of a layout as a config: staged view by view, then published as a build is."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.catalog.scene_file import RESERVED_NAMES, scene_name_of
from dataset_builder.importing.import_layout import Layout, read_layout
from dataset_builder.importing.source_files import DepthTally
from dataset_builder.importing.source_views import SourceViews, open_views
from dataset_builder.importing.survey_check import SurveyCheck, read_bars_file
from dataset_builder.pipeline.folder import build_lock, check_target, remove_build_folder
from dataset_builder.pipeline.plan import BUILD_FOLDER, KEY_CHARACTERS, generator_versions
from dataset_builder.pipeline.publish import StagedScene, publish, remove_leftovers
from dataset_builder.pipeline.retained import Finished, check_retained
from dataset_builder.pipeline.shards import Staging, encode_row, stage_row
from dataset_builder.user_files.scene_schema import SCENE_NAME
from rebar_depth_bench.base.errors import InputError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, view_id
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import remove_folder
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.files import file_sha256, parameters_digest
from rebar_depth_bench.data.schema import OPTIONAL_COLUMNS

_ROLE = "not surveyed"
"""Role of bars that images show and no file of bars describes."""


@dataclass(frozen=True, eq=False)
class Import:
    """Data to import as the config ``name``: checked views, surveyed bars, and the columns that are absent."""

    name: str
    views: SourceViews
    bars: tuple[Bar, ...]

    @property
    def layout(self) -> Layout:
        """Layout of the data."""
        return self.views.layout

    @property
    def absent_columns(self) -> tuple[str, ...]:
        """Columns that are null in every row, sorted."""
        files, present = self.layout.files, set(self.layout.files.patterns)
        present |= {name.replace("bars", "mask") for name in present}  # A mask follows from bar ids.
        if files.has_right:
            present |= {f"right_{kind}" for kind in ("K", "distortion", "cam_from_world")} | {"baseline_m"}
        return tuple(sorted(set(OPTIONAL_COLUMNS) - present))


def plan_import(path: Path, name: str) -> Import:
    """Return the data that a layout file describes, after checking all of it but the content of images.

    Raises ``InputError`` with all problems of the layout, its cameras or its bars, and for a reserved name.
    """
    is_name = scene_name_of(Path(f"{name}.toml")) == name and SCENE_NAME.accept(name)
    if not is_name or name in RESERVED_NAMES:
        expected = f"{SCENE_NAME.text}, none of {', '.join(RESERVED_NAMES)}"
        raise InputError(f"--config is {escape_text(name)}, expected {expected}")
    layout = read_layout(path)
    views = open_views(path, layout)
    bars = read_bars_file(path.parent / layout.bars.file) if layout.bars is not None else ()
    return Import(name, views, bars)


@dataclass(frozen=True)
class ImportFindings:
    """What an import found out: lines of its summary, and notes on the layout."""

    summary: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def run_import(
    source: Import, out: Path, progress: Progress = silent, *, overwrite: Collection[str] = ()
) -> ImportFindings:
    """Write the config into the dataset folder ``out``, or continue an interrupted import.

    There are no findings if the config was there. Raises ``InputError`` for images that cannot be read, for a
    folder that is none of a dataset, and for a config of this name that was rendered or, unless it is among
    ``overwrite``, imported from other data; nothing is published then.
    """
    key = parameters_digest(_key_inputs(source, progress))
    staging = Staging(out / BUILD_FOLDER / f"{source.name}-{key[:KEY_CHARACTERS]}")
    check_target(out, [source.name])
    finished = Finished(out)
    published = finished.configs.get(source.name)
    if published is not None:
        if published.imported is None:
            raise InputError(
                f"{out}: config {source.name} was rendered, expected another --config for imported data"
            )
        if published.key == key and all(map(finished.matches, published.files)):
            return ImportFindings()
        if published.key != key and source.name not in overwrite:
            raise InputError(
                f"{out}: config {source.name} has {len(published.views)} finished views, which were imported from "
                f"other data or with another layout and would be lost; --overwrite {source.name} replaces them"
            )
    with build_lock(out / BUILD_FOLDER):
        try:
            check_retained(out, finished, [], [source.name])
            remove_leftovers(out, finished.folder)
            try:
                ids, findings = _stage_views(source, staging, progress)
            except InputError:
                remove_folder(staging.root)  # With another layout or other files, the views are staged elsewhere.
                raise
            bars = {bar.bar_id: bar for bar in source.bars}
            bars |= {bar_id: Bar.without_axis(bar_id, _ROLE) for bar_id in sorted(ids - bars.keys())}
            views = {view_id(source.name, index): index for index in range(len(source.views.names))}
            in_order = tuple(bars[bar_id] for bar_id in sorted(bars))
            scene = StagedScene(_scene_entry(source, key), TEST_SPLIT, staging, views, in_order)
            publish(out, finished.folder, source.name, _config_entry(source), [scene])
            remove_folder(staging.root)
        finally:
            remove_build_folder(out / BUILD_FOLDER)
    return findings


def _key_inputs(source: Import, progress: Progress) -> list[Any]:
    """Return everything that determines the bytes of the config. Raises ``InputError`` for an unreadable file."""
    files = source.views.files
    digests = []
    for done, path in enumerate(files, start=1):
        try:
            digests.append(file_sha256(path))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
        progress("files read", done, len(files))
    cameras = source.views.cameras.values()
    calibrations = [asdict(one) for one in dict.fromkeys(camera.calibration for camera in cameras)]
    poses = [None if camera.cam_from_world is None else camera.cam_from_world.tolist() for camera in cameras]
    bars = [asdict(bar) for bar in source.bars]
    layout, names = source.layout.model_dump(), source.views.names
    return [layout, names, digests, calibrations, poses, bars, generator_versions()]


def _stage_views(source: Import, staging: Staging, progress: Progress) -> tuple[set[int], ImportFindings]:
    """Stage the rows of all views; return the bar ids in the left images, and what was found out.

    All views are decoded, because views of an interrupted import are compared as well. Raises ``InputError`` for
    files that cannot be read.
    """
    ids: set[int] = set()
    tally, survey = DepthTally(), SurveyCheck(source.layout, source.bars, len(source.views.names))
    for index, name in enumerate(source.views.names):
        columns = source.views.decode(name, tally)
        survey.add(columns)
        if "left_bars" in columns:
            ids |= set(np.unique(columns["left_bars"]).tolist()) - {0}
        path = staging.row(index)
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            identity = {"view_id": view_id(source.name, index), "scene": source.name}
            row, record = encode_row({**dict.fromkeys(OPTIONAL_COLUMNS), **identity, **columns})
            stage_row(path, row, record)
        progress(f"import of {source.name}", index + 1, len(source.views.names))
    depth, (summary, survey_notes) = source.layout.depth, survey.findings()
    if depth.max_m is not None:
        summary.append(f"depth beyond depth.max_m = {depth.max_m:g} m: {tally.beyond_px} pixels left out")
    notes = [
        f"depth.invalid: no pixel of any view has the value {value:.15g}, in units of the files"
        for value in depth.invalid
        if value not in tally.invalid
    ]
    return ids, ImportFindings(tuple(summary), (*notes, *survey_notes))


def _config_entry(source: Import) -> dict[str, Any]:
    """Return the manifest entry of the config without its scene, views and digests."""
    layout, (height, width) = source.layout, source.views.grid
    return {
        "has_splits": False,
        "imported": {
            "truth_sigma_m": layout.truth_sigma_m,
            "absent_columns": source.absent_columns,
            "has_poses": source.views.has_poses,
            "description": layout.description,
            "source": layout.source,
            "licence": layout.licence,
            "layout": layout.model_dump(exclude_none=True),
            "views": source.views.names,
        },
        "rig": {"width": width, "height": height},
        "colour": {} if "left_rgb" in layout.files.patterns else None,
    }


def _scene_entry(source: Import, key: str) -> dict[str, Any]:
    """Return the manifest entry of the scene without its shards."""
    board = source.views.board
    return {
        "name": source.name,
        "split": TEST_SPLIT,
        "board": None if board is None else asdict(board),
        "protocol_views": len(source.views.names),
        "key": key,
        "generator": dict(generator_versions()),
        "mesh": None,
    }
