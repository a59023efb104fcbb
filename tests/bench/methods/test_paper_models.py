"""The paper's networks end to end, each replaced by a stand-in.

The packages of the real networks are not available in the test environment. A stand-in (``stand_in_models``) with
the same public interface returns the image's red channel, so that the expected depth follows from a formula.
"""

from __future__ import annotations

import importlib
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")

import cv2
import numpy as np

from rebar_depth_bench import score
from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.geometry import rectification
from rebar_depth_bench.methods import METHODS, MultiViewMethod, find_method, own_methods
from rebar_depth_bench.methods.paper.monocular import metric3d_input
from rebar_depth_bench.methods.registry import FROM_FOLDER
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_models import GAIN
from tests.bench.methods.stand_in_views import (
    BASELINE_M,
    BUILDERS,
    FX,
    FY,
    H,
    W,
    find_stand_in,
    select_columns,
    stereo_row,
)

METRES_OF_RED = {
    "depth-anything-3": GAIN * (FX * 504 / W + FY * 280 / H) / 2 / 300,
    "metric3d": GAIN * FX * 6.65 / 1000,
    "unidepth": GAIN,
}
"""Depth in metres per step of the red channel.

The 160 x 90 image is resized to 504 x 280 for Depth Anything 3 and enlarged by 6.65 for Metric3D.
"""


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[Path]:
    """Make the stand-in packages importable during a test."""
    with stand_ins.stand_in_packages(tmp_path / "site") as folder:
        yield folder


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_uniform_image_gives_expected_depth(name: str, tmp_path: Path) -> None:
    predictor = find_stand_in(name, tmp_path).load()
    depth_m = predictor(select_columns(name, stereo_row()))
    assert depth_m.shape == (H, W)
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, 200 * METRES_OF_RED[name], rtol=3e-3)
    importlib.import_module("torch").manual_seed(7)
    assert np.array_equal(depth_m, predictor(select_columns(name, stereo_row()))), (
        "whatever else draws random numbers"
    )


@pytest.mark.parametrize("grid", [(H, W), (720, 1280), (308, 300), (1001, 333)])
def test_metric3d_input_is_that_of_the_authors_code(grid: tuple[int, int]) -> None:
    """The reference follows the main part of ``hubconf.py`` step by step, with OpenCV and torch."""
    rgb = np.random.default_rng(1).integers(0, 256, (*grid, 3), np.uint8)
    image, inside, factor = metric3d_input(rgb)
    scale = min(616 / grid[0], 1064 / grid[1])
    assert factor == scale
    resized = cv2.resize(rgb, (int(grid[1] * scale), int(grid[0] * scale)), interpolation=cv2.INTER_LINEAR)
    rows, columns = 616 - resized.shape[0], 1064 - resized.shape[1]
    margins = (rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)
    mean, std = [123.675, 116.28, 103.53], [58.395, 57.12, 57.375]
    padded = cv2.copyMakeBorder(resized, *margins, cv2.BORDER_CONSTANT, value=mean)
    assert np.array_equal(padded[inside], resized)
    torch = importlib.import_module("torch")
    mean_tensor, std_tensor = (torch.tensor(values).float()[:, None, None] for values in (mean, std))
    expected = torch.div(torch.from_numpy(padded.transpose((2, 0, 1))).float() - mean_tensor, std_tensor)
    assert torch.equal(image, expected[None])


def test_metric3d_on_benchmark_image_size(tmp_path: Path) -> None:
    """1280 x 720 is reduced by 1064 / 1280; a ramp returns in place, in metres for fx = 700 px."""
    predictor = find_stand_in("metric3d", tmp_path).load()
    rows, columns = np.mgrid[:720, :1280]
    for ramp in (rows / 3, columns / 6):
        red = np.round(10 + ramp).astype(np.uint8)
        rgb = np.stack([red, np.full_like(red, 90), np.full_like(red, 7)], axis=-1)
        K = np.array([[700.0, 0, 639.5], [0, 700.0, 359.5], [0, 0, 1]])
        depth_m = predictor({"left_rgb": rgb, "left_K": K})
        assert depth_m.shape == (720, 1280)
        red_seen = depth_m / (GAIN * 700 * 0.83125 / 1000)
        difference = (red_seen - (10 + ramp))[3:-3, 3:-3]
        assert np.abs(difference).max() < 1.1, "the ramp's own steps, and the rounding of the resized picture"
        assert np.abs(difference.mean()) < 0.05, "half a row would be 0.17"


