"""Monocular networks of ``transformers`` by name: real classes with random weights, through the whole way."""

from __future__ import annotations

import importlib
import json
import re
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from rebar_depth_bench import score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods import METHODS, find_method
from rebar_depth_bench.methods.huggingface.families import (
    FAMILIES,
    PREPARATIONS,
    Output,
    canonical_to_depth_m,
    depth_m,
)
from rebar_depth_bench.methods.huggingface.model import hf_method
from tests.bench.methods.predictors import loaded
from tests.bench.methods.tiny_depth_models import LAST_LAYER, MODELS, save

H, W = 90, 160
FX = 87.5
SIGMOID_2 = 1 / (1 + np.exp(-2.0))


def row(seed: int = 1, fx: float = FX) -> dict[str, Any]:
    """A picture of blurred noise, and its intrinsics."""
    coarse = np.random.default_rng(seed).integers(0, 256, (9, 16, 3), np.uint8)
    rgb = np.asarray(Image.fromarray(coarse).resize((W, H), Image.Resampling.BICUBIC))
    K = np.array([[fx, 0, (W - 1) / 2], [0, fx, (H - 1) / 2], [0, 0, 1]])
    return {"view_id": "a/0", "left_rgb": rgb, "left_K": K}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A checkpoint of each kind whose answer differs from place to place."""
    root = tmp_path_factory.mktemp("checkpoints")
    return {kind: save(root / kind, kind) for kind in MODELS}


@pytest.mark.parametrize("kind", MODELS)
def test_every_family_answers_on_the_left_grid_the_same_each_time(folders: dict[str, Path], kind: str) -> None:
    method = find_method(f"hf:{folders[kind]}")
    asked = {name: row()[name] for name in method.info.columns}
    first, second = loaded(method)(asked), loaded(method)(asked)
    assert first.shape == (H, W)
    assert first.dtype == np.float32
    assert np.array_equal(first, second, equal_nan=True)
    told = first[np.isfinite(first)]
    assert told.size > 0.3 * first.size
    assert (told > 0).all()
    assert told.std() > 1e-3 * told.mean(), "the network looks at the picture"
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
def test_a_known_output_becomes_known_metres(
    tmp_path: Path, kind: str, bias: float, changes: dict[str, Any], expected: float
) -> None:
    found = hf_method(str(save(tmp_path, kind, bias, **changes))).load()(row())
    np.testing.assert_allclose(found, np.full((H, W), expected), rtol=1e-5)


def test_depth_pros_depth_goes_with_the_focal_length(folders: dict[str, Path]) -> None:
    run = hf_method(str(folders["depth-pro"])).load()
    near, far = run(row(fx=70.0)), run(row(fx=140.0))
    free = (near > 2e-4) & (far < 9e3)  # not at the model's own bounds
    assert free.mean() > 0.3
    np.testing.assert_allclose(far[free], 2 * near[free], rtol=1e-6)


@given(st.integers(1, 40), st.floats(10, 2000), st.floats(0.3, 30))
def test_a_picture_of_any_size_gives_depth_pros_canonical_camera(width: int, fx: float, z: float) -> None:
    """A camera whose focal length is one picture width sees 1 / z itself."""
    K = np.diag([fx, fx, 1.0])
    canonical = np.full((2, width), fx / (z * width))
    np.testing.assert_allclose(canonical_to_depth_m(canonical, K), np.clip(z, 1e-4, 1e4), rtol=1e-6)
    np.testing.assert_allclose(
        canonical_to_depth_m(np.full((1, width), 1 / z), np.diag([width, 1.0, 1.0])), z, rtol=1e-6
    )


def test_no_answer_is_nan_whatever_the_network_puts_out() -> None:
    values = np.array([[np.nan, np.inf, -np.inf, -1, 0, 1e-45, 2]], np.float32)
    inverse, metres = (depth_m(output, values) for output in (Output.INVERSE, Output.METRES))
    assert np.isfinite(inverse).tolist() == [[False] * 6 + [True]]
    assert inverse[0, -1] == 0.5
    assert np.isfinite(metres).tolist() == [[False] * 5 + [True, True]]


@pytest.mark.parametrize("kind", ["depth-anything", "dpt", "glpn"])
def test_the_answer_is_that_of_the_librarys_own_pipeline(folders: dict[str, Path], kind: str) -> None:
    transformers = importlib.import_module("transformers")
    processor = transformers.AutoImageProcessor.from_pretrained(folders[kind], backend="pil")
    pipe = transformers.pipeline("depth-estimation", model=str(folders[kind]), image_processor=processor)
    theirs = pipe(Image.fromarray(row()["left_rgb"]))["predicted_depth"].numpy()
    method = hf_method(str(folders[kind]))
    ours = method.load()(row())
    if "up to scale" in method.info.summary:
        theirs = np.where(theirs > 0, 1 / theirs, np.nan)
    np.testing.assert_allclose(ours, np.where(theirs > 0, theirs, np.nan), rtol=1e-5)


def test_depth_pros_picture_is_that_of_pillow() -> None:
    """Enlarged, Pillow's bilinear filter is the same interpolation; of each value 2 v / 255 - 1."""
    settings = {**MODELS["depth-pro"][1], "size": {"height": 128, "width": 192}}
    rgb = row()["left_rgb"]
    found = PREPARATIONS["depth_pro"](settings, None).pixels(rgb).numpy()
    assert found.shape == (1, 3, 128, 192)
    for channel in range(3):
        plane = Image.fromarray(rgb[..., channel].astype(np.float32))
        expected = np.asarray(plane.resize((192, 128), Image.Resampling.BILINEAR)) * 2 / 255 - 1
        np.testing.assert_allclose(found[0, channel], expected, atol=2e-5)


