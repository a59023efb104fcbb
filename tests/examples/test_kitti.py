"""``study kitti`` on a small KITTI folder: known scales and noise, output files and bad input."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from rebar_depth_bench.studies.kitti import command as study_module
from rebar_depth_bench.studies.kitti.command import run_kitti_study
from rebar_depth_bench.studies.kitti.ground_truth import find_truth, read_truth
from rebar_depth_bench.studies.kitti.metrics import CROPS, scored_mask
from rebar_depth_bench.studies.kitti.result import KittiProtocol

from rebar_depth_bench import SubmissionWriter
from rebar_depth_bench.errors import SubmissionError
from tests.bench.studies import kitti_folder as kitti
from tests.bench.studies.commands import run_study

COUNT = 24
FACTORS = np.linspace(0.4, 1.6, COUNT)
NOISE = 0.08
RAW = KittiProtocol("raw", "garg", 80.0, "camera")
Depths = dict[str, NDArray[Any]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the raw data of the first images of the split and return the folder."""
    folder = tmp_path_factory.mktemp("kitti")
    kitti.write_raw(folder, kitti.first_images(COUNT))
    return folder


@pytest.fixture(scope="module")
def truths(root: Path) -> Depths:
    """Return the raw ground truth in metres by image name."""
    files, _ = find_truth(root, kitti.first_images(COUNT), "raw")
    return {file.image.name: read_truth(file) for file in files}


def predictions(truths: Depths, noise: float = 0.0) -> Depths:
    """Return ground truth divided by each image's factor, with multiplicative noise; 7 m outside ground truth."""
    rng = np.random.default_rng(5)
    return {
        name: np.where(z_m > 0, z_m / factor * np.exp(noise * rng.standard_normal(z_m.shape)), 7.0).astype(
            np.float32
        )
        for (name, z_m), factor in zip(truths.items(), FACTORS, strict=True)
    }


def write_npy(folder: Path, depths: Depths) -> Path:
    folder.mkdir()
    for name, depth_m in depths.items():
        np.save(folder / f"{name}.npy", depth_m)
    return folder


def test_known_scales_are_recovered(root: Path, truths: Depths, tmp_path: Path) -> None:
    result = run_kitti_study(write_npy(tmp_path / "mono", predictions(truths)), root, RAW)
    assert result.method == "mono"
    assert result.images_with_truth == COUNT
    assert len(result.missing) == 697 - COUNT
    assert [image.scale for image in result.images] == pytest.approx(list(FACTORS), rel=1e-6)
    table = result.table
    assert table.complete
    assert table.scale_median == pytest.approx(np.median(FACTORS))
    assert table.native is not None
    assert table.scaled is not None
    assert table.scaled.abs_rel < 1e-6
    errors = [
        np.mean(np.abs(np.minimum(z_m / factor, 80) - z_m) / z_m)
        for (z_map, factor) in zip(truths.values(), FACTORS, strict=True)
        for z_m in [z_map[scored_mask(z_map, CROPS["garg"], 80.0)].astype(np.float64)]
    ]
    assert table.native.abs_rel == pytest.approx(np.mean(errors), rel=1e-6)


def test_known_noise_lies_within_the_interval(root: Path, truths: Depths, tmp_path: Path) -> None:
    result = run_kitti_study(
        write_npy(tmp_path / "mono", predictions(truths, NOISE)), root, replace(RAW, cap_m=1e4)
    )
    expected = np.abs(np.exp(NOISE * np.random.default_rng(0).standard_normal(1_000_000)) - 1).mean()
    low, high = result.table.intervals["scaled.abs_rel"] or (0, 0)
    assert low < expected < high
    assert high - low < 0.2 * expected
    low, high = result.table.intervals["scale_median"] or (0, 0)
    assert low < np.median(FACTORS) < high


def test_missing_predictions_make_result_incomplete(root: Path, truths: Depths, tmp_path: Path) -> None:
    whole = predictions(truths, NOISE)
    holed = {name: depth_m.copy() for name, depth_m in whole.items()}
    for depth_m in holed.values():
        depth_m[:, :62] = np.nan
    holed[next(iter(holed))][:] = 0
    first, other = (
        run_kitti_study(write_npy(tmp_path / name, depths), root, RAW).table
        for name, depths in (("whole", whole), ("holed", holed))
    )
    assert (first.complete, other.complete) == (True, False)
    assert (first.images_scored, other.images_scored, other.images) == (COUNT, COUNT - 1, COUNT)
    coverages = [
        scored_mask(z_m, CROPS["garg"], 80.0)[:, 62:].sum() / scored_mask(z_m, CROPS["garg"], 80.0).sum()
        for z_m in truths.values()
    ]
    assert other.coverage == pytest.approx(sum(coverages[1:]) / COUNT)


def test_low_coverage_makes_result_incomplete(root: Path, truths: Depths, tmp_path: Path) -> None:
    left_half = {
        name: np.where(np.arange(124) < 62, depth_m, np.nan) for name, depth_m in predictions(truths).items()
    }
    table = run_kitti_study(write_npy(tmp_path / "left", left_half), root, RAW).table
    assert table.images_scored == COUNT
    assert 0.3 < table.coverage < 0.7
    assert not table.complete


