"""Marker check of pictures: ArUco corners that OpenCV detects, against the projections of the cameras.

The check covers the detected corners, the share of visible markers that are detected, and the camera poses that
``cv2.solvePnP`` recovers from them.

Two effects displace a detected corner although cameras and board are correct. The images are stored with a tone
curve, under which white spreads over black in a pixel that covers both: every black edge moves inward by the same
fraction of a pixel. And ``cv2.cornerSubPix`` places a rounded corner inside the true one. Both effects are the
same for all edges, so one inset is fitted to all markers of a config, reported and subtracted. It cannot hide a
camera error, which shifts or scales the marker centres. Measured on the lattice (1280 x 720, ideal grid, 8
samples; 640 x 360, raw grid, 4 samples), the inset is 0.51 px in both cases; the residual is 0.21 and 0.28 px
(RMS) of the corners, and 0.07 and 0.13 px of the marker centres (means of the four corners).

In noisy pictures, of few samples or with the noise of a sensor, the sub-pixel search of a corner sometimes slides
along an edge of a slanted marker, by some pixels. Such markers are counted and left out: camera errors displace
all corners alike.

Sub-pixel windows reach 4 px from a corner, or 0.8 of a marker's module if that is less, so that they never
touch the bits inside the black frame. The detector's 0.3 modules leave 0.36 px of small markers (24 to 46 px).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, Check
from dataset_builder.scene.variants.registry import IMAGE_LIGHTS, LIGHT_SLOT, variants_of_slot
from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners, detected_corners_px
from rebar_depth_bench.geometry.cameras import NOMINAL_FOCAL_PX, Camera, camera_centre, project, rigid, transform

MIN_MARKER_WIDTH_PX = 24.0
"""Least width of a marker that must be detected, pixels: 4 px per module.

The width is that of ``min_width_px``; distance and slant reduce it.
"""
_BOARD_PLANE_TOLERANCE_M = 0.001


@dataclass(frozen=True, eq=False)
class DetectedMarkers:
    """Markers of one eye: its camera, the number that must be detected, and the corners of those that are.

    ``detected_px`` and ``true_px`` are pixels, ``corners_m`` world metres.
    """

    camera: Camera
    expected: int
    detected_px: Float64[ndarray, "n 4 2"]
    true_px: Float64[ndarray, "n 4 2"]
    corners_m: Float64[ndarray, "n 4 3"]


def detect_markers(eye: AuditedEye, board: BoardSpec) -> DetectedMarkers:
    """Detect the board's markers that the eye sees completely, unobstructed and large enough."""
    assert eye.rgb is not None
    layout = marker_corners_m(board)
    true_px = projected_corners_px(eye.camera, layout)
    visible_ids = [marker for marker in sorted(layout) if _is_unobstructed(eye, true_px[marker])]
    detected = detected_corners_px(eye.rgb, board.dictionary) if visible_ids else {}
    found_ids = [marker for marker in visible_ids if marker in detected]
    return DetectedMarkers(
        camera=eye.camera,
        expected=len(visible_ids),
        detected_px=np.array([detected[marker] for marker in found_ids]).reshape(-1, 4, 2),
        true_px=np.array([true_px[marker] for marker in found_ids]).reshape(-1, 4, 2),
        corners_m=np.array([layout[marker] for marker in found_ids]).reshape(-1, 4, 3),
    )


def projected_corners_px(camera: Camera, corners_m: Mapping[int, Float64[ndarray, "4 3"]]) -> Corners:
    """Return the projected corners by marker id, pixels; NaN for a marker that is not in front of the camera."""
    corners_px = {}
    for marker, world_m in corners_m.items():
        points_cam = transform(camera.cam_from_world, world_m)
        in_front = bool((points_cam[:, 2] > 0).all())
        corners_px[marker] = (
            project(camera.K, points_cam, camera.distortion) if in_front else np.full((4, 2), np.nan)
        )
    return corners_px


def inset_directions(quads_px: Float64[ndarray, "n 4 2"]) -> Float64[ndarray, "n 4 2"]:
    """Return the displacement of a quad's corners when each of its edges moves inward by one pixel."""
    next_corners, previous_corners = np.roll(quads_px, -1, axis=1), np.roll(quads_px, 1, axis=1)
    centres = quads_px.mean(axis=1, keepdims=True)
    normals = np.stack(
        [_inward(previous_corners, quads_px, centres), _inward(quads_px, next_corners, centres)], axis=2
    )
    return np.asarray(np.linalg.solve(normals, np.ones((*quads_px.shape[:2], 2, 1)))[..., 0])


def _inward(
    start: Float64[ndarray, "n 4 2"], end: Float64[ndarray, "n 4 2"], centres: Float64[ndarray, "n 1 2"]
) -> Float64[ndarray, "n 4 2"]:
    """Return the unit normals of edges, pointing towards the centre of the quad."""
    along = end - start
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    side = np.sign(((centres - start) * normal).sum(axis=-1, keepdims=True))
    return np.asarray(normal * side)


