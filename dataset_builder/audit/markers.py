"""ArUco markers that OpenCV finds in the colour pictures, against where the cameras put them.

Two things move a found corner although cameras and board are right. Pictures are stored with a tone curve, under
which white spreads over black where a pixel sees both: every black edge moves inward by the same fraction of a
pixel. And ``cv2.cornerSubPix`` finds a rounded corner inside the true one. Both act alike on all edges, so one
inset for all markers of a config is fitted, told and taken off; it can hide no error of a camera, which moves or
scales the markers' places. Measured on the lattice (1280 x 720, ideal grid, 8 samples; 640 x 360, raw grid,
4 samples): an inset of 0.51 px both times, which leaves 0.21 and 0.28 px (RMS) of the corners, and 0.07 and
0.13 px of the markers' places, the means of their four corners.

Sub-pixel windows reach 4 px from a corner, or 0.8 of a marker's module where that is less, so that they never
touch the bits inside the black frame. The detector's 0.3 modules leave 0.36 px of small markers (24 to 46 px).

Verdicts on the markers: their corners, how many are found, and the poses they give back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from dataset_builder.config.rigs import Camera
from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners, detected_corners_px
from rebar_depth_bench.geometry.cameras import NOMINAL_FOCAL_PX, camera_centre, project, rigid, transform

LEAST_WIDTH_PX = 24.0
"""A marker whose shorter side or width across is less, by distance or slant, is not asked for: 4 px a module."""
_FLAT_M = 0.001


@dataclass(frozen=True, eq=False)
class FoundMarkers:
    """Of one eye: how many markers ought to be found, and the found of these beside the true ones, pixels."""

    expected: int
    found_px: Float64[ndarray, "n 4 2"]
    true_px: Float64[ndarray, "n 4 2"]
    corners_m: Float64[ndarray, "n 4 3"]


def found_markers(eye: AuditedEye, board: BoardSpec) -> FoundMarkers:
    """Look for the board's markers that the eye sees whole, large and not too slanted."""
    layout = marker_corners_m(board)
    true_px = projected_corners_px(eye.camera, layout)
    expected = [marker for marker in sorted(layout) if _is_clear(eye, true_px[marker])]
    detected = detected_corners_px(eye.rgb, board.dictionary) if expected else {}
    found = [marker for marker in expected if marker in detected]
    return FoundMarkers(
        expected=len(expected),
        found_px=np.array([detected[marker] for marker in found]).reshape(-1, 4, 2),
        true_px=np.array([true_px[marker] for marker in found]).reshape(-1, 4, 2),
        corners_m=np.array([layout[marker] for marker in found]).reshape(-1, 4, 3),
    )


def projected_corners_px(camera: Camera, corners_m: Mapping[int, Float64[ndarray, "4 3"]]) -> Corners:
    """Return where a camera sees markers' corners, pixels; not a number for a marker that is not before it."""
    found = {}
    for marker, world_m in corners_m.items():
        points_cam = transform(camera.cam_from_world, world_m)
        in_front = bool((points_cam[:, 2] > 0).all())
        found[marker] = project(camera.K, points_cam, camera.distortion) if in_front else np.full((4, 2), np.nan)
    return found


def inset_directions(quads_px: Float64[ndarray, "n 4 2"]) -> Float64[ndarray, "n 4 2"]:
    """Return how a quad's corners move when each of its edges moves inward by one pixel."""
    following, before = np.roll(quads_px, -1, axis=1), np.roll(quads_px, 1, axis=1)
    middle = quads_px.mean(axis=1, keepdims=True)
    normals = np.stack([_inward(before, quads_px, middle), _inward(quads_px, following, middle)], axis=2)
    return np.asarray(np.linalg.solve(normals, np.ones((*quads_px.shape[:2], 2, 1)))[..., 0])


def _inward(
    start: Float64[ndarray, "n 4 2"], end: Float64[ndarray, "n 4 2"], middle: Float64[ndarray, "n 1 2"]
) -> Float64[ndarray, "n 4 2"]:
    """Return the unit normals of edges, towards the middle."""
    along = end - start
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    side = np.sign(((middle - start) * normal).sum(axis=-1, keepdims=True))
    return np.asarray(normal * side)


