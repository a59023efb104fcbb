"""The method files of ``examples/methods``, with tiny networks in place of the weights."""

from __future__ import annotations

import itertools
import json
import runpy
import shutil
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import numpy as np
import onnx
from onnx import TensorProto, helper

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import find_method
from tests.bench.methods.onnx_models import make_image
from tests.bench.methods.predictors import load_predictor

EXAMPLES = Path("examples/methods")
LEFT = make_image(70, 50, lambda x, y: (3 * x, 5 * y, x))
RIGHT = make_image(70, 50, lambda x, y: (7 * (x % 30), y, x + y))
STEREO_ROW: dict[str, Any] = {
    "left_rgb": LEFT,
    "right_rgb": RIGHT,
    "left_K": np.array([[300.0, 0, 36], [0, 300, 25], [0, 0, 1]]),
    "right_K": np.array([[300.0, 0, 33], [0, 300, 25], [0, 0, 1]]),
    "baseline_m": 0.1,
}
Input = tuple[int, tuple[int | str, ...]]
IMAGE: Input = (TensorProto.FLOAT, (1, 3, "h", "w"))


def write_network(path: Path, nodes: list[Any], **inputs: Input) -> None:
    """Write a network with the output ``y`` and inputs by name, each of a type and shape."""
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, *kind) for name, kind in inputs.items()],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


def template(name: str, folder: Path, nodes: list[Any], **inputs: Input) -> Any:
    """Return the predictor of a copy of the example ``name`` beside a network."""
    copy = Path(shutil.copy(EXAMPLES / f"{name}.py", folder))
    write_network(folder / f"{name}.onnx", nodes, **inputs)
    return load_predictor(f"{copy}:METHOD")


def channel_mean(name: str, axis: int = 1) -> Any:
    return helper.make_node("ReduceMean", [name], ["y"], axes=[axis])


def stereo_depth(disparity: np.ndarray) -> np.ndarray:
    """Return f B / (disparity - 3), the rig's difference of centres, NaN below one pixel."""
    return np.array([[30 / (d - 3) if d - 3 >= 1 else np.nan for d in row] for row in disparity.tolist()])


def test_stereo_network_with_two_inputs(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Sum", ["left", "left", "left", "left"], ["four"]),
        helper.make_node("Exp", ["four"], ["large"]),
        helper.make_node("Sub", ["large", "right"], ["difference"]),
        channel_mean("difference"),
    ]
    predict = template("stereo", tmp_path, nodes, left=IMAGE, right=IMAGE)
    disparity = (np.exp(4 * (LEFT / 255)) - RIGHT / 255).mean(-1)
    assert (disparity < 4).any()
    np.testing.assert_allclose(predict(STEREO_ROW), stereo_depth(disparity), rtol=1e-3)


def test_network_with_image_and_intrinsics(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("ReduceMax", ["K"], ["focal"]),
        helper.make_node("Mul", ["image", "focal"], ["product"]),
        channel_mean("product"),
    ]
    predict = template("several_inputs", tmp_path, nodes, image=IMAGE, K=(TensorProto.FLOAT, (1, 3, 3)))
    np.testing.assert_allclose(predict(STEREO_ROW), 300 * LEFT.mean(-1) / 255, rtol=1e-5)


def test_network_with_uint8_input(tmp_path: Path) -> None:
    nodes = [helper.make_node("Cast", ["x"], ["float"], to=TensorProto.FLOAT), channel_mean("float")]
    predict = template("uint8", tmp_path, nodes, x=(TensorProto.UINT8, (1, 3, "h", "w")))
    np.testing.assert_allclose(predict(STEREO_ROW), LEFT.mean(-1), rtol=1e-6)


def test_network_with_channels_last(tmp_path: Path) -> None:
    predict = template("channels_last", tmp_path, [channel_mean("x", 3)], x=(TensorProto.FLOAT, (1, 256, 256, 3)))
    quadrants = make_image(512, 300, lambda x, y: (51 * (1 + (x >= 256) + 2 * (y >= 150)),) * 3)
    depth_m = predict({"left_rgb": quadrants})
    assert depth_m.shape == (300, 512)
    for x, y in itertools.product((0, 250, 262, 511), (0, 145, 155, 299)):
        assert depth_m[y, x] == pytest.approx((1 + (x >= 256) + 2 * (y >= 150)) / 5)


