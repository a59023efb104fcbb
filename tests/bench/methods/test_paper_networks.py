"""The paper's networks with stand-ins: units, resizing and back, names of weights, and missing parts."""

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

import cv2
import numpy as np
from huggingface_hub import constants

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import METHODS, Predictor, find_method
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_models import BUILDERS, FX, FY, GAIN, stereo_row

pytestmark = pytest.mark.slow  # torch takes seconds to import
torch: Any = importlib.import_module("torch")

H, W = 90, 160
DA3_FOCAL_PX = (FX * 504 / W + FY * 280 / H) / 2
METRES_OF_RED = {
    "depth-anything-3": GAIN * DA3_FOCAL_PX / 300,
    "metric3d": GAIN * FX * 6.65 / 1000,
    "unidepth": GAIN,
}
"""Depth in metres per step of the red channel.

The 160 x 90 image is resized to 504 x 280 for Depth Anything 3 and enlarged by 6.65 for Metric3D.
"""
RATIO_FOR_TWICE_FX = {
    "depth-anything-3": (2 * FX * 504 / W + FY * 280 / H) / (2 * DA3_FOCAL_PX),
    "metric3d": 2.0,
    "unidepth": 1.0,
}
COMMITS = ("0123456789abcdef0123456789abcdef01234567", "89abcdef0123456789abcdef0123456789abcdef")


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[Path]:
    """Make the stand-in packages importable during a test."""
    with stand_ins.stand_in_packages(tmp_path / "site") as folder:
        yield folder


def load_stand_in(name: str, folder: Path) -> Predictor:
    """Return the predictor of a stand-in with the columns that its method reads."""
    predictor = load_predictor(f"{name}:{BUILDERS[name](folder / 'theirs')}")
    return lambda row: predictor({column: row[column] for column in METHODS[name].info.columns})


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_depth_is_in_metres_and_aligned_with_the_image(name: str, tmp_path: Path) -> None:
    """Ramps over columns and rows would reveal a shifted, flipped or wrongly cropped image."""
    predictor = load_stand_in(name, tmp_path)
    inner = np.s_[3:-3, 3:-3]
    for ramp in np.mgrid[:H, :W] + 20:
        depth_m = predictor(stereo_row(ramp))
        assert (depth_m.shape, depth_m.dtype) == ((H, W), np.float32)
        red_seen = depth_m / METRES_OF_RED[name]
        np.testing.assert_allclose(red_seen[inner], ramp[inner], atol=0.7)
        assert np.abs(np.mean(red_seen[inner] - ramp[inner])) < 0.3
    torch.manual_seed(7)
    assert np.array_equal(depth_m, predictor(stereo_row(ramp))), "whatever else draws random numbers"
    np.testing.assert_allclose(predictor(stereo_row(np.full((H, W), 200))), 200 * METRES_OF_RED[name], rtol=3e-3)


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_depth_scales_with_fx_where_intrinsics_are_used(name: str, tmp_path: Path) -> None:
    predictor, red = load_stand_in(name, tmp_path), np.full((H, W), 200)
    ratio = predictor(stereo_row(red, fx=2 * FX)) / predictor(stereo_row(red))
    np.testing.assert_allclose(ratio, RATIO_FOR_TWICE_FX[name], rtol=1e-6)
    assert METHODS[name].info.uses_intrinsics == ("left_K" in METHODS[name].info.columns) == (name != "unidepth")


@pytest.mark.parametrize("name", METRES_OF_RED)
def test_zero_output_gives_nan(name: str, tmp_path: Path) -> None:
    depth_m = load_stand_in(name, tmp_path)(stereo_row(np.full((H, W), 200) * (np.arange(W) >= 40)))
    assert np.isnan(depth_m[:, :36]).all()
    assert np.isfinite(depth_m[:, 44:]).all()


