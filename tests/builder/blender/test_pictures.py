"""Rendered colour against the ground truth: right pictures warped to the left, and detected ArUco markers.

Pictures: the right one is sampled where the points of the left pixels project, and at whole-pixel shifts from
there. If depth, poses, K and pictures are consistent, they match best at zero shift. All whole-pixel shifts
sample at the same fractions of a pixel, so that noise and interpolation affect them equally; a parabola through
the three lowest costs gives the shift to hundredths of a pixel.

Markers: two effects displace a detected corner although camera and board are correct. Under the tone curve white
spreads over black in a pixel that covers both, and ``cv2.cornerSubPix`` places a rounded corner inside the true
one. Both move every black edge inward by about half a pixel, so one inset is fitted to all markers and subtracted.
It cannot hide a camera error, which shifts or scales the centres of the markers. In noisy pictures the search of a
corner sometimes slides along an edge by some pixels; a few such markers are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import map_coordinates

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, RayCache, view_from_row
from dataset_builder.audit.independent_depth import project_into
from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.scene.variants.registry import IMAGE_LIGHTS, LIGHT_SLOT, variants_of_slot
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners, board_pose, detected_corners_px
from rebar_depth_bench.geometry.cameras import (
    NOMINAL_FOCAL_PX,
    Camera,
    camera_centre,
    project,
    rotation_vector,
    transform,
)
from tests.builder.audit.audit_scene import with_baseline, with_depth, with_K_shift
from tests.building import RunBuild

Pictures = tuple[str, AuditedConfig, Sequence[AuditedView]]
PictureCheck = Callable[[AuditedConfig, Sequence[AuditedView]], list[str] | None]
"""Check that returns problems, or None if there is too little to measure."""

GRID = ("--width", "640", "--height", "360")
SHIFTS_PX = range(-3, 4)
MAX_PIXELS = 20_000
DEPTH_TOLERANCE = 0.03
"""Relative difference from which two depths belong to different surfaces."""


def photometric_problems(config: AuditedConfig, views: Sequence[AuditedView]) -> list[str] | None:
    """Report a common shift of all views above 0.1 px, more with few pixels, or of a single view above a pixel.

    Correct renders give under 0.05 px at 1280 x 720, and 0.1 px in three noisy views of 160 x 90.
    """
    costs, counts = zip(*(shift_costs(config, view) for view in views), strict=True)
    if sum(counts) < 1000:
        return None
    together_px = [best_shift_px(cost) for cost in np.sum(costs, axis=0)]
    is_off = np.abs(together_px).max() > 0.1 + 6 / sum(counts) ** 0.5
    problems = [f"all views match best at an offset of {together_px} px"] if is_off else []
    for view, cost, count in zip(views, costs, counts, strict=True):
        if count >= 300 and max(abs(best_shift_px(along)) for along in cost) > 1:
            problems.append(f"view {view.view_id} matches best more than a pixel off")
    return problems


def shift_costs(config: AuditedConfig, view: AuditedView) -> tuple[Float64[ndarray, "2 7"], int]:
    """Return the squared differences of both pictures by shift along u and along v, and the number of pixels."""
    left, right = smoothed_grey(view.left), smoothed_grey(view.right)
    left_m, right_m = (camera_centre(eye.camera.cam_from_world) for eye in view.eyes.values())
    pixels = comparable_pixels(config, view.left, left, float(np.linalg.norm(left_m - right_m)))
    projected = project_into(view.right, view.left.points_m.reshape(-1, 3)[pixels], len(SHIFTS_PX))
    seen = np.flatnonzero(projected.inside)
    bars = view.left.bars.ravel()[pixels[seen]]
    seen = seen[is_visible(view.right, projected.px[seen], projected.depth_m[seen], bars)]
    seen = seen[:: len(seen) // MAX_PIXELS + 1]
    cost = np.zeros((2, len(SHIFTS_PX)))
    for axis, (n, shift_px) in product((0, 1), enumerate(SHIFTS_PX)):
        u, v = (projected.px[seen] + shift_px * np.eye(2)[axis]).T
        difference = map_coordinates(right, [v, u], order=1) - left.ravel()[pixels[seen]]
        # Clipping bounds the weight of highlights that only one eye sees.
        cost[axis, n] = np.minimum(difference**2, 40.0**2).sum()
    return cost, len(seen)


def best_shift_px(cost: Float64[ndarray, " 7"]) -> float:
    """Return the vertex of the parabola through the least cost and its neighbours, or the end of the range."""
    best = int(np.argmin(cost))
    if best in (0, len(cost) - 1):
        return float(SHIFTS_PX[best])
    before, here, after = cost[best - 1 : best + 2]
    return float(SHIFTS_PX[best] + (before - after) / 2 / (before - 2 * here + after))


def smoothed_grey(eye: AuditedEye) -> Float32[ndarray, "h w"]:
    """Return the grey levels without the noise of few samples, and smooth enough for bilinear interpolation."""
    assert eye.rgb is not None
    grey = cv2.cvtColor(eye.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0))


def comparable_pixels(
    config: AuditedConfig, eye: AuditedEye, levels: Float32[ndarray, "h w"], baseline_m: float
) -> Int64[ndarray, " n"]:
    """Return the flat indices of pixels with depth and texture that look the same to both eyes.

    Left out are bars whose light and dark sides move by more than 0.05 px between the eyes, about half the angle
    between the eyes times the radius, and other surfaces near a jump or steep change of depth: there the colours
    of two surfaces are mixed, or only one side of an edge would be compared.
    """
    textured = np.hypot(*(cv2.Sobel(levels, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))) >= 4.0
    has_depth = eye.depth_m > 0
    focal_px, depth_m = eye.camera.K[0, 0], np.where(has_depth, eye.depth_m, np.inf).astype(np.float64)
    around = np.ones((3, 3), dtype=np.uint8)
    rise_m = np.maximum(
        cv2.dilate(eye.depth_m, around) - eye.depth_m, eye.depth_m - cv2.erode(eye.depth_m, around)
    )
    jump = np.abs(cv2.Laplacian(focal_px * baseline_m / depth_m, cv2.CV_64F)) > 0.2
    jump |= eye.mask | (rise_m >= DEPTH_TOLERANCE * eye.depth_m)
    near_jump = cv2.dilate(jump.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    radius_m = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in config.steel:
        radius_m[bar.bar_id] = bar.diameter_m / 2 if bar.has_axis else np.inf
    shading_shift_px = radius_m[eye.bars] * focal_px * baseline_m / depth_m**2 / 2
    return np.flatnonzero(textured & has_depth & (eye.mask | ~near_jump) & (shading_shift_px < 0.05))


def is_visible(
    eye: AuditedEye, px: Float64[ndarray, "n 2"], depth_m: Float64[ndarray, " n"], bars: ndarray
) -> Bool[ndarray, " n"]:
    """Return whether the eye's pixels around each projection have the point's bar id and about its depth.

    They are four, or fewer where a coordinate is whole, as the rows of parallel eyes are: a row more, always the
    one below, would leave out the lower sides of thin bars only.
    """
    low, high = np.floor(px + 1e-6).astype(int), np.ceil(px - 1e-6).astype(int)
    visible = np.ones(len(px), dtype=bool)
    for u, v in product((low[:, 0], high[:, 0]), (low[:, 1], high[:, 1])):
        visible &= (np.abs(eye.depth_m[v, u] - depth_m) < DEPTH_TOLERANCE * depth_m) & (eye.bars[v, u] == bars)
    return visible


def marker_problems(config: AuditedConfig, views: Sequence[AuditedView]) -> list[str] | None:
    """Report few markers, corners away from their projections, and poses of ``solvePnP`` unlike the stored."""
    board, eyes = config.board, [eye for view in views for eye in view.eyes.values()]
    expected = [] if board is None else [visible_corners_px(eye, board) for eye in eyes]
    count = sum(map(len, expected))
    if board is None or not count:
        return None
    detected = [detected_corners_px(np.asarray(eye.rgb), board.dictionary) for eye in eyes]
    found = [(n, marker) for n, corners in enumerate(expected) for marker in corners if marker in detected[n]]
    light_may_hide_markers = not set(variants_of_slot(config.variants, LIGHT_SLOT)) <= set(IMAGE_LIGHTS)
    if len(found) < 0.5 * count:
        return None if light_may_hide_markers else [f"{len(found)} of {count} large markers are detected"]
    true_px = np.array([expected[n][marker] for n, marker in found])
    off_px = np.array([detected[n][marker] for n, marker in found]) - true_px
    inward = inset_directions(true_px)
    is_slipped = np.linalg.norm(off_px - fitted_inset_px(off_px, inward) * inward, axis=2).max(axis=1) >= 1.5
    problems = (
        [f"{is_slipped.sum()} of {len(found)} slipped"] if is_slipped.sum() > max(1, 0.1 * len(found)) else []
    )
    true_px, off_px, inward = true_px[~is_slipped], off_px[~is_slipped], inward[~is_slipped]
    inset_px = fitted_inset_px(off_px, inward)
    off_px -= inset_px * inward
    corners_px, centres_px = (
        float(np.sqrt((off**2).sum(axis=-1).mean())) for off in (off_px, off_px.mean(axis=1))
    )
    if corners_px > 0.4 or centres_px > 0.25 or abs(inset_px) > 1:
        problems.append(f"corners are {corners_px} px off, centres {centres_px} px; the inset is {inset_px} px")
    corrected: list[Corners] = [{} for _ in eyes]
    for (n, marker), corners in zip(np.array(found)[~is_slipped].tolist(), true_px + off_px, strict=True):
        corrected[n][marker] = corners
    errors = [pose_error(eye.camera, corners, board) for eye, corners in zip(eyes, corrected, strict=True)]
    off_mm_per_m, off_deg = np.nanmedian([error for error in errors if error], axis=0)
    if off_mm_per_m > 8 or off_deg > 0.5:
        problems.append(f"poses of solvePnP are {off_mm_per_m} mm/m and {off_deg} degrees off")
    return problems


def visible_corners_px(eye: AuditedEye, board: BoardSpec) -> Corners:
    """Return the projected corners of markers 24 px wide or more, in the frame and with nothing before them."""
    visible = {}
    for marker, corners_m in marker_corners_m(board).items():
        corners_cam = transform(eye.camera.cam_from_world, corners_m)
        if (corners_cam[:, 2] <= 0).any():
            continue
        corners_px = project(eye.camera.K, corners_cam, eye.camera.distortion)
        sides_px = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1)
        width_px = cv2.contourArea(corners_px.astype(np.float32)) / sides_px.max()
        middle_px = corners_px.mean(axis=0)
        with_margin = np.round(middle_px + (corners_px - middle_px) * (1 + 1 / MARKER_MODULES)).astype(np.int32)
        in_frame = (with_margin >= 1).all() and (
            with_margin <= [eye.camera.width - 2, eye.camera.height - 2]
        ).all()
        if not in_frame or width_px < 24:
            continue
        is_paper = ~eye.mask & (eye.depth_m > 0) & (np.abs(eye.points_m[..., 2]) < 0.001)
        covered = cv2.fillConvexPoly(np.zeros(eye.mask.shape, np.uint8), with_margin, 1) > 0
        if is_paper[covered].all():
            visible[marker] = corners_px
    return visible


def inset_directions(quads_px: Float64[ndarray, "n 4 2"]) -> Float64[ndarray, "n 4 2"]:
    """Return the displacement of the corners when each edge of the clockwise quads moves inward by one pixel."""
    along = np.roll(quads_px, -1, axis=1) - quads_px
    normals = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    both = np.stack([np.roll(normals, 1, axis=1), normals], axis=2)
    return np.asarray(np.linalg.solve(both, np.ones((*quads_px.shape[:2], 2, 1)))[..., 0])


def fitted_inset_px(off_px: Float64[ndarray, "n 4 2"], inward: Float64[ndarray, "n 4 2"]) -> float:
    """Return the inset that explains the offsets best."""
    return float((off_px * inward).sum() / (inward**2).sum())


def pose_error(camera: Camera, corners_px: Corners, board: BoardSpec) -> tuple[float, float] | None:
    """Return the errors of the pose recovered from two markers or more: mm per metre of distance, and degrees.

    Both are scaled to the focal length of 700 px: at half of it, a pixel covers twice the angle.
    """
    found = board_pose(corners_px, board, camera.K, camera.distortion) if len(corners_px) > 1 else None
    if found is None:
        return None
    centre_m, zoom = camera_centre(camera.cam_from_world), camera.K[0, 0] / NOMINAL_FOCAL_PX
    off_m = np.linalg.norm(camera_centre(found) - centre_m)
    turn_rad = np.linalg.norm(rotation_vector(found[:3, :3] @ camera.cam_from_world[:3, :3].T))
    return float(1000 * off_m / np.linalg.norm(centre_m) * zoom), float(np.rad2deg(turn_rad) * zoom)


CHECKS = (photometric_problems, marker_problems)


def pictures(root: Path) -> Iterator[Pictures]:
    """Yield the label and the views of each scene of each config of a folder."""
    steel = read_bars(root / BARS_FILE)
    for config in open_folder(root).config_by_name.values():
        for scene in config.by_scene():
            spec, rays = scene.scene, RayCache()
            audited = AuditedConfig(spec.appearance.variants, steel[spec.name], spec.board)
            yield scene.label, audited, [view_from_row(row, rays) for row in iterate_rows(scene, COLUMNS)]


@pytest.fixture(scope="module")
def lattice(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Pictures:
    """Return two small views of the lattice; in one of them most markers are wide enough to be checked."""
    root = tmp_path_factory.mktemp("pictures") / "dataset"
    process = run_build("--out", root, "--config", "lattice", "--views", "2", *GRID, "--samples", "4")
    assert process.returncode == 0, process.stderr
    (only,) = pictures(root)
    return only


@pytest.mark.parametrize("check", CHECKS)
def test_lattice_is_where_its_ground_truth_says(lattice: Pictures, check: PictureCheck) -> None:
    _, config, views = lattice
    assert check(config, views) == []


DAMAGES: dict[str, tuple[PictureCheck, Callable[[AuditedView], AuditedView]]] = {
    "pictures: depth 1 % off": (photometric_problems, lambda view: with_depth(view, 1.01)),
    "pictures: baseline 2 mm off": (photometric_problems, lambda view: with_baseline(view, 0.002)),
    "pictures: K off along u": (photometric_problems, lambda view: with_K_shift(view, ("right",), 0, 0.5)),
    "pictures: K off along v": (photometric_problems, lambda view: with_K_shift(view, ("right",), 1, 0.5)),
    "markers: baseline 2 mm off": (marker_problems, lambda view: with_baseline(view, 0.002)),
    "markers: one K off along u": (marker_problems, lambda view: with_K_shift(view, ("right",), 0, 0.5)),
    "markers: both K off along u": (marker_problems, lambda view: with_K_shift(view, ("left", "right"), 0, 0.5)),
    "markers: both K off along v": (marker_problems, lambda view: with_K_shift(view, ("left", "right"), 1, 0.5)),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_small_errors_of_the_ground_truth_are_reported(lattice: Pictures, damage: str) -> None:
    check, damaged = DAMAGES[damage]
    _, config, views = lattice
    assert check(config, [damaged(view) for view in views])


@pytest.mark.nightly
def test_every_config_is_where_its_ground_truth_says(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"
    for options in (
        ("--views", "3"),
        ("--config", "lattice", "--variant", "wet", "formwork", "--views", "2"),
        ("--config", "lattice", "--variant", "sensor", "sunset", "--views", "2"),
        ("--scene", "examples/beam.toml", "--views", "2"),
        ("--config", "cages", "--split", "validation", "--scenes", "4", "--views-per-scene", "2"),
    ):
        process = run_build("--out", root, *options, *GRID, "--samples", "8")
        assert process.returncode == 0, process.stderr
    made = {check: set[str]() for check in CHECKS}
    for label, config, views in pictures(root):
        for check in CHECKS:
            problems = check(config, views)
            assert not problems, (label, problems)
            if problems is not None:
                made[check].add(label)
    assert made[photometric_problems] >= set(CONFIGS)
    assert made[marker_problems] >= {name for name in CONFIGS if name not in ("pile", "pier")}
