"""ONNX models as methods: units, normalisation, resampling, focal length and a prediction run."""

from __future__ import annotations

import math
import zipfile
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from rebar_depth_bench import load, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.onnx.model import place_image, source_cells
from rebar_depth_bench.methods.onnx.spec import InputSpec
from tests.bench.methods.onnx_models import (
    DEPTH_OUTPUT,
    PLAIN_INPUT,
    make_image,
    predict_depth,
    write_constant_model,
    write_mixer_model,
    write_model,
    write_toml,
)

GREY = np.full((4, 6, 3), 128, np.uint8)
SIDES = st.integers(1, 40)


@pytest.mark.parametrize(
    ("white", "mean", "std"),
    [
        (1, (0, 0, 0), (1, 1, 1)),
        (255, (0, 0, 0), (1, 1, 1)),
        (1, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
        (255, (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
    ],
)
def test_model_input_is_normalised_rgb(
    white: int, mean: tuple[float, ...], std: tuple[float, ...], tmp_path: Path
) -> None:
    write_mixer_model(tmp_path, (1, 10, 100), offset=5000)
    input_table = f"{PLAIN_INPUT}\nmean = {list(mean)}\nstd = {list(std)}".replace("255", str(white), 1)
    sums = predict_depth(write_toml(tmp_path, input_table), make_image(6, 4, lambda u, v: (200, 10 * u, 30 * v)))
    for v, u in np.ndindex(4, 6):
        channels = [(c / 255 * white - m) / s for c, m, s in zip((200, 10 * u, 30 * v), mean, std, strict=True)]
        assert sums[v, u] == pytest.approx(5000 + channels[0] + 10 * channels[1] + 100 * channels[2], rel=1e-6)


def test_output_meaning_converts_to_metres(tmp_path: Path) -> None:
    write_constant_model(tmp_path, np.full((1, 1, 4, 6), 2.5))
    rgb = np.zeros((8, 24, 3), np.uint8)  # Resized from 24 to 6 columns: fx is divided by 4.
    expected = {
        DEPTH_OUTPUT: 2.5,
        "meaning = 'depth'\nscale = 0.001": 0.0025,
        "meaning = 'inverse-depth'": 0.4,
        "meaning = 'inverse-depth'\nscale = 0.01": 40.0,
        "meaning = 'canonical-depth'\nfocal_canonical_px = 1000": 2.5 * (700 / 4) / 1000,
        # Depth Pro: 1 / z = C W / f, with W and f of the image; its canonical focal length is its input width.
        "meaning = 'canonical-inverse-depth'\nfocal_canonical_px = 6": 1 / (2.5 * 24 / 700),
    }
    for output, expected_m in expected.items():
        depth_m = predict_depth(write_toml(tmp_path, output_table=output), rgb, 700.0)
        assert np.unique(depth_m) == pytest.approx([expected_m]), output


def test_invalid_output_becomes_nan(tmp_path: Path) -> None:
    values = [[0.0, -1.0, np.nan, np.inf, -np.inf, 1e-45], [0.09, 0.1, 0.5, 2.0, 2.01, 3e38], [1] * 6, [1] * 6]
    write_constant_model(tmp_path, np.array(values))
    depth_m = predict_depth(write_toml(tmp_path), GREY)
    assert np.isnan(depth_m[0]).tolist() == [True] * 5 + [False]
    assert depth_m[1] == pytest.approx(values[1])
    depth_m = predict_depth(write_toml(tmp_path, output_table="meaning = 'depth'\nscale = 1000"), GREY)
    assert np.isnan(depth_m[1]).tolist() == [False] * 5 + [True], "more than float32 holds"
    depth_m = predict_depth(write_toml(tmp_path, output_table="meaning = 'inverse-depth'"), GREY)
    assert np.isnan(depth_m[0]).all(), "one over the smallest float is more than float32 holds"


@pytest.mark.parametrize("meaning", ["scale", "affine-depth", "affine-disparity"])
def test_relative_output_is_kept_as_it_is(tmp_path: Path, meaning: str) -> None:
    write_constant_model(tmp_path, np.array([[-2.0, 0.0, 1e-30, np.inf, np.nan, 3.0]] * 4))
    path = write_toml(tmp_path, output_table=f"meaning = '{meaning}'\nscale = 2")
    assert find_method(str(path)).info.prediction == meaning
    values = predict_depth(path, GREY)[0]
    np.testing.assert_array_equal(values, np.array([-4, 0, 2e-30, np.nan, np.nan, 6], np.float32))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
@given(sides=st.tuples(SIDES, SIDES, SIDES, SIDES), pad=st.booleans(), axis=st.integers(0, 1))
def test_coordinate_model_reveals_source_pixels(
    sides: tuple[int, int, int, int], pad: bool, axis: int, tmp_path: Path
) -> None:
    width, height, wide, high = sides
    write_constant_model(tmp_path, 1 + np.indices((high, wide))[axis])
    input_table = f"width = {wide}\nheight = {high}\nresize = '{'pad' if pad else 'stretch'}'\nrange = 1"
    source = predict_depth(write_toml(tmp_path, input_table), np.zeros((height, width, 3), np.uint8)) - 1
    side, canvas = ((height, high), (width, wide))[axis]
    ratio = min(wide / width, high / height)
    resized = max(1, round(side * ratio)) if pad else canvas
    before = (canvas - resized) // 2
    for pixel in np.ndindex(height, width):
        assert source[pixel] == before + (2 * pixel[axis] + 1) * resized // (2 * side)


@given(image_px=SIDES, canvas_px=SIDES, share=st.floats(0, 1), cells=SIDES, known_px=st.integers(0, 39))
def test_cell_contains_centre_of_pixel_and_no_padding(
    image_px: int, canvas_px: int, share: float, cells: int, known_px: int
) -> None:
    """Exact fractions of the canvas; on a grid that is coarser than the padding, the middle cell is taken."""
    resized_px, pixel = max(1, round(share * canvas_px)), known_px % image_px
    first_px = (canvas_px - resized_px) // 2
    found = int(source_cells(image_px, canvas_px, resized_px, cells)[pixel])
    inside = [
        cell
        for cell in range(cells)
        if first_px * cells <= cell * canvas_px and (cell + 1) * canvas_px <= (first_px + resized_px) * cells
    ]
    centre = (first_px + Fraction(2 * pixel + 1, 2 * image_px) * resized_px) * cells / canvas_px
    if inside:
        assert found == min(max(math.floor(centre), inside[0]), inside[-1])
    else:
        middle = Fraction(2 * first_px + resized_px, 2 * canvas_px) * cells
        assert found == min(math.floor(middle), cells - 1)


def test_image_is_resized_in_place(tmp_path: Path) -> None:
    """A ramp survives the smoothing of resizing; a shift of half a pixel would change it by one grey level."""
    write_mixer_model(tmp_path, offset=1)
    rgb = make_image(80, 50, lambda u, v: (2 * u + v, 0, 0))
    for resize, high, wide in (("pad", 25, 40), ("stretch", 40, 40)):
        path = write_toml(tmp_path, f"width = 40\nheight = 40\nresize = '{resize}'\nrange = 255")
        difference = predict_depth(path, rgb) - 1 - rgb[..., 0]
        v, u = (np.arange(side) + 0.5 for side in (50, 80))
        cell_v, cell_u = (
            (np.floor(at * small / side) + 0.5) * side / small - at
            for at, small, side in ((v, high, 50), (u, wide, 80))
        )
        expected = 2 * cell_u[None, :] + cell_v[:, None]
        assert np.abs(difference - expected)[3:-3, 3:-3].max() < 0.6, "grey levels are rounded"


def test_padding_is_mean_and_never_sampled(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("ReduceSum", ["x", "axes"], ["sum"], keepdims=1),
        helper.make_node("Mul", ["x", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "sum"], ["all"]),
        helper.make_node("ReduceMax", ["all"], ["y"], axes=[1]),
    ]
    constants = {"axes": np.array([1, 2, 3]), "zero": np.array(0, np.float32)}
    write_model(tmp_path, nodes, constants=constants)
    input_table = (
        "width = 20\nheight = 20\nresize = 'pad'\nrange = 1\nmean = [0.5, 0.25, 0]\nstd = [0.5, 0.5, 0.5]"
    )
    depth_m = predict_depth(write_toml(tmp_path, input_table), np.full((10, 40, 3), 255, np.uint8))
    assert np.unique(depth_m) == pytest.approx([20 * 5 * (1 + 1.5 + 2)])


def test_coarse_output_grid_covers_whole_image(tmp_path: Path) -> None:
    write_constant_model(tmp_path, np.array([[[1, 2], [3, 4]]]))
    path = write_toml(tmp_path, PLAIN_INPUT.replace("height = 4", "height = 6"))
    assert predict_depth(path, np.zeros((2, 6, 3), np.uint8)).tolist() == [[1, 1, 1, 2, 2, 2], [3, 3, 3, 4, 4, 4]]


@pytest.mark.parametrize(
    ("size", "expected"), [((1280, 720), (518, 294)), ((720, 1280), (294, 518)), ((2000, 3), (518, 14))]
)
def test_input_size_from_longest_side_and_multiple(size: tuple[int, int], expected: tuple[int, int]) -> None:
    spec = InputSpec(longest_side=518, multiple_of=14, resize="stretch", range=255)
    assert place_image(spec, size[::-1]) == (expected[::-1], expected[::-1])


def test_dynamic_size_and_half_precision(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[1]),
        helper.make_node("Add", ["mean", "one"], ["y"]),
    ]
    half = {"input_type": TensorProto.FLOAT16, "output_type": TensorProto.FLOAT16}
    write_model(tmp_path, nodes, constants={"one": np.array(1, np.float16)}, **half)
    path = write_toml(tmp_path, "longest_side = 6\nresize = 'stretch'\nrange = 1")
    assert np.unique(predict_depth(path, np.full((4, 6, 3), 255, np.uint8))) == pytest.approx([2.0])


def test_method_info_and_coverage_of_its_digest(tmp_path: Path) -> None:
    write_mixer_model(tmp_path, offset=1)
    path = write_toml(tmp_path, top_level="source = 'a paper'")
    info = find_method(str(path)).info
    assert (info.name, info.licence, info.columns, info.uses_intrinsics) == ("tiny", "MIT", ("left_rgb",), False)
    assert "metres" in info.summary
    write_toml(tmp_path, output_table="meaning = 'canonical-depth'\nfocal_canonical_px = 1000")
    canonical = find_method(str(path)).info
    assert (canonical.columns, canonical.uses_intrinsics) == (("left_rgb", "left_K"), True)
    assert info.source.startswith("a paper (tiny.toml sha256:")
    write_toml(tmp_path, PLAIN_INPUT + "\nstd = [2, 2, 2]", top_level="source = 'a paper'")
    other_settings = find_method(str(path)).info.source
    write_mixer_model(tmp_path, offset=2)
    assert len({info.source, other_settings, find_method(str(path)).info.source}) == 3


@pytest.mark.slow
def test_predict_command_runs_onnx_model(tiny_root: Path, tmp_path: Path) -> None:
    write_mixer_model(tmp_path, (0.5, 0.25, 0.25), offset=0.25)
    path = write_toml(tmp_path, "width = 160\nheight = 90\nresize = 'pad'\nrange = 1", top_level="name = 'mine'")
    archive = tmp_path / "mine.zip"
    command = ["predict", str(path), "--data", str(tiny_root), "--config", "lattice-orbit", "--out", str(archive)]
    assert main(command) == 0
    assert score(archive, tiny_root).method == "mine"
    with zipfile.ZipFile(archive) as entries:
        for row in load(tiny_root, "lattice-orbit", columns=["view_id", "left_rgb"]):
            depth_m = np.load(BytesIO(entries.read(f"{row['view_id']}.npy")))
            expected = row["left_rgb"] / 255 @ [0.5, 0.25, 0.25] + 0.25
            assert depth_m == pytest.approx(expected, rel=1e-5)
