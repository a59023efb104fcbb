"""Disk space of a build: estimates from real data, resumed builds, and refusal before the start."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from dataset_builder.cli import main
from dataset_builder.config.cages import CagesRequest
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.specs import RigSpec
from dataset_builder.pipeline.disk_space import (
    ConfigSpace,
    bytes_text,
    check_space,
    config_space,
    free_bytes,
    needed_bytes,
    spaces_by_config,
    view_bytes,
)
from dataset_builder.pipeline.folder import stagings_by_label
from dataset_builder.pipeline.plan import ConfigPlan, plan_config
from dataset_builder.pipeline.retained import Finished
from rebar_depth_bench.data.config_tables import ViewRecord
from rebar_depth_bench.data.digests import views_digest
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import OutputError
from tests.commands import run_in_process
from tests.synthetic_dataset import write_split_dataset

SMALL = BuildRequest(configs=("pile",), views=10, width=64, height=36)


def space_of(plan: ConfigPlan, out: Path) -> ConfigSpace:
    return config_space([plan], Finished(out), stagings_by_label(out))


@pytest.mark.parametrize("config", ["lattice", "lattice-orbit"])
def test_estimate_is_above_real_views_by_its_margin(tiny_root: Path, config: str) -> None:
    entry = open_folder(tiny_root).config(config)
    shards_bytes = sum((tiny_root / name).stat().st_size for name in entry.shards)
    estimated_bytes = len(entry.views) * view_bytes(RigSpec(160, 90), has_colour=True)
    assert shards_bytes < estimated_bytes < 1.6 * shards_bytes


def test_mesh_is_estimated_from_the_assembly(tiny_root: Path, tmp_path: Path) -> None:
    [spec] = BuildRequest(configs=("lattice",)).config_specs()
    space = space_of(plan_config(spec, 1, tmp_path), tmp_path)
    mesh_bytes = (tiny_root / "meshes" / "lattice.ply").stat().st_size
    assert mesh_bytes < space.mesh_bytes < 1.1 * mesh_bytes


def test_views_without_colour_are_smaller() -> None:
    rig = RigSpec()
    assert view_bytes(rig, has_colour=False) < view_bytes(rig, has_colour=True)


def test_only_missing_views_count_in_resumed_build(tmp_path: Path) -> None:
    [spec] = SMALL.config_specs()
    plan = plan_config(spec, SMALL.views, tmp_path)
    before = space_of(plan, tmp_path)
    plan.staging.row(plan.indices[0]).parent.mkdir(parents=True)
    for index in plan.indices[:4]:
        plan.staging.row(index).write_bytes(bytes(1000))
    resumed = space_of(plan, tmp_path)
    assert resumed.staged_bytes == 4000
    assert resumed.missing_bytes == before.missing_bytes * 6 // 10
    assert resumed.kept_bytes == before.kept_bytes - before.missing_bytes * 4 // 10
    assert resumed.replaced_bytes == 0


def test_files_of_an_older_build_are_freed_only_after_their_config(tmp_path: Path) -> None:
    [spec] = SMALL.config_specs()
    plan = plan_config(spec, SMALL.views, tmp_path)
    abandoned = plan.staging.root.with_name("pile-0123456789abcdef") / "rows" / "0001.parquet"
    abandoned.parent.mkdir(parents=True)
    abandoned.write_bytes(bytes(500))
    assert space_of(plan, tmp_path).replaced_bytes == 500
    first, second = ConfigSpace(0, 100, 10, replaced_bytes=60), ConfigSpace(0, 100, 10)
    assert needed_bytes([first]) == 100 + 110 + 10
    assert needed_bytes([first, second]) == (110 - 60) + 220
    assert needed_bytes([]) == 0


def test_staged_rows_are_packed_beside_themselves() -> None:
    assert needed_bytes([ConfigSpace(staged_bytes=900, missing_bytes=100, mesh_bytes=0)]) == 100 + 1000


def test_space_of_a_new_folder_is_that_of_its_disk(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "a" / "b") == pytest.approx(shutil.disk_usage(tmp_path).free, abs=1e9)


def test_build_that_does_not_fit_is_named_with_its_numbers(tmp_path: Path) -> None:
    check_space(tmp_path, [ConfigSpace(0, 1000, 0)])
    with pytest.raises(OutputError) as error:
        check_space(tmp_path, [ConfigSpace(0, 10**18, 0)])
    assert str(tmp_path) in str(error.value)
    assert "needs about 2e+06 TB" in str(error.value)
    assert "are free" in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("extra", [(), ("--workers", "3"), ("--scene", "tests/data/two-bars.toml")])
def test_build_that_does_not_fit_is_refused_before_it_starts(tmp_path: Path, extra: tuple[str, ...]) -> None:
    huge = ("--config", "lattice-distance", "--width", "8192", "--height", "8192", "--samples", "1")
    usable = shutil.disk_usage(tmp_path).free
    configs = ("--config", "lattice", "pile", "pier", "lattice-12", "lattice-zed", "lattice-zed-12")
    process = run_in_process(main, "--out", tmp_path / "dataset", *huge, *configs, *extra)
    if usable > 500e9:
        pytest.skip("the disk of the temporary folder has room for a huge build")
    assert process.returncode == 1, process.stdout
    assert "of disk space" in process.stderr
    assert not any(tmp_path.iterdir())


def test_scenes_of_a_config_are_staged_together_and_replace_their_own_shards(tmp_path: Path) -> None:
    write_split_dataset(tmp_path, dict.fromkeys("abc", "test"), 1)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    request = BuildRequest(("cages",), width=64, height=36, colour=None, cages=CagesRequest("test", 4, 2))
    plans = [plan_config(spec, None, tmp_path) for spec in request.config_specs()]
    for scene, plan in zip(manifest["configs"]["cages"]["scenes"], plans, strict=False):
        scene["bytes"] = 1000
        for view in manifest["configs"]["cages"]["views"]:
            view["view_id"] = view["view_id"].replace(f"-{scene['name']}-", f"-{plan.spec.scene.name}-")
        scene["name"] = plan.spec.scene.name
    entry = manifest["configs"]["cages"]
    entry["ground_truth_digest"] = views_digest(ViewRecord(**view) for view in entry["views"])
    manifest["ground_truth"]["digest"] = entry["ground_truth_digest"]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    finished = Finished(tmp_path)
    one, all_of_them = (config_space(part, finished, {}) for part in (plans[:1], plans))
    assert (one.replaced_bytes, all_of_them.replaced_bytes) == (1000, 3000)
    assert all_of_them.missing_bytes == 4 * one.missing_bytes
    assert spaces_by_config(tmp_path, plans, finished) == {"cages": all_of_them}


def test_published_config_needs_no_space(tiny_root: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(tiny_root, tmp_path / "dataset"))
    [spec] = BuildRequest(configs=("lattice",), width=160, height=90).config_specs()
    space = space_of(plan_config(spec, None, root), root)
    assert space.replaced_bytes == sum(path.stat().st_size for path in root.glob("lattice/*.parquet"))


@pytest.mark.parametrize(
    ("count", "text"),
    [(12, "0.012 kB"), (999_400, "999 kB"), (999_600, "1 MB"), (1.234e9, "1.23 GB"), (3.4e12, "3.4 TB")],
)
def test_bytes_are_shown_in_decimal_units(count: float, text: str) -> None:
    assert bytes_text(count) == text
