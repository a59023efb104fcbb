"""Monocular depth networks of ``transformers``: the real classes with random weights, end to end."""

from __future__ import annotations

import importlib
import json
import re
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from rebar_depth_bench import score
from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import METHODS, find_method
from rebar_depth_bench.methods.transformers import (
    FAMILIES,
    OutputKind,
    depth_pro_preprocessing,
    hf_method,
    network_output_to_depth_m,
    to_left_grid,
)
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.tiny_depth_models import LAST_LAYER, MODELS, save_checkpoint

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
    assert first.shape == (H, W)
    assert first.dtype == np.float32
    assert np.array_equal(first, second, equal_nan=True)
    known = first[np.isfinite(first)]
    assert known.size > 0.3 * first.size
    assert (known > 0).all()
    assert known.std() > 1e-3 * known.mean(), "the network looks at the picture"
    assert method.info.name == f"hf:{kind}"
    assert str(folders[kind]) not in json.dumps(vars(method.info))


@pytest.mark.parametrize(
    ("kind", "bias", "changes", "expected"),
    [
        ("depth-anything", 2.0, {"depth_estimation_type": "metric", "max_depth": 20}, 20 * SIGMOID_2),
        ("depth-anything", 2.0, {}, 1 / 2.0),
        ("depth-anything", -1.0, {}, np.nan),
        ("dpt", 4.0, {}, 1 / 4.0),
        ("dpt-dinov2", 4.0, {}, 4.0),
        ("glpn", 2.0, {"max_depth": 80}, 80 * SIGMOID_2),
        ("depth-pro", 0.25, {}, FX / (0.25 * W)),
        ("depth-pro", -1.0, {}, 1e4),
    ],
)
def test_known_output_becomes_expected_metres(
    tmp_path: Path, kind: str, bias: float, changes: dict[str, Any], expected: float
) -> None:
    depth_m = hf_method(str(save_checkpoint(tmp_path, kind, bias, **changes))).load()(row())
    np.testing.assert_allclose(depth_m, np.full((H, W), expected), rtol=1e-5)


def test_depth_pro_depth_scales_with_focal_length(folders: dict[str, Path]) -> None:
    predictor = hf_method(str(folders["depth-pro"])).load()
    near, far = predictor(row(fx=70.0)), predictor(row(fx=140.0))
    unclipped = (near > 2e-4) & (far < 9e3)  # Exclude depths clipped to the model's bounds.
    assert unclipped.mean() > 0.3
    np.testing.assert_allclose(far[unclipped], 2 * near[unclipped], rtol=1e-6)


@given(st.integers(1, 40), st.floats(10, 2000), st.floats(0.3, 30))
def test_canonical_output_to_depth_at_any_image_width(width: int, fx: float, z: float) -> None:
    """The canonical output equals 1 / z for a camera whose focal length is one image width."""
    K = np.diag([fx, fx, 1.0])
    canonical = np.full((2, width), fx / (z * width))
    depth_m = network_output_to_depth_m(OutputKind.CANONICAL, canonical, K)
    np.testing.assert_allclose(depth_m, np.clip(z, 1e-4, 1e4), rtol=1e-6)
    canonical, K = np.full((1, width), 1 / z), np.diag([width, 1.0, 1.0])
    np.testing.assert_allclose(network_output_to_depth_m(OutputKind.CANONICAL, canonical, K), z, rtol=1e-6)


def test_invalid_network_output_is_nan() -> None:
    values = np.array([[np.nan, np.inf, -np.inf, -1, 0, 1e-45, 2]], np.float32)
    inverse, metres = (
        network_output_to_depth_m(output, values) for output in (OutputKind.INVERSE, OutputKind.METRES)
    )
    assert np.isfinite(inverse).tolist() == [[False] * 6 + [True]]
    assert inverse[0, -1] == 0.5
    assert np.isfinite(metres).tolist() == [[False] * 5 + [True, True]]


