"""Disk space of a build: its estimate, and the refusal of a build that does not fit.

While a config is built, its rows are staged and then packed into shards beside them. The staged rows, and the
files of an older build of the config, are deleted when it has been published. Only views that are not staged yet
are estimated.
The scratch folders of the workers of a cluster, which hold one work unit per render process, are not checked.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from dataset_builder.config.specs import RigSpec, SceneConfigSpec
from dataset_builder.pipeline.folder import SHARD_NAME, existing_ancestor
from dataset_builder.pipeline.plan import ConfigPlan
from dataset_builder.pipeline.publish import is_published
from rebar_depth_bench.errors import OutputError

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


_CAGE_BYTES = 6_000_000
"""Allowance for the mesh of a generated cage, which is not made for an estimate: the mean of 40 is 4 MB."""


@dataclass(frozen=True)
class ConfigSpace:
    """Disk space of a config: bytes of staged views, missing views, the mesh, and the files that it replaces."""

    staged_bytes: int
    missing_bytes: int
    mesh_bytes: int
    replaced_bytes: int = 0

    @property
    def finished_bytes(self) -> int:
        """Size of the finished config in the dataset folder."""
        return self.staged_bytes + self.missing_bytes + self.mesh_bytes

    @property
    def building_bytes(self) -> int:
        """Largest additional space during the build: missing rows, all rows packed, and two copies of the mesh."""
        return self.missing_bytes + self.finished_bytes + self.mesh_bytes

    @property
    def kept_bytes(self) -> int:
        """Additional space after the build; negative if it needs less than what it replaces."""
        return self.finished_bytes - self.staged_bytes - self.replaced_bytes


def view_bytes(rig: RigSpec, has_colour: bool) -> int:
    """Return the estimated size of one view of both eyes."""
    pixels = rig.width * rig.height
    at_measured_size = _TRUTH_BYTES + _COLOUR_BYTES if has_colour else _TRUTH_BYTES
    return int(_MARGIN * at_measured_size * pixels * (pixels / _MEASURED_PIXELS) ** _EXPONENT)


def config_space(plan: ConfigPlan, out: Path) -> ConfigSpace:
    """Return the disk space of a config that is not published yet in the folder ``out``."""
    staged = [path for index in plan.indices if (path := plan.staging.row(index)).is_file()]
    shards = (path for path in (out / plan.spec.name).glob("*.parquet") if SHARD_NAME.fullmatch(path.name))
    abandoned = (os.walk(staging) for staging in plan.all_stagings() if staging != plan.staging.root)
    other_files = (Path(folder, name) for walk in abandoned for folder, _, names in walk for name in names)
    return ConfigSpace(
        _size(staged),
        (len(plan.indices) - len(staged)) * view_bytes(plan.spec.rig, plan.spec.colour is not None),
        _mesh_bytes(plan),
        _size(shards) + _size(other_files),
    )


def needed_bytes(spaces: Iterable[ConfigSpace]) -> int:
    """Return the largest additional space at any time while configs are built one after the other."""
    needed = kept = 0
    for space in spaces:
        needed = max(needed, kept + space.building_bytes)
        kept += space.kept_bytes
    return needed


def free_bytes(out: Path) -> int:
    """Return the space that is free for a folder, which need not exist yet."""
    return shutil.disk_usage(existing_ancestor(out)).free


def check_fits_on_disk(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Raise ``OutputError`` if building the plans needs more than the free disk space.

    Whether configs are published already, which takes long in a large folder, is checked only if it matters.
    """
    if needed_bytes(config_space(plan, out) for plan in plans) > free_bytes(out):
        check_space(out, [config_space(plan, out) for plan in plans if not is_published(out, plan)])


def check_space(out: Path, spaces: Iterable[ConfigSpace]) -> None:
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


def _size(paths: Iterable[Path]) -> int:
    """Return the size of files; those that a build in another process has just removed have none."""
    size = 0
    for path in paths:
        with suppress(FileNotFoundError):
            size += path.stat().st_size
    return size
