"""What a Blender process can be asked to do. Plain values: they are pickled to the process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dataset_builder.optics import Camera
from dataset_builder.specs import ConfigSpec


@dataclass(frozen=True)
class RenderTask:
    """Render views of one shard of a config into ``staging``; views already staged are not done again.

    Idempotent: the same task gives the same bytes, however often it is interrupted. Where ``mesh_sha256`` is
    known, a scene whose mesh has another digest is refused before anything is rendered.
    """

    config: ConfigSpec
    shard: int
    indices: tuple[int, ...]
    staging: Path
    threads: int
    mesh_sha256: str | None = None


@dataclass(frozen=True)
class DepthTask:
    """Render Cycles' own planar depth of a mesh file from some cameras; one float32 .npy each into ``out``."""

    mesh: Path
    cameras: tuple[Camera, ...]
    out: Path
    threads: int


Task = RenderTask | DepthTask
