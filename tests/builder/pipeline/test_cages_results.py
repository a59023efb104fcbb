"""Generated cages from build to result: exact depth, groups, bars as built against as designed, and export."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import rebar_depth_bench as rdb
from dataset_builder.export import export
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.as_built import MEASURES
from rebar_depth_bench.extended.registry import score_extended
from rebar_depth_bench.scoring.evaluation import open_evaluation
from tests.building import RunBuild
from tests.commands import run_in_process
from tests.ground_truth import truth_of

SPLITS = {"test": 2, "validation": 1}
VIEWS = 2


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    """Return a build of a few scenes of two splits, without colour."""
    root = tmp_path_factory.mktemp("cages") / "dataset"
    for split, scenes in SPLITS.items():
        amount = ("--split", split, "--scenes", str(scenes), "--views-per-scene", str(VIEWS))
        size = ("--width", "320", "--height", "180", "--no-colour")
        process = run_build("--out", root, "--config", "cages", *amount, *size)
        assert process.returncode == 0, process.stderr
    return root


def write_truth(root: Path, archive: Path, split: str) -> Path:
    with rdb.SubmissionWriter(archive, "truth", uses_ground_truth=True) as writer:
        for row in rdb.load(root, "cages", split=split, streaming=True, columns=["view_id", "left_depth"]):
            writer.add(row["view_id"], row["left_depth"])
    return archive


@pytest.mark.parametrize("split", SPLITS)
def test_exact_depth_is_perfect_in_every_group(root: Path, tmp_path: Path, split: str) -> None:
    result = rdb.score(write_truth(root, tmp_path / "a.zip", split), root)
    table = result.tables["cages"]
    assert (table.split, table.views) == (split, SPLITS[split] * VIEWS)
    families = {scene.family for scene in open_folder(root).config("cages").of_split(split).scenes}
    assert set(table.groups["family"]) == families
    for groups in table.groups.values():
        assert sum(group.views for group in groups.values()) == table.views
        for group in groups.values():
            assert (group.rank_error, group.coverage, group.scale_median) == (0.0, 1.0, 1.0)
            assert group.native is not None
            assert (group.native.abs_rel, group.native.delta1) == (0.0, 1.0)
            assert group.within_mm == dict.fromkeys(group.within_mm, 1.0)
            assert 0 < (group.reference.one_pixel.abs_rel or 0) < 1


def test_reference_errors_of_the_manifest_are_those_of_the_table(root: Path, tmp_path: Path) -> None:
    manifest = json.loads((root / "manifest.json").read_text())["configs"]["cages"]["references"]
    for split in SPLITS:
        result = rdb.score(write_truth(root, tmp_path / f"{split}.zip", split), root)
        assert result.tables["cages"].reference.to_dict() == manifest[split]


def test_widths_follow_from_bars_and_cameras(root: Path) -> None:
    """Bars of the cages are millimetres wide: their width in pixels is that in the middle of the steel."""
    diameters_m = {bar.diameter_m for bars in read_bars(root / BARS_FILE).values() for bar in bars}
    rows = rdb.load(root, "cages", split="test", columns=["view_id", "left_K"])
    for row, view in zip(rows, truth_of(root, "cages", "test").traits, strict=True):
        assert view.bar_width_px is not None
        assert view.family is not None
        about_m = view.bar_width_px * view.distance_m / row["left_K"][0, 0]
        assert 0.5 * min(diameters_m) < about_m < 2 * max(diameters_m)


def test_exact_depth_measures_the_deviation_from_the_design(root: Path, tmp_path: Path) -> None:
    with open_evaluation(write_truth(root, tmp_path / "a.zip", "test"), root) as evaluation:
        extended = score_extended(evaluation).extended
    assert extended is not None
    numbers = extended.tables["cages"].numbers["native"]
    judged = numbers["deviation_median_mm"]
    assert 0 < judged.samples <= numbers["bars_found"].samples
    assert 0 <= (judged.value or 0) < 0.2
    assert (numbers["deviation_p95_mm"].value or 0) < 2
    assert abs(numbers["deviation_bias_mm"].value or 0) < 0.1
    assert 1 < (numbers["deviation_true_p95_mm"].value or 0) < 40, "the tolerances of the generator"
    assert {measure.name for measure in MEASURES} <= numbers.keys()


def test_commands_work_on_several_scenes(root: Path, tmp_path: Path) -> None:
    archive = write_truth(root, tmp_path / "a.zip", "test")
    constant = tmp_path / "constant.zip"
    commands = (
        ("verify", root),
        ("predict", "constant", "--data", root, "--out", constant),
        ("check", constant, "--data", root),
        ("score", archive, "--data", root, "--html", tmp_path / "r.html", "--groups-csv", tmp_path / "g.csv"),
        ("table", archive, constant, "--data", root, "--latex", tmp_path / "t.tex"),
        ("compare", archive, constant, "--data", root),
    )
    for command in commands:
        process = run_in_process(rebar_bench, *command)
        assert process.returncode == 0, (command[0], process.stderr)
    groups = {line.split(",")[6] for line in (tmp_path / "g.csv").read_text().splitlines()[1:]}
    assert groups == {"family", "distance", "bar_width"}
    exported = export(root, tmp_path / "out", split="test")
    assert [part.views for part in exported] == [VIEWS] * SPLITS["test"]
