"""Views of a dataset folder for an export: cameras are read directly, images are decoded on request."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.config_tables import ViewRecord
from rebar_depth_bench.data.dataset import iterate_undecoded
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.decoding import RowDecoder
from rebar_depth_bench.data.eye_view import camera_from_row, truth_columns, truth_from_row
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.view_ids import scene_of

_COLUMNS = ("view_id", "baseline_m", *(name for eye in EYES for name in (f"{eye}_rgb", *truth_columns(eye))))


@dataclass(frozen=True, eq=False)
class CameraView:
    """Cameras of one stereo view by eye, without images: they are held for all views of a config at once."""

    view_id: str
    baseline_m: float
    cameras: Mapping[str, Camera]

    @property
    def index(self) -> str:
        """Number of the view in the full protocol of its scene, with the digits of its id."""
        return self.view_id.removeprefix(scene_of(self.view_id))

    def stem(self, eye: str) -> str:
        """Return the common file name of one eye's files, without folder and suffix, e.g. ``0000_left``."""
        return f"{self.index}_{eye}"


@dataclass(frozen=True, eq=False)
class StoredView:
    """One row of a dataset folder, its images still encoded."""

    config: DatasetConfig
    view: CameraView
    record: ViewRecord
    row: Mapping[str, Any]

    def decode(self) -> dict[str, Any]:
        """Return the decoded row (see ``rebar_depth_bench.load``), checked against the manifest.

        Raises ``DatasetError``, naming the view, if an image cannot be decoded or the digest of the ground truth
        differs from the manifest.
        """
        decoded = RowDecoder.of(self.config).row(self.row)
        for eye in self.config.truth_eyes:
            digest, expected = truth_from_row(decoded, eye).digest(), getattr(self.record, eye)
            if digest != expected:
                raise DatasetError(
                    f"{self.config.root}: view {self.record.view_id}: the {eye} ground truth has digest "
                    f"{digest[:16]}, expected {expected[:16]} as in the manifest"
                )
        return decoded


def stored_views(config: DatasetConfig, wanted: Collection[str]) -> Iterator[StoredView]:
    """Yield the wanted views of a config in the folder's order, one row in memory at a time.

    Raises ``DatasetError`` for shards that cannot be read, lack a wanted view or contain an unknown one.
    """
    records = {record.view_id: record for record in config.views}
    missing = set(wanted)
    for row in iterate_undecoded(config, _COLUMNS):
        if row["view_id"] in missing:
            missing.remove(row["view_id"])
            yield StoredView(config, _camera_view(row, config), records[row["view_id"]], row)
    if missing:
        raise DatasetError(f"{config.root}: {config.name} lacks {len(missing)} views, among them {min(missing)}")


def _camera_view(row: Mapping[str, Any], config: DatasetConfig) -> CameraView:
    try:
        cameras = {eye: camera_from_row(row, eye, config.grid) for eye in EYES}
        return CameraView(row["view_id"], float(row["baseline_m"]), cameras)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{config.root}: view {row['view_id']}: a camera is damaged: {error}") from error
