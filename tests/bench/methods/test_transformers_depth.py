"""Monocular depth networks of ``transformers``: the real classes with random weights, end to end."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("starlette")
pytest.importorskip("torch")
pytest.importorskip("transformers")
pytest.importorskip("uvicorn")

import numpy as np
from huggingface_hub import constants
from PIL import Image

from rebar_depth_bench import evaluate, score
from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.transformers import (
    hf_method,
)
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.tiny_depth_models import IMAGENET, MODELS, save_checkpoint
from tests.hub_server import HubServer, folder_files

pytestmark = pytest.mark.slow  # torch and transformers take seconds to import

H, W = 90, 160
FX = 87.5
SIGMOID_2 = 1 / (1 + np.exp(-2.0))


def row(seed: int = 1, fx: float = FX) -> dict[str, Any]:
    """Return a row with an image of blurred noise and its intrinsics."""
    coarse = np.random.default_rng(seed).integers(0, 256, (9, 16, 3), np.uint8)
    rgb = np.asarray(Image.fromarray(coarse).resize((W, H), Image.Resampling.BICUBIC))
    K = np.array([[fx, 0, (W - 1) / 2], [0, fx, (H - 1) / 2], [0, 0, 1]])
    return {"view_id": "a/0", "left_rgb": rgb, "left_K": K}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Save a checkpoint of each kind whose output varies over the image; return the folders by kind."""
    root = tmp_path_factory.mktemp("checkpoints")
    return {kind: save_checkpoint(root / kind, kind) for kind in MODELS}


@pytest.mark.parametrize("kind", MODELS)
def test_families_predict_deterministically_on_left_grid(folders: dict[str, Path], kind: str) -> None:
    method = find_method(f"hf:{folders[kind]}")
    inputs = {name: row()[name] for name in method.info.columns}
    first, second = load_predictor(method)(inputs), load_predictor(method)(inputs)
    assert (first.shape, first.dtype) == ((H, W), np.float32)
    assert np.array_equal(first, second, equal_nan=True)
    known = first[np.isfinite(first)]
    assert known.size > 0.3 * first.size
    assert method.info.prediction != "metric" or (known > 0).all()
    assert known.std() > 1e-3 * known.mean(), "the network looks at the picture"
    assert method.info.name == f"hf:{kind}"
    assert str(folders[kind]) not in json.dumps(vars(method.info))
    is_relative = kind in ("depth-anything", "dpt")
    assert ("up to scale" in method.info.summary) == is_relative
    assert method.info.prediction == ("affine-disparity" if is_relative else "metric")
    assert method.info.uses_intrinsics == (kind == "depth-pro")


@pytest.mark.parametrize(
    ("kind", "bias", "changes", "expected"),
    [
        ("depth-anything", 2.0, {"depth_estimation_type": "metric", "max_depth": 20}, 20 * SIGMOID_2),
        ("depth-anything", 2.0, {}, 2.0),
        ("depth-anything", -1.0, {}, 0.0),
        ("dpt", 4.0, {}, 4.0),
        ("dpt-dinov2", 4.0, {}, 4.0),
        ("glpn", 2.0, {"max_depth": 80}, 80 * SIGMOID_2),
        ("depth-pro", 0.25, {}, FX / (0.25 * W)),
        ("depth-pro", -1.0, {}, 1e4),
        ("depth-pro", 1e9, {}, 1e-4),
        ("dpt", np.nan, {}, np.nan),
        ("glpn", np.nan, {}, np.nan),
    ],
)
def test_known_output_becomes_expected_values(
    tmp_path: Path, kind: str, bias: float, changes: dict[str, Any], expected: float
) -> None:
    depth_m = hf_method(str(save_checkpoint(tmp_path, kind, bias, **changes))).load()(row())
    np.testing.assert_allclose(depth_m, np.full((H, W), expected), rtol=1e-5)