def test_hitnet_gives_the_depth_of_its_disparity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in returns exp(4 left) - right of grey images, N H W C as HITNet."""
    nodes = [
        helper.make_node("Split", ["pair"], ["left", "right"], axis=1),
        helper.make_node("Sum", ["left", "left", "left", "left"], ["four"]),
        helper.make_node("Exp", ["four"], ["large"]),
        helper.make_node("Sub", ["large", "right"], ["difference"]),
        helper.make_node("Transpose", ["difference"], ["y"], perm=[0, 2, 3, 1]),
    ]
    write_network(tmp_path / "hitnet_eth3d.onnx", nodes, pair=(TensorProto.FLOAT, (1, 2, 64, 128)))
    monkeypatch.setenv("MODELS", str(tmp_path))
    left, right = (0.299 * rgb[..., 0] + 0.587 * rgb[..., 1] + 0.114 * rgb[..., 2] for rgb in (LEFT, RIGHT))
    expected = stereo_depth(np.exp(4 * (left / 255)) - right / 255)
    assert np.isnan(expected).any()
    found = load_predictor(f"{EXAMPLES / 'hitnet.py'}:METHOD")(STEREO_ROW)
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_tcmonodepth_writes_an_archive_of_affine_disparity(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = tmp_path / "tcmonodepth_tcsmallnet_192x320.onnx"
    write_network(network, [channel_mean("input")], input=(TensorProto.FLOAT, (1, 3, 192, 320)))
    monkeypatch.setenv("MODELS", str(tmp_path))
    predict = load_predictor(f"{EXAMPLES / 'tcmonodepth.py'}:METHOD")
    ramp = make_image(640, 384, lambda x, y: (x // 4, y // 4, 90))
    np.testing.assert_allclose(predict({"left_rgb": ramp}), ramp.mean(-1), atol=2)
    archive = tmp_path / "relative.zip"
    assert (
        main(["predict", f"{EXAMPLES / 'tcmonodepth.py'}:METHOD", "--data", str(tiny_root), "--out", str(archive)])
        == 0
    )
    with zipfile.ZipFile(archive) as entries:
        assert json.loads(entries.read("submission.json"))["prediction"] == "affine-disparity"


def test_costs_are_aggregated_along_four_directions() -> None:
    """Each path is compared with the recurrence of Hirschmueller (2008), equation 13, written as loops."""
    example = runpy.run_path(str(EXAMPLES / "mccnn.py"))
    small, large = example["SMALL_STEP"], example["LARGE_STEP"]
    cost = np.random.default_rng(4).uniform(-1, 2, (4, 5, 6)).astype(np.float32)
    height, width, count = cost.shape
    expected = np.zeros(cost.shape)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = np.zeros(cost.shape)
        rows, columns = range(height)[:: dy or 1], range(width)[:: dx or 1]
        for y, x in itertools.product(rows, columns):
            path[y, x] = cost[y, x]
            if 0 <= y - dy < height and 0 <= x - dx < width:
                before = path[y - dy, x - dx]
                for d in range(count):
                    steps = [before[k] + (0, small, large)[min(abs(k - d), 2)] for k in range(count)]
                    path[y, x, d] += min(steps) - before.min()
        expected += path
    np.testing.assert_allclose(example["aggregated"](cost), expected, rtol=1e-5)


def test_disparity_is_that_of_both_views_with_a_fraction() -> None:
    """The costs are parabolas: minimum at 1 px before column 6, at 3.25 px from there on."""
    example = runpy.run_path(str(EXAMPLES / "mccnn.py"))
    true = np.where(np.arange(16) < 6, 1.0, 3.25)
    cost = (np.arange(8) - true[:, None]) ** 2 * np.ones((2, 1, 1))
    found = example["consistent_disparity"](cost)
    assert found.shape == (2, 16)
    np.testing.assert_allclose(found[:, 1:6], 1.0)
    np.testing.assert_allclose(found[:, 9:], 3.25)
    assert np.isnan(found[:, 0]).all()  # Its match lies outside the right image.


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_patchmatchnet_is_given_the_nearest_cameras(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stand-in returns the range of depth if the first image and pose are the view's own."""
    torch = pytest.importorskip("torch")
    source = """
def forward(self, images: List[Tensor], K: Tensor, pose: Tensor, low: Tensor, high: Tensor):
    centre = -torch.matmul(pose[0, :, :3, :3].transpose(1, 2), pose[0, :, :3, 3:])[:, :, 0]
    distance = ((centre - centre[0]) ** 2).sum(1)
    ordered = bool((distance[1:] >= distance[:-1]).all()) and len(images) == K.shape[1]
    depth = torch.full_like(images[0][:, :1], float(high - low) if ordered else 0.0)
    return depth, depth, {0: [depth]}
"""
    network = torch.jit.ScriptModule()
    network.define(source)
    network.save(str(tmp_path / "patchmatchnet_module_000007.pt"))
    monkeypatch.setenv("MODELS", str(tmp_path))
    name, archive = f"{EXAMPLES / 'patchmatchnet.py'}:METHOD", tmp_path / "multi.zip"
    assert find_method(name).info.uses_ground_truth
    assert main(["predict", name, "--data", str(tiny_root), "--out", str(archive)]) == 0
    with zipfile.ZipFile(archive) as entries:
        assert json.loads(entries.read("submission.json"))["uses_ground_truth"] is True
        (view,) = list(rdb.load(tiny_root, "lattice"))[:1]
        with entries.open(f"{view['view_id']}.npy") as entry:
            depth_m = np.load(entry)
    steel = view["left_depth"][(view["left_mask"] > 0) & (view["left_depth"] > 0)]
    expected = 1.25 * np.percentile(steel, 99) - 0.75 * np.percentile(steel, 1)
    np.testing.assert_allclose(depth_m, expected, rtol=1e-5)


def test_ultralytics_receives_blue_green_red_and_its_depth_is_returned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package is not installed here: a stand-in returns the red channel, the last, as its network's depth."""

    class Stand:
        def __init__(self, weights: Path, task: str) -> None:
            assert (weights, task) == (tmp_path / "best.pt", "depth")

        def predict(self, image: np.ndarray, verbose: bool) -> list[Any]:
            assert image.flags.c_contiguous
            depth_m = SimpleNamespace(cpu=lambda: SimpleNamespace(numpy=lambda: image[..., 2].astype(np.float32)))
            return [SimpleNamespace(depth=SimpleNamespace(data=depth_m))]

    monkeypatch.setitem(sys.modules, "ultralytics", SimpleNamespace(YOLO=Stand))
    monkeypatch.setenv("MODELS", str(tmp_path))
    predict = load_predictor(f"{EXAMPLES}/ultralytics_depth.py:METHOD")
    assert np.array_equal(predict(STEREO_ROW), LEFT[..., 0])
