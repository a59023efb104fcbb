"""The config ``cages`` from build to result: scenes and splits that are added, equal bytes and scores."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest

import rebar_depth_bench as rdb
from cards.dataset import dataset_card
from dataset_builder.audit import audit
from dataset_builder.catalog.cages_config import CagesRequest
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.cli.main import main
from dataset_builder.pipeline import plan as plan_module
from dataset_builder.pipeline.build import build
from dataset_builder.pipeline.plan import BUILD_FOLDER, plan_config
from dataset_builder.scene.cages import generate as generate_module
from dataset_builder.scene.cages.generate import drawn_family
from dataset_builder.specs.config_specs import CAGES_VERSION, ColourSpec, GeneratedCageSpec, SceneConfigSpec
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.inspection import AS_BUILT_MEASURES
from rebar_depth_bench.scoring.columns import WITHIN
from rebar_depth_bench.scoring.truth import reference_errors
from tests.building import RunBuild, StartBuild, contents, staged_rows
from tests.commands import run_in_process
from tests.dask_cluster import NewCluster
from tests.processes import wait_until

SPLITS = {"train": 2, "validation": 1}
VIEWS = 2
SIZE = ("--width", "320", "--height", "180")
GROUND_TRUTH = (*SIZE, "--no-colour")


def cages(split: str, scenes: int, views: int = VIEWS) -> tuple[str, ...]:
    return (*("--config", "cages", "--split", split), *("--scenes", str(scenes), "--views-per-scene", str(views)))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    """Return a folder without colour: two scenes of train, then one of validation."""
    root = tmp_path_factory.mktemp("cages") / "dataset"
    for split, scenes in SPLITS.items():
        process = run_build("--out", root, *cages(split, scenes), *GROUND_TRUTH)
        assert process.returncode == 0, process.stderr
    return root


@pytest.fixture(scope="module")
def grown(root: Path, tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    """Return a copy of the folder to which a scene of train is added by two workers."""
    grown = tmp_path_factory.mktemp("grown") / "dataset"
    shutil.copytree(root, grown)
    process = run_build("--out", grown, *cages("train", 3), *GROUND_TRUTH, "--workers", "2")
    assert process.returncode == 0, process.stderr
    return grown


def scene_files(root: Path) -> Mapping[str, str]:
    """Return the digests of the shards and meshes of a folder."""
    return {
        name: digest for name, digest in contents(root).items() if name.partition("/")[0] in ("cages", "meshes")
    }


@pytest.mark.parametrize("streaming", [False, True])
def test_views_of_a_split_are_named_by_family_split_and_number(root: Path, streaming: bool) -> None:
    scenes = open_folder(root).config("cages").scenes
    drawn = [("train", 0), ("train", 1), ("validation", 0)]
    families = [drawn_family(split, number, 0) for split, number in drawn]
    assert [scene.family for scene in scenes] == families
    assert [scene.name for scene in scenes] == [
        f"{family}-{split}{number:04d}" for family, (split, number) in zip(families, drawn, strict=True)
    ]
    expected = [f"cages/train-{scene.name}-{index:04d}" for scene in scenes[:2] for index in range(VIEWS)]
    plain = datasets.load_dataset(str(root), "cages", split="train", streaming=streaming)
    assert [row["view_id"] for row in plain] == expected
    rows = list(rdb.load(root, "cages", split="train", streaming=streaming))
    assert [row["view_id"] for row in rows] == expected
    assert all(row["left_depth"].shape == (180, 320) and row["left_mask"].any() for row in rows)


def test_card_states_how_far_mats_are_off(root: Path) -> None:
    rows = {}
    for line in (root / "README.md").read_text().partition("mats and directions")[2].splitlines()[2:]:
        if not line.startswith("|"):
            break
        family, *cells = [cell.strip() for cell in line.strip("|").split("|")]
        rows[family] = cells
    scenes = open_folder(root).config("cages").scenes
    assert set(rows) == {scene.family for scene in scenes}
    for family, (count, within, least, median, largest) in rows.items():
        mats = [mat for scene in scenes if scene.family == family for mat in scene.entry["cage"]["mats"]]
        assert int(count) == len(mats) > 0
        assert within == f"{np.mean([not mat['beyond'] for mat in mats]):.0%}"
        mm = 1000 * np.array([mat["deviation_m"] for mat in mats])
        assert [float(least), float(largest)] == pytest.approx([mm.min(), mm.max()], abs=0.051)
        assert float(median) == pytest.approx(np.median(np.maximum(-mm[:, 0], mm[:, 1])), abs=0.051)


def test_folder_of_an_earlier_generator_is_scored_and_not_continued(
    root: Path, truths: Mapping[str, Path], tmp_path: Path
) -> None:
    copy = tmp_path / "dataset"
    shutil.copytree(root, copy)
    manifest = json.loads((copy / MANIFEST_FILE).read_text())
    for scene in manifest["configs"]["cages"]["scenes"]:
        scene["assembly"]["version"] = 1
        del scene["cage"]["mats"]
    (copy / MANIFEST_FILE).write_text(json.dumps(manifest))
    assert len(rdb.load(copy, "cages", split="train")) == SPLITS["train"] * VIEWS
    assert rdb.score(truths["train"], copy).tables["cages"]["rank_error"] == 0.0
    folder = open_folder(copy)
    assert "mats" not in dataset_card(folder.version, folder.digest, [folder.config("cages")], {})
    before = contents(copy)
    for request in (cages("train", 2), cages("train", 3), cages("test", 1)):
        refused = run_in_process(main, "--out", copy, *request, *GROUND_TRUTH)
        assert refused.returncode == 2
        assert f"version 1 of the generator of cages, this is version {CAGES_VERSION}" in refused.stderr
        assert "another folder (--out); --overwrite cages replaces the config" in refused.stderr
    assert contents(copy) == before


def test_audit_passes_and_finds_a_moved_bar(root: Path, tmp_path: Path) -> None:
    report = audit(root, depth_views=1)
    assert report.failures == ()
    assert len([check for check in report.checks if check.passed]) >= 9
    copy = tmp_path / "dataset"
    shutil.copytree(root, copy)
    manifest = json.loads((copy / MANIFEST_FILE).read_text())
    manifest["configs"]["cages"]["scenes"][1]["assembly"]["number"] = 5
    (copy / MANIFEST_FILE).write_text(json.dumps(manifest))
    failed = [check.name for check in audit(copy, depth_views=0).failures]
    assert failed == ["cages: bars and their designs"]


def test_neither_order_of_builds_nor_a_kill_nor_a_cluster_changes_bytes(
    root: Path, grown: Path, tmp_path: Path, run_build: RunBuild, start_build: StartBuild, new_cluster: NewCluster
) -> None:
    other, folder = tmp_path / "dataset", tmp_path / "cluster"
    folder.mkdir()
    with new_cluster(folder) as cluster:
        cluster.start_scheduler()
        cluster.start_worker()
        remote = ("--cluster", cluster.address)
        process = run_build("--out", other, *cages("validation", 1), *GROUND_TRUTH, *remote)
    assert process.returncode == 0, process.stderr
    before = (other / MANIFEST_FILE).read_bytes()
    killed = start_build(other, *cages("train", 3), *GROUND_TRUTH)
    wait_until(lambda: staged_rows(other) or killed.poll() is not None)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    assert (other / MANIFEST_FILE).read_bytes() == before
    assert run_build("--out", other, *cages("train", 3), *GROUND_TRUTH).returncode == 0
    assert contents(other) == contents(grown)
    assert scene_files(root).items() < scene_files(grown).items()
    assert not (other / BUILD_FOLDER).exists()


def test_scenes_with_colour_are_rendered_and_differ(tmp_path: Path, run_build: RunBuild) -> None:
    other = tmp_path / "dataset"
    small = ("--width", "96", "--height", "54")
    process = run_build("--out", other, *cages("test", 1), *small, "--quality", "preview")
    assert process.returncode == 0, process.stderr
    rows = list(rdb.load(other, "cages"))
    assert all(row["left_rgb"].std() > 5 for row in rows)
    assert not np.array_equal(rows[0]["left_rgb"], rows[1]["left_rgb"])
    refused = run_in_process(main, "--out", other, *cages("test", 1), *small, "--no-colour")
    assert (refused.returncode, "colour is {'samples'" in refused.stderr) == (2, True)


def specs(split: str, scenes: int = 30, seed: int = 0) -> list[SceneConfigSpec]:
    request = BuildRequest(("cages",), seed=seed, cages=CagesRequest(split, scenes), colour=ColourSpec())
    return [spec for spec in request.config_specs() if isinstance(spec, SceneConfigSpec)]


def test_scenes_do_not_depend_on_their_number_and_vary() -> None:
    train = specs("train")
    assert specs("train", 3) == train[:3]
    assert len({spec.rig.baseline_m for spec in train}) > 3
    assert len({spec.scene.appearance for spec in train}) > 10
    assert len({spec.scene.environment for spec in train}) > 1
    seeds = [spec.scene.seed for split in ("train", "validation", "test") for spec in specs(split)]
    assert len(set(seeds)) == len(seeds)
    assert {spec.scene.seed for spec in train}.isdisjoint({spec.scene.seed for spec in specs("train", seed=1)})


def test_version_of_the_generator_changes_the_key(tmp_path: Path) -> None:
    [spec] = specs("test", 1)
    assembly = GeneratedCageSpec("test", 0, version=CAGES_VERSION + 1)
    later = replace(spec, scene=replace(spec.scene, assembly=assembly))
    assert plan_config(spec, None, tmp_path).key != plan_config(later, None, tmp_path).key


def test_infeasible_cage_is_refused_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def place_here(plans: Any, *_: Any) -> Any:
        return [plan_module.with_cameras(plan) for plan in plans]

    monkeypatch.setattr("dataset_builder.pipeline.build.place_cameras", place_here)
    monkeypatch.setattr(generate_module, "MAX_ATTEMPTS", 0)
    with pytest.raises(InputError, match="no cage of the family"):
        build(BuildRequest(("cages",), colour=None, cages=CagesRequest("test", 1)), tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("key", ["seed", "number"])
def test_damaged_entry_of_a_scene_is_refused(root: Path, tmp_path: Path, key: str) -> None:
    copy = tmp_path / "dataset"
    shutil.copytree(root, copy)
    manifest: dict[str, Any] = json.loads((copy / MANIFEST_FILE).read_text())
    manifest["configs"]["cages"]["scenes"][0]["assembly"][key] = "x"
    (copy / MANIFEST_FILE).write_text(json.dumps(manifest))
    process = run_in_process(main, "--out", copy, *cages("test", 1), *GROUND_TRUTH, "--overwrite", "cages")
    assert process.returncode == 2
    assert f"assembly.{key}" in process.stderr
    assert "Traceback" not in process.stderr


@pytest.fixture(scope="module")
def truths(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """Return archives with the exact depth of each split."""
    folder = tmp_path_factory.mktemp("truth")
    return {split: write_truth(root, folder / f"{split}.zip", split) for split in SPLITS}


def write_truth(root: Path, archive: Path, split: str) -> Path:
    with rdb.SubmissionWriter(archive, "truth", uses_ground_truth=True) as writer:
        for row in rdb.load(root, "cages", split=split, streaming=True, columns=["view_id", "left_depth"]):
            writer.add(row["view_id"], row["left_depth"])
    return archive


@pytest.mark.parametrize("split", SPLITS)
def test_exact_depth_is_perfect_in_every_group(root: Path, truths: Mapping[str, Path], split: str) -> None:
    table = rdb.score(truths[split], root).tables["cages"]
    assert (table.split, table.views) == (split, SPLITS[split] * VIEWS)
    config = open_folder(root).config("cages")
    references = config.manifest_entry["references"]
    assert list(references) == list(SPLITS)
    written = table.to_dict()["reference"]
    del written["scaled_constant"]
    assert written == references[split] == reference_errors(config.of_split(split))
    families = {scene.family for scene in config.of_split(split).scenes}
    assert set(table.groups["family"]) == families
    for groups in table.groups.values():
        assert sum(group.views for group in groups.values()) == table.views
        for group in groups.values():
            assert (group["rank_error"], group["coverage"], group["scale_median"]) == (0.0, 1.0, 1.0)
            assert (group["native.abs_rel"], group["native.delta1"]) == (0.0, 1.0)
            assert {group.number(column) for column in WITHIN} == {1.0}
            assert 0 < group["reference.one_pixel.abs_rel"] < 1


def test_exact_depth_measures_the_deviation_from_the_design(root: Path, truths: Mapping[str, Path]) -> None:
    extended = rdb.score(truths["train"], root, extended=True).extended
    assert extended is not None
    numbers = extended.tables["cages"].numbers["native"]
    judged = numbers["deviation_median_mm"]
    assert 0 < judged.samples <= numbers["bars_found"].samples
    assert 0 <= (judged.value or 0) < 0.2
    assert (numbers["deviation_p95_mm"].value or 0) < 2
    assert abs(numbers["deviation_bias_mm"].value or 0) < 0.1
    assert 0 < (numbers["deviation_true_median_mm"].value or 0) < 40, "the tolerances of the generator"
    assert {measure.name for measure in AS_BUILT_MEASURES} <= numbers.keys()