def _is_clear(eye: AuditedEye, quad_px: Float64[ndarray, "4 2"]) -> bool:
    """Return whether a marker and its quiet zone stand in the frame, large enough, with nothing before them."""
    grown = quad_px.mean(axis=0) + (quad_px - quad_px.mean(axis=0)) * (1 + 1 / MARKER_MODULES)
    size = np.array([eye.camera.width, eye.camera.height])
    if not ((grown >= 1) & (grown <= size - 2)).all() or least_width_px(quad_px) < LEAST_WIDTH_PX:
        return False
    low, high = np.floor(grown.min(axis=0)).astype(int), np.ceil(grown.max(axis=0)).astype(int) + 1
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    inside = np.zeros(eye.mask[window].shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, np.round(grown - low).astype(np.int32), 1)
    flat = ~eye.mask[window] & (np.abs(eye.points_m[window][..., 2]) < _FLAT_M) & (eye.depth_m[window] > 0)
    return bool(flat[inside > 0].all())


def least_width_px(quad_px: Float64[ndarray, "4 2"]) -> float:
    """Return the least distance of a quad's corners from the lines of the sides they are not on, pixels."""
    start, end = quad_px, np.roll(quad_px, -1, axis=0)
    along = end - start
    widths = []
    for n in range(4):
        others = quad_px[[(n + 2) % 4, (n + 3) % 4]] - start[n]
        widths += (
            np.abs(along[n, 0] * others[:, 1] - along[n, 1] * others[:, 0]) / np.linalg.norm(along[n])
        ).tolist()
    return float(min(widths))


MAX_CORNER_RMS_PX = 0.4
MAX_PLACE_RMS_PX = 0.25
"""Principal points half a pixel off in both eyes give 0.5 px, in one eye 0.37 px."""
MAX_INSET_PX = 1.0
MIN_FOUND_SHARE = 0.5
MAX_POSE_MM_A_METRE = 8.0
MAX_POSE_DEG = 0.5
"""Of a picture of ``NOMINAL_FOCAL_PX``; at half that focal length, where a pixel is twice as much, twice that."""
_LEAST_MARKERS = 2
"""One marker alone leaves a pose that may as well be its mirror."""


@dataclass(frozen=True, eq=False)
class MarkerFigures:
    """Of both eyes of a view: camera and markers; none without a board."""

    eyes: tuple[tuple[Camera, FoundMarkers], ...]


def view_markers(config: AuditedConfig, view: AuditedView) -> MarkerFigures:
    """Look for the markers in both pictures of a view."""
    board = config.board
    if board is None:
        return MarkerFigures(())
    return MarkerFigures(tuple((eye.camera, found_markers(eye, board)) for eye in view.eyes.values()))


