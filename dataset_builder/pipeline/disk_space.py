"""Sizes of a build: views, disk space and memory. Refused: what does not fit, or is too large for its readers.

While a config is built, its rows are staged and then packed into shards beside them. Staged rows and replaced
files are deleted when it has been published; their space is not counted on. The scratch folders of the workers of
a cluster, which hold one work unit per render process, are not checked.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from dataset_builder.pipeline.folder import existing_ancestor
from dataset_builder.pipeline.plan import ConfigPlan, by_config, config_parameters, generator_versions
from dataset_builder.pipeline.retained import Finished
from dataset_builder.scene.variants.registry import image_light
from dataset_builder.specs.config_specs import RigSpec, SceneConfigSpec
from rebar_depth_bench.base.errors import InputError, OutputError
from rebar_depth_bench.base.limits import JSON_BYTES, TABLE_BYTES
from rebar_depth_bench.data.bars import BARS_FILE, decoded_bytes
from rebar_depth_bench.data.files import MANIFEST_FILE

_MEASURED_PIXELS = 640 * 360
_COLOUR_BYTES, _TRUTH_BYTES = 1.61, 2.11
"""Bytes per pixel of a grid of ``_MEASURED_PIXELS``: largest mean of the views of lattice, pile and pier.

Both eyes of a view together; colour is largest for the pier, ground truth for the lattice. The variant ``sensor``
needs no more.
"""
_EXPONENT = -0.22
"""Decrease of the bytes per pixel with the number of pixels, since edges cover a smaller share of larger images.

A view of the lattice has 6.4, 4.8, 3.4 and 2.4 bytes per pixel at 160 x 90, 320 x 180, 640 x 360 and 1280 x 720.
"""
_MARGIN = 1.15
"""Margin for views with more detail than those of these scenes, whose sizes are estimated 1.2 to 1.5 times."""
_SURROUNDINGS_BYTES = 1_000_000
"""Allowance for surfaces in the mesh of a scene that are no steel (0.1 MB), contact sheet and metadata."""


_VIEW_BYTES, _SCENE_BYTES, _HEAD_BYTES = 280, 1200, 2000
"""Lengths in the manifest: a view, a scene without its parameters, and the rest, with digests of their files."""
_PROCESS_BYTES, _PANORAMA_BYTES, _MEMORY_BYTES_PER_PIXEL = 660_000_000, 330_000_000, 850
"""Peak memory of a render process: with any image, what a panorama adds, and growth with the number of pixels.

