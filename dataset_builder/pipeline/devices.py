"""Devices that render colour: the list of this machine, the choice of a type, and the device of each process.

Cycles itself lists the devices, in a Blender process. Only the type of the device is part of a config's key, so
that equal GPUs give equal keys; GPUs of different models may differ in the last bit of a pixel. Rendering on a GPU
is untested: the machines that this was written on have none. The choice is tested on lists as Cycles reports them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from dataset_builder.config.specs import CPU, GPU_TYPES
from dataset_builder.pipeline.blender_process import BlenderProcesses, DevicesTask, Event
from rebar_depth_bench.atomic_io import scratch_folder
from rebar_depth_bench.errors import InputError

AUTO = "auto"
"""Choice of the best type of device that the machine has."""

DeviceNames = Mapping[str, Sequence[str]]
"""Names of the devices by type, ``cpu`` or one of ``GPU_TYPES``; types without devices are absent."""


@dataclass(frozen=True)
class Devices:
    """Devices of one type that render a build; the CPU is one device."""

    type: str = CPU
    count: int = 1


def find_devices(requested: str) -> Devices:
    """Return the devices of this machine for a value of ``--device``.

    Raises what ``choose_devices`` raises, and ``RenderProcessError`` if Blender fails while it lists the devices.
    """
    return Devices() if requested == CPU else choose_devices(requested, available_devices(), "this machine")


def available_devices() -> DeviceNames:
    """Return the devices of this machine, as Cycles lists them in a Blender process."""
    found: dict[str, list[str]] = {}

    def on_event(event: Event) -> None:
        found.update(event["devices"])

    with scratch_folder("rebar-devices-") as scratch, BlenderProcesses() as blender:
        blender.run(DevicesTask(), "the list of devices", scratch / "blender.log", on_event)
    return found


def choose_devices(requested: str, available: DeviceNames, machine: str) -> Devices:
    """Return the devices of the type ``requested``, or of the best available type for ``auto``.

    Raises ``InputError`` that lists the devices of ``machine`` if it has none of this type.
    """
    if requested == AUTO:
        requested = next((name for name in GPU_TYPES if available.get(name)), CPU)
    if requested == CPU:
        return Devices()
    if not available.get(requested):
        listed = [f"{device} ({', '.join(names)})" for device, names in available.items()]
        raise InputError(
            f"--device {requested}: {machine} has no such device, expected one of those that Cycles finds: "
            f"{'; '.join(listed) or CPU}"
        )
    return Devices(requested, len(available[requested]))


class DeviceShares:
    """Number of render processes on each of several equal devices; thread-safe."""

    def __init__(self, devices: int) -> None:
        self._running = [0] * devices
        self._lock = threading.Lock()

    @contextmanager
    def least_busy(self) -> Iterator[int]:
        """Yield the index of the device with the fewest processes, the first of them; count one until the end."""
        with self._lock:
            index = self._running.index(min(self._running))
            self._running[index] += 1
        try:
            yield index
        finally:
            with self._lock:
                self._running[index] -= 1
