"""Builds of the config ``cages``: scenes and splits that are added, byte identity, interruptions and refusals."""

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
from dataset_builder.audit import audit
from dataset_builder.catalog.cages_config import MAX_SCENES, CagesRequest
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.plan import BUILD_FOLDER, plan_config
from dataset_builder.scene.cages import generate as generate_module
from dataset_builder.scene.cages.generate import drawn_family
from dataset_builder.specs.config_specs import ColourSpec, GeneratedCageSpec, SceneConfigSpec
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.scoring.truth import reference_errors
from tests.building import RunBuild, StartBuild, contents, staged_rows
from tests.dask_cluster import NewCluster
from tests.processes import wait_until

SIZE = ("--width", "96", "--height", "54")
GROUND_TRUTH = (*SIZE, "--no-colour")


def cages(split: str, scenes: int, views: int = 2) -> tuple[str, ...]:
    return (
        *("--config", "cages", "--split", split),
        *("--scenes", str(scenes), "--views-per-scene", str(views)),
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    """Return a folder without colour: two scenes of train, then one of validation."""
    root = tmp_path_factory.mktemp("cages") / "dataset"
    for split, scenes in (("train", 2), ("validation", 1)):
        process = run_build("--out", root, *cages(split, scenes), *GROUND_TRUTH)
        assert process.returncode == 0, process.stderr
    return root


def names(root: Path) -> list[str]:
    return [scene.name for scene in open_folder(root).config("cages").scenes]


def scene_files(root: Path) -> Mapping[str, str]:
    """Return the digests of the shards and meshes of a folder."""
    return {
        name: digest for name, digest in contents(root).items() if name.partition("/")[0] in ("cages", "meshes")
    }


def test_scenes_are_named_by_family_split_and_number(root: Path) -> None:
    drawn = [("train", 0), ("train", 1), ("validation", 0)]
    assert names(root) == [f"{drawn_family(split, number, 0)}-{split}{number:04d}" for split, number in drawn]
    assert [scene.family for scene in open_folder(root).config("cages").scenes] == [
        drawn_family(split, number, 0) for split, number in drawn
    ]


@pytest.mark.parametrize("streaming", [False, True])
def test_plain_datasets_and_load_return_the_views_of_a_split(root: Path, streaming: bool) -> None:
    expected = [f"cages/train-{scene}-{index:04d}" for scene in names(root)[:2] for index in range(2)]
    plain = datasets.load_dataset(str(root), "cages", split="train", streaming=streaming)
    assert [row["view_id"] for row in plain] == expected
    rows = list(rdb.load(root, "cages", split="train", streaming=streaming))
    assert [row["view_id"] for row in rows] == expected
    assert all(row["left_depth"].shape == (54, 96) and row["left_mask"].any() for row in rows)


def test_bars_have_nominal_axes(root: Path) -> None:
    entries = {scene.name: scene.entry for scene in open_folder(root).config("cages").scenes}
    for scene, bars in read_bars(root / BARS_FILE).items():
        designed = [bar for bar in bars if bar.nominal_axis_m]
        record = entries[scene]["cage"]
        assert len(bars) - len(designed) == record["doubled"]
        off_m = [np.linalg.norm(np.subtract(bar.axis_m[0], bar.nominal_axis_m[0])) for bar in designed]
        assert 0 < max(off_m) < 0.06


def test_references_are_those_of_each_split(root: Path) -> None:
    config = open_folder(root).config("cages")
    references = config.manifest_entry["references"]
    assert list(references) == ["train", "validation"]
    for split, values in references.items():
        assert values == reference_errors(config.of_split(split)).to_dict()


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


def test_more_scenes_keep_the_files_of_others_and_order_of_builds_does_not_matter(
    root: Path, tmp_path: Path, run_build: RunBuild
) -> None:
    grown = tmp_path / "grown"
    shutil.copytree(root, grown)
    before = scene_files(grown)
    assert run_build("--out", grown, *cages("train", 3), *GROUND_TRUTH, "--workers", "2").returncode == 0
    assert before.items() < scene_files(grown).items()
    at_once = tmp_path / "at-once"
    for split, scenes in (("validation", 1), ("train", 3)):
        assert run_build("--out", at_once, *cages(split, scenes), *GROUND_TRUTH).returncode == 0
    assert contents(at_once) == contents(grown)
    fewer = run_build("--out", grown, *cages("train", 1), *GROUND_TRUTH)
    assert "up to date: cages" in fewer.stdout
    assert contents(at_once) == contents(grown)


def test_killed_build_resumes_to_the_same_bytes(
    root: Path, tmp_path: Path, run_build: RunBuild, start_build: StartBuild
) -> None:
    other = tmp_path / "dataset"
    build = start_build(other, *cages("train", 2), *GROUND_TRUTH)
    wait_until(lambda: staged_rows(other) or build.poll() is not None)
    os.killpg(build.pid, signal.SIGKILL)
    build.communicate()
    assert not (other / MANIFEST_FILE).exists()
    for split, scenes in (("train", 2), ("validation", 1)):
        assert run_build("--out", other, *cages(split, scenes), *GROUND_TRUTH).returncode == 0
    assert contents(other) == contents(root)
    assert not (other / BUILD_FOLDER).exists()


def test_cluster_build_equals_local_build(
    root: Path, tmp_path: Path, run_build: RunBuild, new_cluster: NewCluster
) -> None:
    other, folder = tmp_path / "dataset", tmp_path / "cluster"
    folder.mkdir()
    with new_cluster(folder) as cluster:
        cluster.start_scheduler()
        cluster.start_worker()
        process = run_build("--out", other, *cages("train", 2), *GROUND_TRUTH, "--cluster", cluster.address)
    assert process.returncode == 0, process.stderr
    assert scene_files(other).items() < scene_files(root).items()


def test_scenes_with_colour_are_rendered_and_differ(tmp_path: Path, run_build: RunBuild) -> None:
    other = tmp_path / "dataset"
    process = run_build("--out", other, *cages("test", 1), *SIZE, "--quality", "preview")
    assert process.returncode == 0, process.stderr
    rows = list(rdb.load(other, "cages"))
    assert all(row["left_rgb"].std() > 5 for row in rows)
    assert not np.array_equal(rows[0]["left_rgb"], rows[1]["left_rgb"])
    refused = run_build("--out", other, *cages("test", 1), *GROUND_TRUTH)
    assert (refused.returncode, "colour is {'samples'" in refused.stderr) == (2, True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (cages("val", 1), "--split: got 'val', expected one of train, validation, test"),
        (cages("test", 0), "--scenes: got 0"),
        (cages("test", MAX_SCENES + 1), f"--scenes: got {MAX_SCENES + 1}"),
        (cages("test", 1, 0), "--views-per-scene: got 0"),
        ((*cages("test", 1), "--views", "3"), "--views: is combined with --config cages"),
        ((*cages("test", 1), "--variant", "rusted"), "--variant: is combined with --config cages"),
        (("--config", "lattice", "--scenes", "3"), "--scenes: only cages has such scenes"),
    ],
)
def test_unusable_requests_are_refused_without_a_folder(
    tmp_path: Path, run_build: RunBuild, options: tuple[str, ...], message: str
) -> None:
    process = run_build("--out", tmp_path / "dataset", *options, *GROUND_TRUTH)
    assert process.returncode == 2
    assert message in " ".join(process.stderr.split())
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            (*cages("test", 1), *GROUND_TRUTH, "--seed", "1"),
            "3 other scenes have another image size, colour, seed or version",
        ),
        (
            (*cages("train", 2), "--width", "64", "--height", "36", "--no-colour"),
            "1 other scenes have another image size",
        ),
    ],
)
def test_scenes_that_do_not_fit_to_others_are_refused(
    root: Path, run_build: RunBuild, options: tuple[str, ...], message: str
) -> None:
    before = contents(root)
    process = run_build("--out", root, *options)
    assert process.returncode == 2
    assert message in " ".join(process.stderr.split())
    assert contents(root) == before


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
    assembly = GeneratedCageSpec("test", 0, version=2)
    later = replace(spec, scene=replace(spec.scene, assembly=assembly))
    assert plan_config(spec, None, tmp_path).key != plan_config(later, None, tmp_path).key


