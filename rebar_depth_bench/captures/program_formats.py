"""Fields of the calibrations of OpenCV, ROS, Kalibr and Middlebury, in the spellings that are known."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from rebar_depth_bench.captures.fields import Field, FileFormat


def _field(name: str, keys: str, use: Literal["used", "checked", "harmless"], meaning: str) -> Field:
    """Return a field whose keys are the words of ``keys``."""
    return Field(name, tuple(keys.split()), use, meaning)


_MATRIX = "camera_matrix M K intrinsics intrinsic_matrix mtx cam_matrix"
_TERMS = "distortion_coefficients D distortion distortion_coeffs dist dist_coeffs dist_coeff"
_MODEL = "camera_model model model_type camera_type lens_model projection_model fisheye_model fisheye is_fisheye"
_NEW_MATRIX = "projection_matrix P new_camera_matrix optimal_camera_matrix newcameramtx"
_HARMLESS = (
    "header comment description camera_name camera_id calibration_time calibration_date date nframes nr_of_frames "
    "board_width board_height square_size marker_size aspectRatio fix_aspect_ratio avg_reprojection_error "
    "reprojection_error rms rms_error ret per_view_reprojection_errors extrinsic_parameters image_points "
    "grid_points rvecs tvecs E F essential_matrix fundamental_matrix Q disparity_to_depth_matrix roi1 roi2 "
    "valid_roi1 valid_roi2"
)
CAMERA = FileFormat(
    "One camera of OpenCV's FileStorage, or ROS camera_info",
    (
        _field("matrix", _MATRIX, "used", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixel centres at integers"),
        _field("distortion", _TERMS, "used", "k1 k2 p1 p2 k3; further terms must be 0"),
        _field("distortion model", "distortion_model", "checked", "plumb_bob, radtan or another name of them"),
        _field("camera model", _MODEL, "checked", "pinhole; no fisheye lens"),
        _field("other lenses", "xi k4 k5 k6 s1 s2 s3 s4 tau_x tau_y", "checked", "absent or 0"),
        _field("rectification", "rectification_matrix R", "used", "rotation to the rectified camera"),
        _field("projection", _NEW_MATRIX, "used", "matrix of rectified pictures; P[0, 3] = -fx * baseline"),
        _field("size", "image_size size camera_resolution resolution", "used", "width, height"),
        _field("width", "image_width width", "used", "of the full sensor, pixels"),
        _field("height", "image_height height", "used", "of the full sensor, pixels"),
        _field("region", "roi", "used", "x_offset, y_offset, width, height in pixels of the sensor; 0: all of it"),
        _field("binning x", "binning_x", "used", "columns of the sensor in one of the pictures; 0: one"),
        _field("binning y", "binning_y", "used", "rows of the sensor in one of the pictures; 0: one"),
        _field("flags", "flags", "checked", "of OpenCV's calibration; not a text that names fisheye"),
        _field("details", _HARMLESS, "harmless", "of the calibration, its target and its message"),
    ),
)
PAIR = FileFormat(
    "Pair of OpenCV's FileStorage: the keys above with 1, left or l (2, right or r) at an end",
    (
        _field("rotation", "R rotation rotation_matrix rmat", "used", "x_right = R x_left + T"),
        _field("translation", "T translation translation_vector tvec", "used", "x_right = R x_left + T"),
    ),
)
MIDDLEBURY = FileFormat(
    "calib.txt of Middlebury's and ETH3D's rectified pairs",
    (
        _field("matrix", "cam0", "used", "[fx 0 cx; 0 fy cy; 0 0 1], pixel centres at integers"),
        _field("right matrix", "cam1", "used", "[fx 0 cx; 0 fy cy; 0 0 1] of the right camera"),
        _field("width", "width", "used", "pixels"),
        _field("height", "height", "used", "pixels"),
        _field("baseline", "baseline", "used", "millimetres"),
        _field("offset", "doffs", "checked", "cx of cam1 minus cx of cam0"),
        _field("details", "ndisp isint vmin vmax dyavg dymax", "harmless", "of the disparity"),
    ),
)
MIDDLEBURY_RIGHT = FileFormat("", (replace(MIDDLEBURY.fields[1], name="matrix"), *MIDDLEBURY.fields[2:]))
KALIBR = FileFormat(
    "Kalibr's camera chain",
    (
        _field("cameras", "cam0 cam1", "used", "the left camera and the right one"),
        _field("matrix", "intrinsics", "used", "fx fy cx cy, pixel centres at integers"),
        _field("distortion", "distortion_coeffs", "used", "k1 k2 p1 p2"),
        _field("distortion model", "distortion_model", "checked", "radtan or none"),
        _field("camera model", "camera_model", "checked", "pinhole"),
        _field("size", "resolution", "used", "width, height"),
        _field("motion", "T_cn_cnm1", "used", "cam1_from_cam0, 4 x 4"),
        _field("details", "cam_overlaps rostopic T_cam_imu timeshift_cam_imu", "harmless", "of the recording"),
    ),
)