@pytest.mark.parametrize("kind", ["depth-anything", "dpt", "dpt-dinov2", "glpn"])
def test_depth_matches_transformers_pipeline(folders: dict[str, Path], kind: str) -> None:
    transformers = importlib.import_module("transformers")
    processor = transformers.AutoImageProcessor.from_pretrained(folders[kind], backend="pil")
    pipe = transformers.pipeline("depth-estimation", model=str(folders[kind]), image_processor=processor)
    theirs = pipe(Image.fromarray(row()["left_rgb"]))["predicted_depth"].numpy()
    method = hf_method(str(folders[kind]))
    ours = method.load()(row())
    if "up to scale" in method.info.summary:
        theirs = np.where(theirs > 0, 1 / theirs, np.nan)
    np.testing.assert_allclose(ours, np.where(theirs > 0, theirs, np.nan), rtol=1e-5)


def test_depth_pro_input_matches_pillow() -> None:
    """For enlargement Pillow's bilinear filter is the same interpolation; values become 2 v / 255 - 1."""
    settings = {**MODELS["depth-pro"][1], "size": {"height": 128, "width": 192}}
    rgb = row()["left_rgb"]
    network_input = depth_pro_preprocessing(settings)(rgb).numpy()
    assert network_input.shape == (1, 3, 128, 192)
    for channel in range(3):
        plane = Image.fromarray(rgb[..., channel].astype(np.float32))
        expected = np.asarray(plane.resize((192, 128), Image.Resampling.BILINEAR)) * 2 / 255 - 1
        np.testing.assert_allclose(network_input[0, channel], expected, atol=2e-5)


@pytest.mark.parametrize("kind", ["depth-anything", "dpt", "glpn", "zoedepth"])
def test_preprocessing_round_trip_keeps_pixel_positions(folders: dict[str, Path], kind: str) -> None:
    """Ramps over rows and columns, passed through pre- and postprocessing only, keep every pixel in place."""
    transformers = importlib.import_module("transformers")
    processor = transformers.AutoImageProcessor.from_pretrained(folders[kind], backend="pil")
    model_type = json.loads((folders[kind] / "config.json").read_text())["model_type"]
    rows, columns = np.mgrid[:H, :W]
    rgb = np.stack([rows, columns, np.zeros_like(rows)], axis=-1).astype(np.uint8)
    pixels = processor(images=rgb, return_tensors="pt", input_data_format="channels_last").pixel_values.float()
    mean, std = (
        np.asarray(MODELS[kind][1].get(f"image_{name}", [x] * 3)) for name, x in (("mean", 0), ("std", 1))
    )
    for channel, expected in ((0, rows), (1, columns)):
        network_output = SimpleNamespace(predicted_depth=pixels[:, channel])
        on_left_grid = to_left_grid(model_type, processor, network_output, (H, W)).numpy()
        restored = on_left_grid * std[channel] + mean[channel]
        inner = np.s_[12:-12, 12:-12]
        np.testing.assert_allclose(255 * restored[inner], expected[inner], atol=1.5)


def test_summary_states_scale_ambiguity(tmp_path: Path, folders: dict[str, Path]) -> None:
    metric = save_checkpoint(tmp_path / "metric", "depth-anything", depth_estimation_type="metric")
    summaries = {kind: hf_method(str(folder)).info.summary for kind, folder in folders.items()}
    assert {kind for kind, text in summaries.items() if "up to scale" in text} == {"depth-anything", "dpt"}
    assert "metres" in hf_method(str(metric)).info.summary
    assert {kind for kind, folder in folders.items() if hf_method(str(folder)).info.uses_intrinsics} == {
        "depth-pro"
    }


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


def test_other_weights_give_different_method_info(tmp_path: Path) -> None:
    """An interrupted prediction is not continued with other weights under the same name."""
    infos = [hf_method(str(save_checkpoint(tmp_path, "glpn", bias))).info for bias in (1.0, 2.0, 2.0)]
    assert infos[0] != infos[1]
    assert infos[1] == infos[2]