@pytest.mark.parametrize("kind", [kind for kind in MODELS if kind != "depth-pro"])
def test_what_the_network_sees_at_a_pixel_lies_there_again(folders: dict[str, Path], kind: str) -> None:
    """A ramp of columns and one of rows, as pictures and straight back as answers: every pixel at its place."""
    transformers = importlib.import_module("transformers")
    processor = transformers.AutoImageProcessor.from_pretrained(folders[kind], backend="pil")
    model_type = json.loads((folders[kind] / "config.json").read_text())["model_type"]
    prepare = PREPARATIONS[model_type](MODELS[kind][1], processor)
    rows, columns = np.mgrid[:H, :W]
    rgb = np.stack([rows, columns, np.zeros_like(rows)], axis=-1).astype(np.uint8)
    mean, std = (
        np.asarray(MODELS[kind][1].get(f"image_{name}", [x] * 3)) for name, x in (("mean", 0), ("std", 1))
    )
    for channel, expected in ((0, rows), (1, columns)):
        seen = prepare.pixels(rgb)[0, channel]
        back = prepare.on_left_grid(seen, (H, W)).numpy() * std[channel] + mean[channel]
        inner = np.s_[12:-12, 12:-12]
        np.testing.assert_allclose(255 * back[inner], expected[inner], atol=1.5)


def test_whatever_is_up_to_scale_says_so(tmp_path: Path, folders: dict[str, Path]) -> None:
    metric = save(tmp_path / "metric", "depth-anything", depth_estimation_type="metric")
    summaries = {kind: hf_method(str(folder)).info.summary for kind, folder in folders.items()}
    assert {kind for kind, text in summaries.items() if "up to scale" in text} == {"depth-anything", "dpt"}
    assert "metres" in hf_method(str(metric)).info.summary
    assert {kind for kind, folder in folders.items() if hf_method(str(folder)).info.uses_intrinsics} == {
        "depth-pro"
    }


