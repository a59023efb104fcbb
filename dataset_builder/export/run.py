"""Dataset export: writes configs of a dataset folder as plain files for use without ``datasets``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dataset_builder.config.trajectories import subset
from dataset_builder.export.colmap import cameras_txt, images_txt, points_txt
from dataset_builder.export.metadata import cameras_json, exported_files, readme_txt
from dataset_builder.export.nerfstudio import transforms_json
from dataset_builder.export.target import export_target
from dataset_builder.export.views import CameraView, StoredView, stored_views
from rebar_depth_bench.atomic_io import write_bytes, write_error, write_text
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.progress import Progress, silent


@dataclass(frozen=True)
class ConfigExport:
    """Export summary of one config: the number of views, and of image files written and already present."""

    config: str
    views: int
    written: int
    kept: int


@dataclass(frozen=True)
class ExportSummary:
    """Summary of an export, config by config."""

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

    ``views`` selects that many of a config's views, spread evenly. Files are written atomically, images before
    the metadata that refers to them. An interrupted export is resumed by calling it again: images that exist are
    kept, and the result is byte-identical to that of an uninterrupted export. ``progress`` counts views.

    Raises ``DatasetError`` for a folder that is not a complete local dataset folder, an unknown config or data
    that contradicts the manifest; ``InputError`` for fewer than one view and for a ``to`` that contains anything
    but an earlier export of the same data; ``OutputError`` for one that cannot be written.
    """
    folder = _local_folder(root)
    chosen = [folder.config(name) for name in dict.fromkeys(configs or folder.configs)]
    wanted = {config.name: _select_view_ids(config, views) for config in chosen}
    has_bars = BARS_FILE in folder.files
    bars = read_bars(folder.verified_file(BARS_FILE)) if has_bars else {}
    target = Path(to)
    try:
        with export_target(target, folder, wanted):
            exported = [
                _export_config(folder, config, wanted[config.name], bars, target / config.name, progress)
                for config in chosen
            ]
    except OSError as error:  # Only writing raises OSError here: reading raises DatasetError.
        raise write_error(error.filename or to, error) from error
    return ExportSummary(target, tuple(exported))


def _local_folder(root: str | Path) -> DatasetFolder:
    """Open a local dataset folder. Raises ``DatasetError`` if ``root`` is not a folder."""
    if not Path(root).is_dir():
        raise DatasetError(
            f"{root}: no such folder, expected a dataset folder on this machine; download a Hub repository first"
        )
    return open_folder(root)


def _select_view_ids(config: DatasetConfig, views: int | None) -> list[str]:
    """Return the ids of the selected views of a config.

    Raises ``InputError`` for fewer than one view.
    """
    if views is not None and views < 1:
        raise InputError(f"--views is {views}, expected 1 or more")
    return [config.views[index].view_id for index in subset(len(config.views), views)]


def _export_config(
    folder: DatasetFolder,
    config: DatasetConfig,
    wanted: Sequence[str],
    bars: dict[str, tuple[Bar, ...]],
    into: Path,
    progress: Progress,
) -> ConfigExport:
    """Write a config's images, then the metadata that refers to them."""
    views: list[CameraView] = []
    written = 0
    for stored in stored_views(config, wanted):
        written += _write_missing(stored, into)
        views.append(stored.view)
        progress(f"export of {config.name}", len(views), len(wanted))
    texts = {
        "cameras.json": cameras_json(folder, config, views),
        "README.txt": readme_txt(folder, config, len(views)),
    }
    if config.colour is not None:  # COLMAP's and nerfstudio's files describe colour images.
        texts |= {
            "sparse/0/cameras.txt": cameras_txt(views),
            "sparse/0/images.txt": images_txt(views),
            "sparse/0/points3D.txt": points_txt(bars.get(config.scene.name, ())),
            "transforms.json": transforms_json(views),
        }
    for name, text in texts.items():
        write_text(into / name, text)
    file_count = sum(len(view.cameras) for view in views) * len(exported_files(config))
    return ConfigExport(config.name, len(views), written, file_count - written)


def _write_missing(stored: StoredView, into: Path) -> int:
    """Write those image files of a view that do not exist yet; return their number."""
    targets = [
        (into / export_file.path(stored.view.stem(eye)), f"{eye}_{export_file.column}", export_file.encode)
        for eye in stored.view.cameras
        for export_file in exported_files(stored.config).values()
    ]
    missing = [target for target in targets if not target[0].is_file()]
    decoded = stored.decode() if missing else {}
    for path, column, encode in missing:
        write_bytes(path, encode(decoded[column]))
    return len(missing)