def test_unidepth_gets_no_intrinsics() -> None:
    assert METHODS["unidepth"].info.columns == ("left_rgb",)


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_depth_is_aligned_with_input_pixels(name: str, tmp_path: Path) -> None:
    """Ramps over columns and rows would reveal a shifted, flipped or wrongly cropped image."""
    predictor = find_stand_in(name, tmp_path).load()
    rows, columns = np.mgrid[:H, :W] + 20
    inner = np.s_[3:-3, 3:-3]
    for ramp in (rows, columns):
        red_seen = predictor(select_columns(name, stereo_row(ramp))) / METRES_OF_RED[name]
        np.testing.assert_allclose(red_seen[inner], ramp[inner], atol=0.7)
        assert np.abs(np.mean(red_seen[inner] - ramp[inner])) < 0.3


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("metric3d", 2.0),
        ("unidepth", 1.0),
        ("depth-anything-3", (2 * FX * 504 / W + FY * 280 / H) / (FX * 504 / W + FY * 280 / H)),
    ],
)
def test_depth_scales_with_fx_where_intrinsics_are_used(name: str, expected: float, tmp_path: Path) -> None:
    predictor = find_stand_in(name, tmp_path).load()
    ratio = predictor(select_columns(name, stereo_row(fx=2 * FX))) / predictor(select_columns(name, stereo_row()))
    np.testing.assert_allclose(ratio, expected, rtol=1e-6)
    assert METHODS[name].info.uses_intrinsics == (expected > 1)


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_zero_output_gives_nan(name: str, tmp_path: Path) -> None:
    red = np.full((H, W), 200)
    red[:, :40] = 0
    depth_m = find_stand_in(name, tmp_path).load()(select_columns(name, stereo_row(red)))
    assert np.isnan(depth_m[:, :36]).all()
    assert np.isfinite(depth_m[:, 44:]).all()


def test_metric3d_depth_is_at_most_300_m(tmp_path: Path) -> None:
    depth_m = find_stand_in("metric3d", tmp_path, gain=1e4).load()(select_columns("metric3d", stereo_row()))
    assert (depth_m == 300).all()


def test_foundation_stereo_disparity_becomes_metres(tmp_path: Path) -> None:
    """A wall at 1 m has a disparity of 87.5 * 0.12 = 10.5 px: red 21 at half a pixel per step."""
    predictor = find_stand_in("foundation-stereo", tmp_path).load()
    wall_m = predictor(select_columns("foundation-stereo", stereo_row(np.full((H, W), 21))))
    assert wall_m.shape == (H, W)
    np.testing.assert_allclose(wall_m[:, 11:], 1.0, rtol=1e-6)
    assert np.isnan(wall_m[:, :11]).all(), "their match would lie left of the right picture"
    rows, columns = np.mgrid[:H, :W]
    ramp_m = predictor(select_columns("foundation-stereo", stereo_row(rows + columns)))
    known = np.isfinite(ramp_m)
    np.testing.assert_allclose(FX * BASELINE_M / ramp_m[known] / GAIN, (rows + columns)[known], rtol=1e-5)
    assert known[0, 3:].all()


def test_stereo_pair_with_different_principal_points(tmp_path: Path) -> None:
    row = stereo_row(np.full((H, W), 21)) | {
        "right_K": stereo_row()["left_K"] + np.array([[0, 0, 4.0], [0, 0, 0], [0, 0, 0]])
    }
    depth_m = find_stand_in("foundation-stereo", tmp_path).load()(select_columns("foundation-stereo", row))
    np.testing.assert_allclose(depth_m[:, 11:], FX * BASELINE_M / 14.5, rtol=1e-6)


