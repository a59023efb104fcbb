"""ONNX models as methods: units, normalisation, where pixels come from and go, focal length; a run end to end."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper
from scipy.ndimage import map_coordinates

from rebar_depth_bench import load, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.onnx.model import input_tensor, metres, on_picture, placement
from rebar_depth_bench.methods.onnx.spec import MEANINGS, InputSpec, OutputSpec
from tests.bench.methods.onnx_models import DEPTH, PLAIN, described, fixed, mixer, picture, run, write_model

GREY = np.full((4, 6, 3), 128, np.uint8)
SIDES = st.integers(1, 40)


def spec_of(size: tuple[int, int] | None, *, pad: bool, longest: int = 1, multiple: int = 1) -> InputSpec:
    return InputSpec(size, longest, multiple, pad, False, 255, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("white", "mean", "std"),
    [
        (1, (0, 0, 0), (1, 1, 1)),
        (255, (0, 0, 0), (1, 1, 1)),
        (1, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
        (255, (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
    ],
)
def test_the_model_gets_the_normalised_red_green_and_blue(
    white: int, mean: tuple[float, ...], std: tuple[float, ...], tmp_path: Path
) -> None:
    mixer(tmp_path, (1, 10, 100), offset=5000)
    settings = (
        f"width = 6\nheight = 4\nresize = 'stretch'\nrange = {white}\nmean = {list(mean)}\nstd = {list(std)}"
    )
    found = run(described(tmp_path, settings), picture(6, 4, lambda u, v: (200, 10 * u, 30 * v)))
    for v, u in np.ndindex(4, 6):
        channels = [(c / 255 * white - m) / s for c, m, s in zip((200, 10 * u, 30 * v), mean, std, strict=True)]
        assert found[v, u] == pytest.approx(5000 + channels[0] + 10 * channels[1] + 100 * channels[2], rel=1e-6)


def test_a_value_becomes_metres_as_its_meaning_says(tmp_path: Path) -> None:
    fixed(tmp_path, np.full((1, 1, 4, 6), 2.5))
    rgb = np.zeros((8, 24, 3), np.uint8)  # 24 wide on 6: the focal length becomes a quarter
    expected = {
        DEPTH: 2.5,
        "meaning = 'depth'\nscale = 0.001": 0.0025,
        "meaning = 'inverse-depth'": 0.4,
        "meaning = 'inverse-depth'\nscale = 0.01": 40.0,
        "meaning = 'canonical-depth'\nfocal_canonical_px = 1000": 2.5 * (700 / 4) / 1000,
        # Depth Pro: 1 / z = C W / f, with W and f of the picture; its canonical focal length is its own width.
        "meaning = 'canonical-inverse-depth'\nfocal_canonical_px = 6": 1 / (2.5 * 24 / 700),
    }
    for output, depth_m in expected.items():
        assert np.unique(run(described(tmp_path, returned=output), rgb, 700.0)) == pytest.approx([depth_m]), output


def test_metric3d_conversion(tmp_path: Path) -> None:
    """The field's formula: 1280 x 720 kept in ratio on 1064 x 616, depth times fx * scale / 1000."""
    fixed(tmp_path, np.full((1, 1, 616, 1064), 3.0))
    given = "width = 1064\nheight = 616\nresize = 'pad'\nrange = 255"
    path = described(tmp_path, given, "meaning = 'canonical-depth'\nfocal_canonical_px = 1000")
    found = run(path, np.zeros((720, 1280, 3), np.uint8), 700.0)
    assert np.unique(found) == pytest.approx([3.0 * 700 * min(616 / 720, 1064 / 1280) / 1000], rel=1e-6)
    info = find_method(str(path)).info
    assert info.uses_intrinsics
    assert "left_K" in info.columns


def test_what_is_no_depth_becomes_no_answer(tmp_path: Path) -> None:
    values = [[0.0, -1.0, np.nan, np.inf, -np.inf, 1e-45], [0.09, 0.1, 0.5, 2.0, 2.01, 3e38], [1] * 6, [1] * 6]
    fixed(tmp_path, np.array(values))
    found = run(described(tmp_path, returned="meaning = 'depth'\nmin_m = 0.1\nmax_m = 2"), GREY)
    assert np.isnan(found[0]).all()
    assert np.isnan(found[1]).tolist() == [True, False, False, False, True, True]
    found = run(described(tmp_path, returned="meaning = 'inverse-depth'"), GREY)
    assert np.isnan(found[0]).all(), "one over the smallest float is more than float32 holds"


