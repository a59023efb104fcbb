"""Scene file fragments and a writer of scene files for tests."""

from __future__ import annotations

from pathlib import Path

from dataset_builder.catalog.scene_file import read_scene
from dataset_builder.specs.config_specs import ConfigSpec

BAR = "[[bar]]\ndiameter = 10\npoints = [[-100, 0, 50], [100, 0, 50]]\n"


MM = 'unit = "mm"\n'


def write_scene(folder: Path, content: str | bytes, name: str = "my-beam.toml") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def scene_config(path: Path) -> ConfigSpec:
    return read_scene(path).config
