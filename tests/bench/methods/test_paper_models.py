"""The paper's networks whose packages cannot be had here, through the whole way, each by a stand-in.

None of these runs the real network: a stand-in (``stand_in_models``) of the same public interface answers with the
picture's red channel, so that every metre follows from a formula.
"""

from __future__ import annotations

import importlib
import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rebar_depth_bench import score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry import rectification
from rebar_depth_bench.methods import METHODS, MultiViewMethod, find_method, own_methods
from rebar_depth_bench.methods.monocular import metric3d
from rebar_depth_bench.methods.monocular.conversions import fit_keeping_ratio
from rebar_depth_bench.methods.registry import LOCATED
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import loaded
from tests.bench.methods.stand_in_models import GAIN
from tests.bench.methods.stand_in_views import BASELINE_M, BUILDERS, FX, FY, H, W, asked, located, row

METRES_OF_RED = {
    "depth-anything-3": GAIN * (FX * 504 / W + FY * 280 / H) / 2 / 300,
    "metric3d": GAIN * FX * 6.65 / 1000,
    "unidepth": GAIN,
}
"""What one step of the red channel becomes: 504 x 280 pixels seen of 160 x 90, and 6.65 times as many."""


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[Path]:
    """Put the stand-ins of the packages on the path, and take them off again."""
    with stand_ins.installed(tmp_path / "site") as folder:
        yield folder


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_a_wall_of_one_colour_is_at_its_metres(name: str, tmp_path: Path) -> None:
    run = located(name, tmp_path).load()
    found = run(asked(name, row()))
    assert found.shape == (H, W)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, 200 * METRES_OF_RED[name], rtol=3e-3)
    importlib.import_module("torch").manual_seed(7)
    assert np.array_equal(found, run(asked(name, row()))), "whatever else draws random numbers"


@pytest.mark.parametrize("grid", [(H, W), (720, 1280)])
def test_metric3ds_picture_is_that_of_opencv(grid: tuple[int, int]) -> None:
    """Made larger or smaller, put in the middle and normalised with OpenCV, which rounds to whole numbers."""
    noise = np.random.default_rng(1).integers(0, 256, (*grid, 3), np.uint8)
    noise[..., 0] = np.mgrid[: grid[0], : grid[1]][1] % 256
    rgb = cv2.GaussianBlur(noise, (7, 7), 2)
    fit = fit_keeping_ratio(grid, metric3d.TARGET)
    found = metric3d.network_input(rgb, fit).numpy()
    large = cv2.resize(rgb, (1064, 598), interpolation=cv2.INTER_LINEAR)
    whole = cv2.copyMakeBorder(large, 9, 9, 0, 0, cv2.BORDER_CONSTANT, value=(123.675, 116.28, 103.53))
    expected = (whole - np.array([123.675, 116.28, 103.53])) / np.array([58.395, 57.12, 57.375])
    off = np.abs(found[0].transpose(1, 2, 0) - expected) * 57
    assert off.max() < 1.1, "a step of 255 at most: OpenCV counts in 2048ths"
    assert off.mean() < 0.2


def test_metric3d_on_the_benchmarks_own_grid(tmp_path: Path) -> None:
    """1280 x 720 is made smaller, 1064 / 1280: a ramp comes back where it was, in metres of fx = 700."""
    run = located("metric3d", tmp_path).load()
    rows, columns = np.mgrid[:720, :1280]
    for ramp in (rows / 3, columns / 6):
        red = np.round(10 + ramp).astype(np.uint8)
        rgb = np.stack([red, np.full_like(red, 90), np.full_like(red, 7)], axis=-1)
        K = np.array([[700.0, 0, 639.5], [0, 700.0, 359.5], [0, 0, 1]])
        found = run({"left_rgb": rgb, "left_K": K})
        assert found.shape == (720, 1280)
        seen = found / (GAIN * 700 * 0.83125 / 1000)
        off = (seen - (10 + ramp))[3:-3, 3:-3]
        assert np.abs(off).max() < 1.1, "the ramp's own steps, and the rounding of the resized picture"
        assert np.abs(off.mean()) < 0.03, "half a row would be 0.17"


def test_unidepth_is_not_given_the_camera() -> None:
    assert METHODS["unidepth"].info.columns == ("left_rgb",)


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_what_the_network_sees_at_a_pixel_lies_there_again(name: str, tmp_path: Path) -> None:
    """Ramps of columns and of rows: a picture shifted, flipped or cut with its margins would show."""
    run = located(name, tmp_path).load()
    rows, columns = np.mgrid[:H, :W] + 20
    inner = np.s_[3:-3, 3:-3]
    for ramp in (rows, columns):
        found = run(asked(name, row(ramp))) / METRES_OF_RED[name]
        np.testing.assert_allclose(found[inner], ramp[inner], atol=0.7)
        assert np.abs(np.mean(found[inner] - ramp[inner])) < 0.3


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("metric3d", 2.0),
        ("unidepth", 1.0),
        ("depth-anything-3", (2 * FX * 504 / W + FY * 280 / H) / (FX * 504 / W + FY * 280 / H)),
    ],
)
def test_depth_goes_with_fx_where_the_camera_is_given(name: str, expected: float, tmp_path: Path) -> None:
    run = located(name, tmp_path).load()
    ratio = run(asked(name, row(fx=2 * FX))) / run(asked(name, row()))
    np.testing.assert_allclose(ratio, expected, rtol=1e-6)
    assert METHODS[name].info.uses_intrinsics == (expected > 1)


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_where_the_network_says_nothing_there_is_no_answer(name: str, tmp_path: Path) -> None:
    red = np.full((H, W), 200)
    red[:, :40] = 0
    found = located(name, tmp_path).load()(asked(name, row(red)))
    assert np.isnan(found[:, :36]).all()
    assert np.isfinite(found[:, 44:]).all()


