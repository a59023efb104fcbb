"""Fields of the calibrations of OpenCV, ROS, Kalibr and Middlebury, in the spellings that are known."""

from __future__ import annotations

from dataclasses import replace

from rebar_depth_bench.captures.fields import Field, FileFormat

_MODEL_NAMES = (
    *("camera_model", "model", "model_type", "camera_type", "lens_model", "projection_model"),
    *("fisheye_model", "fisheye", "is_fisheye"),
)
_OTHER_TERMS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_HARMLESS = (
    *("header", "camera_name", "camera_id", "calibration_time", "calibration_date", "date", "nframes"),
    *(
        "nr_of_frames",
        "board_width",
        "board_height",
        "square_size",
        "marker_size",
        "aspectRatio",
        "fix_aspect_ratio",
    ),
    *("avg_reprojection_error", "reprojection_error", "rms", "rms_error", "ret", "per_view_reprojection_errors"),
    *("extrinsic_parameters", "image_points", "grid_points", "rvecs", "tvecs", "E", "F", "essential_matrix"),
    *("fundamental_matrix", "Q", "disparity_to_depth_matrix", "roi1", "roi2", "valid_roi1", "valid_roi2"),
)
_FLAGS = Field("flags", ("flags",), "checked", "of OpenCV's calibration; not a text that names fisheye")
_DETAILS = Field("details", _HARMLESS, "harmless", "of the calibration, its target and its message")


def _camera_fields(*eyes: str) -> tuple[Field, ...]:
    """Return the fields of one camera; ``eyes`` are the spellings of which one, before or after a name."""

    def spellings(*names: str, of: tuple[str, ...] = eyes) -> tuple[str, ...]:
        return tuple(dict.fromkeys(text for name in names for eye in of for text in (name + eye, eye + name)))

    short, long = ("M", "K"), ("camera_matrix", "intrinsics", "intrinsic_matrix", "mtx", "cam_matrix")
    matrix = spellings(*((*long, *short) if eyes == ("",) else (*short, *long)))
    distortion = ("D", "distortion", "distortion_coefficients", "distortion_coeffs", "dist", "dist_coeffs")
    terms = spellings(*distortion, "dist_coeff")
    new_matrix = ("P", "projection_matrix", "new_camera_matrix", "optimal_camera_matrix", "newcameramtx")
    both = (*eyes, "")
    return (
        Field("matrix", matrix, "used", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixel centres at integers"),
        Field("distortion", terms, "used", "k1 k2 p1 p2 k3; further terms must be 0"),
        Field("distortion model", spellings("distortion_model", of=both), "checked", "plumb_bob or radtan"),
        Field("camera model", spellings(*_MODEL_NAMES, of=both), "checked", "pinhole; not a fisheye lens"),
        Field("other lenses", spellings("xi", of=both) + _OTHER_TERMS, "checked", "0"),
        Field("rectification", spellings("R", "rectification_matrix"), "used", "rotation to the rectified camera"),
        Field("projection", spellings(*new_matrix), "used", "P of rectified pictures; P[0, 3] = -fx * baseline"),
    )


_SIZE = (
    Field("size", ("image_size", "size", "camera_resolution", "resolution"), "used", "width, height"),
    Field("width", ("image_width", "width"), "used", "of the full sensor, pixels"),
    Field("height", ("image_height", "height"), "used", "of the full sensor, pixels"),
    Field("region", ("roi",), "used", "x_offset, y_offset, width, height in pixels of the sensor; 0: all of it"),
    Field("binning x", ("binning_x",), "used", "columns in one of the pictures; 0: one"),
    Field("binning y", ("binning_y",), "used", "rows in one of the pictures; 0: one"),
)
_MOTION = (
    Field("rotation", ("R", "rotation", "rotation_matrix", "rmat"), "used", "x_right = R x_left + T"),
    Field("translation", ("T", "translation", "translation_vector", "tvec"), "used", "x_right = R x_left + T"),
)
EYES = tuple(
    FileFormat(f"camera {eyes[0]}", (*_camera_fields(*eyes), *_SIZE, *_MOTION, _FLAGS))
    for eyes in (("1", "left", "l"), ("2", "right", "r"))
)
CAMERA = FileFormat(
    "One camera of OpenCV's FileStorage, or ROS camera_info", (*_camera_fields(""), *_SIZE, _FLAGS, _DETAILS)
)
PAIR = FileFormat("Pair of OpenCV's FileStorage", (*dict.fromkeys(EYES[0].fields + EYES[1].fields), _DETAILS))
MIDDLEBURY = FileFormat(
    "calib.txt of Middlebury's and ETH3D's rectified pairs",
    (
        Field("matrix", ("cam0",), "used", "[fx 0 cx; 0 fy cy; 0 0 1], pixel centres at integers"),
        Field("right matrix", ("cam1",), "used", "[fx 0 cx; 0 fy cy; 0 0 1] of the right camera"),
        Field("width", ("width",), "used", "pixels"),
        Field("height", ("height",), "used", "pixels"),
        Field("baseline", ("baseline",), "used", "millimetres"),
        Field("offset", ("doffs",), "checked", "cx of cam1 minus cx of cam0"),
        Field("details", ("ndisp", "isint", "vmin", "vmax", "dyavg", "dymax"), "harmless", "of the disparity"),
    ),
)
MIDDLEBURY_RIGHT = FileFormat("", (replace(MIDDLEBURY.fields[1], name="matrix"), *MIDDLEBURY.fields[2:]))
KALIBR = FileFormat(
    "Kalibr's camera chain",
    (
        Field("cameras", ("cam0", "cam1"), "used", "the left camera and the right one"),
        Field("matrix", ("intrinsics",), "used", "fx fy cx cy, pixel centres at integers"),
        Field("distortion", ("distortion_coeffs",), "used", "k1 k2 p1 p2"),
        Field("distortion model", ("distortion_model",), "checked", "radtan or none"),
        Field("camera model", ("camera_model",), "checked", "pinhole"),
        Field("size", ("resolution",), "used", "width, height"),
        Field("motion", ("T_cn_cnm1",), "used", "cam1_from_cam0, 4 x 4"),
        Field(
            "recording",
            ("cam_overlaps", "rostopic", "T_cam_imu", "timeshift_cam_imu"),
            "harmless",
            "of the IMU too",
        ),
    ),
)