def pose_error(camera: Camera, markers: FoundMarkers, inset_px: float) -> tuple[float, float] | None:
    """Return how far off ``cv2.solvePnP`` puts a camera by its markers: its centre (mm), its turn (degrees).

    The inset of all markers is taken off the found corners. None with fewer than two markers, or where no pose is
    found.
    """
    if len(markers.found_px) < _LEAST_MARKERS:
        return None
    found_px = markers.found_px - inset_px * inset_directions(markers.found_px)
    points_m, points_px = markers.corners_m.reshape(-1, 3), found_px.reshape(-1, 2)
    solved, rotation_rad, translation_m = cv2.solvePnP(
        points_m, points_px, camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    if not solved:
        return None
    rotation_rad, translation_m = cv2.solvePnPRefineLM(
        points_m, points_px, camera.K, camera.distortion, rotation_rad, translation_m
    )
    found = rigid(cv2.Rodrigues(rotation_rad)[0], translation_m[:, 0])
    off_m = np.linalg.norm(camera_centre(found) - camera_centre(camera.cam_from_world))
    turn_rad = np.linalg.norm(cv2.Rodrigues(found[:3, :3] @ camera.cam_from_world[:3, :3].T)[0])
    return float(off_m * 1000), float(np.rad2deg(turn_rad))


def marker_verdict(config: AuditedConfig, views: Sequence[MarkerFigures]) -> Check:
    """Hold corners, shares and poses of all views together against their bounds."""
    name = f"{config.name}: ArUco markers"
    if config.board is None:
        return Check(name, "no board in this scene", "left out")
    cameras_and_eyes = [pair for view in views for pair in view.eyes]
    eyes = [eye for _, eye in cameras_and_eyes]
    expected, found = sum(eye.expected for eye in eyes), sum(len(eye.found_px) for eye in eyes)
    if not expected:
        return Check(name, f"none large enough: {LEAST_WIDTH_PX:g} px, whole and clear", "left out")
    least_share = 0.0 if config.has_other_light else MIN_FOUND_SHARE
    missing = () if found >= least_share * expected else (f"{found} of {expected} clear, large markers are found",)
    inset_px, rms_px, place_px = corner_figures(eyes)
    errors = _nominal_pose_errors(cameras_and_eyes, inset_px)
    off_mm, off_deg = np.median(errors, axis=0).tolist() if len(errors) else (0.0, 0.0)
    poses = (
        f"{len(errors)} poses back to {off_mm:.2f} mm a metre, {off_deg:.3f} deg"
        if len(errors)
        else "no pose asked for"
    )
    return Check(
        name,
        f"{found} of {expected} found, markers {place_px:.2f} px and corners {rms_px:.2f} px off after an inset "
        f"of {inset_px:+.2f} px; {poses}",
        f"{least_share:.0%} found, {MAX_PLACE_RMS_PX} and {MAX_CORNER_RMS_PX} px, inset {MAX_INSET_PX:g} px; "
        f"median {MAX_POSE_MM_A_METRE:g} mm a metre, {MAX_POSE_DEG:g} deg",
        (*missing, *_problems(inset_px, rms_px, place_px, off_mm, off_deg)),
    )


def _nominal_pose_errors(
    cameras_and_eyes: Sequence[tuple[Camera, FoundMarkers]], inset_px: float
) -> Float64[ndarray, "n 2"]:
    """Return each found pose's error in mm per metre from the board's middle and in degrees, at 700 px."""
    errors = []
    for camera, eye in cameras_and_eyes:
        error = pose_error(camera, eye, inset_px)
        if error is not None:
            distance_m = float(np.linalg.norm(camera_centre(camera.cam_from_world)))
            zoom = camera.K[0, 0] / NOMINAL_FOCAL_PX
            errors.append((error[0] / distance_m * zoom, error[1] * zoom))
    return np.array(errors).reshape(-1, 2)


def corner_figures(eyes: Sequence[FoundMarkers]) -> tuple[float, float, float]:
    """Return the inset that fits all found corners best, and the RMS of what it leaves of corners and of markers.

    All are pixels; a marker's place is the mean of its four corners.
    """
    off_px = np.concatenate([eye.found_px - eye.true_px for eye in eyes])
    if not len(off_px):
        return 0.0, 0.0, 0.0
    unit: Float64[ndarray, "n 4 2"] = inset_directions(np.concatenate([eye.true_px for eye in eyes]))
    inset_px = float((off_px * unit).sum() / (unit * unit).sum())
    left_px = off_px - inset_px * unit
    rms_px, place_px = (float(np.sqrt((off * off).sum(axis=-1).mean())) for off in (left_px, left_px.mean(axis=1)))
    return inset_px, rms_px, place_px


def _problems(inset_px: float, rms_px: float, place_px: float, off_mm: float, off_deg: float) -> Iterator[str]:
    if not place_px <= MAX_PLACE_RMS_PX:
        yield f"found markers lie {place_px:.2f} px (RMS) from where the cameras put them"
    if not rms_px <= MAX_CORNER_RMS_PX:
        yield f"found corners lie {rms_px:.2f} px (RMS) from where the cameras put them"
    if not abs(inset_px) <= MAX_INSET_PX:
        yield f"found corners lie {inset_px:+.2f} px inside the printed markers"
    if not (off_mm <= MAX_POSE_MM_A_METRE and off_deg <= MAX_POSE_DEG):
        yield f"solvePnP on found markers lands {off_mm:.2f} mm a metre, {off_deg:.3f} degrees from the poses"
