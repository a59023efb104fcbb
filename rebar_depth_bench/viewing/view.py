"""One view of a dataset, read and verified: both eyes, the rays of the left one, and the bars of its scene."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, UInt8
from numpy import ndarray

from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.decoding import RowDecoder
from rebar_depth_bench.data.eye_view import CAMERA_KINDS, EyeTruth, camera_from_row, truth_columns, truth_from_row
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.data.shards import rows_at
from rebar_depth_bench.errors import DatasetError, escape_text
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.view_ids import config_of

_COLUMNS = (
    *("view_id", "left_rgb", *truth_columns("left")),
    *("right_rgb", *(f"right_{kind}" for kind in CAMERA_KINDS)),
)


@dataclass(frozen=True, eq=False)
class ShownView:
    """View to show; what its config lacks is None: colour, the mask of steel, the right camera.

    ``rays`` are the left camera's: depth times ray is a point in its frame. ``bars`` are those of the scene, none
    where the pose of the camera in their frame is unknown.
    """

    view_id: str
    left: EyeTruth
    rays: Float[ndarray, "h w 3"]
    right_camera: Camera | None
    right_rgb: UInt8[ndarray, "h w 3"] | None
    bars: tuple[Bar, ...]


def read_view(folder: DatasetFolder, view_id: str) -> ShownView:
    """Read a view of a dataset, and verify its ground truth and the table of bars against the manifest.

    Only the row of the view is read. Raises ``DatasetError`` for an unknown view, and for damaged files.
    """
    config = folder.config(config_of(view_id))
    position = _position(config, view_id)
    rows = map(RowDecoder.of(config).row, rows_at(config, _COLUMNS, [position]))
    row = next((row for row in rows if row["view_id"] == view_id), None)
    verify = f"rebar-bench verify {config.root} lists damaged files"
    if row is None:
        raise DatasetError(f"{config.root}: the shards lack {view_id} at its place in the manifest; {verify}")
    left = truth_from_row(row, "left")
    if left.digest() != config.views[position].left:
        raise DatasetError(f"{config.root}: view {view_id}: ground truth differs from its digest; {verify}")
    try:
        rays = left.camera.rays()
    except ValueError as error:
        raise DatasetError(f"{config.root}: view {view_id}: {error}") from None
    right_camera = None if row["right_K"] is None else camera_from_row(row, "right", config.grid)
    has_poses = config.imported is None or config.imported.has_poses
    bars = read_bars(folder.verified_file(BARS_FILE)).get(config.scene_by_view[view_id], ()) if has_poses else ()
    return ShownView(view_id, left, rays, right_camera, row["right_rgb"], bars)


def _position(config: DatasetConfig, view_id: str) -> int:
    """Return the position of a view in its config. Raises ``DatasetError`` if it has no such view."""
    view_ids = config.view_ids
    if view_id not in view_ids:
        expected = f"one of its {len(view_ids)} views from {view_ids[0]} to {view_ids[-1]}"
        raise DatasetError(f"{config.root}: no view {escape_text(view_id)}, expected {expected}")
    return view_ids.index(view_id)
