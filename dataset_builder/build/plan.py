"""What a build has to do for one config, and the key that names everything that decides its bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.trajectories import offsets_m, subset
from dataset_builder.build.shards import VIEWS_PER_SHARD, Staging
from dataset_builder.config.specs import ConfigSpec
from rebar_depth_bench.data.digests import parameters_digest
from rebar_depth_bench.version import software_version

_KEY_CHARACTERS = 16
BUILD_FOLDER = ".rebar-build"
_STAMPED = ("bpy", "embreex", "numpy", "opencv-contrib-python-headless", "OpenEXR", "pillow", "pyarrow")
"""Libraries that decide bytes; their versions are part of the key and stand in the manifest."""


@dataclass(frozen=True)
class ConfigPlan:
    """One config to build: its spec, which of its protocol's views, and where its pieces are staged."""

    spec: ConfigSpec
    indices: tuple[int, ...]
    key: str
    staging: Staging

    def all_stagings(self) -> list[Path]:
        """Return the staging folders of this config, those of abandoned builds with other parameters included."""
        return list(self.staging.root.parent.glob(f"{self.spec.name}-{'[0-9a-f]' * _KEY_CHARACTERS}"))

    @property
    def parameters(self) -> dict[str, Any]:
        """Every parameter of the config, as the manifest holds it."""
        return config_parameters(self.spec)


def plan_config(spec: ConfigSpec, views: int | None, out: Path) -> ConfigPlan:
    """Return the plan of one config in the dataset folder ``out``."""
    indices = tuple(subset(len(offsets_m(spec.protocol)), views))
    decides_bytes = [config_parameters(spec), indices, VIEWS_PER_SHARD, generator_stamp()]
    key = parameters_digest(decides_bytes)
    return ConfigPlan(spec, indices, key, Staging(out / BUILD_FOLDER / f"{spec.name}-{key[:_KEY_CHARACTERS]}"))


def plan_request(request: BuildRequest, out: Path) -> list[ConfigPlan]:
    """Return the plans of all requested configs."""
    return [plan_config(spec, request.views, out) for spec in request.config_specs()]


def config_parameters(spec: ConfigSpec) -> dict[str, Any]:
    """Return a config's spec as plain JSON values; a mesh file is named without its folder."""
    parameters = asdict(spec)
    assembly = parameters["scene"]["assembly"]
    if "path" in assembly:
        assembly["path"] = Path(assembly["path"]).name
    return parameters


def generator_stamp() -> Mapping[str, str]:
    """Return the versions of this software and of the libraries that decide bytes."""
    return {"rebar-depth-bench": software_version(), **{name: _installed(name) for name in _STAMPED}}


def _installed(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "of another distribution"  # such as OpenCV with a window toolkit
