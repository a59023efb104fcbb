"""Build plan of a scene of a config: its views, the places of its cameras, and its key.

The key is the digest of all parameters that determine the bytes of the views.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from dataset_builder.cameras.trajectories import aim_point_m, subset, view_count
from dataset_builder.pipeline.shards import VIEWS_PER_SHARD, Staging
from dataset_builder.scene.model import Assembly, Note
from dataset_builder.scene.variants.props import form_planes, make_props
from dataset_builder.scene.variants.registry import image_light
from dataset_builder.scene.variants.sensor import sensor_spec
from dataset_builder.specs.config_specs import ConfigSpec, GeneratedCageSpec, RandomViewsSpec, SceneConfigSpec
from dataset_builder.user_files.make_assembly import assembly_bars, make_assembly
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.files import parameters_digest
from rebar_depth_bench.data.schema import ROW_SCHEMA, FormPlane

if TYPE_CHECKING:
    from dataset_builder.scene.assemblies.cage import Cage

KEY_CHARACTERS = 16
STAGING_KEY = f"[0-9a-f]{{{KEY_CHARACTERS}}}"
"""Pattern of the end of a staging folder's name."""
BUILD_FOLDER = ".rebar-build"
MAX_NOTES, _MAX_NOTE_CHARACTERS = 20, 4000
"""Largest number of notes on scene files that are printed, and of characters of one."""
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
    """Plan of one config, or of one scene of it: spec, view indices in the full trajectory, key and staging.

    ``cage`` is what was read from the user's file that the spec names; None for a generated assembly.
    """

    spec: ConfigSpec
    indices: tuple[int, ...]
    key: str
    staging: Staging
    cage: Cage | None = field(default=None, compare=False)

    @property
    def view_ids(self) -> dict[str, int]:
        """Indices of the views by their ids, in order."""
        return {self.spec.view_id(index): index for index in self.indices}

    @cached_property
    def assembly(self) -> Assembly:
        """Bars and meshes of the config, made on first access. Raises what ``make_assembly`` raises."""
        return make_assembly(self.spec.scene.assembly, self.cage)

    @property
    def bars(self) -> tuple[Bar, ...]:
        """Bars of the scene; those of a generated cage are made without meshes."""
        if isinstance(self.spec, SceneConfigSpec):
            return assembly_bars(self.spec.scene.assembly)
        return self.assembly.bars

    def derived(self) -> dict[str, Any]:
        """Return what the scene's entry in the manifest has beside the parameters, and follows from them."""
        matrix = self.assembly.world_from_source
        placement = {} if matrix is None else {"world_from_source": matrix.tolist()}
        planes = form_planes(self.spec.scene, make_props(self.assembly, self.spec.scene))
        return {"aim_point_m": aim_point_m(self.assembly).tolist(), **_planes_entry(planes), **placement}


def _planes_entry(planes: Iterable[FormPlane]) -> dict[str, Any]:
    dumped = [plane.model_dump() for plane in planes]
    return {"planes": dumped} if dumped else {}


def plan_config(spec: ConfigSpec, views: int | None, out: Path, cage: Cage | None = None) -> ConfigPlan:
    """Return the plan of one config in the dataset folder ``out``; ``views`` limits the number of views.

    ``cage`` is required for a config of a user's file.

    The key does not depend on the views, so that a build of another number of them uses what is staged. That of a
    generated scene, whose cameras are not placed yet, does not depend on their places either: these follow from
    the other parameters.
    """
    indices = tuple(subset(view_count(spec.protocol), views))
    key = parameters_digest([config_parameters(spec), VIEWS_PER_SHARD, ROW_SCHEMA.names, generator_versions()])
    staging = Staging(out / BUILD_FOLDER / f"{spec.label}-{key[:KEY_CHARACTERS]}")
    return ConfigPlan(spec, indices, key, staging, cage)


def by_config(plans: Iterable[ConfigPlan]) -> dict[str, list[ConfigPlan]]:
    """Return plans by the name of their config, in order."""
    plans_by_name: dict[str, list[ConfigPlan]] = {}
    for plan in plans:
        plans_by_name.setdefault(plan.spec.name, []).append(plan)
    return plans_by_name


