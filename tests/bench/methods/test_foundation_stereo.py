"""FoundationStereo with a stand-in: disparity to metres, the mode for each range of distances, its settings."""

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

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.geometry import rectification
from rebar_depth_bench.methods import Method, find_method
from rebar_depth_bench.methods.paper.foundation_stereo import (
    SMALL_RATIO,
    choose_passes,
    full_size_disparity_px,
)
from rebar_depth_bench.methods.paper.third_party import scaled_image
from rebar_depth_bench.methods.sgbm import largest_disparity_px, rectified_row
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_models import BASELINE_M, FX, GAIN, stereo_row

pytestmark = pytest.mark.slow  # torch takes seconds to import

ROW = stereo_row(np.full((67, 201), 40))


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[Path]:
    """Remove the modules of the stand-in after a test."""
    with stand_ins.stand_in_packages(tmp_path / "site") as folder:
        yield folder


def stereo_method(tmp_path: Path, nearest_m: float | None = None) -> Method:
    """Return the method of the stand-in in ``clone``, which is written if it is missing."""
    clone = tmp_path / "clone"
    if not clone.exists():
        stand_ins.stereo_clone(clone)
    method = find_method(f"foundation-stereo:{clone}", nearest_m=nearest_m)
    assert isinstance(method, Method)
    return method