@pytest.mark.parametrize("kind", ["depth-anything", "dpt", "dpt-dinov2", "glpn"])
def test_depth_matches_transformers_pipeline(folders: dict[str, Path], kind: str) -> None:
    transformers = importlib.import_module("transformers")
    processor = transformers.AutoImageProcessor.from_pretrained(folders[kind], backend="pil")
    pipe = transformers.pipeline("depth-estimation", model=str(folders[kind]), image_processor=processor)
    theirs = pipe(Image.fromarray(row()["left_rgb"]))["predicted_depth"].numpy()
    method = hf_method(str(folders[kind]))
    ours = method.load()(row())
    if method.info.prediction == "metric":
        theirs = np.where(theirs > 0, theirs, np.nan)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


def test_depth_pro_input_matches_pillow(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """For enlargement Pillow's bilinear filter is the same interpolation; values become 2 v / 255 - 1."""
    network, given = importlib.import_module("transformers").DepthProForDepthEstimation, list[Any]()
    forward = network.forward

    def record(self: Any, pixel_values: Any) -> Any:
        given.append(pixel_values)
        return forward(self, pixel_values)

    monkeypatch.setattr(network, "forward", record)
    small = {**row(), "left_rgb": row()["left_rgb"][20:50, 10:60]}
    hf_method(str(folders["depth-pro"])).load()(small)
    [[planes]] = given
    assert planes.shape == (3, 64, 64)
    for channel in range(3):
        plane = Image.fromarray(small["left_rgb"][..., channel].astype(np.float32))
        expected = np.asarray(plane.resize((64, 64), Image.Resampling.BILINEAR)) * 2 / 255 - 1
        np.testing.assert_allclose(planes[channel].numpy(), expected, atol=2e-5)


@pytest.mark.parametrize("channel", [0, 1])
def test_zoedepth_round_trip_keeps_pixel_positions(
    channel: int, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ramps over rows and columns, passed through pre- and postprocessing only, keep every pixel in place."""
    network, offset = importlib.import_module("transformers").ZoeDepthForDepthEstimation, 10
    mean, std = (IMAGENET[name][channel] for name in ("image_mean", "image_std"))

    def return_channel(_: Any, pixel_values: Any) -> SimpleNamespace:
        return SimpleNamespace(predicted_depth=pixel_values[:, channel] + offset)

    monkeypatch.setattr(network, "forward", return_channel)
    rows, columns = np.mgrid[:H, :W]
    rgb = np.stack([rows, columns, np.zeros_like(rows)], axis=-1).astype(np.uint8)
    restored = (hf_method(str(folders["zoedepth"])).load()({"left_rgb": rgb}) - offset) * std + mean
    inner = np.s_[12:-12, 12:-12]
    np.testing.assert_allclose(255 * restored[inner], (rows, columns)[channel][inner], atol=1.5)


@pytest.mark.parametrize("backbone", ['{"model_type": "beit"}', "[]", '["x"]', '"dinov2"', "3", "null"])
def test_other_backbone_is_not_dinov2(backbone: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(f'{{"model_type": "dpt", "backbone_config": {backbone}}}')
    assert "up to scale" in find_method(f"hf:{tmp_path}").info.summary


def test_legacy_weights_and_settings_are_read(tmp_path: Path) -> None:
    """The preprocessor settings are those of a feature extractor, as written by version 4 of the library."""
    folder = save_checkpoint(tmp_path, "dpt")
    new = hf_method(str(folder)).load()(row())
    tensors = importlib.import_module("safetensors.torch").load_file(folder / "model.safetensors")
    importlib.import_module("torch").save(tensors, folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()
    settings = {**MODELS["dpt"][1], "feature_extractor_type": "DPTFeatureExtractor", "size": 32}
    del settings["image_processor_type"]
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    assert np.array_equal(hf_method(str(folder)).load()(row()), new, equal_nan=True)


def test_predict_command_runs_hf_folder(
    tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, archive = save_checkpoint(tmp_path / "pro", "depth-pro", 0.5), tmp_path / "pro.zip"
    command = ["predict", f"hf:{folder}", "--data", str(tiny_root), "--config", "lattice-orbit"]
    assert main([*command, "--out", str(archive)]) == 0, capsys.readouterr().err
    assert score(archive, tiny_root).tables["lattice-orbit"]["coverage"] == 1
    with zipfile.ZipFile(archive) as entries:
        metadata = json.loads(entries.read("submission.json"))
        with entries.open(next(name for name in entries.namelist() if name.endswith(".npy"))) as entry:
            np.testing.assert_allclose(
                np.load(entry), FX / (0.5 * W), rtol=1e-6
            )  # fx of the dataset at this image size.
    assert (metadata["inputs"], metadata["uses_ground_truth"]) == ("rgb+K", False)
    assert metadata["method"] == "hf:pro"
    assert metadata["description"].endswith("focal length given")


@pytest.mark.parametrize("kind", ["depth-anything", "glpn"])
def test_evaluation_takes_the_kind_of_the_checkpoint(folders: dict[str, Path], kind: str, tiny_root: Path) -> None:
    result = evaluate(f"hf:{folders[kind]}", tiny_root, config="lattice-orbit")
    assert result.kind == ("affine-disparity" if kind == "depth-anything" else "metric")
    table = result.tables["lattice-orbit"]
    assert math.isnan(table["aligned.abs_rel"]) == math.isfinite(table["native.abs_rel"]) == (kind == "glpn")


def drop_tensor(path: Path) -> None:
    safetensors = importlib.import_module("safetensors.torch")
    tensors = safetensors.load_file(path)
    del tensors["head.conv3.weight"]
    safetensors.save_file(tensors, path, metadata={"format": "pt"})


def write(content: bytes) -> Callable[[Path], None]:
    """Return a function that writes a file with this content."""

    def write_file(path: Path) -> None:
        path.write_bytes(content)

    return write_file


LONG_NAME = b'{"model_type": "' + b"x" * 10_000 + rb'\u001b[31m"}'


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        (
            "config.json",
            Path.unlink,
            "No such file or directory, expected a checkpoint folder as written by save_",
        ),
        ("config.json", write(b"{"), "config.json: 1 problem\n  - the text is not valid JSON"),
        ("config.json", write(b"[]"), "config.json: 1 problem\n  - got [], expected a JSON object"),
        (
            "config.json",
            write(b'{"model_type": "bert"}'),
            "model_type is 'bert', expected one of depth_anything, dep",
        ),
        ("config.json", write(b'{"model_type": ["x"]}'), "model_type is ['x'], expected one of depth_anything"),
        ("config.json", write(LONG_NAME), "model_type is 'xxxxxxxxx"),
        (
            "config.json",
            write(b'{"model_type": "prompt_depth_anything"}'),
            "(it completes measured depth, which a single image does not have)",
        ),
        ("preprocessor_config.json", Path.unlink, "preprocessor_config.json: 1 problem\n  - cannot be read: No"),
        (
            "preprocessor_config.json",
            write(b"null"),
            "preprocessor_config.json: 1 problem\n  - got None, expected a",
        ),
        ("model.safetensors", Path.unlink, "cannot be loaded: OSError: Error no file named model.safetensors"),
        ("model.safetensors", write(b"{}" * 500), "cannot be loaded: SafetensorError"),
        ("model.safetensors", drop_tensor, "the weights lack 1 of the network's tensors, first head.conv3.weight"),
    ],
)
def test_unusable_checkpoint_is_refused_with_reason(
    name: str, spoil: Callable[[Path], None], words: str, tmp_path: Path
) -> None:
    folder = save_checkpoint(tmp_path / "checkpoint", "depth-anything")
    spoil(folder / name)
    with pytest.raises(MethodError, match=re.escape(words)) as caught:
        hf_method(str(folder)).load()
    assert len(str(caught.value)) < 600
    assert all(line.isprintable() for line in str(caught.value).splitlines())


@pytest.mark.parametrize("prefix", ["hf", "depth-anything-3"])
def test_named_pipe_and_large_file_are_refused(
    prefix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model.safetensors").touch()
    (tmp_path / "config.json").write_text(f'{{"x": "{"x" * 1000}"}}')
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", "1000")
    with pytest.raises(MethodError, match=r"at most 1000 bytes|REBAR_MAX_JSON_BYTES"):
        find_method(f"{prefix}:{tmp_path}")
    (tmp_path / "config.json").unlink()
    os.mkfifo(tmp_path / "config.json")
    with pytest.raises(MethodError, match=r"named pipe|no config\.json"):
        find_method(f"{prefix}:{tmp_path}")


@pytest.mark.parametrize("package", ["torch", "transformers"])
def test_missing_package_names_extra_to_install(
    package: str, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    method = hf_method(str(folders["glpn"]))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MethodError, match=re.escape("pip install '.[models]'")):
        method.load()


def test_hub_checkpoint_is_fetched_once_then_read_from_cache(
    folders: dict[str, Path],
    hub: HubServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Weights in one format are enough, and what is in the cache is not asked for."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    files = folder_files(folders["glpn"])
    repository = hub.add("models/org/model", {**files, "pytorch_model.bin": b"the same once more"})
    method = find_method("hf:org/model")
    assert method.info.name == "hf:org/model"
    assert method.info.summary.endswith(f"weights commit {repository.branches['main']}")
    depth_m = load_predictor(method)(row())
    assert np.array_equal(depth_m, hf_method(str(folders["glpn"])).load()(row()), equal_nan=True)
    stderr = capsys.readouterr().err
    megabytes = sum(map(len, files.values())) / 1e6
    assert f"org/model: downloading config.json from {hub.url}\n" in stderr
    assert f"org/model: downloading the weights from {hub.url}\norg/model: {megabytes:.1f} MB\n" in stderr
    assert [request for request in hub.requests if "model.safetensors" in request.path]
    assert not [request for request in hub.requests if "pytorch_model.bin" in request.path]
    del hub.requests[:]
    for is_offline in (False, True):
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", is_offline)
        assert np.array_equal(load_predictor("hf:org/model")(row()), depth_m, equal_nan=True)
    assert (hub.requests, "downloading" in capsys.readouterr().err) == ([], False)
    [weights] = tmp_path.glob("cache/models--*/snapshots/*/model.safetensors")
    weights.unlink()
    with pytest.raises(MethodError, match="org/model: the weights must be downloaded, but HF_HUB_OFFLINE is set"):
        load_predictor("hf:org/model")


@pytest.mark.parametrize(
    ("name", "repository"), [("hf:org/other", "org/other"), ("depth-pro", "apple/DepthPro-hf")]
)
def test_offline_and_missing_hub_checkpoint_names_local_copy(
    name: str, repository: str, hub: HubServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = f"{repository}: config.json cannot be downloaded from {hub.url}: RepositoryNotFoundError"
    with pytest.raises(MethodError, match=words) as caught:
        find_method(name)
    assert "(and HF_TOKEN if the model is not public), or a local copy: hf" in str(caught.value)
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(
        MethodError, match=f"^{repository}: config.json must be downloaded, but HF_HUB_OFF"
    ) as caught:
        load_predictor(find_method(name))
    assert str(caught.value).endswith(f"hf:FOLDER (hf download {repository} --local-dir FOLDER)")


@pytest.mark.parametrize("name", ["no/such/folder", "./nowhere", "word", "~/nowhere", "", "a/b:c"])
def test_invalid_hf_name_raises(name: str) -> None:
    with pytest.raises(MethodError, match="is neither a folder nor the name of a model on the Hub"):
        find_method(f"hf:{name}")