def test_infeasible_cage_is_refused_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dataset_builder.pipeline import plan as plan_module
    from dataset_builder.pipeline.build import build

    def place_here(plans: Any, *_: Any) -> Any:
        return [plan_module.with_cameras(plan) for plan in plans]

    monkeypatch.setattr("dataset_builder.pipeline.build.place_cameras", place_here)
    monkeypatch.setattr(generate_module, "MAX_ATTEMPTS", 0)
    with pytest.raises(InputError, match="no cage of the family"):
        build(BuildRequest(("cages",), colour=None, cages=CagesRequest("test", 1)), tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("key", ["seed", "number"])
def test_damaged_entry_of_a_scene_is_refused(root: Path, tmp_path: Path, run_build: RunBuild, key: str) -> None:
    copy = tmp_path / "dataset"
    shutil.copytree(root, copy)
    manifest: dict[str, Any] = json.loads((copy / MANIFEST_FILE).read_text())
    manifest["configs"]["cages"]["scenes"][0]["assembly"][key] = "x"
    (copy / MANIFEST_FILE).write_text(json.dumps(manifest))
    process = run_build("--out", copy, *cages("test", 1), *GROUND_TRUTH, "--overwrite", "cages")
    assert process.returncode == 2
    assert f"scenes 1: assembly.{key}" in process.stderr or f"assembly.{key}" in process.stderr
    assert "Traceback" not in process.stderr
