"""Options of builds: those that are refused, devices, ``--dry-run``, and the disk space that a build needs."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dataset_builder.catalog.cages_config import MAX_SCENES, CagesRequest
from dataset_builder.catalog.named_configs import CONFIGS, BuildRequest
from dataset_builder.cli.main import main
from dataset_builder.pipeline.blender_process import AUTO, available_devices, choose_device
from dataset_builder.pipeline.disk_space import (
    ConfigSpace,
    check_space,
    config_space,
    needed_bytes,
    spaces_by_config,
    view_bytes,
)
from dataset_builder.pipeline.plan import config_parameters, plan_config
from dataset_builder.specs.config_specs import CPU, GPU_TYPES, QUALITIES, ColourSpec, RigSpec
from rebar_depth_bench.base.errors import InputError, OutputError
from rebar_depth_bench.data.manifest import open_folder
from tests.building import TINY, TWO_BARS
from tests.commands import run_in_process

SMALL = ("--scene", str(TWO_BARS), "--views", "9", *TINY)
CAGES = ("--config", "cages", "--split", "test")
NVIDIA = {"cpu": ["AMD EPYC"], "cuda": ["NVIDIA L4"] * 2, "optix": ["NVIDIA L4"] * 2}
"""Lists as Cycles reports them: a GPU of NVIDIA appears under both of its types."""
AMD = {"cpu": ["AMD EPYC"], "hip": ["AMD Radeon Pro W7900"]}
INTEL = {"cpu": ["Intel Xeon"], "oneapi": ["Intel Arc A770"] * 3}
APPLE = {"cpu": ["Apple M4"], "metal": ["Apple M4 (GPU - 10 cores)"]}
NO_GPU = {"cpu": ["AMD EPYC"]}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--config", "latice"), "--config: got 'latice', expected one of lattice"),
        (("--views", "0"), "--views: got 0, expected 1 to"),
        (("--width", "2", "--samples", "0"), "--width: got 2, expected 16 to 8192 - --samples: got 0"),
        (("--quality", "high", "--samples", "4"), "--samples: not allowed with argument --quality"),
        (("--sampling", "best"), "invalid choice: 'best' (choose from 'steel-first', 'uniform')"),
        (("--workers", "0"), "--workers is 0, expected 1 or more"),
        (("--no-colour", "--samples", "4"), "--no-colour is combined with --samples 4, expected only one"),
        (
            ("--no-colour", "--quality", "high", "--sampling", "uniform", "--device", "cpu"),
            "combined with --sampling uniform, --quality high, --device cpu",
        ),
        (("--config", "lattice", "audit", "ROOT"), "--config is followed by the command audit"),
        (("--views", "3", "audit", "tiny"), "unrecognized arguments: audit tiny"),
        (("--mesh", "nothing.stl"), "nothing.stl"),
        (("--mesh", __file__), "unsupported mesh file type '.py', expected"),
        (("--scene", "missing.toml"), "missing.toml"),
        (("--device", "vulkan"), "--device: invalid choice: 'vulkan' (choose from 'cpu', 'optix', 'cuda'"),
        (("--cluster", "tcp://a:1", "--workers", "2"), "--workers 2 is combined with --cluster tcp://a:1"),
        ((*CAGES[:-1], "val"), "--split: got 'val', expected one of train, validation, test"),
        ((*CAGES, "--scenes", "0"), "--scenes: got 0"),
        ((*CAGES, "--scenes", str(MAX_SCENES + 1)), f"--scenes: got {MAX_SCENES + 1}"),
        ((*CAGES, "--scenes", "1", "--views-per-scene", "0"), "--views-per-scene: got 0"),
        ((*CAGES, "--views", "3"), "--views: is combined with --config cages"),
        ((*CAGES, "--variant", "rusted"), "--variant: is combined with --config cages"),
        (("--config", "lattice", "--scenes", "3"), "--scenes: only cages has such scenes"),
    ],
)
def test_unusable_options_are_refused_and_nothing_is_written(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    for dry_run in ((), ("--dry-run",)):
        process = run_in_process(main, "--out", tmp_path / "dataset", *dry_run, *arguments)
        assert process.returncode == 2
        assert words in " ".join(process.stderr.split())
        assert "Traceback" not in process.stderr
        assert not any(tmp_path.iterdir())


def test_mesh_option_is_refused_for_other_scenes(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(b"")
    options = ("--config", "pile", "--mesh", tmp_path / "a.stl")
    process = run_in_process(main, "--out", tmp_path / "dataset", *options)
    assert process.returncode == 2
    assert "--mesh replaces the rods of a lattice, but config pile is not a lattice" in process.stderr


def test_folders_that_cannot_be_built_in_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for root in (tmp_path, tmp_path / "file", tmp_path / "file" / "below"):
        for dry_run in ((), ("--dry-run",)):
            process = run_in_process(main, "--out", root, *SMALL, *dry_run)
            assert process.returncode == 2, process.stdout
            assert "Traceback" not in process.stderr
            assert str(root) in process.stderr
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file", "mine")]


UNPRIVILEGED = """
import os, sys
from pathlib import Path
from dataset_builder.pipeline.folder import check_target
from rebar_depth_bench.base.errors import OutputError