def test_weights_of_the_older_kind_are_read(tmp_path: Path) -> None:
    """And settings as the library wrote them in its version 4: a feature extractor's."""
    folder = save(tmp_path, "dpt")
    new = hf_method(str(folder)).load()(row())
    tensors = importlib.import_module("safetensors.torch").load_file(folder / "model.safetensors")
    importlib.import_module("torch").save(tensors, folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()
    settings = {**MODELS["dpt"][1], "feature_extractor_type": "DPTFeatureExtractor", "size": 32}
    del settings["image_processor_type"]
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    assert np.array_equal(hf_method(str(folder)).load()(row()), new, equal_nan=True)


def test_other_weights_are_another_method(tmp_path: Path) -> None:
    """An interrupted prediction is not continued with other weights under the same name."""
    told = [hf_method(str(save(tmp_path, "glpn", bias))).info for bias in (1.0, 2.0, 2.0)]
    assert told[0] != told[1]
    assert told[1] == told[2]


def test_predicted_from_the_command_line(
    tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, archive = save(tmp_path / "pro", "depth-pro", 0.5), tmp_path / "pro.zip"
    command = ["predict", f"hf:{folder}", "--data", str(tiny_root), "--config", "lattice-orbit"]
    assert main([*command, "--out", str(archive)]) == 0, capsys.readouterr().err
    assert score(archive, tiny_root).tables["lattice-orbit"].coverage == 1
    with zipfile.ZipFile(archive) as entries:
        told = json.loads(entries.read("submission.json"))
        with entries.open(next(name for name in entries.namelist() if name.endswith(".npy"))) as entry:
            np.testing.assert_allclose(np.load(entry), FX / (0.5 * W), rtol=1e-6)  # the contract's fx at this size
    assert told["uses_intrinsics"] is True
    assert told["method"] == "hf:pro"
    assert re.search(r"focal length given; weights sha256:[0-9a-f]{64}$", told["description"])


def break_config(folder: Path) -> None:
    (folder / "config.json").write_text("{")


def of_another_kind(folder: Path) -> None:
    (folder / "config.json").write_text('{"model_type": "bert"}')


def asking_for_measured_depth(folder: Path) -> None:
    (folder / "config.json").write_text('{"model_type": "prompt_depth_anything"}')


def without(name: str) -> Any:
    return lambda folder: (folder / name).unlink()


def damaged(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:1000])


def lacking_a_tensor(folder: Path) -> None:
    load_file = importlib.import_module("safetensors.torch").load_file
    tensors = load_file(folder / "model.safetensors")
    del tensors["head.conv3.weight"]
    importlib.import_module("safetensors.torch").save_file(
        tensors, folder / "model.safetensors", metadata={"format": "pt"}
    )


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (without("config.json"), "no config.json, expected a checkpoint's folder"),
        (break_config, "config.json: cannot be read"),
        (of_another_kind, "model_type is 'bert', expected one of depth_anything, depth_pro, dpt, glpn, zoedepth"),
        (asking_for_measured_depth, "(it completes measured depth, which a single picture does not bring)"),
        (without("preprocessor_config.json"), "no preprocessor_config.json"),
        (without("model.safetensors"), "no weights, expected *.safetensors or *.bin beside config.json"),
        (damaged, "cannot be loaded: SafetensorError"),
        (lacking_a_tensor, "the weights lack 1 of the network's tensors, first head.conv3.weight"),
    ],
)
def test_what_cannot_be_run_is_said_in_words(tmp_path: Path, spoil: Any, words: str) -> None:
    folder = save(tmp_path / "checkpoint", "depth-anything")
    spoil(folder)
    with pytest.raises(MethodError, match=re.escape(words)):
        hf_method(str(folder)).load()


@pytest.mark.parametrize("package", ["torch", "transformers"])
def test_a_missing_package_is_named(
    package: str, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    method = hf_method(str(folders["glpn"]))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MethodError, match=re.escape("pip install 'rebar-depth-bench[models]'")):
        method.load()


@pytest.mark.parametrize("name", ["no/such/folder", "./nowhere", "word", "~/nowhere", "", "a/b:c"])
def test_a_name_that_is_neither_folder_nor_model_is_refused(name: str) -> None:
    with pytest.raises(MethodError, match="no such folder, and no name of a model on the Hub"):
        find_method(f"hf:{name}")


def test_families_are_all_tried_here() -> None:
    assert set(FAMILIES) == set(PREPARATIONS)
    assert set(FAMILIES) <= {kind.replace("-", "_") for kind in MODELS}
    assert set(LAST_LAYER) <= set(MODELS)
    assert METHODS["depth-pro"].info.uses_intrinsics
