"""Verdicts on the markers: their corners, how many are found, and the poses they give back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.markers import LEAST_WIDTH_PX, FoundMarkers, found_markers, inset_directions
from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedView
from dataset_builder.optics import Camera
from rebar_depth_bench.cameras import NOMINAL_FOCAL_PX, camera_centre, rigid

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
