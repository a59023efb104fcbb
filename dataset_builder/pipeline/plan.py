"""Build plan of a config, and its key: the digest of all parameters that determine the bytes of its views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dataset_builder.config.specs import ConfigSpec
from dataset_builder.config.trajectories import aim_point_m, subset, view_count
from dataset_builder.pipeline.shards import VIEWS_PER_SHARD, Staging
from dataset_builder.scene.assemblies import make_assembly
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.variants.registry import image_light
from dataset_builder.scene.variants.sensor import sensor_spec
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.columns import ROW_SCHEMA
from rebar_depth_bench.data.digests import parameters_digest
from rebar_depth_bench.version import software_version

KEY_CHARACTERS = 16
STAGING_KEY = f"[0-9a-f]{{{KEY_CHARACTERS}}}"
"""Pattern of the end of a staging folder's name."""
BUILD_FOLDER = ".rebar-build"
_VERSIONED_LIBRARIES = (
    "bpy",
    "embreex",
    "numpy",
    "opencv-contrib-python-headless",
    "OpenEXR",
    "pillow",
    "pyarrow",
)
"""Libraries that determine the bytes of the result; their versions enter the key and the manifest."""


@dataclass(frozen=True)
class ConfigPlan:
    """Plan of one config, or of one scene of it: spec, view indices in the full trajectory, key and staging."""

    spec: ConfigSpec
    indices: tuple[int, ...]
    key: str
    staging: Staging

    @property
    def view_ids(self) -> dict[str, int]:
        """Indices of the views by their ids, in order."""
        return {self.spec.view_id(index): index for index in self.indices}

    @cached_property
    def assembly(self) -> Assembly:
        """Bars and meshes of the config, made on first access. Raises what ``make_assembly`` raises."""
        return make_assembly(self.spec.scene.assembly)

    @property
    def bars(self) -> tuple[Bar, ...]:
        """Bars of the scene."""
        return self.assembly.bars

    def derived(self) -> dict[str, Any]:
        """Return what the scene's entry in the manifest has beside the parameters, and follows from them."""
        matrix = self.assembly.world_from_source
        placement = {} if matrix is None else {"world_from_source": matrix.tolist()}
        return {"aim_point_m": aim_point_m(self.assembly).tolist(), **placement}


def plan_config(spec: ConfigSpec, views: int | None, out: Path) -> ConfigPlan:
    """Return the plan of one config in the dataset folder ``out``; ``views`` limits the number of views.

    The key does not depend on the views, so that a build of another number of them uses what is staged. That of a
    generated scene, whose cameras are not placed yet, does not depend on their places either: these follow from
    the other parameters.
    """
    indices = tuple(subset(view_count(spec.protocol), views))
    key = parameters_digest([config_parameters(spec), VIEWS_PER_SHARD, ROW_SCHEMA.names, generator_versions()])
    return ConfigPlan(spec, indices, key, Staging(out / BUILD_FOLDER / f"{spec.label}-{key[:KEY_CHARACTERS]}"))


def config_parameters(spec: ConfigSpec) -> dict[str, Any]:
    """Return the spec of a config as JSON values, with the parameters of its panorama and its sensor.

    The path of an assembly file is reduced to its name.
    """
    parameters = asdict(spec)
    of_variants = {"image_light": image_light(spec.scene), "sensor": sensor_spec(spec.scene)}
    parameters["scene"]["appearance"] |= {key: asdict(value) for key, value in of_variants.items() if value}
    assembly = parameters["scene"]["assembly"]
    if "path" in assembly:
        assembly["path"] = Path(assembly["path"]).name
    return parameters


@cache
def generator_versions() -> Mapping[str, str]:
    """Return the versions of this software and of the libraries in ``_VERSIONED_LIBRARIES``."""
    return {
        "rebar-depth-bench": software_version(),
        **{name: _installed_version(name) for name in _VERSIONED_LIBRARIES},
    }


def _installed_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "of another distribution"  # For example OpenCV built with a window toolkit.
