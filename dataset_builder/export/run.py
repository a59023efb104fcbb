"""Dataset export: writes configs of a dataset folder as plain files for use without ``datasets``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dataset_builder.config.trajectories import subset
from dataset_builder.export.kitti import KittiLayout
from dataset_builder.export.layout import ExportedConfig, Layout
from dataset_builder.export.plain import PlainLayout
from dataset_builder.export.target import export_target
from dataset_builder.export.views import CameraView, StoredView, stored_views
from dataset_builder.export.zed import ZedLayout
from rebar_depth_bench.atomic_io import write_bytes, write_error, write_text
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.progress import Progress, silent

LAYOUTS: Mapping[str, Layout] = {"plain": PlainLayout(), "zed": ZedLayout(), "kitti": KittiLayout()}
"""Layouts of an export by name."""
DEFAULT_LAYOUT = "plain"


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
    layout: str = DEFAULT_LAYOUT,
    progress: Progress = silent,
) -> ExportSummary:
    """Export configs (default: all) of the dataset folder ``root``, each into its own folder below ``to``.

    ``layout`` is a name in ``LAYOUTS``. ``views`` selects that many of a config's views, spread evenly. Files are
    written atomically, images before the metadata that refers to them. An interrupted export is resumed by calling
    it again: images that exist are kept, and the result is byte-identical to that of an uninterrupted export.
    ``progress`` counts views.

    Raises ``DatasetError`` for a folder that is not a complete local dataset folder, an unknown config or data
    that contradicts the manifest; ``InputError`` for fewer than one view, for a config that the layout cannot hold
    and for a ``to`` that contains anything but an earlier export of the same data in this layout; ``OutputError``
    for one that cannot be written.
    """
    folder = _local_folder(root)
    chosen = [folder.config(name) for name in dict.fromkeys(configs or folder.configs)]
    for config in chosen:
        if config.imported is not None:
            raise InputError(f"{root}: config {config.name} was imported, expected configs that were rendered")
        LAYOUTS[layout].check(config)
    wanted = {config.name: _select_view_ids(config, views) for config in chosen}
    folders = {config.name: tuple(LAYOUTS[layout].folders(config, wanted[config.name])) for config in chosen}
    has_bars = BARS_FILE in folder.files
    bars = read_bars(folder.verified_file(BARS_FILE)) if has_bars else {}
    target = Path(to)
    try:
        with export_target(target, folder, layout, wanted, folders):
            exported = [
                _export_config(LAYOUTS[layout], folder, config, wanted[config.name], bars, target, progress)
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
    layout: Layout,
    folder: DatasetFolder,
    config: DatasetConfig,
    wanted: Sequence[str],
    bars: dict[str, tuple[Bar, ...]],
    to: Path,
    progress: Progress,
) -> ConfigExport:
    """Write a config's images, then the texts that refer to them."""
    views: list[CameraView] = []
    into = to / config.name
    written = files = 0
    for stored in stored_views(config, wanted):
        view_files, view_written = _write_missing(layout, stored, into)
        files, written = files + view_files, written + view_written
        views.append(stored.view)
        progress(f"export of {config.name}", len(views), len(wanted))
    for name, text in layout.texts(ExportedConfig(folder, config, views, bars)).items():
        write_text(into / name, text)
    return ConfigExport(config.name, len(views), written, files - written)


def _write_missing(layout: Layout, stored: StoredView, into: Path) -> tuple[int, int]:
    """Write those image files of a view that do not exist yet; return the numbers of all and of those written."""
    images = list(layout.images(stored.config, stored.view))
    missing = [image for image in images if not (into / image.path).is_file()]
    decoded = stored.decode() if missing else {}
    for image in missing:
        write_bytes(into / image.path, image.encode(decoded[image.column]))
    return len(images), len(missing)