def test_raw_pair_is_rectified_and_mapped_back(tmp_path: Path) -> None:
    """Both eyes turn inward by 3 degrees; a rectified disparity of 20 px is a wall parallel to the baseline."""
    turn = np.deg2rad(3.0)
    inward = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = inward.T, inward
    right[:3, 3] = inward @ np.array([-BASELINE_M, 0, 0])
    row = stereo_row(np.full((H, W), 40)) | {"left_cam_from_world": left, "right_cam_from_world": right}
    depth_m = find_stand_in("foundation-stereo", tmp_path).load()(select_columns("foundation-stereo", row))
    assert depth_m.shape == (H, W)
    known = np.isfinite(depth_m)
    assert known.mean() > 0.5
    rows, columns = np.mgrid[:H, :W]
    K = row["left_K"]
    rays = np.stack([(columns - K[0, 2]) / FX, (rows - K[1, 2]) / FY, np.ones((H, W))], axis=-1)
    rectified_z = (rays @ left[:3, :3])[..., 2]  # Depth along the rectified axis, per unit of planar depth.
    rectified = rectification.rectified_pair(row).K
    np.testing.assert_allclose((depth_m * rectified_z)[known], rectified[0, 0] * BASELINE_M / 20, rtol=1e-5)


@pytest.mark.parametrize("name", FROM_FOLDER)
def test_predict_command_runs_paper_model(
    name: str, tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, archive = BUILDERS[name](tmp_path / "theirs"), tmp_path / "out.zip"
    command = ["predict", f"{name}:{folder}", "--data", str(tiny_root), "--config", "lattice-orbit"]
    assert main([*command, "--out", str(archive)]) == 0, capsys.readouterr().err
    assert (score(archive, tiny_root).tables["lattice-orbit"].coverage or 0) > 0.5
    with zipfile.ZipFile(archive) as entries:
        metadata = json.loads(entries.read("submission.json"))
    assert metadata["inputs"] == {"foundation-stereo": "stereo", "unidepth": "rgb"}.get(name, "rgb+K")
    assert metadata["uses_ground_truth"] is False
    assert metadata["method"] == f"{name}:{'23-51-11' if name == 'foundation-stereo' else 'theirs'}"
    assert re.search(r"as in the paper; weights sha256:[0-9a-f]{64}$", metadata["description"])
    assert "talkative" not in capsys.readouterr().out


@pytest.mark.parametrize("name", FROM_FOLDER)
def test_other_weights_give_different_method_info(name: str, tmp_path: Path) -> None:
    infos = [
        find_method(f"{name}:{BUILDERS[name](tmp_path / place / 'a', gain=gain)}").info
        for place, gain in (("1", 1.0), ("2", 2.0), ("3", 1.0))
    ]
    assert infos[0] == infos[2]
    assert infos[0] != infos[1]
    assert str(tmp_path) not in repr(infos)


def test_weights_folder_inside_clone_is_accepted(tmp_path: Path) -> None:
    clone = stand_ins.stereo_clone(tmp_path / "clone")
    small = clone / "pretrained_models" / "11-33-40"
    (clone / "pretrained_models" / "23-51-11").rename(small)
    method = find_method(f"foundation-stereo:{small}")
    assert method.info.name == "foundation-stereo:11-33-40"
    assert np.isfinite(load_predictor(method)(select_columns("foundation-stereo", stereo_row()))).any()
    with pytest.raises(MethodError, match=r"no model_best_bp2.pth in .*23-51-11; to install it: git clone"):
        find_method(f"foundation-stereo:{clone}")


def test_methods_list_marks_untested_and_multi_view(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "600")
    assert main(["methods"]) == 0
    listed = capsys.readouterr().out
    for name in FROM_FOLDER:
        assert METHODS[name].info.untested_note
        assert f"({METHODS[name].info.untested_note})" in listed
        assert METHODS[name].info.licence in listed
    multi_view_methods = [method for method in own_methods().values() if isinstance(method, MultiViewMethod)]
    assert listed.count("(prepares a whole config before it predicts any view)") == len(multi_view_methods) > 0
    assert "both rgb, both" in listed
    assert "left_depth" in listed
    assert "right_rgb" not in listed