def test_predict_command_runs_hf_folder(
    tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, archive = save_checkpoint(tmp_path / "pro", "depth-pro", 0.5), tmp_path / "pro.zip"
    command = ["predict", f"hf:{folder}", "--data", str(tiny_root), "--config", "lattice-orbit"]
    assert main([*command, "--out", str(archive)]) == 0, capsys.readouterr().err
    assert score(archive, tiny_root).tables["lattice-orbit"].coverage == 1
    with zipfile.ZipFile(archive) as entries:
        metadata = json.loads(entries.read("submission.json"))
        with entries.open(next(name for name in entries.namelist() if name.endswith(".npy"))) as entry:
            np.testing.assert_allclose(
                np.load(entry), FX / (0.5 * W), rtol=1e-6
            )  # fx of the dataset at this image size.
    assert (metadata["inputs"], metadata["uses_ground_truth"]) == ("rgb+K", False)
    assert metadata["method"] == "hf:pro"
    assert re.search(r"focal length given; weights sha256:[0-9a-f]{64}$", metadata["description"])


def break_config(folder: Path) -> None:
    (folder / "config.json").write_text("{")


def set_unsupported_type(folder: Path) -> None:
    (folder / "config.json").write_text('{"model_type": "bert"}')


def set_depth_completion_type(folder: Path) -> None:
    (folder / "config.json").write_text('{"model_type": "prompt_depth_anything"}')


def delete_file(name: str) -> Any:
    return lambda folder: (folder / name).unlink()


def truncate_weights(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:1000])


def drop_tensor(folder: Path) -> None:
    load_file = importlib.import_module("safetensors.torch").load_file
    tensors = load_file(folder / "model.safetensors")
    del tensors["head.conv3.weight"]
    importlib.import_module("safetensors.torch").save_file(
        tensors, folder / "model.safetensors", metadata={"format": "pt"}
    )


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (delete_file("config.json"), "no config.json, expected a checkpoint folder"),
        (break_config, "config.json: 1 problem\n  - the text is not valid JSON"),
        (
            set_unsupported_type,
            "model_type is 'bert', expected one of depth_anything, depth_pro, dpt, glpn, zoedepth",
        ),
        (set_depth_completion_type, "(it completes measured depth, which a single image does not have)"),
        (delete_file("preprocessor_config.json"), "no preprocessor_config.json"),
        (delete_file("model.safetensors"), "no weights, expected *.safetensors or *.bin beside config.json"),
        (truncate_weights, "cannot be loaded: SafetensorError"),
        (drop_tensor, "the weights lack 1 of the network's tensors, first head.conv3.weight"),
    ],
)
def test_unusable_checkpoint_raises_with_reason(tmp_path: Path, spoil: Any, words: str) -> None:
    folder = save_checkpoint(tmp_path / "checkpoint", "depth-anything")
    spoil(folder)
    with pytest.raises(MethodError, match=re.escape(words)):
        hf_method(str(folder)).load()


@pytest.mark.parametrize("package", ["torch", "transformers"])
def test_missing_package_names_extra_to_install(
    package: str, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    method = hf_method(str(folders["glpn"]))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MethodError, match=re.escape("pip install 'rebar-depth-bench[models]'")):
        method.load()


@pytest.mark.parametrize("name", ["no/such/folder", "./nowhere", "word", "~/nowhere", "", "a/b:c"])
def test_invalid_hf_name_raises(name: str) -> None:
    with pytest.raises(MethodError, match="is neither a folder nor the name of a model on the Hub"):
        find_method(f"hf:{name}")


def test_all_families_are_covered() -> None:
    assert set(FAMILIES) <= {kind.replace("-", "_") for kind in MODELS}
    assert set(LAST_LAYER) <= set(MODELS)
    assert METHODS["depth-pro"].info.uses_intrinsics
