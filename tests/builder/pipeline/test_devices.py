"""Devices that render colour: the list of Cycles, and the choice of a type."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataset_builder.catalog.named_configs import CONFIGS, BuildRequest
from dataset_builder.pipeline.blender_process import AUTO, available_devices, choose_device
from dataset_builder.pipeline.plan import config_parameters, plan_config
from dataset_builder.specs.config_specs import CPU, GPU_TYPES, ColourSpec
from rebar_depth_bench.base.errors import InputError
from tests.building import TINY, TWO_BARS, RunBuild

NVIDIA = {"cpu": ["AMD EPYC"], "cuda": ["NVIDIA L4"] * 2, "optix": ["NVIDIA L4"] * 2}
"""Lists as Cycles reports them: a GPU of NVIDIA appears under both of its types."""
AMD = {"cpu": ["AMD EPYC"], "hip": ["AMD Radeon Pro W7900"]}
INTEL = {"cpu": ["Intel Xeon"], "oneapi": ["Intel Arc A770"] * 3}
APPLE = {"cpu": ["Apple M4"], "metal": ["Apple M4 (GPU - 10 cores)"]}
NO_GPU = {"cpu": ["AMD EPYC"]}
SMALL = ("--scene", str(TWO_BARS), "--views", "1", *TINY)


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
    plans = {
        device: plan_config(
            BuildRequest(configs=("pile",), colour=ColourSpec(device=device)).config_specs()[0], 1, tmp_path
        )
        for device in (CPU, *GPU_TYPES)
    }
    assert len({plan.key for plan in plans.values()}) == len(plans)
    for device, plan in plans.items():
        assert config_parameters(plan.spec)["colour"]["device"] == device


def test_raw_grids_need_a_device_with_lenses() -> None:
    for device in (CPU, "optix"):
        assert {
            spec.colour.device
            for spec in BuildRequest(colour=ColourSpec(device=device)).config_specs()
            if spec.colour
        } == {device}
    for device in ("cuda", "hip", "oneapi", "metal"):
        with pytest.raises(InputError, match="lattice-zed-raw: cannot be rendered with"):
            BuildRequest(colour=ColourSpec(device=device)).config_specs()
        others = tuple(name for name in CONFIGS if name != "lattice-zed-raw")
        assert len(BuildRequest(configs=others, colour=ColourSpec(device=device)).config_specs()) == len(others)


@pytest.mark.parametrize("device", ["auto", "gpu", ""])
def test_request_needs_a_concrete_device(device: str) -> None:
    with pytest.raises(InputError, match="--device"):
        BuildRequest(colour=ColourSpec(device=device)).config_specs()


def test_absent_device_is_refused_before_anything_is_written(tmp_path: Path, run_build: RunBuild) -> None:
    available = available_devices()
    assert available[CPU]
    device = next(device for device in ("hip", "cuda") if device not in available)
    process = run_build("--out", tmp_path / "dataset", *SMALL, "--device", device)
    assert process.returncode == 2, process.stderr
    assert f"--device {device}" in process.stderr
    assert f"cpu ({available[CPU][0]})" in process.stderr
    assert not any(tmp_path.iterdir())


def test_auto_without_gpu_continues_a_build_for_the_cpu(tmp_path: Path, run_build: RunBuild) -> None:
    if set(available_devices()) != {CPU}:
        pytest.skip("this machine has a GPU")
    assert run_build("--out", tmp_path, *SMALL).returncode == 0
    process = run_build("--out", tmp_path, *SMALL, "--device", "auto")
    assert "up to date: two-bars" in process.stdout, process.stderr


def test_unknown_device_is_refused(tmp_path: Path, run_build: RunBuild) -> None:
    process = run_build("--out", tmp_path / "dataset", *SMALL, "--device", "vulkan")
    assert process.returncode == 2
    assert "vulkan" in process.stderr
    assert "optix" in process.stderr