Lattice, pile and pier differ by 5 %. ``python -m benchmarks.build`` prints the memory at 1280 x 720.
"""
_CAGE_BYTES = 6_000_000
"""Allowance for the mesh of a generated cage, which is not made for an estimate: the mean of 40 is 4 MB."""


@dataclass(frozen=True)
class ConfigSpace:
    """Additional disk space of a config: what is staged until it is published, and its finished files, bytes."""

    staged_bytes: int
    finished_bytes: int


def view_bytes(rig: RigSpec, has_colour: bool) -> int:
    """Return the estimated size of one view of both eyes."""
    pixels = rig.width * rig.height
    at_measured_size = _TRUTH_BYTES + _COLOUR_BYTES if has_colour else _TRUTH_BYTES
    return int(_MARGIN * at_measured_size * pixels * (pixels / _MEASURED_PIXELS) ** _EXPONENT)


def spaces_by_config(plans: Sequence[ConfigPlan]) -> dict[str, ConfigSpace]:
    """Return the disk space by name of each config of plans that are missing in their folder."""
    return {name: config_space(of_config) for name, of_config in by_config(plans).items()}


def config_space(plans: Sequence[ConfigPlan]) -> ConfigSpace:
    """Return the disk space of one config, of which ``plans`` are the scenes that are missing or to be replaced.

    All rows of all scenes are staged before their shards are packed.
    """
    per_view = view_bytes(plans[0].spec.rig, plans[0].spec.colour is not None)
    views, mesh_bytes = sum(len(plan.indices) for plan in plans), sum(map(_mesh_bytes, plans))
    missing = views - sum(plan.staging.row(index).is_file() for plan in plans for index in plan.indices)
    return ConfigSpace(missing * per_view + mesh_bytes, views * per_view + mesh_bytes)


def needed_bytes(spaces: Collection[ConfigSpace]) -> int:
    """Return the largest additional space at any time while configs are built one after the other."""
    return sum(space.finished_bytes for space in spaces) + max((space.staged_bytes for space in spaces), default=0)


def free_bytes(out: Path) -> int:
    """Return the space that is free for a folder, which need not exist yet."""
    return shutil.disk_usage(existing_ancestor(out)).free


def check_readable(plans: Sequence[ConfigPlan], finished: Finished) -> None:
    """Raise ``InputError`` if the folder would have a manifest or bars that are larger than their readers accept.

    ``plans`` are those that are missing in the folder, with their cameras. Crossings need less than bars.
    """
    entries = ([config_parameters(plan.spec), plan.derived(), generator_versions()] for plan in plans)
    manifest_bytes = _HEAD_BYTES + sum(len(json.dumps(entry, indent=1)) + _SCENE_BYTES for entry in entries)
    manifest_bytes += sum(len(plan.indices) * (_VIEW_BYTES + len(plan.spec.view_id(0))) for plan in plans)
    bars_bytes = sum(bar.decoded_bytes for plan in plans for bar in plan.bars)
    if finished.folder is not None:
        manifest_bytes += Path(finished.folder.root, MANIFEST_FILE).stat().st_size
        bars_bytes += decoded_bytes(Path(finished.folder.root, BARS_FILE))
    for limit, size, what in (
        (JSON_BYTES, manifest_bytes, "the manifest"),
        (TABLE_BYTES, bars_bytes, f"the decoded {BARS_FILE}"),
    ):
        if size > limit.value():
            raise InputError(
                f"{what} of the folder would have about {size} bytes and could not be read, expected "
                f"{limit.allowed('bytes')}; build fewer scenes or views"
            )


def estimate_lines(out: Path, plans: Sequence[ConfigPlan], finished: Finished) -> Iterator[str]:
    """Yield lines that tell what building the plans in the folder ``out`` needs: views, disk space and memory."""
    views, spaces = 0, spaces_by_config([plan for plan in plans if not finished.has(plan)])
    for name, of_config in by_config(plans).items():
        spec, planned = of_config[0].spec, sum(len(plan.indices) for plan in of_config)
        scenes = f" in {len(of_config)} scenes," if len(of_config) > 1 else ""
        yield f"{name}: {planned} views{scenes} of two pictures, {spec.rig.width} x {spec.rig.height}"
        if name not in spaces:
            yield "  up to date: nothing to render"
            continue
        missing = sum(_missing_views(plan, finished) for plan in of_config if not finished.has(plan))
        views, space = views + missing, spaces[name]
        colour = asdict(spec.colour).items() if spec.colour else [("none", "")]
        yield f"  views: {missing} to render ({2 * missing} pictures), {planned - missing} already rendered"
        yield f"  colour: {', '.join(f'{key} {value}'.rstrip() for key, value in colour)}"
        finished_text, building_text = bytes_text(space.finished_bytes), bytes_text(needed_bytes([space]))
        yield f"  disk space: {finished_text} finished, {building_text} to build"
        yield f"  memory: about {bytes_text(max(map(memory_bytes, of_config)))} in each render process"
    yield f"total: {views} of {sum(len(plan.indices) for plan in plans)} views to render"
    needed_text, free_text = bytes_text(needed_bytes(spaces.values())), bytes_text(free_bytes(out))
    yield f"disk space: {needed_text} needed, {free_text} free for {out}"


def _missing_views(plan: ConfigPlan, finished: Finished) -> int:
    """Return the number of views of a plan that are neither staged nor kept from the finished config."""
    staged = sum(plan.staging.row(index).is_file() for index in plan.indices)
    return len(plan.indices) - staged - len(finished.kept_views(plan))


def memory_bytes(plan: ConfigPlan) -> int:
    """Return the peak memory of a process that renders colour of a plan; without colour, it needs less."""
    panorama_bytes = _PANORAMA_BYTES if image_light(plan.spec.scene) is not None else 0
    return _PROCESS_BYTES + panorama_bytes + _MEMORY_BYTES_PER_PIXEL * plan.spec.rig.width * plan.spec.rig.height


def check_space(out: Path, spaces: Collection[ConfigSpace]) -> None:
    """Raise ``OutputError`` if building configs one after the other needs more than the free disk space."""
    needed, free = needed_bytes(spaces), free_bytes(out)
    if needed > free:
        raise OutputError(
            f"{out}: the build needs about {bytes_text(needed)} of disk space, but {bytes_text(free)} are free: "
            "delete other files, choose another folder, or build fewer configs, fewer views or smaller images"
        )


def bytes_text(count: float) -> str:
    """Return a number of bytes in decimal units."""
    for unit in ("kB", "MB", "GB"):
        count /= 1000
        if count < 999.5:
            return f"{count:.3g} {unit}"
    return f"{count / 1000:.3g} TB"


def _mesh_bytes(plan: ConfigPlan) -> int:
    """Return the size of the mesh file: 24 bytes per vertex and 15 per face."""
    if isinstance(plan.spec, SceneConfigSpec):
        return _SURROUNDINGS_BYTES + _CAGE_BYTES
    meshes = [part.mesh for part in plan.assembly.parts]
    return _SURROUNDINGS_BYTES + sum(24 * len(mesh.vertices_m) + 15 * len(mesh.faces) for mesh in meshes)
