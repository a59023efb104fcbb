"""Errors of the paper's networks, tested with stand-ins: missing packages, invalid weights, failed downloads."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.registry import FROM_FOLDER
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_views import BUILDERS, find_stand_in, select_columns, stereo_row


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[Path]:
    """Make the stand-in packages importable during a test."""
    with stand_ins.stand_in_packages(tmp_path / "site") as folder:
        yield folder


@pytest.mark.parametrize(
    ("name", "module", "words"),
    [
        ("unidepth", "unidepth", "pip install 'unidepth @ git+https://github.com/lpiccinelli-eth/UniDepth'"),
        ("depth-anything-3", "depth_anything_3", "pip install depth-anything-3 addict"),
        ("metric3d", "cv2", "pip install 'rebar-depth-bench[methods]'"),
        ("foundation-stereo", "cv2", "pip install 'rebar-depth-bench[methods]'"),
        *((name, "torch", "pip install 'rebar-depth-bench[torch]'") for name in FROM_FOLDER),
    ],
)
def test_missing_package_names_install_command(
    name: str, module: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = find_stand_in(name, tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MethodError, match=f"{name} needs {module} .*{re.escape(words)}"):
        method.load()


@pytest.mark.parametrize("name", FROM_FOLDER)
def test_weights_of_other_network_raise(name: str, tmp_path: Path) -> None:
    with pytest.raises(
        MethodError, match=r"weights cover 0.00% of the network, 1 tensors are missing, first gain|Missing"
    ):
        find_stand_in(name, tmp_path, other=1.0).load()


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("metric3d", "hubconf.py", "no hubconf.py in it"),
        ("metric3d", "metric_depth_vit_small_800k.pth", "expected the file of https://huggingface.co/JUGGHM/"),
        (
            "unidepth",
            "model.safetensors",
            "no model.safetensors in it, expected config.json and model.safetensors",
        ),
        ("depth-anything-3", "config.json", "no config.json in it"),
        ("foundation-stereo", "core/foundation_stereo.py", "no clone of FoundationStereo with core/foundation_"),
        ("foundation-stereo", "pretrained_models/23-51-11/cfg.yaml", "no cfg.yaml in"),
    ],
)
def test_folder_with_missing_file_raises(name: str, spoil: str, words: str, tmp_path: Path) -> None:
    folder = BUILDERS[name](tmp_path / "theirs")
    (folder / spoil).unlink()
    with pytest.raises(MethodError, match=re.escape(words)):
        find_method(f"{name}:{folder}")
    with pytest.raises(MethodError, match=r"no such folder|no clone of FoundationStereo"):
        find_method(f"{name}:{tmp_path / 'nowhere'}")


@pytest.mark.parametrize("name", FROM_FOLDER)
def test_damaged_checkpoint_raises(name: str, tmp_path: Path) -> None:
    folder = BUILDERS[name](tmp_path / "theirs")
    [weights] = [*folder.rglob("*.pth"), *folder.rglob("*.safetensors")]
    weights.write_bytes(b"no checkpoint")
    with pytest.raises(MethodError, match=r"cannot be (loaded|read)"):
        load_predictor(f"{name}:{folder}")


@pytest.mark.parametrize("config", ['{"model_name": "da3-large"}', "{}", "[]", "{"])
def test_other_da3_model_raises(config: str, tmp_path: Path) -> None:
    folder = stand_ins.da3_weights(tmp_path / "theirs")
    (folder / "config.json").write_text(config)
    with pytest.raises(
        MethodError, match=r"expected 'da3metric-large', the paper's network|config.json: 1 problem"
    ):
        find_method(f"depth-anything-3:{folder}")


@pytest.mark.parametrize("encoder", ["dinov2_vits14", ["dinov2_vitl14"]])
def test_other_unidepth_encoder_raises(encoder: Any, tmp_path: Path) -> None:
    folder = stand_ins.unidepth_weights(tmp_path / "theirs", encoder=encoder)
    with pytest.raises(MethodError, match=r"pixel_encoder.name in config.json is .*, expected 'dinov2_vitl14'"):
        find_method(f"unidepth:{folder}")


def test_cuda_only_code_raises_without_gpu(tmp_path: Path) -> None:
    if importlib.import_module("torch").cuda.is_available():
        pytest.skip("there is a GPU")
    folder = stand_ins.metric3d_clone(tmp_path / "theirs")
    code = (folder / "hubconf.py").read_text()
    (folder / "hubconf.py").write_text(code.replace("print(", 'torch.linspace(0, 1, 2, device="cuda"); print('))
    predictor = load_predictor(f"metric3d:{folder}")
    with pytest.raises(MethodError, match=r"metric3d: .* requires a CUDA GPU, and torch finds none"):
        predictor(select_columns("metric3d", stereo_row()))


@pytest.mark.parametrize(
    ("name", "code"), [("metric3d", "hubconf.py"), ("foundation-stereo", "core/foundation_stereo.py")]
)
def test_missing_import_of_model_code_is_named(name: str, code: str, tmp_path: Path) -> None:
    folder = BUILDERS[name](tmp_path / "theirs")
    text = (folder / code).read_text()
    (folder / code).write_text(text.replace("import torch", "import torch, no_such_mmcv", 1))
    with pytest.raises(
        MethodError, match=r"No module named 'no_such_mmcv'; to install what its code imports: pip install "
    ):
        load_predictor(f"{name}:{folder}")


@pytest.mark.parametrize(
    ("name", "code", "old", "new", "words"),
    [
        ("metric3d", "theirs/hubconf.py", "self.gain * red", "red[..., ::2]", r"(616, 532), expected (616, 1064)"),
        (
            "unidepth",
            "site/unidepth/models.py",
            "* rgb[None, :1]",
            "* rgb[None, :1, 1:]",
            "(1, 1, 89, 160), expec",
        ),
        (
            "depth-anything-3",
            "site/depth_anything_3/api.py",
            "red[None]",
            "red",
            "(280, 504), expected (1, 280, 504)",
        ),
    ],
)
def test_output_of_wrong_shape_raises(
    name: str, code: str, old: str, new: str, words: str, tmp_path: Path
) -> None:
    method = find_stand_in(name, tmp_path)
    text = (tmp_path / code).read_text()
    assert old in text
    (tmp_path / code).write_text(text.replace(old, new))
    with pytest.raises(MethodError, match=re.escape(f"depth of shape {words}")):
        method.load()(select_columns(name, stereo_row()))


def test_foreign_core_package_raises(tmp_path: Path, site: Path) -> None:
    (site / "core").mkdir()
    (site / "core" / "foundation_stereo.py").write_text("FoundationStereo = None\n")
    importlib.import_module("core.foundation_stereo")
    with pytest.raises(MethodError, match=r"core is already imported from .*, expected it from"):
        find_stand_in("foundation-stereo", tmp_path).load()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("unidepth", "must be downloaded, but HF_HUB_OFFLINE is set: .* pass their folder: unidepth:FOLDER"),
        ("depth-anything-3", "depth-anything/DA3METRIC-LARGE: .* HF_HUB_OFFLINE .*: depth-anything-3:FOLDER"),
        ("metric3d", "metric3d: its code, which is then executed, must be downloaded, but HF_HUB_"),
        (
            "foundation-stereo",
            "Google Drive .*: git clone https://github.com/NVlabs/FoundationStereo, put the folder",
        ),
    ],
)
def test_bare_name_offline_raises(name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    with pytest.raises(MethodError, match=words):
        load_predictor(name)
