"""Disk space of a build: estimates from real data, resumed builds, and refusal before the start."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dataset_builder.catalog.cages_config import CagesRequest
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.cli.main import main
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
from dataset_builder.pipeline.plan import plan_config
from dataset_builder.specs.config_specs import RigSpec
from rebar_depth_bench.base.errors import OutputError
from rebar_depth_bench.data.manifest import open_folder
from tests.commands import run_in_process

SMALL = BuildRequest(configs=("pile",), views=10, width=64, height=36)


@pytest.mark.parametrize("config", ["lattice", "lattice-orbit"])
def test_estimate_is_above_real_views_by_its_margin(tiny_root: Path, config: str) -> None:
    entry = open_folder(tiny_root).config(config)
    shards_bytes = sum((tiny_root / name).stat().st_size for name in entry.shards)
    estimated_bytes = len(entry.views) * view_bytes(RigSpec(160, 90), has_colour=True)
    assert shards_bytes < estimated_bytes < 1.6 * shards_bytes


def test_mesh_is_estimated_from_the_assembly(tiny_root: Path, tmp_path: Path) -> None:
    [spec] = BuildRequest(configs=("lattice",)).config_specs()
    estimated_bytes = config_space([plan_config(spec, 1, tmp_path)]).staged_bytes - view_bytes(spec.rig, True)
    mesh_bytes = (tiny_root / "meshes" / "lattice.ply").stat().st_size
    assert mesh_bytes < estimated_bytes < 1.1 * mesh_bytes


def test_views_without_colour_are_smaller() -> None:
    rig = RigSpec()
    assert view_bytes(rig, has_colour=False) < view_bytes(rig, has_colour=True)


def test_only_missing_views_are_staged_in_a_resumed_build(tmp_path: Path) -> None:
    [spec] = SMALL.config_specs()
    plan = plan_config(spec, SMALL.views, tmp_path)
    before, per_view = config_space([plan]), view_bytes(spec.rig, has_colour=True)
    plan.staging.row(plan.indices[0]).parent.mkdir(parents=True)
    for index in plan.indices[:4]:
        plan.staging.row(index).write_bytes(bytes(1000))
    resumed = config_space([plan])
    assert resumed.staged_bytes == before.staged_bytes - 4 * per_view
    assert resumed.finished_bytes == before.finished_bytes


def test_rows_of_one_config_at_a_time_are_beside_finished_files() -> None:
    assert needed_bytes([ConfigSpace(staged_bytes=100, finished_bytes=110)]) == 210
    assert needed_bytes([ConfigSpace(100, 110), ConfigSpace(300, 320), ConfigSpace(0, 5)]) == 435 + 300
    assert needed_bytes([]) == 0


def test_space_of_a_new_folder_is_that_of_its_disk(tmp_path: Path) -> None:
    assert free_bytes(tmp_path / "a" / "b") == pytest.approx(shutil.disk_usage(tmp_path).free, abs=1e9)


def test_build_that_does_not_fit_is_named_with_its_numbers(tmp_path: Path) -> None:
    check_space(tmp_path, [ConfigSpace(0, 1000)])
    with pytest.raises(OutputError) as error:
        check_space(tmp_path, [ConfigSpace(10**18, 10**18)])
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


def test_scenes_of_a_config_are_staged_together(tmp_path: Path) -> None:
    request = BuildRequest(("cages",), width=64, height=36, colour=None, cages=CagesRequest("test", 4, 2))
    plans = [plan_config(spec, None, tmp_path) for spec in request.config_specs()]
    one, all_of_them = config_space(plans[:1]), spaces_by_config(plans)["cages"]
    assert all_of_them == ConfigSpace(4 * one.staged_bytes, 4 * one.finished_bytes)


@pytest.mark.parametrize(
    ("count", "text"),
    [(12, "0.012 kB"), (999_400, "999 kB"), (999_600, "1 MB"), (1.234e9, "1.23 GB"), (3.4e12, "3.4 TB")],
)
def test_bytes_are_shown_in_decimal_units(count: float, text: str) -> None:
    assert bytes_text(count) == text
