"""The training example at toy size: what it learns, exports, prints and refuses, and how it continues."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from cards.learned import own_network_table
from tests.bench.methods.predictors import load_predictor
from tests.synthetic_dataset import write_split_dataset

torch = pytest.importorskip("torch")

OPTIONS = ("--batch", "2", "--workers", "0", "--crop", "64", "96")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder without the configs lattice and pile."""
    folder = tmp_path_factory.mktemp("cages") / "dataset"
    write_split_dataset(folder, {"a": "train", "b": "train", "c": "validation", "d": "test"}, 2)
    return folder


@pytest.fixture(scope="module")
def example() -> dict[str, Any]:
    return runpy.run_path("examples/finetune.py")


@pytest.fixture(scope="module")
def trained(root: Path, example: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    assert example["main"]([str(root), "--out", str(out), "--epochs", "6", *OPTIONS]) == 0
    return out


def weights(out: Path) -> dict[str, Any]:
    net: dict[str, Any] = torch.load(out / "checkpoint.pt", weights_only=True)["net"]
    return net


def test_errors_fall_and_the_table_has_every_method(
    root: Path, example: dict[str, Any], trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(trained, tmp_path / "out")
    (tmp_path / "out" / "checkpoint.pt").unlink()
    assert example["main"]([str(root), "--out", str(tmp_path / "out"), "--epochs", "6", *OPTIONS]) == 0
    printed = capsys.readouterr()
    errors = [float(text) for text in re.findall(r"depth ([0-9.]+) on steel", printed.err)]
    validated = [float(text) for text in re.findall(r"validation: rank error ([0-9.]+),", printed.err)]
    assert len(errors) == len(validated) == 6
    assert errors[-1] < 0.6 * errors[0]
    _, _, *rows = printed.out.splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[:3] for row in cells] == [
        [f"cages, {split}", method, "2"]
        for split in ("validation", "test")
        for method in ("finetuned", "constant", "sgbm")
    ]
    network, constant, sgbm = (
        dict(zip(example["NUMBERS"], map(float, row[3:]), strict=True)) for row in cells[:3]
    )
    assert 0 < network["rank error"] < sgbm["rank error"] == 1
    assert constant["coverage"] == 1
    assert constant["AbsRel scaled"] == constant["plane, scaled"]
    # The exported network, which the table is about, is that of the last epoch.
    assert validated[-1] == pytest.approx(network["rank error"], abs=2e-4)
    # The same seed and options give the same weights.
    assert all(torch.equal(value, weights(trained)[name]) for name, value in weights(tmp_path / "out").items())


def test_stored_numbers_are_those_of_the_archives(
    root: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = runpy.run_path("benchmarks/own_network.py")["main"]
    monkeypatch.setitem(main.__globals__, "results_file", lambda name: tmp_path / f"{name}.json")
    assert main(root, trained) == 0
    stored = json.loads((tmp_path / "own-network.json").read_text())
    assert (stored["training"]["epochs"], stored["training"]["views"], stored["training"]["scenes"]) == (6, 4, 2)
    [(config, numbers)] = stored["configs"].items()
    assert (config, numbers["views"]) == ("cages", 2)
    for method, row in numbers["methods"].items():
        table = rdb.score(trained / f"{method}-cages-test.zip", root).tables["cages"]
        assert row["rank_error"] == pytest.approx(table["rank_error"])
        assert row["within_5_mm"] == pytest.approx(table["within_mm.5"])
    assert "| cages | 2 | `finetuned` | " in own_network_table(stored["configs"])


def test_interrupted_training_continues_to_the_same_weights(
    root: Path, example: dict[str, Any], trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = [str(root), "--out", str(tmp_path), "--epochs", "6", *OPTIONS]
    namespace, real = example["train"].__globals__, example["train_epoch"]

    def interrupted(training: Any, *rest: Any) -> Any:
        if training.epoch == 2:
            raise KeyboardInterrupt
        return real(training, *rest)

    monkeypatch.setitem(namespace, "train_epoch", interrupted)
    assert example["main"](arguments) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pt"]
    monkeypatch.setitem(namespace, "train_epoch", real)
    assert example["main"](arguments) == 0
    assert all(torch.equal(value, weights(trained)[name]) for name, value in weights(tmp_path).items())


@pytest.mark.parametrize("size", [(320, 180), (320, 221)])
def test_exported_network_predicts_the_depth_of_the_trained_one(
    example: dict[str, Any], trained: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    width, height = size
    net = example["DepthNet"]()
    net.load_state_dict(weights(trained))
    toml = example["export"](net, tmp_path, width, height)
    rgb = np.random.default_rng(3).integers(0, 256, (height // 20, width // 20, 3), np.uint8)
    rgb = np.asarray(rgb.repeat(20, 0).repeat(20, 1))
    rgb = np.pad(rgb, ((0, height - rgb.shape[0]), (0, 0), (0, 0)))
    with torch.no_grad():
        image = torch.from_numpy((rgb / 255 - example["MEAN"]) / example["STD"]).float().permute(2, 0, 1)[None]
        expected = net(image).exp()[0, 0].numpy() * 260 / example["FOCAL_PX"]
    found = load_predictor(str(toml))({"left_rgb": rgb, "left_K": np.diag([260.0, 260.0, 1.0])})
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_target_is_canonical_depth_of_both_eyes(example: dict[str, Any]) -> None:
    """A longer focal length and a longer distance of the same image have the same target."""
    depth = torch.tensor([[[[2.0, 0.0], [4.0, 1.0]]]])
    batch: dict[str, Any] = {}
    for eye, factor in (("", 1.0), ("right_", 3.0)):
        batch |= {f"{eye}rgb": torch.full((1, 3, 2, 2), 255, dtype=torch.uint8), f"{eye}depth": depth * factor}
        batch |= {f"{eye}mask": torch.tensor([[[[True, True], [False, False]]]])}
        batch |= {f"{eye}K": torch.eye(3, dtype=torch.float64)[None] * example["FOCAL_PX"] * factor}
    rgb, target, steel, surface = example["images"](batch)
    assert rgb.max() == 1
    torch.testing.assert_close(target[1], target[0])
    torch.testing.assert_close(target[0].exp()[surface[0] > 0], depth[depth > 0])
    assert steel[0].tolist() == [[[1, 0], [0, 0]]]
    error = torch.tensor([1.0, 9.0, 5.0, 9.0]).reshape(1, 1, 2, 2).repeat(2, 1, 1, 1)
    assert example["image_mean"](error, steel) == 1
    assert example["image_mean"](error, torch.cat([steel[:1], torch.zeros_like(steel[:1])])) == 1


def test_other_options_and_unusable_inputs_are_refused(
    root: Path,
    example: dict[str, Any],
    trained: Path,
    tiny_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    checkpoint = (trained / "checkpoint.pt").read_bytes()
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "checkpoint.pt").write_bytes(checkpoint[: len(checkpoint) // 2])
    for data, out, options, words in (
        (root, trained, ("--epochs", "6", "--seed", "1"), "other seed"),
        (tiny_root, tmp_path / "out", (), "cages"),
        (root, tmp_path / "half", (), "checkpoint.pt: cannot be read"),
    ):
        assert example["main"]([str(data), "--out", str(out), *options, *OPTIONS]) == 2
        assert words in capsys.readouterr().err
    assert (trained / "checkpoint.pt").read_bytes() == checkpoint
    assert not (tmp_path / "out").exists()


def test_damaged_views_are_no_missing_split(
    root: Path, example: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = shutil.copytree(root, tmp_path / "root")
    [shard] = damaged.glob("cages/test-*.parquet")
    shard.write_bytes(shard.read_bytes()[:-1])
    assert example["main"]([str(damaged), "--out", str(tmp_path / "out"), "--epochs", "1", *OPTIONS]) == 2
    assert f"error: {damaged}: config cages cannot be read: cages/{shard.name}" in capsys.readouterr().err