if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
for root in sys.argv[1:]:
    try:
        check_target(Path(root), {"pile"})
    except OutputError as error:
        print(error)
"""


@pytest.mark.slow
def test_folders_without_permission_are_refused_before_the_start(tmp_path: Path) -> None:
    for mode in (0o555, 0o000):
        (tmp_path / f"{mode:o}").mkdir(mode=mode)
    roots = [str(folder / below) for folder in tmp_path.iterdir() for below in (".", "a/dataset")]
    command = [sys.executable, "-c", UNPRIVILEGED, *roots]
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    for root in roots:
        assert f"{root}: cannot be written" in process.stdout


def test_dry_run_prints_views_space_and_memory_and_writes_nothing(tmp_path: Path) -> None:
    process = run_in_process(main, "--out", tmp_path / "new" / "dataset", *SMALL, "--dry-run")
    assert process.returncode == 0, process.stderr
    assert "two-bars: 9 views of two pictures, 160 x 90" in process.stdout
    assert "9 to render (18 pictures), 0 already rendered" in process.stdout
    assert f"steel_samples {QUALITIES['preview'].steel_samples}" in process.stdout
    memory = re.search(r"memory: about ([\d.]+) ([MG])B in each", process.stdout)
    assert memory
    assert 200 < float(memory[1]) * (1000 if memory[2] == "G" else 1) < 5000
    assert re.search(r"disk space: [\d.]+ MB needed, [\d.]+ [GT]B free", process.stdout)
    process = run_in_process(main, "--out", tmp_path / "dataset", *SMALL[:-2], "--no-colour", "--dry-run")
    assert process.returncode == 0, process.stderr
    assert "  colour: none" in process.stdout.splitlines()
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_dry_run_of_a_mesh_and_a_variant_writes_nothing(tiny_root: Path, tmp_path: Path) -> None:
    mesh = ("--mesh", tiny_root / "meshes" / "lattice.ply", "--mesh-unit", "m")
    options = ("--config", "lattice", "--variant", "dusk", "--views", "2", *TINY, "--workers", "2")
    process = run_in_process(main, "--out", tmp_path / "dataset", *mesh, *options, "--dry-run")
    assert process.returncode == 0, process.stderr
    assert "lattice-dusk: 2 views" in process.stdout
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("available", "expected"),
    [
        (NVIDIA, "optix"),
        (AMD, "hip"),
        (INTEL, "oneapi"),
        (APPLE, "metal"),
        ({"cpu": ["Xeon"], "hip": ["Radeon"], "cuda": ["GTX 680"], "optix": []}, "cuda"),
        (NO_GPU, CPU),
        ({}, CPU),
    ],
)
def test_auto_is_the_best_type_of_the_list(available: dict[str, list[str]], expected: str) -> None:
    assert choose_device(AUTO, available, "this machine") == expected


@pytest.mark.parametrize("available", [NVIDIA, AMD, INTEL, APPLE, NO_GPU])
def test_named_type_is_used_or_refused_with_the_list(available: dict[str, list[str]]) -> None:
    for device in (CPU, *GPU_TYPES):
        if device in available:
            assert choose_device(device, available, "this machine") == device
        else:
            with pytest.raises(InputError) as error:
                choose_device(device, available, "worker tcp://a:1")
            assert str(error.value).startswith(f"--device {device}: worker tcp://a:1 has no such device")
            for name, models in available.items():
                assert f"{name} ({', '.join(models)})" in str(error.value)


def test_device_is_part_of_key_and_manifest(tmp_path: Path) -> None:
    plans = {}
    for device in (CPU, *GPU_TYPES):
        [spec] = BuildRequest(configs=("pile",), colour=ColourSpec(device=device)).config_specs()
        plans[device] = plan_config(spec, 1, tmp_path)
    assert len({plan.key for plan in plans.values()}) == len(plans)
    for device, plan in plans.items():
        assert config_parameters(plan.spec)["colour"]["device"] == device


def test_raw_grids_need_a_device_with_lenses() -> None:
    for device in (CPU, "optix"):
        specs = BuildRequest(colour=ColourSpec(device=device)).config_specs()
        assert {spec.colour.device for spec in specs if spec.colour} == {device}
    for device in ("cuda", "hip", "oneapi", "metal"):
        with pytest.raises(InputError, match="lattice-zed-raw: cannot be rendered with"):
            BuildRequest(colour=ColourSpec(device=device)).config_specs()
        others = tuple(name for name in CONFIGS if name != "lattice-zed-raw")
        assert len(BuildRequest(configs=others, colour=ColourSpec(device=device)).config_specs()) == len(others)


def test_request_needs_a_concrete_device() -> None:
    for device in ("auto", "gpu", ""):
        with pytest.raises(InputError, match="--device"):
            BuildRequest(colour=ColourSpec(device=device)).config_specs()


@pytest.mark.usefixtures("blender")
def test_absent_device_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    available = available_devices()
    assert available[CPU]
    device = next(device for device in ("hip", "cuda") if device not in available)
    process = run_in_process(main, "--out", tmp_path / "dataset", *SMALL, "--device", device)
    assert process.returncode == 2, process.stderr
    assert f"--device {device}" in process.stderr
    assert f"cpu ({available[CPU][0]})" in process.stderr
    assert not any(tmp_path.iterdir())


def test_estimate_is_above_real_views_by_its_margin(tiny_root: Path) -> None:
    rig = RigSpec(160, 90)
    assert view_bytes(rig, has_colour=False) < view_bytes(rig, has_colour=True)
    for config in open_folder(tiny_root).config_by_name.values():
        shards_bytes = sum((tiny_root / name).stat().st_size for name in config.shards)
        estimated_bytes = len(config.views) * view_bytes(rig, has_colour=True)
        assert shards_bytes < estimated_bytes < 1.6 * shards_bytes


def test_mesh_is_estimated_from_the_assembly(tiny_root: Path, tmp_path: Path) -> None:
    [spec] = BuildRequest(configs=("lattice",)).config_specs()
    estimated_bytes = config_space([plan_config(spec, 1, tmp_path)]).staged_bytes - view_bytes(spec.rig, True)
    mesh_bytes = (tiny_root / "meshes" / "lattice.ply").stat().st_size
    assert mesh_bytes < estimated_bytes < 1.1 * mesh_bytes


def test_only_missing_views_are_staged_in_a_resumed_build(tmp_path: Path) -> None:
    [spec] = BuildRequest(configs=("pile",), width=64, height=36).config_specs()
    plan = plan_config(spec, 10, tmp_path)
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
