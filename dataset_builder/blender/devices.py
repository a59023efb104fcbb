"""Devices of Cycles: their list, and the selection of the one device that renders colour.

Ground truth is ray cast on the CPU and does not depend on the device. Rendering on a GPU is untested, since no
machine with one was at hand; listing, selection of the CPU and refusal of absent devices are tested.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import bpy

from dataset_builder.config.specs import CPU, GPU_TYPES
from dataset_builder.pipeline.blender_process import DevicesTask
from rebar_depth_bench.errors import InputError


def run_devices_task(task: DevicesTask, report: Callable[[Mapping[str, Any]], None]) -> None:  # noqa: ARG001
    """Report the devices of this machine."""
    report({"devices": available_devices()})


def available_devices() -> dict[str, list[str]]:
    """Return the names of the devices by type; types without devices are absent."""
    supported = {entry[0].lower() for entry in _preferences().get_device_types(bpy.context)}
    found = {device: [entry.name for entry in _entries(device)] for device in (CPU, *GPU_TYPES)}
    return {device: names for device, names in found.items() if names and device in (CPU, *supported)}


def select_device(device: str, index: int) -> None:
    """Let Cycles render the open scene on device number ``index`` of a type, and on no other device.

    Required after ``configure_colour``. The compositor denoises on the CPU in any case: images are then denoised
    in the same way on all devices, and the GPU's memory holds only the scene.

    Raises ``InputError`` if there is no such device.
    """
    cycles = bpy.context.scene.cycles
    if device == CPU:
        cycles.device = "CPU"
        return
    chosen = _entries(device)[index : index + 1]
    if not chosen:
        listed = ", ".join(f"{name} ({len(names)})" for name, names in available_devices().items())
        raise InputError(f"--device {device}: device {index} was not found, only: {listed}")
    preferences = _preferences()
    preferences.compute_device_type = device.upper()
    for entry in preferences.devices:
        entry.use = (entry.type, entry.id) == (chosen[0].type, chosen[0].id)
    cycles.device = "GPU"


def _preferences() -> Any:
    """Return the preferences of Cycles; ``read_factory_settings`` replaces them."""
    return bpy.context.preferences.addons["cycles"].preferences


def _entries(device: str) -> list[Any]:
    """Return Cycles' entries of the devices of a type, in the order of their ids, which hold the PCI address."""
    entries = _preferences().get_devices_for_type(device.upper())
    return sorted((entry for entry in entries if entry.type == device.upper()), key=lambda entry: entry.id)