def test_disparities_become_metres_of_the_benchmarks_rig(tmp_path: Path) -> None:
    """A wall at 1 m is 87.5 * 0.12 = 10.5 px apart: red 21 at half a pixel each."""
    run = located("foundation-stereo", tmp_path).load()
    found = run(asked("foundation-stereo", row(np.full((H, W), 21))))
    assert found.shape == (H, W)
    np.testing.assert_allclose(found[:, 11:], 1.0, rtol=1e-6)
    assert np.isnan(found[:, :11]).all(), "their match would lie left of the right picture"
    rows, columns = np.mgrid[:H, :W]
    ramp = run(asked("foundation-stereo", row(rows + columns)))
    told = np.isfinite(ramp)
    np.testing.assert_allclose(FX * BASELINE_M / ramp[told] / GAIN, (rows + columns)[told], rtol=1e-5)
    assert told[0, 3:].all()


def test_a_pair_with_unlike_principal_points(tmp_path: Path) -> None:
    given = row(np.full((H, W), 21)) | {"right_K": row()["left_K"] + np.array([[0, 0, 4.0], [0, 0, 0], [0, 0, 0]])}
    found = located("foundation-stereo", tmp_path).load()(asked("foundation-stereo", given))
    np.testing.assert_allclose(found[:, 11:], FX * BASELINE_M / 14.5, rtol=1e-6)


def test_a_raw_pair_is_rectified_and_brought_back(tmp_path: Path) -> None:
    """Two eyes turned by 3 degrees inward look at a disparity of 20 px in the rectified pair: a wall across it."""
    turn = np.deg2rad(3.0)
    inward = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = inward.T, inward
    right[:3, 3] = inward @ np.array([-BASELINE_M, 0, 0])
    given = row(np.full((H, W), 40)) | {"left_cam_from_world": left, "right_cam_from_world": right}
    found = located("foundation-stereo", tmp_path).load()(asked("foundation-stereo", given))
    assert found.shape == (H, W)
    told = np.isfinite(found)
    assert told.mean() > 0.5
    rows, columns = np.mgrid[:H, :W]
    K = given["left_K"]
    rays = np.stack([(columns - K[0, 2]) / FX, (rows - K[1, 2]) / FY, np.ones((H, W))], axis=-1)
    along_the_rig = (rays @ left[:3, :3])[..., 2]  # a ray's depth along the axis between both eyes'
    rectified = rectification.rectified_pair(given).K
    np.testing.assert_allclose((found * along_the_rig)[told], rectified[0, 0] * BASELINE_M / 20, rtol=1e-5)


@pytest.mark.parametrize("name", LOCATED)
def test_predicted_from_the_command_line(
    name: str, tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, archive = BUILDERS[name](tmp_path / "theirs"), tmp_path / "out.zip"
    command = ["predict", f"{name}:{folder}", "--data", str(tiny_root), "--config", "lattice-orbit"]
    assert main([*command, "--out", str(archive)]) == 0, capsys.readouterr().err
    assert (score(archive, tiny_root).tables["lattice-orbit"].coverage or 0) > 0.5
    with zipfile.ZipFile(archive) as entries:
        told = json.loads(entries.read("submission.json"))
    assert told["uses_intrinsics"] is METHODS[name].info.uses_intrinsics
    assert told["method"] == f"{name}:{'23-51-11' if name == 'foundation-stereo' else 'theirs'}"
    assert re.search(r"as in the paper; weights sha256:[0-9a-f]{64}$", told["description"])
    assert "talkative" not in capsys.readouterr().out


@pytest.mark.parametrize("name", LOCATED)
def test_other_weights_are_another_method(name: str, tmp_path: Path) -> None:
    infos = [
        find_method(f"{name}:{BUILDERS[name](tmp_path / place / 'a', gain=gain)}").info
        for place, gain in (("1", 1.0), ("2", 2.0), ("3", 1.0))
    ]
    assert infos[0] == infos[2]
    assert infos[0] != infos[1]
    assert str(tmp_path) not in repr(infos)


def test_a_folder_of_weights_inside_a_clone_is_taken(tmp_path: Path) -> None:
    clone = stand_ins.stereo_clone(tmp_path / "clone")
    small = clone / "pretrained_models" / "11-33-40"
    (clone / "pretrained_models" / "23-51-11").rename(small)
    method = find_method(f"foundation-stereo:{small}")
    assert method.info.name == "foundation-stereo:11-33-40"
    assert np.isfinite(loaded(method)(asked("foundation-stereo", row()))).any()
    with pytest.raises(MethodError, match=r"no model_best_bp2.pth in .*23-51-11, expected: git clone"):
        find_method(f"foundation-stereo:{clone}")


def test_the_list_of_methods_tells_what_never_ran_and_what_sees_all_views(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "600")
    assert main(["methods"]) == 0
    listed = capsys.readouterr().out
    for name in LOCATED:
        assert METHODS[name].info.unexercised
        assert f"({METHODS[name].info.unexercised})" in listed
        assert METHODS[name].info.licence in listed
    many = [method for method in own_methods().values() if isinstance(method, MultiViewMethod)]
    assert listed.count("(sees all views of a config before it answers for any)") == len(many) > 0
    assert "both rgb, both" in listed
    assert "left_depth" in listed
    assert "right_rgb" not in listed