@given(
    values=st.lists(st.floats(width=32), min_size=1, max_size=20),
    meaning=st.sampled_from(list(MEANINGS)),
    scale=st.floats(1e-9, 1e9),
)
def test_no_value_at_all_makes_a_depth_out_of_bounds(values: list[float], meaning: str, scale: float) -> None:
    spec = OutputSpec(MEANINGS[meaning], 1000.0, scale, 0.1, 30.0, None, True, False)
    depth_m = metres(np.array(values, np.float32), spec, 700.0)
    known = ~np.isnan(depth_m)
    assert (depth_m[known] >= np.float32(0.1)).all()
    assert (depth_m[known] <= np.float32(30.0)).all()
    assert not known[~(np.array(values) > 0)].any()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
@given(sides=st.tuples(SIDES, SIDES, SIDES, SIDES), pad=st.booleans(), axis=st.integers(0, 1))
def test_a_model_that_answers_with_its_own_coordinates_shows_where_pixels_come_from(
    sides: tuple[int, int, int, int], pad: bool, axis: int, tmp_path: Path
) -> None:
    width, height, wide, high = sides
    fixed(tmp_path, 1 + np.indices((high, wide))[axis])
    given = f"width = {wide}\nheight = {high}\nresize = '{'pad' if pad else 'stretch'}'\nrange = 1"
    found = run(described(tmp_path, given), np.zeros((height, width, 3), np.uint8)) - 1
    side, canvas = ((height, high), (width, wide))[axis]
    ratio = min(wide / width, high / height)
    resized = max(1, round(side * ratio)) if pad else canvas
    before = (canvas - resized) // 2
    for place in np.ndindex(height, width):
        assert found[place] == before + (2 * place[axis] + 1) * resized // (2 * side)


@given(sides=st.tuples(SIDES, SIDES, SIDES, SIDES), pad=st.booleans(), cells=st.tuples(SIDES, SIDES))
def test_bilinear_is_interpolation_between_centres_within_the_picture(
    sides: tuple[int, int, int, int], pad: bool, cells: tuple[int, int]
) -> None:
    width, height, wide, high = sides
    place = placement(spec_of((wide, high), pad=pad), width, height)
    values = np.random.default_rng(7).uniform(1, 2, cells)
    clipped, ranges = [], []
    for span, count in ((place.down, cells[0]), (place.across, cells[1])):
        centres = np.linspace(span.before, span.before + span.resized, 2 * span.picture + 1)[1::2]
        inside = [i for i in range(count) if span.before <= i * span.canvas / count + 1e-9]
        inside = [i for i in inside if (i + 1) * span.canvas / count - 1e-9 <= span.before + span.resized]
        ranges.append(inside)
        clipped.append(
            np.clip(centres * count / span.canvas - 0.5, *((inside[0], inside[-1]) if inside else (0, 0)))
        )
    if not all(ranges):  # a grid so coarse that every cell holds padding
        assert on_picture(place, values, bilinear=True).shape == (height, width)
        return
    expected = map_coordinates(values, np.meshgrid(*clipped, indexing="ij"), order=1, mode="nearest")
    assert on_picture(place, values, bilinear=True) == pytest.approx(expected, rel=1e-9)
    assert np.isin(on_picture(place, values, bilinear=False), values[np.ix_(*ranges)]).all()


@pytest.mark.parametrize("resize", ["pad", "stretch"])
def test_what_the_model_sees_comes_back_where_it_was(resize: str, tmp_path: Path) -> None:
    """A ramp that survives smoothing returns unmoved: half a pixel's shift would be 1 grey level across."""
    mixer(tmp_path, offset=1)
    given = f"width = 40\nheight = 40\nresize = '{resize}'\nrange = 255"
    path = described(tmp_path, given, f"{DEPTH}\nresize = 'bilinear'")
    rgb = picture(80, 50, lambda u, v: (2 * u + v, 0, 0))
    assert np.abs(run(path, rgb)[3:-3, 3:-3] - 1 - rgb[3:-3, 3:-3, 0]).max() < 0.6  # rounding to whole grey levels


def test_padding_is_the_mean_and_never_an_answer(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("ReduceSum", ["x", "axes"], ["sum"], keepdims=1),
        helper.make_node("Mul", ["x", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "sum"], ["all"]),
        helper.make_node("ReduceMax", ["all"], ["y"], axes=[1]),
    ]
    constants = {"axes": np.array([1, 2, 3]), "zero": np.array(0, np.float32)}
    write_model(tmp_path, nodes, constants=constants)
    given = "width = 20\nheight = 20\nresize = 'pad'\nrange = 1\nmean = [0.5, 0.25, 0]\nstd = [0.5, 0.5, 0.5]"
    found = run(described(tmp_path, given), np.full((10, 40, 3), 255, np.uint8))
    assert np.unique(found) == pytest.approx([20 * 5 * (1 + 1.5 + 2)])


def test_a_grid_coarser_than_the_input_covers_the_same_field(tmp_path: Path) -> None:
    fixed(tmp_path, np.array([[[1, 2], [3, 4]]]))
    path = described(tmp_path, returned=f"{DEPTH}\nat_input_size = false")
    assert run(path, np.zeros((2, 6, 3), np.uint8)).tolist() == [[1, 1, 1, 2, 2, 2], [3, 3, 3, 4, 4, 4]]