def _is_unobstructed(eye: AuditedEye, quad_px: Float64[ndarray, "4 2"]) -> bool:
    """Return whether a marker and its quiet zone lie in the frame, large enough, with nothing in front of them."""
    grown = quad_px.mean(axis=0) + (quad_px - quad_px.mean(axis=0)) * (1 + 1 / MARKER_MODULES)
    size = np.array([eye.camera.width, eye.camera.height])
    if not ((grown >= 1) & (grown <= size - 2)).all() or min_width_px(quad_px) < MIN_MARKER_WIDTH_PX:
        return False
    low, high = np.floor(grown.min(axis=0)).astype(int), np.ceil(grown.max(axis=0)).astype(int) + 1
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    inside = np.zeros(eye.mask[window].shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, np.round(grown - low).astype(np.int32), 1)
    on_board = (
        ~eye.mask[window]
        & (np.abs(eye.points_m[window][..., 2]) < _BOARD_PLANE_TOLERANCE_M)
        & (eye.depth_m[window] > 0)
    )
    return bool(on_board[inside > 0].all())


def min_width_px(quad_px: Float64[ndarray, "4 2"]) -> float:
    """Return the least distance of a quad's corners from the lines of the sides not touching them, pixels."""
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
"""Largest RMS error of the detected corners after the inset, pixels."""
MAX_CENTRE_RMS_PX = 0.25
"""Largest RMS error of the marker centres after the inset, pixels.

Principal points that are half a pixel off in both eyes give 0.5 px, in one eye 0.37 px.
"""
MAX_INSET_PX = 1.0
"""Largest fitted inset, pixels."""
MIN_DETECTED_SHARE = 0.5
"""Least share of the visible markers that must be detected; not applied where the light may hide markers."""
MAX_POSE_MM_PER_M = 8.0
"""Largest median position error, millimetres per metre of distance from the board's middle."""
MAX_POSE_DEG = 0.5
"""Largest median rotation error, degrees.

Both pose bounds hold at ``NOMINAL_FOCAL_PX``; at half that focal length, where a pixel covers twice the angle,
they are twice as large.
"""
SLIPPED_CORNER_PX = 1.5
"""Error after the inset from which a marker's corner counts as slipped."""
MAX_SLIPPED_SHARE = 0.1
"""Largest share of the detected markers with a slipped corner, if there are more than one."""
_MIN_MARKERS = 2
"""Markers needed for a pose: one marker alone leaves the pose ambiguous with its mirror image."""


def detect_view_markers(config: AuditedConfig, view: AuditedView) -> list[DetectedMarkers]:
    """Detect the markers in both images of a view; the list is empty for a scene without a board."""
    return [] if config.board is None else [detect_markers(eye, config.board) for eye in view.eyes.values()]