def test_disparity_becomes_metres_in_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At half a pixel per step of red, each pixel of a ramp has its own disparity."""
    rows, columns = np.mgrid[:67, :180]
    ramp_m = load_predictor(stereo_method(tmp_path))(stereo_row(rows + columns))
    assert (ramp_m.shape, ramp_m.dtype) == ((67, 180), np.float32)
    known = np.isfinite(ramp_m)
    np.testing.assert_allclose(FX * BASELINE_M / ramp_m[known] / GAIN, (rows + columns)[known], rtol=1e-5)
    assert known[0, 3:].all()
    stderr = capsys.readouterr().err
    assert "DINOv2's code (https://github.com/facebookresearch/dinov2, even if HF_HUB_OFFLINE is set)" in stderr
    assert "and timm's edgenext_small (from the Hub)\n" in stderr


@pytest.mark.parametrize(
    ("nearest_m", "mode", "scale"),
    [(0.12, "single pass", 1.0), (None, "hierarchical", 1.0), (1e-6, "hierarchical", 832 / 1001)],
)
def test_mode_and_scale_keep_metres(nearest_m: float | None, mode: str, scale: float, tmp_path: Path) -> None:
    """The stand-in returns half of the red channel as the disparity of the resized image, in two passes all of it.

    As in the authors' demo, columns whose match would be left of the right image have no depth.
    """
    method, row = stereo_method(tmp_path, nearest_m), stereo_row(np.full((31, 1001), 100))
    assert method.notes is not None
    notes = method.notes(row)
    assert (notes["mode"], notes["scale"], notes["cost_volume_px"]) == (mode, round(scale, 4), 416)
    depth_m = load_predictor(method)(row)
    width_px, disparity_px = int(1001 * scale), 100 * GAIN * (2 if mode == "hierarchical" else 1)
    has_match = (np.arange(1001) + 0.5) * width_px / 1001 >= disparity_px
    assert np.isnan(depth_m[:, ~has_match]).all()
    expected_m = FX * BASELINE_M / (disparity_px * 1001 / width_px)
    np.testing.assert_allclose(depth_m[:, has_match], expected_m, rtol=1e-6)


@given(st.floats(0, 20_000), st.integers(1, 800), st.integers(40, 5000))
def test_first_pass_holds_largest_disparity(largest_px: float, volume_px: int, width: int) -> None:
    is_hierarchical, scale = choose_passes(largest_px, volume_px)
    ratio = SMALL_RATIO if is_hierarchical else 1.0
    width_px = max(1, int(width * scale))
    assert width_px == 1 or largest_px * width_px / width * ratio <= volume_px * (1 + 1e-9)


@pytest.mark.parametrize(
    ("nearest_m", "expected"),
    [(None, 100.5), (0.25, 42.0), (0.0625, 168.0), (0.01, 201.0), (1000.0, 0.0105)],
)
def test_largest_disparity_of_default_and_declared_distance(nearest_m: float | None, expected: float) -> None:
    rectified, pair = rectified_row(ROW)
    assert pair is None
    assert largest_disparity_px(rectified, nearest_m) == pytest.approx(expected)


def test_principal_points_shift_largest_disparity() -> None:
    row = ROW | {"right_K": ROW["left_K"] - np.array([[0, 0, 6.0], [0, 0, 0], [0, 0, 0]])}
    assert largest_disparity_px(rectified_row(row)[0], 0.25) == pytest.approx(48)


def test_raw_pair_counts_in_pixels_of_rectified_row(tmp_path: Path) -> None:
    row = ROW | {"left_distortion": np.array([0.1, 0, 0, 0, 0])}
    pair = rectification.rectified_pair(row)
    assert pair.left_rgb.shape[1] != 201
    for nearest_m, expected in ((None, pair.left_rgb.shape[1] / 2), (0.5, pair.K[0, 0] * BASELINE_M / 0.5)):
        notes = stereo_method(tmp_path, nearest_m).notes
        assert notes is not None
        assert notes(row)["largest_disparity_px"] == round(expected, 1)


@pytest.mark.parametrize("grid", [(67, 201), (720, 1280), (37, 38)])
@pytest.mark.parametrize("scale", [1.0, 0.83, 0.5, 0.31])
def test_disparity_returns_to_full_size_in_place(grid: tuple[int, int], scale: float) -> None:
    """A disparity that grows over columns and rows is at most half a pixel of the smaller image away."""
    rows, columns = np.mgrid[: grid[0], : grid[1]].astype(np.float64)
    small = scaled_image(np.zeros((*grid, 3), np.uint8), scale).shape[:2]
    row_step, column_step = grid[0] / small[0], grid[1] / small[1]
    small_rows, small_columns = np.mgrid[: small[0], : small[1]]
    seen = ((small_rows + 0.5) * row_step + 2 * (small_columns + 0.5) * column_step - 1.5) / column_step
    full = full_size_disparity_px(seen.astype(np.float32), grid)
    assert (full.shape, full.dtype) == (grid, np.float32)
    error = full - (rows + 2 * columns)
    assert np.abs(error).max() <= row_step / 2 + column_step + 1e-3
    assert np.abs(error.mean()) < 0.05 * (row_step + 2 * column_step)


def test_declared_distance_is_part_of_method_info(tmp_path: Path) -> None:
    infos = [stereo_method(tmp_path, nearest_m).info for nearest_m in (None, 0.2, 0.2000001)]
    assert len({info.summary for info in infos}) == 3
    assert infos[1].summary.endswith("as in the paper, nearest distance 0.2 m")


def test_weights_folder_inside_clone_is_accepted(tmp_path: Path) -> None:
    clone = stand_ins.stereo_clone(tmp_path / "clone")
    small = clone / "pretrained_models" / "11-33-40"
    (clone / "pretrained_models" / "23-51-11").rename(small)
    method = find_method(f"foundation-stereo:{small}")
    assert method.info.name == "foundation-stereo:11-33-40"
    assert np.isfinite(load_predictor(method)(ROW)).any()
    with pytest.raises(MethodError, match=r"no model_best_bp2.pth in .*23-51-11; to install it: git clone"):
        find_method(f"foundation-stereo:{clone}")


def test_foreign_core_package_is_refused(tmp_path: Path, site: Path) -> None:
    (site / "core").mkdir()
    (site / "core" / "foundation_stereo.py").write_text("FoundationStereo = None\n")
    importlib.import_module("core.foundation_stereo")
    with pytest.raises(MethodError, match=r"core is already imported from .*, expected it from"):
        stereo_method(tmp_path).load()


END = "expected the end of the cost volume"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        *((f"max_disp: {value}".encode(), END) for value in ("0", "-416", "true", "416.0", "'416'", "[]", "null")),
        (b"hidden_dims: [1]", END),
        (b"a: &a [*a]\n", "alias"),
        (b"- 1\n", "holds list"),
        (b"{", "not valid YAML"),
        (b"a: 9999-99-99", "1 problem"),
    ],
)
def test_invalid_settings_are_refused(settings: bytes, words: str, tmp_path: Path) -> None:
    path = stand_ins.stereo_clone(tmp_path / "clone") / "pretrained_models" / "23-51-11" / "cfg.yaml"
    path.write_bytes(settings)
    with pytest.raises(MethodError, match=f"(?s)^{re.escape(str(path))}: .*{words}"):
        stereo_method(tmp_path)


def test_predict_records_mode_of_each_config(
    tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clone, archive = stand_ins.stereo_clone(tmp_path / "theirs"), tmp_path / "out.zip"
    command = ["predict", f"foundation-stereo:{clone}", "--data", str(tiny_root), "--out", str(archive)]
    assert main([*command, "--nearest-distance", "0.12"]) == 0
    assert "lattice-orbit: mode: single pass" in capsys.readouterr().err
    with zipfile.ZipFile(archive) as entries:
        metadata = json.loads(entries.read("submission.json"))
    expected = {
        "mode": "single pass",
        "scale": 1.0,
        "largest_disparity_px": 87.5,
        "largest_disparity_from": "nearest distance 0.12 m",
        "cost_volume_px": 416,
    }
    assert metadata["notes"] == {"lattice": expected, "lattice-orbit": expected}
    assert metadata["method"] == "foundation-stereo:23-51-11"
    assert (metadata["inputs"], metadata["uses_ground_truth"]) == ("stereo", False)
    assert "preparing" not in metadata["runtime"]


def test_distance_for_other_method_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["predict", "sgbm", "--data", "x", "--out", str(tmp_path / "out.zip"), "--nearest-distance", "0.2"]
    assert main(command) == 2
    assert "sgbm: has no nearest distance, expected foundation-stereo:FOLDER" in capsys.readouterr().err
