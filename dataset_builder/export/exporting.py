"""Dataset export: configs as plain files, and their target folder with its lock and its ``export.json``."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from dataset_builder.cameras.trajectories import subset
from dataset_builder.export.camera_formats import (
    cameras_json,
    cameras_txt,
    images_txt,
    points_txt,
    readme_txt,
    transforms_json,
    ultralytics_yaml,
)
from dataset_builder.export.exported_views import (
    EXPORT_FILES,
    ULTRALYTICS_FILES,
    CameraView,
    decoded_row,
    exported_files,
    stored_views,
)
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import check_no_links, parse_json, read_file, remove_file
from rebar_depth_bench.base.system import exclusive_lock
from rebar_depth_bench.base.validation import StrictModel, one_of, validate_table
from rebar_depth_bench.base.writing import temporary_target, write_bytes, write_error, write_text
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.files import local_folder
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder

_FOLDERS = (".", "sparse/0", *sorted({file.folder for file in EXPORT_FILES.values()}))
"""Folders with files, relative to that of a config, which is "."."""

FileFormat = Literal["plain", "ultralytics"]
"""Format of an export: all files with their cameras, or those that Ultralytics reads."""


@dataclass(frozen=True)
class ConfigExport:
    """Export summary of one config, or of one scene of a config with splits, whose name is that of its folder.

    It has the number of views, and of image files written and already present.
    """

    config: str
    views: int
    written: int
    kept: int


def export(
    root: str | Path,
    to: str | Path,
    configs: Sequence[str] | None = None,
    views: int | None = None,
    progress: Progress = silent,
    split: str | None = None,
    file_format: FileFormat = "plain",
) -> list[ConfigExport]:
    """Export configs (default: all) of the dataset folder ``root``, each into its own folder below ``to``.

    A scene of a config with splits has a folder of its own, ``<config>/<split>-<scene>``, since each has its own
    cameras. ``split`` chooses the scenes of one split (default: all) and leaves out configs that lack it, unless
    they are named. ``views`` selects that many views of a config, or of each scene, spread evenly. Files are
    written atomically, images before the metadata that refers to them. An interrupted export is resumed by calling
    it again: images that exist are kept, and the result is byte-identical to that of an uninterrupted export.
    ``progress`` counts views. For ``ultralytics``, images and depth of both eyes are written, and
    ``<config>.yaml`` in ``to``, which names all folders exported for it so far by split.

    Raises ``DatasetError`` for a folder that is not a complete local dataset folder, an unknown config or split,
    or data that contradict the manifest; ``InputError`` for fewer than one view, no colour for Ultralytics, and
    for a ``to`` that contains anything but an earlier export of the same data; ``OutputError`` for one that cannot
    be written.
    """
    if views is not None and views < 1:
        raise InputError(f"--views is {views}, expected 1 or more")
    folder = open_folder(local_folder(root))
    every = folder.config_by_name.items()
    names = configs or [name for name, config in every if split is None or split in config.splits]
    if not names:
        raise DatasetError(f"{folder.root}: no config has the split {split}")
    chosen = [folder.config(name) for name in dict.fromkeys(names)]
    for config in chosen:
        if config.imported is not None:
            raise InputError(f"{root}: config {config.name} was imported, expected configs that were rendered")
        if file_format == "ultralytics" and config.colour is None:
            raise InputError(
                f"{root}: config {config.name} was built with --no-colour, expected colour for Ultralytics; build "
                "it without --no-colour in another folder, or name others with --config"
            )
    parts = _by_folder(chosen, split)
    wanted = {
        name: ExportedPart(
            key=config.key, views=[config.view_ids[index] for index in subset(len(config.views), views)]
        )
        for name, config in parts.items()
    }
    bars = read_bars(folder.verified_file(BARS_FILE)) if BARS_FILE in folder.files else {}
    target = Path(to)
    try:
        with export_target(target, folder, wanted, _FOLDERS):
            summary = [
                _export_part(folder, name, config, wanted[name].views, bars, target, progress, file_format)
                for name, config in parts.items()
            ]
            for config in chosen if file_format == "ultralytics" else ():
                scenes = _by_folder([config], None).items()
                done = {name: part for name, part in scenes if any((target / name / "depth").glob("*.npy"))}
                write_text(target / f"{config.name}.yaml", ultralytics_yaml(folder, config, done))
            return summary
    except OSError as error:  # Only writing raises OSError here: reading raises DatasetError.
        raise write_error(error.filename or to, error) from error


def _by_folder(chosen: Sequence[DatasetConfig], split: str | None) -> dict[str, DatasetConfig]:
    """Return what is exported into each folder: a config, or a scene of a config with splits.

    Raises ``DatasetError`` if a config has no such split.
    """
    parts = {}
    for config in chosen:
        selected = config if split is None else config.of_split(split)
        if config.has_splits:
            for scene in selected.by_scene():
                parts[f"{config.name}/{scene.scene.split}-{scene.scene.name}"] = scene
        else:
            parts[config.name] = selected
    return parts


def _export_part(
    folder: DatasetFolder,
    name: str,
    config: DatasetConfig,
    wanted: Sequence[str],
    bars: dict[str, tuple[Bar, ...]],
    to: Path,
    progress: Progress,
    file_format: FileFormat,
) -> ConfigExport:
    """Write the images of what is exported into the folder ``name``, then for ``plain`` the texts that name them.

    Images that exist are kept.
    """
    views: list[CameraView] = []
    written = kept = 0
    records = {record.view_id: record for record in config.views}
    files = list(exported_files(config).values()) if file_format == "plain" else ULTRALYTICS_FILES
    for view, row in stored_views(config, wanted):
        images = [
            (to / name / file.path(view.stem(eye)), f"{eye}_{file.column}", file.encode)
            for eye in view.cameras
            for file in files
        ]
        missing = [image for image in images if not image[0].is_file()]
        decoded = decoded_row(config, records[view.view_id], row) if missing else {}
        for path, column, encode in missing:
            write_bytes(path, encode(decoded[column]))
        written, kept = written + len(missing), kept + len(images) - len(missing)
        views.append(view)
        progress(f"export of {name}", len(views), len(wanted))
    if file_format == "plain":
        for place, text in _texts(folder, config, views, bars).items():
            write_text(to / name / place, text)
    return ConfigExport(name, len(views), written, kept)


def _texts(
    folder: DatasetFolder, config: DatasetConfig, views: Sequence[CameraView], bars: Mapping[str, tuple[Bar, ...]]
) -> dict[str, str]:
    """Return the metadata by path; COLMAP's and nerfstudio's files describe colour images."""
    texts = {
        "cameras.json": cameras_json(folder, config, views),
        "README.txt": readme_txt(folder, config, len(views)),
    }
    if config.colour is not None:
        texts |= {
            "sparse/0/cameras.txt": cameras_txt(views),
            "sparse/0/images.txt": images_txt(views),
            "sparse/0/points3D.txt": points_txt(bars.get(config.scene.name, ())),
            "transforms.json": transforms_json(views),
        }
    return texts


# Target folder: new, empty, or an earlier export of the same data that is resumed.

MARKER = "export.json"
"""File in the target folder that identifies an export."""

FORMAT = "rebar-depth-export-1"
"""Format version of ``MARKER``."""


class ExportedPart(StrictModel):
    """What is exported into one folder, a config or a scene: the key of its build and the ids of its views."""

    key: str
    views: list[str]


class _Marker(StrictModel):
    """Content of ``MARKER``."""

    format: Annotated[str, one_of(FORMAT)]
    dataset: str
    configs: dict[str, ExportedPart]


@contextmanager
def export_target(
    to: Path, folder: DatasetFolder, parts: Mapping[str, ExportedPart], subfolders: Sequence[str]
) -> Iterator[None]:
    """Prepare and lock ``to`` for an export of ``parts``, by folder below ``to``, into ``subfolders`` of each.

    Context manager; the lock is held until it exits. ``export.json`` in the folder records the dataset and, for
    each config, its build and its views. Temporary files left by a killed export are removed. Raises
    ``InputError`` if the folder contains anything else, another dataset or build, or views that are not
    wanted now, a link in place of a folder that the export writes to, or if another export holds the lock.
    """
    _check_target(to, folder)
    folders = [f"{name}/{subfolder}" for name in parts for subfolder in subfolders]
    check_no_links(to, *folders)
    try:
        to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(to, error) from None
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(to))  # Locking the folder itself leaves no file behind.
        except BlockingIOError:
            raise InputError(f"{to}: another export is using this folder") from None
        earlier = _read_marker(to / MARKER, folder) if (to / MARKER).is_file() else {}
        for name in earlier.keys() & parts.keys():
            _check_same_build(to, name, earlier[name], parts[name])
        data_files = {f"{name.partition('/')[0]}.yaml" for name in parts}  # of Ultralytics
        for path in (to, *(to / name for name in folders)):
            _remove_temporary_files(path, {MARKER, *data_files} if path == to else None)
        marker = _Marker(format=FORMAT, dataset=folder.digest, configs={**earlier, **parts})
        write_text(to / MARKER, json.dumps(marker.model_dump()) + "\n")
        yield


def _remove_temporary_files(folder: Path, only_of: Collection[str] | None) -> None:
    """Delete the temporary files in a folder, if it exists, or with ``only_of`` those for files of these names."""
    for path in list(folder.iterdir()) if folder.is_dir() else ():
        target = temporary_target(path.name)
        if target is not None and (only_of is None or target in only_of):
            remove_file(path)


def _check_target(to: Path, folder: DatasetFolder) -> None:
    """Raise ``InputError`` if ``to`` is a file, is in the dataset folder or contains anything but an export."""
    if to.exists() and not to.is_dir():
        raise InputError(f"{to}: is a file, expected a folder")
    root = Path(folder.root).resolve()
    if to.resolve().is_relative_to(root):
        raise InputError(f"{to}: is inside the dataset folder {folder.root}, expected a folder outside it")
    if to.is_dir() and not (to / MARKER).is_file():
        foreign = sorted(path.name for path in to.iterdir() if temporary_target(path.name) != MARKER)
        if foreign:
            raise InputError(
                f"{to}: is not empty (it contains {foreign[0]}) and has no {MARKER}, "
                "expected a new or an empty folder"
            )


def _read_marker(path: Path, folder: DatasetFolder) -> dict[str, ExportedPart]:
    """Return the configs of an earlier export from its ``export.json``.

    Raises ``InputError`` if the file is invalid, has another format or names another dataset.
    """
    values, problems = parse_json(read_file(path, JSON_BYTES, "the record of an export", InputError))
    marker = None if problems else validate_table(_Marker, values, problems)
    if marker is None:
        raise InputError.from_problems(path, problems)
    if marker.dataset != folder.digest:
        raise InputError(
            f"{path.parent}: contains an export of dataset {marker.dataset}, expected {folder.digest} "
            f"as in {folder.root}; choose another folder"
        )
    return marker.configs


def _check_same_build(to: Path, name: str, earlier: ExportedPart, wanted: ExportedPart) -> None:
    """Raise ``InputError`` if a config was exported from another build or has unselected views."""
    if earlier.key != wanted.key:
        raise InputError(
            f"{to}: contains config {name} of another build (key {earlier.key[:16]}, now {wanted.key[:16]}): "
            "the ground truth is the same, but the images may differ; choose another folder"
        )
    dropped = set(earlier.views) - set(wanted.views)
    if dropped:
        raise InputError(
            f"{to}: contains {len(earlier.views)} views of {name}, {len(dropped)} of which are not among the "
            f"{len(wanted.views)} requested, such as {min(dropped)}; request more views or choose another folder"
        )