def test_archive_and_png_folder_score_alike(root: Path, truths: Depths, tmp_path: Path) -> None:
    depths = {name: np.round(depth_m * 256).clip(1, 65535) / 256 for name, depth_m in predictions(truths).items()}
    archive = tmp_path / "mono.zip"
    with SubmissionWriter(archive, method="mono") as writer:
        for name, depth_m in depths.items():
            writer.add(f"kitti/{name}", depth_m)
        writer.add(
            f"kitti/{kitti.first_images(COUNT + 1)[-1].name}", np.ones((3, 5))
        )  # An image without ground truth is allowed.
    folder = tmp_path / "pngs"
    folder.mkdir()
    for name, depth_m in depths.items():
        Image.fromarray((depth_m * 256).astype(np.uint16)).save(folder / f"{name}.png")
    tables = [run_kitti_study(path, root, RAW).table for path in (archive, folder)]
    assert tables[0] == tables[1]


def test_command_writes_files_and_states_conventions(
    root: Path, truths: Depths, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_npy(tmp_path / "mono", predictions(truths, NOISE))
    files = {kind: tmp_path / f"out.{kind}" for kind in ("json", "csv", "html")}
    output_options = [part for kind, path in files.items() for part in (f"--{kind}", path)]
    arguments = ("--predictions", folder, "--kitti", root, "--ground-truth", "raw", "--crop", "eigen")
    assert run_study(study_module, *arguments, *output_options) == 0
    out = capsys.readouterr().out
    title = f"raw LiDAR ground truth, {COUNT} images, crop eigen, cap 80 m: native (no alignment) and scaled"
    assert title in " ".join(out.split())
    assert "0.0926" in out
    assert f"{COUNT} images of the list have raw ground truth here, 697 in the published set" in " ".join(
        out.split()
    )
    content = json.loads(files["json"].read_text())
    assert content["kitti"]["found"] == COUNT
    assert len(content["kitti"]["missing"]) == 697 - COUNT
    assert content["protocol"] == "rebar-kitti-eigen-1"
    rows = list(csv.DictReader(files["csv"].read_text().splitlines()))
    assert [row["alignment"] for row in rows] == ["native", "scaled"]
    assert float(rows[1]["abs_rel"]) == content["table"]["scaled"]["abs_rel"]
    assert title.replace("'", "&#39;") in files["html"].read_text()
    before = [path.read_bytes() for path in files.values()]
    assert run_study(study_module, *arguments, *output_options, "--workers", "1") == 0
    assert [path.read_bytes() for path in files.values()] == before


def test_improved_ground_truth_is_used_unchanged(tmp_path: Path) -> None:
    images = kitti.first_images(2)
    z_m = np.full((38, 124), 10.0)
    for image in images:
        kitti.write_improved(kitti.improved_path(tmp_path / "kitti", image), z_m)
    folder = write_npy(tmp_path / "mono", {image.name: z_m * 1.1 for image in images})
    result = run_kitti_study(folder, tmp_path / "kitti", replace(RAW, ground_truth="improved"))
    assert result.table.native is not None
    assert result.table.native.abs_rel == pytest.approx(0.1)
    assert result.images_with_truth == 2


def test_lidar_depth_option_changes_ground_truth(root: Path, truths: Depths, tmp_path: Path) -> None:
    folder = write_npy(tmp_path / "exact", {name: np.where(z > 0, z, 7) for name, z in truths.items()})
    planar, forward = (
        run_kitti_study(folder, root, replace(RAW, lidar_depth=kind)).table.native
        for kind in ("camera", "velodyne")
    )
    assert planar is not None
    assert forward is not None
    assert planar.rmse_m == 0
    assert 0.2 < forward.rmse_m < 0.5


def test_all_bad_predictions_are_listed(root: Path, truths: Depths, tmp_path: Path) -> None:
    folder = write_npy(tmp_path / "mono", predictions(truths))
    names = list(truths)
    np.save(folder / f"{names[0]}.npy", np.ones((375, 1242)))
    (folder / f"{names[1]}.npy").write_bytes(b"\x93NUMPY")
    (folder / f"{names[2]}.npy").unlink()
    Image.fromarray(np.ones((38, 124), np.uint8)).save(folder / f"{names[2]}.png")
    with pytest.raises(SubmissionError) as caught:
        run_kitti_study(folder, root, RAW)
    assert {(problem.code, problem.where) for problem in caught.value.problems} == {
        ("invalid", f"{names[0]}.npy"),
        ("syntax", f"{names[1]}.npy"),
        ("invalid", f"{names[2]}.png"),
    }
    assert "3 problems" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--predictions", "nowhere.zip"), "does not exist"),
        (("--kitti", "nowhere"), "nowhere: no such folder, expected one with KITTI's raw data"),
        (("--cap", "0"), "the cap is 0.0 m, expected a finite number above 0.001"),
        (("--cap", "nan"), "the cap is nan m"),
        (("--workers", "0"), "workers is 0, expected 1 or more"),
        (("--ground-truth", "improved"), "has no improved ground truth"),
        (("--predictions", "short"), "2011_09_26_drive_0002_sync_0000000003_l: no file, expected one of .npy"),
        (("--predictions", "empty"), "no depth file of any view was found"),
    ],
)
def test_bad_input_exits_with_status_2(
    change: tuple[str, str],
    words: str,
    root: Path,
    truths: Depths,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_npy(tmp_path / "mono", predictions(truths))
    write_npy(tmp_path / "short", dict(list(predictions(truths).items())[:1]))
    (tmp_path / "empty").mkdir()
    options = {"--predictions": "mono", "--kitti": str(root), "--ground-truth": "raw"} | dict([change])
    assert run_study(study_module, *(part for pair in options.items() for part in pair)) == 2
    printed = capsys.readouterr()
    assert words in printed.err
    assert printed.out == ""
