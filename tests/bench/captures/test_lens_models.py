"""Lens models beyond k1 k2 p1 p2 k3, which are refused in every format with one remedy, and what stays accepted.

Terms are in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y. Names are those of ROS' distortion
models (image_geometry), OpenCV's tutorial (fisheye_model), omnidir sample (xi) and camodocal.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
import yaml

from rebar_depth_bench.base.errors import CalibrationError
from rebar_depth_bench.captures.camera_files import read_cameras
from rebar_depth_bench.captures.fields import lens_problem
from tests.bench.captures import calibration_files as files

K = files.LEFT_K
FOUR, FIVE = [-0.29, 0.11, 0.001, -0.0003], files.LEFT_D.tolist()


def opencv(**fields: Any) -> dict[str, str]:
    """Return a file of one camera as ``yaml.safe_dump`` writes it."""
    values = {"camera_matrix": K.tolist(), "dist_coeffs": FIVE} | fields
    return {"camera.yaml": yaml.safe_dump({key: value for key, value in values.items() if value is not None})}


def stored(**fields: Any) -> dict[str, str]:
    """Return a pair as ``cv2.FileStorage`` writes it."""
    values = {"M1": K, "D1": files.LEFT_D, "M2": files.RIGHT_K, "D2": files.RIGHT_D, "R": files.ROTATION}
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in (values | {"T": files.TRANSLATION_M} | fields).items():
        storage.write(key, np.array(value, np.float64) if isinstance(value, list) else value)
    return {"stereo.yml": storage.releaseAndGetString()}


def message(model: str, terms: list[float], name: str = "camera_info.yaml") -> dict[str, str]:
    """Return ``camera_info`` as camera_calibration and drivers state it."""
    fields = {"distortion_model": model, "D": terms, "K": K.ravel().tolist(), "P": [*K[0], 0, *K[1], 0, *K[2], 0]}
    return {
        name: yaml.safe_dump({"width": 640, "height": 480} | {k: np.array(v).tolist() for k, v in fields.items()})
    }


def read(folder: Path, contents: dict[str, str]) -> Any:
    for name, text in contents.items():
        (folder / name).write_text(text)
    return read_cameras(folder, ["a"], 640, 480, is_stereo=False).calibration


@pytest.mark.parametrize(
    ("contents", "found"),
    [
        (message("rational_polynomial", [*FIVE, 0.1, 0.2, 0.3]), "the distortion has 8 terms"),
        (
            message("rational_polynomial", [*FIVE, 0.0, 0.0, 0.0, 0.001, 0.0, 0.0, 0.0]),
            "the distortion has 12 terms",
        ),
        (message("plumb_bob", [*FIVE, 0.1]), "the distortion has 6 terms"),
        (message("equidistant", FOUR), "distortion_model is 'equidistant'"),
        (message("equidistant", [0.0] * 4), "distortion_model is 'equidistant'"),
        (message("fisheye", FOUR), "distortion_model is 'fisheye'"),
        (message("Kannala Brandt4", FOUR), "distortion_model is 'Kannala Brandt4'"),
        (message("thin_prism", FIVE), "distortion_model is 'thin_prism'"),
        (message("modified_brown_conrady", FIVE), "distortion_model is 'modified_brown_conrady'"),
        (message("plumb_bob", FIVE[:3]), "the distortion has 3 terms"),
        (opencv(dist_coeffs=FOUR, model="fisheye"), "model is 'fisheye'"),
        (opencv(camera_model="equidistant"), "camera_model is 'equidistant'"),
        (opencv(camera_model="KANNALA_BRANDT"), "camera_model is 'KANNALA_BRANDT'"),
        (opencv(model_type="MEI"), "model_type is 'MEI'"),
        (opencv(fisheye_model=True), "fisheye_model is True"),
        (opencv(fisheye=1, dist_coeffs=[[0.0] * 4]), "fisheye is 1"),
        (opencv(flags="fisheye.CALIB_FIX_SKEW"), "flags is 'fisheye.CALIB_FIX_SKEW'"),
        (opencv(type="omnidirectional"), "type is 'omnidirectional'"),
        (opencv(lens="Kannala-Brandt"), "lens is 'Kannala-Brandt'"),
        (opencv(xi=1.3), "xi is 1.3"),
        (opencv(k4=0.1, k5=0, k6=0), "k4 is 0.1"),
        (opencv(distortion_model="鱼眼"), "distortion_model is '鱼眼'"),
        (stored(D1=[[*FIVE, 0.0, 0.0, 0.4]]), "the distortion has 8 terms"),
        (stored(D2=[[*FIVE, *[0.0] * 7, 0.01, 0.0]]), "the distortion has 14 terms"),
        (stored(xi1=1.2, xi2=1.1), "xi1 is 1.2"),
        (stored(xi_2=[[1.1]]), "xi_2 is "),
        (stored(fisheye_model=1), "fisheye_model is 1"),
    ],
)
def test_other_lens_is_refused_with_one_remedy(contents: dict[str, str], found: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError) as caught:
        read(tmp_path, contents)
    problem = caught.value.problems[0]
    assert found in problem.found
    assert problem.expected.endswith(
        'rectify the images first with the camera\'s own software or OpenCV, see "Rectify images first" in '
        "docs/captures.md, and give their new K with zero distortion"
    )


@pytest.mark.parametrize(
    ("contents", "terms"),
    [
        (message("plumb_bob", FIVE), FIVE),
        (message("plumb_bob", FOUR), [*FOUR, 0.0]),
        (message("rational_polynomial", [*FIVE, 0.0, 0.0, 0.0]), FIVE),
        (message("rational_polynomial", [0.0] * 8), [0.0] * 5),
        (message("", FIVE), FIVE),
        (message("none", []), [0.0] * 5),
        (opencv(dist_coeffs=[FIVE]), FIVE),
        (opencv(dist_coeffs=[*FIVE, *[0.0] * 9]), FIVE),
        (opencv(dist_coeffs=[0.0] * 4), [0.0] * 5),
        (opencv(dist_coeffs=FOUR, distortion_model="plumb_bob"), [*FOUR, 0.0]),
        (opencv(dist_coeffs=FOUR, camera_model="plumb_bob"), [*FOUR, 0.0]),
        (opencv(dist_coeffs=FOUR, fisheye_model=False), [*FOUR, 0.0]),
        (opencv(camera_name="fisheye_left", comment="no fisheye", sensor="OmniVision"), FIVE),
        (opencv(camera_model="pinhole", xi=0, k4=0.0), FIVE),
        (stored(D1=[[*FIVE, *[0.0] * 9]], fisheye_model=0), FIVE),
    ],
)
def test_terms_that_agree_with_the_model_are_read(contents: dict[str, str], terms: Any, tmp_path: Path) -> None:
    assert read(tmp_path, contents).left.distortion == tuple(terms)


@pytest.mark.parametrize("contents", [opencv(dist_coeffs=FOUR), stored(D1=FOUR), message("", FOUR)])
def test_four_terms_without_a_model_may_be_those_of_a_fisheye_lens(
    contents: dict[str, str], tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match="add distortion_model: plumb_bob, or a fifth term k3 = 0"):
        read(tmp_path, contents)


def test_terms_of_no_model_are_refused() -> None:
    problem = lens_problem("a.yaml", {"distortion_model": None}, FIVE)
    assert problem is None
    problem = lens_problem("a.yaml", {"distortion_model": "none"}, FIVE)
    assert problem is not None
    assert problem.found == "distortion terms beside a model of none"
