"""Ground truth and predictions of one view in 3D, with bars and cameras, in rerun (https://rerun.io).

    python examples/view_rerun.py ROOT lattice/0028 a.zip b.zip                  # opens rerun's viewer
    python examples/view_rerun.py ROOT lattice/0028 a.zip b.zip --out view.rrd   # writes what rerun view.rrd shows

It needs ``pip install . rerun-sdk==0.23.1``; later versions need numpy 2, which the extra ``build`` excludes. The
viewer sends usage statistics unless ``rerun analytics disable`` was run before.

All entities are in the world frame, metres: ``truth``, ``bars``, ``left`` and ``right`` (cameras with images), and
of each archive ``predictions/<method>/native`` and ``scaled``, the latter multiplied by the scale of the protocol.
Points are ``steel`` or ``other``, without those beyond 1.25 times the largest depth of steel. Scaled
predictions, and those of other points, are hidden at first.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import UInt8
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, SubmissionError, escape_text, printable
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars, with_axis
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.data.rows import (
    EyeTruth,
    camera_from_row,
    iterate_rows,
    truth_columns,
    truth_from_row,
)
from rebar_depth_bench.data.schema import CAMERA_SHAPES
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, transform
from rebar_depth_bench.scoring.evaluation import open_evaluation
from rebar_depth_bench.scoring.metrics import is_valid_prediction, median, median_scale
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.submission import EntryError

COLUMNS = ("left_rgb", "right_rgb", *truth_columns("left"), *(f"right_{kind}" for kind in CAMERA_SHAPES))
COLOURS = np.array([[0, 114, 178], [213, 94, 0], [0, 158, 115], [160, 72, 138]], np.uint8)  # Of archives.
MAX_TRUTH_RATIO, MAX_PREDICTION_RATIO = 1.25, 4.0
"""Multiples of the largest depth of steel beyond which points are left out: they would shrink the picture."""
HIDDEN = rrb.EntityBehavior(visible=False)


def show(stream: rr.RecordingStream, folder: DatasetFolder, view_id: str, archives: Sequence[str]) -> None:
    """Log a view of a dataset and its predictions. Raises the library's errors for unknown views and archives."""
    config = folder.config(config_of(view_id))
    if view_id not in config.view_ids:
        raise InputError(f"{config.root}: no view {escape_text(view_id)}, expected one of {config.name}")
    [row] = iterate_rows(config, COLUMNS, [view_id])
    left = truth_from_row(row, "left")
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    colours = np.full((*left.depth_m.shape, 3), 160, np.uint8) if left.rgb is None else left.rgb
    log_points(stream, ["world", "truth"], left, left.depth_m, colours)
    overrides = {"world/left/depth": HIDDEN}  # It would be a second cloud.
    for number, archive in enumerate(archives):
        path = log_prediction(stream, left, archive, number, folder.root, view_id)
        for hidden in (["native", "other"], ["scaled"]):
            overrides[rr.new_entity_path([*path, *hidden])] = HIDDEN
    if config.imported is None or config.imported.has_poses:
        bars = read_bars(folder.verified_file(BARS_FILE)).get(config.scene_by_view[view_id], ())
        log_bars(stream, with_axis(bars))
    log_camera(stream, "left", left.camera, left.rgb)
    stream.log("world/left/depth", rr.DepthImage(left.depth_m, meter=1.0), static=True)
    if row["right_K"] is not None:
        log_camera(stream, "right", camera_from_row(row, "right", config.grid), row["right_rgb"])
    space = rrb.Spatial3DView(origin="world", name=view_id, overrides=overrides)
    images = [rrb.Spatial2DView(origin="world/left", contents=[f"world/left/{name}"]) for name in ("rgb", "depth")]
    stream.send_blueprint(rrb.Blueprint(rrb.Horizontal(space, rrb.Vertical(*images), column_shares=[2, 1])))