def pose_error(markers: DetectedMarkers, inset_px: float) -> tuple[float, float] | None:
    """Return the position (mm) and rotation (degrees) errors of the pose recovered from the markers.

    The pose is that of ``cv2.solvePnP``, refined by Levenberg-Marquardt. The common inset is subtracted from the
    detected corners. The result is None for fewer than two markers, or if no pose is found.
    """
    if len(markers.detected_px) < _MIN_MARKERS:
        return None
    camera = markers.camera
    detected_px = markers.detected_px - inset_px * inset_directions(markers.detected_px)
    points_m, points_px = markers.corners_m.reshape(-1, 3), detected_px.reshape(-1, 2)
    solved, rotation_rad, translation_m = cv2.solvePnP(
        points_m, points_px, camera.K, camera.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    if not solved:
        return None
    rotation_rad, translation_m = cv2.solvePnPRefineLM(
        points_m, points_px, camera.K, camera.distortion, rotation_rad, translation_m
    )
    cam_from_world = rigid(cv2.Rodrigues(rotation_rad)[0], translation_m[:, 0])
    centre_error_m = np.linalg.norm(camera_centre(cam_from_world) - camera_centre(camera.cam_from_world))
    turn_rad = np.linalg.norm(cv2.Rodrigues(cam_from_world[:3, :3] @ camera.cam_from_world[:3, :3].T)[0])
    return float(centre_error_m * 1000), float(np.rad2deg(turn_rad))


def marker_verdict(config: AuditedConfig, views: Sequence[Sequence[DetectedMarkers]]) -> Check:
    """Return the check of corners, detected share and poses of all views together."""
    name = "ArUco markers"
    if config.board is None:
        return Check.skip(name, "no board in this scene")
    eyes = [eye for view in views for eye in view]
    expected, detected = sum(eye.expected for eye in eyes), sum(len(eye.detected_px) for eye in eyes)
    if not expected:
        return Check.skip(name, f"no unoccluded marker of {MIN_MARKER_WIDTH_PX:g} px or more")
    min_share = 0.0 if _light_may_hide_markers(config) else MIN_DETECTED_SHARE
    missing = (
        ()
        if detected >= min_share * expected
        else (f"{detected} of {expected} unoccluded, large markers are detected",)
    )
    eyes = _without_slipped(eyes)
    slipped = detected - sum(len(eye.detected_px) for eye in eyes)
    if slipped > max(1, MAX_SLIPPED_SHARE * detected):
        missing = (*missing, f"{slipped} of {detected} markers have a corner {SLIPPED_CORNER_PX} px or more off")
    left_out = f", {slipped} with a slipped corner left out" if slipped else ""
    inset_px, corner_rms_px, centre_rms_px = fit_inset(eyes)
    errors = _nominal_pose_errors(eyes, inset_px)
    off_mm, off_deg = np.median(errors, axis=0).tolist() if len(errors) else (0.0, 0.0)
    poses = (
        f"{len(errors)} poses recovered within {off_mm:.2f} mm/m, {off_deg:.3f} deg"
        if len(errors)
        else "no pose estimated"
    )
    return Check(
        name,
        f"{detected} of {expected} detected{left_out}; RMS error {centre_rms_px:.2f} px (markers), "
        f"{corner_rms_px:.2f} px (corners) after an inset of {inset_px:+.2f} px; {poses}",
        f"{min_share:.0%} detected; {MAX_CENTRE_RMS_PX} and {MAX_CORNER_RMS_PX} px, inset {MAX_INSET_PX:g} px; "
        f"median {MAX_POSE_MM_PER_M:g} mm/m, {MAX_POSE_DEG:g} deg",
        (*missing, *_marker_problems(inset_px, corner_rms_px, centre_rms_px, off_mm, off_deg)),
    )


def _light_may_hide_markers(config: AuditedConfig) -> bool:
    """Return whether the light may hide markers from the detector; panoramas are exposed as the standard light."""
    return not set(variants_of_slot(config.variants, LIGHT_SLOT)) <= set(IMAGE_LIGHTS)


def _nominal_pose_errors(eyes: Sequence[DetectedMarkers], inset_px: float) -> Float64[ndarray, "n 2"]:
    """Return the pose errors, n x 2: mm per metre of distance from the board's middle, and degrees.

    Both are scaled to ``NOMINAL_FOCAL_PX`` (700 px).
    """
    errors = []
    for eye in eyes:
        error = pose_error(eye, inset_px)
        if error is not None:
            distance_m = float(np.linalg.norm(camera_centre(eye.camera.cam_from_world)))
            zoom = eye.camera.K[0, 0] / NOMINAL_FOCAL_PX
            errors.append((error[0] / distance_m * zoom, error[1] * zoom))
    return np.array(errors).reshape(-1, 2)


def fit_inset(eyes: Sequence[DetectedMarkers]) -> tuple[float, float, float]:
    """Return the least-squares inset of all detected corners, and the residual RMS of corners and marker centres.

    All are pixels; a marker's centre is the mean of its four corners. All are 0 if no marker is detected.
    """
    errors_px = np.concatenate([eye.detected_px - eye.true_px for eye in eyes])
    if not len(errors_px):
        return 0.0, 0.0, 0.0
    directions: Float64[ndarray, "n 4 2"] = inset_directions(np.concatenate([eye.true_px for eye in eyes]))
    inset_px = float((errors_px * directions).sum() / (directions * directions).sum())
    residuals_px = errors_px - inset_px * directions
    corner_rms_px, centre_rms_px = (
        float(np.sqrt((off * off).sum(axis=-1).mean())) for off in (residuals_px, residuals_px.mean(axis=1))
    )
    return inset_px, corner_rms_px, centre_rms_px


def _without_slipped(eyes: Sequence[DetectedMarkers]) -> list[DetectedMarkers]:
    """Return the markers without those that have a slipped corner."""
    inset_px = fit_inset(eyes)[0]
    kept = []
    for eye in eyes:
        off_px = eye.detected_px - eye.true_px - inset_px * inset_directions(eye.true_px)
        keep = (np.linalg.norm(off_px, axis=-1) < SLIPPED_CORNER_PX).all(axis=1)
        arrays = {name: getattr(eye, name)[keep] for name in ("detected_px", "true_px", "corners_m")}
        kept.append(replace(eye, **arrays))
    return kept


def _marker_problems(
    inset_px: float, corner_rms_px: float, centre_rms_px: float, off_mm: float, off_deg: float
) -> Iterator[str]:
    if not centre_rms_px <= MAX_CENTRE_RMS_PX:
        yield f"detected markers are {centre_rms_px:.2f} px (RMS) away from their projected positions"
    if not corner_rms_px <= MAX_CORNER_RMS_PX:
        yield f"detected corners are {corner_rms_px:.2f} px (RMS) away from their projected positions"
    if not abs(inset_px) <= MAX_INSET_PX:
        yield f"detected corners are {inset_px:+.2f} px inside the printed markers"
    if not (off_mm <= MAX_POSE_MM_PER_M and off_deg <= MAX_POSE_DEG):
        yield f"poses from solvePnP differ from the stored poses by {off_mm:.2f} mm/m and {off_deg:.3f} degrees"
