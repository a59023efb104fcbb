"""What a Blender process can be asked to do. Plain values: they are pickled to the process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dataset_builder.optics import Camera
from dataset_builder.specs import ConfigSpec


@dataclass(frozen=True)
class RenderTask:
    """Render one shard's views of a config into ``staging``; views already staged are not done again.

    Idempotent: the same task gives the same bytes, however often it is interrupted.
    """

    config: ConfigSpec
    shard: int
    indices: tuple[int, ...]
    staging: Path
    threads: int


@dataclass(frozen=True)
class DepthTask:
    """Render Cycles' own planar depth of a mesh file from some cameras; one float32 .npy each into ``out``."""

    mesh: Path
    cameras: tuple[Camera, ...]
    out: Path
    threads: int


Task = RenderTask | DepthTask
