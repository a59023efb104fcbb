"""Methods of the benchmark that simulate a scanner.

The paper leaves "a synthetic LiDAR baseline on the existing meshes" as future work. A scan is projected to the
left camera's grid: each return fills its beam's cell at its own depth. Where cells overlap, the nearest return is
used. A return of planar depth z covers a pixel if the pixel's point at depth z lies in the beam's cell as seen
from the scanner. Cells tile the scanner's sphere, so that a wall is covered without gaps at any step size, and
nothing is interpolated beyond a cell. Surfaces that the scanner sees but the left camera does not are removed by
the z-buffer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from dataset_builder.lidar.scanner import (
    MOBILE,
    SURVEY,
    ScannerSpec,
    angles_from_directions,
    beam_angles,
    directions_from_angles,
    simulate_scan,
    visible_beams,
)
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.base.errors import MethodError, install_command
from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.geometry.cameras import Camera, fold_radius, project
from rebar_depth_bench.methods import MethodInfo, MultiViewMethod, Prepared, Views

_COLUMNS = ("left_K", "left_distortion", "left_cam_from_world")
"""Dataset columns that the method reads."""

_MAX_CANDIDATES_PER_BATCH = 1 << 19
"""Maximum number of candidate pixels per batch; bounds memory."""

_BOX_MARGIN_PX = 0.1
"""Safety margin of the bounding boxes, pixels."""


def lidar_method(name: str, spec: ScannerSpec, what: str) -> MultiViewMethod:
    """Return the method of a scanner; ``what`` describes it in the summary.

    The method reads the scene's mesh, which is ground truth, and the scanner's pose is known exactly: it
    simulates what such an instrument could measure and uses no images.
    """

    def check(_: Views) -> None:
        if find_spec("embreex") is None:
            raise MethodError(f"{name} requires embreex for ray casting: {install_command('build')}")

    def prepare(views: Views, _: Path, progress: Progress) -> Prepared:
        progress(f"{name}: the mesh of {views.config}", 0, 1)
        caster = RayCaster(read_mesh_ply(views.mesh))
        progress(f"{name}: the mesh of {views.config}", 1, 1)
        height, width = views.grid

        def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            camera = Camera(row["left_K"], row["left_distortion"], row["left_cam_from_world"], width, height)
            return scan_depth_m(caster, spec, camera, row["view_id"])

        return Prepared(run, {"scanner": json.loads(parameters)})

    parameters = json.dumps(asdict(spec))
    # The digest distinguishes scanners of the same name with different parameters.
    source = f"this project, scanner {hashlib.sha256(parameters.encode()).hexdigest()[:12]}"
    summary = (
        f"simulated laser scanner, {what}, {-1000 * spec.position_left_m[1]:.0f} mm above the left camera, pose"
        " known exactly; reads the scene's mesh: a simulation, not a measurement on images; no prediction at"
        f" ranges below {spec.min_range_m:g} m"
    )
    info = MethodInfo(name, summary, _COLUMNS, True, source, "Apache-2.0", uses_ground_truth=True, inputs="lidar")
    return MultiViewMethod(info, prepare, check)


@dataclass(frozen=True, eq=False)
class _Cells:
    """Returns of a scan: the beam's row and column, the planar depth in the left frame (metres).

    ``half_width`` is half of the extended cell's width, in steps.
    """

    row: Int64[ndarray, " n"]
    column: Int64[ndarray, " n"]
    depth_m: Float64[ndarray, " n"]
    half_width: Float64[ndarray, " n"]


def scan_depth_m(caster: RayCaster, spec: ScannerSpec, camera: Camera, view_id: str) -> Float32[ndarray, "h w"]:
    """Return planar depth on the left camera's grid by a simulated scan, metres; NaN where no beam has a return.

    On a slanted surface, parallax opens gaps between cells. They are up to as wide, in steps, as the tangent of
    the slant times the scanner's distance from the camera over depth. Cells are extended by that much (half on
    each side, at most one step in all) for a slant of 45 degrees, but only into pixels that are in no cell.
    """
    rays = camera.rays()
    row, column = visible_beams(spec, rays)
    range_m = simulate_scan(caster, spec, row, column, camera.cam_from_world, view_id)
    forward = directions_from_angles(*beam_angles(spec, row, column))[:, 2]
    depth_m = range_m * forward + spec.position_left_m[2]
    row, column, depth_m = (values[depth_m > 0] for values in (row, column, depth_m))
    extension = np.minimum(float(np.linalg.norm(spec.position_left_m)) / depth_m, 1.0)
    cells = _Cells(row, column, depth_m, 0.5 * (1.0 + extension))
    in_cell_m, extended_m = (np.full(camera.height * camera.width, np.inf) for _ in range(2))
    for part, pixel in _candidates(spec, cells, camera):
        points_m = cells.depth_m[part, None, None] * rays.reshape(-1, 3)[pixel] - spec.position_left_m
        azimuth, elevation = angles_from_directions(points_m)
        across, up = azimuth / spec.azimuth_step_rad, elevation / spec.elevation_step_rad
        row, column = cells.row[part, None], cells.column[part, None]
        inside = (np.floor(across) == column) & (np.floor(up) == row)
        offset = np.maximum(np.abs(across - (column + 0.5)), np.abs(up - (row + 0.5)))
        in_extended_cell = offset <= cells.half_width[part, None]
        part_m = np.broadcast_to(cells.depth_m[part, None], pixel.shape)
        np.minimum.at(in_cell_m, pixel[inside], part_m[inside])
        np.minimum.at(extended_m, pixel[in_extended_cell], part_m[in_extended_cell])
    nearest_m = np.where(np.isfinite(in_cell_m), in_cell_m, extended_m)
    return np.where(np.isfinite(nearest_m), nearest_m, np.nan).astype(np.float32).reshape(rays.shape[:2])


def _candidates(
    spec: ScannerSpec, cells: _Cells, camera: Camera
) -> Iterator[tuple[Int64[ndarray, " n"], Int64[ndarray, "n p"]]]:
    """Yield batches of returns, bounded by memory: indices, and the pixels of a bounding box around each cell."""
    low, high, valid = _bounding_boxes(spec, cells, camera)
    chosen = np.flatnonzero(valid)
    sizes, group = np.unique((high - low + 1)[chosen], axis=0, return_inverse=True)
    for number, (across, down) in enumerate(sizes):
        members = chosen[group.ravel() == number]
        v, u = (offsets.ravel() for offsets in np.mgrid[:down, :across])
        batch_size = max(_MAX_CANDIDATES_PER_BATCH // len(u), 1)
        for start in range(0, len(members), batch_size):
            part = members[start : start + batch_size]
            pixel_u, pixel_v = low[part, 0, None] + u, low[part, 1, None] + v
            yield part, pixel_v * camera.width + pixel_u


def _bounding_boxes(
    spec: ScannerSpec, cells: _Cells, camera: Camera
) -> tuple[Int64[ndarray, "n 2"], Int64[ndarray, "n 2"], Bool[ndarray, " n"]]:
    """Return first and last pixel (u, v) of a box around each cell, clipped to the image, and whether it is valid.

    A box is invalid if it is empty or a corner of the cell cannot be projected.
    """
    centre_m = np.asarray(spec.position_left_m)
    azimuth, elevation = beam_angles(spec, cells.row, cells.column)
    half = cells.half_width
    lowest, highest = np.full((len(half), 2), np.inf), np.full((len(half), 2), -np.inf)
    valid = np.ones(len(half), bool)
    fold = fold_radius(camera.distortion)
    for side, end in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        corner = directions_from_angles(
            azimuth + side * half * spec.azimuth_step_rad, elevation + end * half * spec.elevation_step_rad
        )
        projectable = corner[:, 2] > 0
        step = (cells.depth_m - centre_m[2]) / np.where(projectable, corner[:, 2], 1.0)
        point = centre_m + step[:, None] * corner
        projectable &= np.hypot(point[:, 0], point[:, 1]) < fold * cells.depth_m
        pixel = project(camera.K, np.where(projectable[:, None], point, [0.0, 0.0, 1.0]), camera.distortion)
        lowest, highest, valid = np.minimum(lowest, pixel), np.maximum(highest, pixel), valid & projectable
    # The edges of a projected cell are curved, by no more than the square of the cell's size.
    bend = np.diag(camera.K)[:2] * max(spec.azimuth_step_rad, spec.elevation_step_rad) ** 2
    limit = np.array([camera.width - 1, camera.height - 1])
    low = np.clip(np.ceil(lowest - bend - _BOX_MARGIN_PX), 0, limit + 1).astype(np.int64)
    high = np.clip(np.floor(highest + bend + _BOX_MARGIN_PX), -1, limit).astype(np.int64)
    return low, high, valid & (low <= high).all(axis=1)


LIDAR_SURVEY = lidar_method("lidar-survey", SURVEY, "surveyor's phase-shift class (FARO Focus S)")
"""Method of ``SURVEY``."""

LIDAR_MOBILE = lidar_method("lidar-mobile", MOBILE, "a robot's spinning class (Ouster OS1-128)")
"""Method of ``MOBILE``."""