def log_prediction(
    stream: rr.RecordingStream, left: EyeTruth, archive: str, number: int, root: str, view_id: str
) -> list[str]:
    """Log the prediction of an archive, native and scaled, and return the path of its entities."""
    with open_evaluation(archive, root) as evaluation:
        evaluation.require_metric("points need depth in metres")
        try:
            predicted_m = evaluation.submission.read(view_id)
        except EntryError as error:
            raise SubmissionError.from_problems(archive, error.problems) from None
        path = ["world", "predictions", f"{number + 1}: {printable(evaluation.meta.method)}"]
    pixels = scored_pixels(left.mask, left.depth_m)
    p_m, z_m = predicted_m.ravel()[pixels], left.depth_m.ravel()[pixels]
    valid = is_valid_prediction(p_m)
    scale = median_scale(p_m[valid], median(z_m[valid])) if valid.any() else None
    print_notice(f"{path[-1]}: " + ("no valid prediction" if scale is None else f"scale {scale:.4g}"))
    colours = np.broadcast_to(COLOURS[number % len(COLOURS)], (*left.depth_m.shape, 3))
    log_points(stream, [*path, "native"], left, predicted_m, colours)
    if scale is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            log_points(stream, [*path, "scaled"], left, scale * predicted_m.astype(float), colours)
    return path


def log_points(
    stream: rr.RecordingStream, path: list[str], left: EyeTruth, depth_m: ndarray, colours: UInt8[ndarray, "h w 3"]
) -> None:
    """Log the points of valid depth (H x W, metres) on surfaces, steel and other ones."""
    steel = np.ones(depth_m.shape, dtype=bool) if left.mask is None else left.mask
    largest_m = left.depth_m[steel].max(initial=0.0) or np.inf
    shown = (left.depth_m > 0) & (left.depth_m <= MAX_TRUTH_RATIO * largest_m)
    shown &= is_valid_prediction(depth_m) & (depth_m <= MAX_PREDICTION_RATIO * largest_m)
    rays, world_from_cam = left.camera.rays(), inverse_rigid(left.camera.cam_from_world)
    for part, pixels in {"steel": shown & steel, "other": shown & ~steel}.items():
        part_m = depth_m[pixels].astype(np.float64)
        points_m = transform(world_from_cam, rays[pixels] * part_m[:, None])
        points = rr.Points3D(points_m, radii=part_m / (2 * left.camera.K[0, 0]), colors=colours[pixels])
        stream.log([*path, part], points, static=True)


def log_bars(stream: rr.RecordingStream, bars: Sequence[Bar]) -> None:
    """Log the axes of bars as lines with their radii."""
    axes_m, radii_m = [np.array(bar.axis_m) for bar in bars], [bar.diameter_m / 2 for bar in bars]
    labels = [f"{bar.bar_id}: {bar.role}, {1000 * bar.diameter_m:g} mm" for bar in bars]
    strips = rr.LineStrips3D(axes_m, radii=radii_m, labels=labels, show_labels=False)
    stream.log("world/bars", strips, static=True)


def log_camera(stream: rr.RecordingStream, eye: str, camera: Camera, rgb: UInt8[ndarray, "h w 3"] | None) -> None:
    """Log a camera, whose distortion rerun does not draw, and its image."""
    pose, K = inverse_rigid(camera.cam_from_world), camera.K.copy()
    K[:2, 2] += 0.5  # The centre of rerun's first pixel is (0.5, 0.5).
    pinhole = rr.Pinhole(image_from_camera=K, width=camera.width, height=camera.height)
    stream.log(f"world/{eye}", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), pinhole, static=True)
    if rgb is not None:
        stream.log(f"world/{eye}/rgb", rr.Image(rgb), static=True)


def run(options: argparse.Namespace) -> None:
    """Write a recording of the view, or show it in a viewer that is started."""
    stream = rr.RecordingStream("rebar-depth-bench")
    memory = stream.memory_recording() if options.out else stream.spawn()
    show(stream, open_folder(options.root), options.view, options.archives)
    if options.out:
        write_output(options.out, memory.drain_as_bytes())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="show ground truth and predictions of one view in 3D")
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument("view", metavar="VIEW", help="id of the view, such as lattice/0000")
    parser.add_argument("archives", metavar="ARCHIVE", nargs="*", help="submission archives")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write a recording (.rrd)")
    options = parser.parse_args()
    sys.exit(run_command(lambda: run(options)))