@pytest.mark.parametrize("grid", [(H, W), (720, 1280), (91, 160), (1001, 334)])
def test_metric3d_input_is_that_of_the_authors_code(grid: tuple[int, int], tmp_path: Path) -> None:
    """The reference follows the main part of ``hubconf.py`` step by step, with OpenCV and torch."""
    code = stand_ins.metric3d_clone(tmp_path / "theirs") / "hubconf.py"
    given = f"torch.save(pixels, {str(tmp_path / 'input.pt')!r}); red ="
    code.write_text(code.read_text().replace("red =", given, 1))
    row = stereo_row(np.zeros(grid))
    load_predictor(f"metric3d:{tmp_path / 'theirs'}")(row)
    scale = min(616 / grid[0], 1064 / grid[1])
    size = (int(grid[1] * scale), int(grid[0] * scale))
    resized = cv2.resize(row["left_rgb"], size, interpolation=cv2.INTER_LINEAR)
    rows, columns = 616 - resized.shape[0], 1064 - resized.shape[1]
    margins = (rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)
    mean, std = [123.675, 116.28, 103.53], [58.395, 57.12, 57.375]
    padded = cv2.copyMakeBorder(resized, *margins, cv2.BORDER_CONSTANT, value=mean)
    mean_tensor, std_tensor = (torch.tensor(values).float()[:, None, None] for values in (mean, std))
    expected = torch.div(torch.from_numpy(padded.transpose((2, 0, 1))).float() - mean_tensor, std_tensor)
    assert torch.equal(torch.load(tmp_path / "input.pt"), expected[None])


def test_metric3d_depth_is_at_most_300_m(tmp_path: Path) -> None:
    predictor = load_predictor(f"metric3d:{stand_ins.metric3d_clone(tmp_path / 'theirs', gain=1e4)}")
    assert (predictor(stereo_row(np.full((H, W), 200))) == 300).all()


@pytest.mark.parametrize(
    ("name", "file", "right", "wrong"),
    [
        ("depth-anything-3", "site/depth_anything_3/api.py", "np.float32)[None]", "np.float32)"),
        ("metric3d", "theirs/hubconf.py", "self.gain * red", "red[..., ::2]"),
        ("unidepth", "site/unidepth/models.py", "rgb[None, :1]", "rgb[None, :1, 1:]"),
    ],
)
def test_output_of_wrong_shape_is_refused(name: str, file: str, right: str, wrong: str, tmp_path: Path) -> None:
    folder, code = BUILDERS[name](tmp_path / "theirs"), tmp_path / file
    assert right in code.read_text()
    code.write_text(code.read_text().replace(right, wrong))
    with pytest.raises(MethodError, match=rf"^{name}: .*depth of shape \(.*\), expected \("):
        load_predictor(f"{name}:{folder}")(stereo_row(np.full((H, W), 200)))


@pytest.mark.parametrize("name", BUILDERS)
def test_folder_of_the_weights_is_in_the_name(name: str, tmp_path: Path) -> None:
    info = find_method(f"{name}:{BUILDERS[name](tmp_path / 'theirs')}").info
    assert info.name == f"{name}:{'23-51-11' if name == 'foundation-stereo' else 'theirs'}"
    assert info.columns == METHODS[name].info.columns
    assert info.summary.endswith("as in the paper")
    assert str(tmp_path) not in repr(info)


@pytest.fixture
def hub_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Point the Hub client and torch.hub at empty caches and return the Hub's folder."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    return tmp_path / "hub"


def add_to_hub_cache(name: str, repository: Path, commit: str, gain: float = GAIN) -> Path:
    """Add a commit to a repository in the Hub cache as its main branch and return the snapshot's folder."""
    folder = BUILDERS[name](repository / "snapshots" / commit, gain=gain)
    (repository / "refs").mkdir(exist_ok=True)
    (repository / "refs" / "main").write_text(commit)
    return folder


def test_cached_weights_are_used_and_their_commit_is_reported(hub_cache: Path) -> None:
    """A moved main branch gives a different method and does not change one that was found before."""
    repository, row = hub_cache / "models--lpiccinelli--unidepth-v2-vitl14", stereo_row(np.full((H, W), 200))
    add_to_hub_cache("unidepth", repository, COMMITS[0])
    first = find_method("unidepth")
    folder = add_to_hub_cache("unidepth", repository, COMMITS[1], gain=2 * GAIN)
    second = find_method("unidepth")
    for method, commit in ((first, COMMITS[0]), (second, COMMITS[1])):
        assert method.info.name == "unidepth"
        assert method.info.summary.endswith(f"as in the paper; weights commit {commit}")
    found, listed = load_predictor(second)(row), load_predictor(METHODS["unidepth"])(row)
    np.testing.assert_allclose(found / load_predictor(first)(row), 2, rtol=1e-6)
    np.testing.assert_array_equal(listed, found)
    (folder / "config.json").write_text('{"model": {"pixel_encoder": {"name": ["dinov2_vitl14"]}}}')
    with pytest.raises(MethodError, match=r"pixel_encoder.name in config.json is .*, expected 'dinov2_vitl14'"):
        find_method("unidepth")