def test_nearest_invents_no_depth_and_bilinear_mixes_only_answers(tmp_path: Path) -> None:
    bar = np.array([[2.0, 2, 1, 1, np.nan, 2]] * 4)  # a bar at 1 m before a wall at 2 m, and a hole
    fixed(tmp_path, bar)
    rgb = np.zeros((16, 24, 3), np.uint8)
    nearest = run(described(tmp_path), rgb)
    assert set(nearest[~np.isnan(nearest)]) == {1.0, 2.0}
    assert np.isnan(nearest[0]).sum() == 4
    mixed = run(described(tmp_path, returned=f"{DEPTH}\nresize = 'bilinear'"), rgb)
    assert ((mixed > 1) & (mixed < 2)).any()
    assert np.isnan(mixed[0]).nonzero()[0].tolist() == list(range(14, 22))
    unmoved = run(described(tmp_path, returned=f"{DEPTH}\nresize = 'bilinear'"), GREY)
    assert np.isnan(unmoved[0]).nonzero()[0].tolist() == [4], "at its own size nothing is mixed, NaN not either"
    limited = run(described(tmp_path, returned=f"{DEPTH}\nresize = 'bilinear'\nmax_m = 1.5"), rgb)
    assert set(limited[~np.isnan(limited)]) == {1.0}, "the wall is out before anything is mixed with it"


@pytest.mark.parametrize(
    ("size", "expected"), [((1280, 720), (518, 294)), ((720, 1280), (294, 518)), ((2000, 3), (518, 14))]
)
def test_longest_side_and_multiple_keep_the_ratio_as_well_as_they_can(
    size: tuple[int, int], expected: tuple[int, int]
) -> None:
    spec = spec_of(None, pad=False, longest=518, multiple=14)
    tensor = input_tensor(spec, placement(spec, *size), np.zeros((size[1], size[0], 3), np.uint8))
    assert tensor.shape == (1, 3, expected[1], expected[0])


def test_open_sizes_and_half_precision(tmp_path: Path) -> None:
    mixer_half = [
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[1]),
        helper.make_node("Add", ["mean", "one"], ["y"]),
    ]
    write_model(
        tmp_path,
        mixer_half,
        constants={"one": np.array(1, np.float16)},
        input_type=TensorProto.FLOAT16,
        output_type=TensorProto.FLOAT16,
    )
    path = described(tmp_path, "longest_side = 6\nresize = 'stretch'\nrange = 1")
    assert np.unique(run(path, np.full((4, 6, 3), 255, np.uint8))) == pytest.approx([2.0])


def test_what_a_method_tells_and_what_its_digest_covers(tmp_path: Path) -> None:
    mixer(tmp_path, offset=1)
    path = described(tmp_path, top="source = 'a paper'")
    info = find_method(str(path)).info
    assert (info.name, info.licence, info.columns, info.uses_intrinsics) == ("tiny", "MIT", ("left_rgb",), False)
    assert "metres" in info.summary
    assert info.source.startswith("a paper (sha256:")
    (tmp_path / "model.onnx_data").write_bytes(b"weights")
    with_data = find_method(str(path)).info.source
    described(tmp_path, PLAIN + "\nstd = [2, 2, 2]", top="source = 'a paper'")
    assert len({info.source, with_data, find_method(str(path)).info.source}) == 3


def test_onnxruntime_is_not_imported_before_a_model_is_loaded(tmp_path: Path) -> None:
    mixer(tmp_path)
    code = (
        "import sys; from rebar_depth_bench.methods import find_method; "
        f"find_method({str(described(tmp_path))!r}); print('onnxruntime' in sys.modules, 'onnx' in sys.modules)"
    )
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout == "False False\n"


def test_predict_runs_a_model_over_a_dataset(tiny_root: Path, tmp_path: Path) -> None:
    mixer(tmp_path, (0.5, 0.25, 0.25), offset=0.25)
    path = described(tmp_path, "width = 160\nheight = 90\nresize = 'pad'\nrange = 1", top="name = 'mine'")
    archive = tmp_path / "mine.zip"
    command = ["predict", str(path), "--data", str(tiny_root), "--config", "lattice-orbit", "--out", str(archive)]
    assert main(command) == 0
    assert score(archive, tiny_root).method == "mine"
    with zipfile.ZipFile(archive) as entries:
        for row in load(tiny_root, "lattice-orbit", columns=["view_id", "left_rgb"]):
            depth_m = np.load(BytesIO(entries.read(f"{row['view_id']}.npy")))
            expected = row["left_rgb"] / 255 @ [0.5, 0.25, 0.25] + 0.25
            assert depth_m == pytest.approx(expected, rel=1e-5)