def config_parameters(spec: ConfigSpec) -> dict[str, Any]:
    """Return the spec of a config as JSON values, with the parameters of its panorama and its sensor.

    The path of an assembly file is reduced to its name. A scene without forms has no key ``forms``.
    """
    parameters = asdict(spec)
    if not spec.scene.forms:
        del parameters["scene"]["forms"]
    of_variants = {"image_light": image_light(spec.scene), "sensor": sensor_spec(spec.scene)}
    parameters["scene"]["appearance"] |= {key: asdict(value) for key, value in of_variants.items() if value}
    assembly = parameters["scene"]["assembly"]
    if "path" in assembly:
        assembly["path"] = Path(assembly["path"]).name
    values: dict[str, Any] = json.loads(json.dumps(parameters))
    return values


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


@dataclass(frozen=True)
class ScenePlan(ConfigPlan):
    """Plan of a generated scene with its cameras: also its bars, planes of formwork, and the generator's record.

    A cage is generated, and its cameras are placed, only where its scene has to be rendered: this takes about two
    seconds for each. It is done before anything is written, so that a cage that cannot be built leaves no folder.
    """

    bars: tuple[Bar, ...] = ()
    planes: tuple[FormPlane, ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict)

    def derived(self) -> dict[str, Any]:
        """Return the family of the cage, the record of the generator, and the planes of formwork."""
        return {"family": self.record["family"], "cage": dict(self.record), **_planes_entry(self.planes)}


def place_cameras(plans: Sequence[ConfigPlan], processes: int, progress: Progress = silent) -> list[ConfigPlan]:
    """Return the plans; those of generated scenes get the stations of their cameras, in several processes.

    Raises ``InputError`` for a cage that cannot be generated, or round which cameras cannot be placed.
    """
    missing = [plan for plan in plans if isinstance(plan.spec, SceneConfigSpec)]
    if not missing:
        return list(plans)
    placed: dict[str, ScenePlan] = {}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(missing)), mp_context=context) as pool:
        futures: list[Future[ScenePlan]] = [pool.submit(with_cameras, plan) for plan in missing]
        try:
            for done, future in enumerate(futures, start=1):
                plan = future.result()
                placed[plan.key] = plan
                progress("cages and cameras", done, len(missing))
        finally:
            pool.shutdown(cancel_futures=True)
    return [placed.get(plan.key, plan) for plan in plans]


def with_cameras(plan: ConfigPlan) -> ScenePlan:
    """Return the plan of a generated scene with its cameras. Raises as ``place_cameras``."""
    # Only processes that place cameras need these modules.
    from dataset_builder.cameras.camera_placement import with_random_stations
    from dataset_builder.scene.cages.generate import cage_assembly, spec_cage
    from dataset_builder.scene.environments.surroundings import SURROUNDINGS

    spec = plan.spec
    cage = spec_cage(cast(GeneratedCageSpec, spec.scene.assembly))
    assembly = cage_assembly(cage)
    space, props = SURROUNDINGS[spec.scene.environment].cameras, make_props(assembly, spec.scene)
    views = cast(RandomViewsSpec, spec.protocol)
    views = with_random_stations(views, assembly, space, spec.rig, f"scene {spec.label}", props)
    return ScenePlan(
        spec=replace(spec, protocol=views),
        indices=plan.indices,
        key=plan.key,
        staging=plan.staging,
        bars=assembly.bars,
        planes=form_planes(spec.scene, props),
        record=cage.record,
    )


def print_notes(notes: Sequence[Note]) -> None:
    """Print notes on scene files to standard error, at most ``MAX_NOTES`` of them."""
    for note in notes[:MAX_NOTES]:
        print(printable(f"note: {note.source}: {note.text}", _MAX_NOTE_CHARACTERS), file=sys.stderr)
    if len(notes) > MAX_NOTES:
        print(f"note: {len(notes) - MAX_NOTES} more notes are not shown", file=sys.stderr)