def test_metric3d_of_the_caches_reports_the_commit_of_its_weights(
    hub_cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = stand_ins.metric3d_clone(tmp_path / "torch" / "hub" / "yvanyin_metric3d_main")
    (code / "metric_depth_vit_small_800k.pth").unlink()
    add_to_hub_cache("metric3d", hub_cache / "models--JUGGHM--Metric3D", COMMITS[0])
    found = find_method("metric3d")
    assert found.info.name == "metric3d"
    assert found.info.summary.endswith(f"as in the paper; weights commit {COMMITS[0]}")
    depth_m = load_predictor(found)(stereo_row(np.full((H, W), 200)))
    np.testing.assert_allclose(depth_m, 200 * METRES_OF_RED["metric3d"], rtol=3e-3)
    assert "downloading" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "module", "words"),
    [
        ("unidepth", "unidepth", "pip install 'unidepth @ git+https://github.com/lpiccinelli-eth/UniDepth'"),
        ("depth-anything-3", "depth_anything_3", "pip install depth-anything-3 addict"),
        ("metric3d", "cv2", "pip install '.[methods]'"),
        ("foundation-stereo", "cv2", "pip install '.[methods]'"),
        *((name, "torch", "pip install '.[torch]'") for name in BUILDERS),
    ],
)
def test_missing_package_names_install_command(
    name: str, module: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = find_method(f"{name}:{BUILDERS[name](tmp_path / 'theirs')}")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MethodError, match=f"{name} needs {module} .*{re.escape(words)}"):
        load_predictor(method)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("unidepth", "must be downloaded, but HF_HUB_OFFLINE is set: .* pass their folder: unidepth:FOLDER"),
        (
            "depth-anything-3",
            "depth-anything-3 needs depth_anything_3, which is not installed: pip install depth-",
        ),
        ("metric3d", "metric3d: its code, which is then executed, must be downloaded, but HF_HUB_"),
        ("foundation-stereo", "Google Drive .*: git clone https://github.com/NVlabs/FoundationStereo, put the f"),
    ],
)
def test_bare_name_without_cache_or_package_is_refused(
    name: str, words: str, hub_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "depth-anything-3":
        monkeypatch.setitem(sys.modules, "depth_anything_3", None)
    with pytest.raises(MethodError, match=words):
        load_predictor(name)


@pytest.mark.parametrize("name", ["foundation-stereo", "metric3d", "unidepth"])
def test_damaged_or_other_weights_are_refused(name: str, tmp_path: Path) -> None:
    folder = BUILDERS[name](tmp_path / "theirs", key="other")
    with pytest.raises(MethodError, match=r"weights cover 0.00% of .*, 1 tensors are missing, first gain|Missing"):
        load_predictor(f"{name}:{folder}")
    [weights] = [*folder.rglob("*.pth"), *folder.rglob("*.safetensors")]
    weights.write_bytes(b"no checkpoint")
    with pytest.raises(MethodError, match=r"cannot be (loaded|read)"):
        load_predictor(f"{name}:{folder}")


@pytest.mark.parametrize(
    ("name", "file", "words"),
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
def test_missing_file_of_a_folder_is_named(name: str, file: str, words: str, tmp_path: Path) -> None:
    folder = BUILDERS[name](tmp_path / "theirs")
    (folder / file).unlink()
    with pytest.raises(MethodError, match=re.escape(words)):
        find_method(f"{name}:{folder}")
    with pytest.raises(MethodError, match=r"no such folder|no clone of FoundationStereo"):
        find_method(f"{name}:{tmp_path / 'nowhere'}")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (
            '{"model_name": "da3-large"}',
            "model_name in config.json is 'da3-large', expected 'da3metric-large', the",
        ),
        ('{"model_name": ["x"]}', "model_name in config.json is ['x'], expected"),
        ("{}", "model_name in config.json is None, expected"),
        ('{"model_name": "\\u001b[31m' + "x" * 10_000 + '"}', "model_name in config.json is '\\x1b[31mxxx"),
    ],
)
def test_config_of_another_network_is_refused(config: str, words: str, tmp_path: Path) -> None:
    folder = stand_ins.da3_weights(tmp_path / "theirs")
    (folder / "config.json").write_text(config)
    with pytest.raises(MethodError, match=re.escape(words)) as caught:
        find_method(f"depth-anything-3:{folder}")
    assert len(str(caught.value)) < 600
