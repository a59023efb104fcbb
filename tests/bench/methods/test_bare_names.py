"""The paper's networks by bare name: identification of the weights in the local caches."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("torch")

import huggingface_hub
import numpy as np
from huggingface_hub import constants

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import METHODS, find_method
from rebar_depth_bench.methods.base import WeightsMethod
from rebar_depth_bench.methods.registry import FROM_FOLDER
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_views import BUILDERS, select_columns, stereo_row

COMMITS = ("0123456789abcdef0123456789abcdef01234567", "89abcdef0123456789abcdef0123456789abcdef")
REPOSITORIES = {
    "depth-anything-3": "depth-anything--DA3METRIC-LARGE",
    "metric3d": "JUGGHM--Metric3D",
    "unidepth": "lpiccinelli--unidepth-v2-vitl14",
}


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[Path]:
    """Make the stand-in packages importable during a test."""
    with stand_ins.stand_in_packages(tmp_path / "site") as folder:
        yield folder


@pytest.fixture
def hub_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Point the Hub client at an empty cache and return its folder."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


@pytest.fixture
def metric3d_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Point torch.hub at a cache that holds Metric3D's code, and return the folder of the code."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    code = stand_ins.metric3d_clone(tmp_path / "torch" / "hub" / "yvanyin_metric3d_main")
    (code / "metric_depth_vit_small_800k.pth").unlink()
    return code


def add_to_hub_cache(name: str, hub_cache: Path, commit: str, gain: float = 0.5) -> Path:
    """Add a commit to the Hub cache as its main branch and return the snapshot's folder."""
    repository = hub_cache / f"models--{REPOSITORIES[name]}"
    folder = BUILDERS[name](repository / "snapshots" / commit, gain=gain)
    (repository / "refs").mkdir(exist_ok=True)
    (repository / "refs" / "main").write_text(commit)
    return folder


@pytest.mark.parametrize("name", ["depth-anything-3", "unidepth"])
def test_cached_weights_commit_is_reported_and_used(name: str, hub_cache: Path) -> None:
    """A moved main branch gives a different method and does not change one that was found before."""
    add_to_hub_cache(name, hub_cache, COMMITS[0])
    first = find_method(name)
    add_to_hub_cache(name, hub_cache, COMMITS[1], gain=2 * 0.5)
    second = find_method(name)
    for method, commit in ((first, COMMITS[0]), (second, COMMITS[1])):
        assert method.info.name == name
        assert method.info.summary.endswith(f"as in the paper; weights commit {commit}")
        assert method.info.columns == METHODS[name].info.columns
    ratio = load_predictor(second)(select_columns(name, stereo_row())) / load_predictor(first)(
        select_columns(name, stereo_row())
    )
    np.testing.assert_allclose(ratio, 2, rtol=2e-3)
    np.testing.assert_array_equal(
        load_predictor(METHODS[name])(select_columns(name, stereo_row())),
        load_predictor(second)(select_columns(name, stereo_row())),
    )


def test_weights_missing_from_cache_raise_on_load(hub_cache: Path) -> None:
    (add_to_hub_cache("unidepth", hub_cache, COMMITS[0]) / "model.safetensors").unlink()
    method = find_method("unidepth")
    with pytest.raises(MethodError, match=r"unidepth-v2-vitl14: model.safetensors must be downloaded, but HF_HUB"):
        load_predictor(method)


def test_other_da3_model_raises_when_found(hub_cache: Path) -> None:
    folder = add_to_hub_cache("depth-anything-3", hub_cache, COMMITS[0])
    (folder / "config.json").write_text('{"model_name": "da3-large"}')
    with pytest.raises(MethodError, match=r"model_name in config.json is 'da3-large', expected 'da3metric-large'"):
        find_method("depth-anything-3")


def test_metric3d_reports_code_digest_and_weights_commit(
    metric3d_code: Path, hub_cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add_to_hub_cache("metric3d", hub_cache, COMMITS[0])
    first = find_method("metric3d")
    assert first.info.name == "metric3d"
    assert "; code yvanyin_metric3d_main sha256:" in first.info.summary
    assert first.info.summary.endswith(f"; weights commit {COMMITS[0]}")
    np.testing.assert_allclose(
        load_predictor(first)(select_columns("metric3d", stereo_row())), 200 * 0.5 * 87.5 * 6.65 / 1000, rtol=3e-3
    )
    assert "downloading" not in capsys.readouterr().err
    (metric3d_code / "mono").mkdir()
    (metric3d_code / "mono" / "model.py").write_text("")
    second = find_method("metric3d")
    add_to_hub_cache("metric3d", hub_cache, COMMITS[1], gain=2.0)
    assert len({first.info, second.info, find_method("metric3d").info}) == 3, "other code, other weights"
    assert str(tmp_path) not in repr(second.info)


def test_methods_listing_needs_no_network(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise AssertionError("asked for")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fail)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", fail)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert main(["methods"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in METHODS)
    assert all(METHODS[name].info.name == name for name in METHODS)
    takes_folder = {name for name, method in METHODS.items() if isinstance(method, WeightsMethod)}
    assert takes_folder == set(FROM_FOLDER)


def test_predict_help_names_weight_folders(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["predict", "--help"])
    assert "NAME:FOLDER (a folder with weights for depth-anything-3," in " ".join(capsys.readouterr().out.split())


def test_foundation_stereo_announces_downloads_of_its_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    load_predictor(find_method(f"foundation-stereo:{stand_ins.stereo_clone(tmp_path / 'clone')}"))
    stderr = capsys.readouterr().err
    assert "DINOv2's code (https://github.com/facebookresearch/dinov2, even if HF_HUB_OFFLINE is set)" in stderr
    assert "and timm's edgenext_small (from the Hub)\n" in stderr
