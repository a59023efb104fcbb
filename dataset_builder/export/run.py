"""Export a dataset folder for people who do not use ``datasets``: plain files that other tools read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from dataset_builder.build.bars_table import BARS, read_bars
from dataset_builder.config.trajectories import subset
from dataset_builder.export.colmap import cameras_txt, images_txt, points_txt
from dataset_builder.export.images import PICTURES
from dataset_builder.export.metadata import cameras_json, readme_txt
from dataset_builder.export.nerfstudio import transforms_json
from dataset_builder.export.target import export_target
from dataset_builder.export.views import CameraView, StoredView, stored_views
from dataset_builder.scene.model import Bar
from rebar_depth_bench.atomic_io import write_bytes, write_text
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.progress import Progress, silent

_FOLDER_NAME = re.compile(r"\w[\w.-]*")


@dataclass(frozen=True)
class ConfigExport:
    """What an export did for one config: how many picture files it wrote and how many it found there."""

    config: str
    views: int
    written: int
    kept: int


@dataclass(frozen=True)
class ExportSummary:
    """What an export did, config by config."""

    folder: Path
    configs: tuple[ConfigExport, ...]


def export(
    root: str | Path,
    to: str | Path,
    configs: Sequence[str] | None = None,
    views: int | None = None,
    progress: Progress = silent,
) -> ExportSummary:
    """Export configs (default: all) of the dataset folder ``root``, each into its own folder below ``to``.

    ``views`` takes that many of a config's views, spread evenly. Every file is written whole or not at all,
    pictures before what describes them. Stopped at any moment and called again, the export goes on: pictures that
    are there are kept, and the bytes are those of an export that was never stopped. ``progress`` counts views.

    Raises ``DatasetError`` for a folder that is no finished local dataset folder, an unknown config or data that
    contradicts the manifest; ``InputError`` for fewer than one view, a ``to`` that holds anything but an earlier
    export of the same data, or one that cannot be written.
    """
    folder = _local_folder(root)
    names = tuple(dict.fromkeys(configs or folder.configs))
    wanted = {name: _chosen_views(folder, name, views) for name in names}
    bars = _bars(folder)
    target = Path(to)
    try:
        with export_target(target, folder, wanted):
            done = [_export_config(folder, name, wanted[name], bars, target / name, progress) for name in names]
    except OSError as error:  # of writing alone: reading raises DatasetError
        raise InputError(f"{to}: cannot be written: {error}") from error
    return ExportSummary(target, tuple(done))


def _local_folder(root: str | Path) -> DatasetFolder:
    if not Path(root).is_dir():
        raise DatasetError(
            f"{root}: no such folder, expected a dataset folder on this machine; download a Hub repository first"
        )
    return open_folder(root)


def _chosen_views(folder: DatasetFolder, config: str, views: int | None) -> list[str]:
    view_ids = [record.view_id for record in folder.views(config)]
    if not _FOLDER_NAME.fullmatch(config):
        raise DatasetError(f"{folder.root}: the name of config {config!r} cannot be a folder's name")
    if views is not None and views < 1:
        raise InputError(f"--views is {views}, expected 1 or more")
    return [view_ids[index] for index in subset(len(view_ids), views)]


def _bars(folder: DatasetFolder) -> dict[str, tuple[Bar, ...]]:
    path = Path(folder.root) / BARS
    try:
        return read_bars(path)
    except (OSError, pa.ArrowException, KeyError) as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from error


def _export_config(
    folder: DatasetFolder,
    config: str,
    wanted: Sequence[str],
    bars: dict[str, tuple[Bar, ...]],
    into: Path,
    progress: Progress,
) -> ConfigExport:
    """Write a config's pictures, then what describes them."""
    views: list[CameraView] = []
    written = 0
    for stored in stored_views(folder, config, wanted):
        written += _write_missing(stored, into)
        views.append(stored.view)
        progress(f"export of {config}", len(views), len(wanted))
    scene = str(folder.config(config)["scene"]["name"])
    texts = {
        "sparse/0/cameras.txt": cameras_txt(views),
        "sparse/0/images.txt": images_txt(views),
        "sparse/0/points3D.txt": points_txt(bars.get(scene, ())),
        "transforms.json": transforms_json(views),
        "cameras.json": cameras_json(folder, config, views),
        "README.txt": readme_txt(folder, config, len(views)),
    }
    for name, text in texts.items():
        write_text(into / name, text)
    pictures = sum(len(view.cameras) for view in views) * len(PICTURES)
    return ConfigExport(config, len(views), written, pictures - written)


def _write_missing(stored: StoredView, into: Path) -> int:
    """Write those pictures of a view that are not there yet; return how many."""
    targets = [
        (into / picture.path(stored.view.stem(eye)), f"{eye}_{picture.column}", picture.encode)
        for eye in stored.view.cameras
        for picture in PICTURES.values()
    ]
    missing = [one for one in targets if not one[0].is_file()]
    decoded = stored.pictures() if missing else {}
    for path, column, encode in missing:
        write_bytes(path, encode(decoded[column]))
    return len(missing)
