"""Layout ``zed``: a capture of a ZED camera, with ``left/``, ``right/`` and Stereolabs' ``calibration.conf``.

The id of a view of the capture is that in the dataset; of a scene of a config with splits it is
``<split>-<scene>/<0000>``. ``cameras.toml`` names the calibration and states what the
calibration cannot: the board. The true poses are left out, as no capture has them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict

from dataset_builder.export.calibration_text import stereolabs_conf
from dataset_builder.export.images import plain_png
from dataset_builder.export.layout import ExportedConfig, ImageFile, Layout
from dataset_builder.export.rig import check_layout, shared_calibration
from dataset_builder.export.views import CameraView
from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.dataset_config import DatasetConfig

_CALIBRATION = "calibration.conf"


class ZedLayout(Layout):
    """Folder that ``rebar-bench predict --data`` reads as a capture."""

    def check(self, config: DatasetConfig) -> None:
        """Raise ``InputError`` for a config without colour."""
        check_layout(config, "zed")

    def folders(self, config: DatasetConfig) -> Iterable[str]:
        """Return the folders with files."""
        del config
        return (".", *EYES)

    def images(self, config: DatasetConfig, view: CameraView) -> Iterable[ImageFile]:
        """Return the images of both eyes."""
        del config
        return [ImageFile(f"{eye}/{view.index}.png", f"{eye}_rgb", plain_png) for eye in EYES]

    def texts(self, exported: ExportedConfig) -> Mapping[str, str]:
        """Return the calibration and ``cameras.toml``."""
        calibration = shared_calibration(exported.config, exported.views)
        return {_CALIBRATION: stereolabs_conf(calibration), "cameras.toml": _cameras_toml(exported)}


def _cameras_toml(exported: ExportedConfig) -> str:
    lines = [f'calibration = "{_CALIBRATION}"']
    board = exported.config.scene.board
    if board is not None:
        values = asdict(board)
        values["dictionary"] = f'"{board.dictionary}"'
        lines += ["", "[board]", *(f"{key} = {value}" for key, value in values.items())]
    return "\n".join(lines) + "\n"
