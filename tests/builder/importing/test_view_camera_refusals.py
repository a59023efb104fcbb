"""Refusals of ``[cameras] views`` of a layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError
from tests.builder.importing.test_view_cameras import POSES, bop_entry, frame, nerfstudio, planned, write_layout

BOTH = {"0": bop_entry(POSES[0]), "1": bop_entry(POSES[1])}


def bop(**keys: Any) -> dict[str, Any]:
    """Return a file whose first entry has other values of ``keys``, or lacks those that are None."""
    entry = {**BOTH["0"], **keys}
    return {"0": {key: value for key, value in entry.items() if value is not None}, "1": BOTH["1"]}


def frames(*ones: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return nerfstudio(frames=list(ones), **keys)


A, B = frame("000000.png"), frame("000001.png", POSES[1])
SHEARED = (np.eye(4) + np.eye(4, k=1) * 0.1).tolist()
REFUSED: dict[str, tuple[object, str]] = {
    "no JSON": ("0: {cam_K: [1]}", "not valid JSON"),
    "key twice": ('{"0": {}, "0": {}}', "the key 0 occurs twice"),
    "a list": ([1], "expected BOP's scene_camera.json"),
    "nothing": ({}, "expected BOP's scene_camera.json"),
    "camera.json of BOP": ({"cx": 16, "cy": 12, "depth_scale": 0.1, "fx": 40, "fy": 40}, "has the keys cx, cy"),
    "frames in a table": ({"frames": {}}, "nerfstudio's transforms.json with frames"),
    "no frames": ({"frames": []}, "nerfstudio's transforms.json with frames"),
    "text as an entry": ({"0": "K", "1": BOTH["1"]}, "0: .*got 'K', expected a table with cam_K"),
    "frame without a path": (
        frames(A, {"transform_matrix": []}),
        "frames 2: .*got .* expected a table with file_path",
    ),
    "view without an entry": ({"0": BOTH["0"], "7": BOTH["1"]}, "1 of 2 views have no entry, such as 000001"),
    "id with and without zeros": ({**BOTH, "01": BOTH["0"]}, "view 000001 has 2 entries: 01, 1"),
    "frames of one stem": (frames(A, B, frame("b/000001.png")), "view 000001 has 2 entries: frames 2, frames 3"),
    "no K": (bop(cam_K=None), "0: .*got .* expected a table with cam_K"),
    "eight numbers": (bop(cam_K=[40, 0, 15, 0, 40, 11, 0, 0]), "0: cam_K: .*got .* expected 9 numbers"),
    "text in K": (bop(cam_K=["40", 0, 15, 0, 40, 11, 0, 0, 1]), "0: cam_K: .*expected 9 numbers"),
    "skew": (bop(cam_K=[40, 1, 15, 0, 40, 11, 0, 0, 1]), r"0: left: K is .* expected \[\[fx, 0, cx\]"),
    "K of another size": (
        bop(cam_K=[40, 0, 150, 0, 40, 11, 0, 0, 1]),
        "0: cx: .*got 150.0, expected a number from",
    ),
    "non-square pixels": (bop(cam_K=[40, 0, 15, 0, 60, 11, 0, 0, 1]), "images of another aspect ratio"),
    "depth_scale of 0": (bop(depth_scale=0), "0: depth_scale: .*got 0"),
    "no depth_scale": (bop(depth_scale=None), "0: depth_scale: .*missing, expected it, or depth.unit or"),
    "rotation alone": (bop(cam_t_w2c=None), "0: cam_t_w2c: .*missing, expected 3 numbers"),
    "mirror": (bop(cam_R_w2c=[1, 0, 0, 0, -1, 0, 0, 0, 1]), "0: cam_R_w2c: .*expected a rotation"),
    "poses of some": (bop(cam_R_w2c=None, cam_t_w2c=None), "1 of 2 views have no pose, such as 000000"),
    "fisheye of HOT3D": (bop(cam_model={"projection_model_type": "FISHEYE624"}), "cam_model: .*undistort images"),
    "fisheye": (frames(A, B, camera_model="OPENCV_FISHEYE"), "camera_model: .*OPENCV_FISHEYE.*undistort images"),
    "panorama": (frames(A, B, camera_model="EQUIRECTANGULAR"), "camera_model: .*EQUIRECTANGULAR"),
    "model in a list": (frames(A, B, camera_model=["OPENCV"]), "camera_model: .*expected OPENCV"),
    "k4": (frames(A, B, k4=0.01), "k4: .*got 0.01, expected no other lens: undistort"),
    "fisheye of instant-ngp": (frames(A, B, is_fisheye=True), "is_fisheye: .*undistort"),
    "rolling shutter": (frames(A, B, rolling_shutter=[0, 0, 0.1, 0]), "rolling_shutter: .*one pose"),
    "degrees": (frames(A, B, x_fov=50), "x_fov: .*got 50, expected only fl_x"),
    "other axes": (frames(A, B, from_na=True), "from_na: .*OpenGL axes"),
    "no focal length": (frames(A, B, fl_x=None), "fl_x: .*missing, expected fl_x, or camera_angle_x"),
    "two focal lengths": (frames(A, B, camera_angle_x=0.5), "fl_x: .*got 40, and 62.6.* by camera_angle_x"),
    "frame unlike the file": (
        frames({**A, "fl_x": 41.0}, B),
        "frames 1: fl_x: .*got 40.0 and 41.0, expected one value",
    ),
    "other size": (frames(A, B, w=64, h=48), "frames 1: w: .*got 64, expected 32 as the images: scale"),
    "lens that folds": (frames(A, B, k1=-5), "frames 1: left: .*the distortion cannot be inverted"),
    "focal length of text": (frames(A, B, fl_x="40"), "fl_x: .*got '40', expected 1 numbers"),
    "focal length below 0": (frames(A, B, fl_x=-40), "frames 1: fx: .*got -40"),
    "scaled camera": (frames({**A, "transform_matrix": SHEARED}, B), "transform_matrix: .*expected a rotation"),
    "ragged pose": (frames({**A, "transform_matrix": [[1, 0], [1]]}, B), "transform_matrix: .*12 or 16 numbers"),
    "frame without pose": (frames(A, {"file_path": "000001.png"}), "1 of 2 views have no pose, such as 000001"),
    "depth without unit": (
        frames({**A, "depth_file_path": "depth/000000.png"}, B),
        "frames 1: depth_unit_scale_factor: .*missing, expected it, or depth.unit",
    ),
    "applied_scale of 0": (frames(A, B, applied_scale=0), "applied_scale: .*got 0"),
}
"""Content of the file, and words of the refusal, by what is wrong."""


@pytest.mark.parametrize(("document", "words"), REFUSED.values(), ids=REFUSED)
def test_file_that_states_no_cameras_of_the_views_is_refused(document: object, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"(?s)views\.json: 1 problem.*{words}"):
        planned(write_layout(tmp_path, document))


BARS = '[bars]\nfile = "bars.csv"\n'
NO_POSES = {"0": bop_entry(), "1": bop_entry()}
WITH_UNIT = nerfstudio(depth_unit_scale_factor=0.001)
MOVED = nerfstudio(applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
CONFLICTS: dict[str, tuple[object, str, str]] = {
    "calibration": (
        BOTH,
        'calibration = "a.yml"',
        "got cameras.views and cameras.calibration, expected cameras.views alone",
    ),
    "left": (BOTH, "[cameras.left]\nfx = 40", "got cameras.views and cameras.left"),
    "pose": (BOTH, "[[cameras.pose]]\nimage = 'a'", "got cameras.views and cameras.pose"),
    "poses": (BOTH, '[poses]\nfile = "p/{view}.txt"', "got cameras.views and poses"),
    "intrinsics": (BOTH, '[intrinsics]\nfile = "k/{view}.txt"', "got cameras.views and intrinsics"),
    "disparity": (BOTH, "[depth]\nkind = 'disparity'", "got cameras.views and disparity"),
    "unit beside depth_scale": (
        BOTH,
        "[depth]\nunit = 'mm'",
        "0: depth_scale: .*given beside depth.unit or depth.scale",
    ),
    "scale beside depth_scale": (BOTH, "[depth]\nscale = 0.001", "0: depth_scale: .*given beside depth.unit"),
    "unit beside the factor": (
        WITH_UNIT,
        "[depth]\nunit = 'mm'",
        "depth_unit_scale_factor: .*given beside depth.unit",
    ),
    "bars without poses": (NO_POSES, BARS, "2 of 2 views have no pose, .* or of none in a layout without bars"),
    "bars in a moved world": (MOVED, BARS, "applied_transform: .*the world was moved, expected surveyed bars in"),
}
"""Content of the file, lines of the layout after ``views``, and words of the refusal, by what contradicts."""


@pytest.mark.parametrize(("document", "lines", "words"), CONFLICTS.values(), ids=CONFLICTS)
def test_cameras_that_contradict_the_layout_are_refused(
    document: object, lines: str, words: str, tmp_path: Path
) -> None:
    layout = write_layout(tmp_path, document, tables=lines + "\n")
    with pytest.raises(InputError, match=f"(?s){words}"):
        planned(layout)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"views.json"', '"../views.json"', "the name of a file in or below the layout's folder"),
        ('"views.json"', "3", "cameras.views is 3, expected the name of a file"),
        ('"views.json"', '"none.json"', r"none\.json: .*cannot be read"),
        ("[cameras]", 'right_rgb = "rgb/{view}.png"\n[cameras]', "got cameras.views and a right camera"),
    ],
)
def test_layout_with_views_is_checked(old: str, new: str, words: str, tmp_path: Path) -> None:
    layout = write_layout(tmp_path, BOTH)
    layout.write_text(layout.read_text().replace(old, new))
    with pytest.raises(InputError, match=f"(?s){words}"):
        planned(layout)
