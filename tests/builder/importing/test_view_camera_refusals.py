"""Refusals of ``[cameras] views`` of a layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.base.errors import InputError
from tests.builder.importing.test_view_cameras import POSES, bop_entry, planned, write_layout

BOTH = {"0": bop_entry(POSES[0]), "1": bop_entry(POSES[1])}


def bop(**keys: Any) -> dict[str, Any]:
    """Return a file whose first entry has other values of ``keys``, or lacks those that are None."""
    entry = {**BOTH["0"], **keys}
    return {"0": {key: value for key, value in entry.items() if value is not None}, "1": BOTH["1"]}


REFUSED: dict[str, tuple[object, str]] = {
    "no JSON": ("0: {cam_K: [1]}", "not valid JSON"),
    "key twice": ('{"0": {}, "0": {}}', "the key 0 occurs twice"),
    "a list": ([1], "expected BOP's scene_camera.json"),
    "nothing": ({}, "expected BOP's scene_camera.json"),
    "camera.json of BOP": ({"cx": 16, "cy": 12, "depth_scale": 0.1, "fx": 40, "fy": 40}, "has the keys cx, cy"),
    "nerfstudio": (
        {"fl_x": 40, "frames": [{"file_path": "000000.png"}]},
        "has the keys fl_x, frames, expected BOP's",
    ),
    "text as an entry": ({"0": "K", "1": BOTH["1"]}, "0: .*got 'K', expected a table with cam_K"),
    "view without an entry": ({"0": BOTH["0"], "7": BOTH["1"]}, "1 of 2 views have no entry, such as 000001"),
    "id with and without zeros": ({**BOTH, "01": BOTH["0"]}, "view 000001 has 2 entries: 1, 01"),
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
    "no depth_scale": (bop(depth_scale=None), "0: depth_scale: .*missing, expected either it, or depth.unit or"),
    "rotation alone": (bop(cam_t_w2c=None), "0: cam_t_w2c: .*missing, expected 3 numbers"),
    "mirror": (bop(cam_R_w2c=[1, 0, 0, 0, -1, 0, 0, 0, 1]), "0: cam_R_w2c: .*expected a rotation"),
    "poses of some": (bop(cam_R_w2c=None, cam_t_w2c=None), "1 of 2 views have no pose, such as 000000"),
    "fisheye of HOT3D": (bop(cam_model={"projection_model_type": "FISHEYE624"}), "cam_model: .*undistort images"),
}
"""Content of the file, and words of the refusal, by what is wrong."""


@pytest.mark.parametrize(("document", "words"), REFUSED.values(), ids=REFUSED)
def test_file_that_states_no_cameras_of_the_views_is_refused(document: object, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"(?s)views\.json: 1 problem.*{words}"):
        planned(write_layout(tmp_path, document))


BARS = '[bars]\nfile = "bars.csv"\n'
NO_POSES = {"0": bop_entry(), "1": bop_entry()}
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
    "bars without poses": (NO_POSES, BARS, "2 of 2 views have no pose, .* or of none in a layout without bars"),
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
