"""Work units of a build, and the checks of their results.

A work unit renders views of one shard of a config. Without colour it renders those of several shards, because
starting a process and building the scene take as long as several views. It is idempotent and contains only views
that are not staged yet. Its result is a ``UnitResult``. A unit rendered on this machine writes its rows to the
staging folder, view by view, and its result contains no files; the result of a unit rendered elsewhere contains
the requested ones. In both cases ``accept_result`` checks the result before it is used.

The ground truth of all rows of a scene is cast against the same mesh. The digest of the mesh is stored with the
first result; the mesh itself, tens of megabytes, is returned only by the one unit that has ``with_mesh`` set.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from dataset_builder.pipeline.plan import ConfigPlan
from dataset_builder.pipeline.shards import VIEWS_PER_SHARD, Staging, split_into_shards
from dataset_builder.specs.config_specs import ConfigSpec
from rebar_depth_bench.base.errors import BuildError, InputError
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import read_file
from rebar_depth_bench.base.writing import write_bytes, write_text
from rebar_depth_bench.data.files import file_sha256

VIEWS_WITHOUT_COLOUR = 4 * VIEWS_PER_SHARD
"""Views of a work unit without colour."""


@dataclass(frozen=True)
class WorkUnit:
    """Work unit: views ``indices`` of a config, all of ``shard`` or, without colour, of it and the next ones.

    ``with_mesh`` requests the mesh as well; ``mesh_sha256`` is its required digest (None: not known yet).
    """

    config: ConfigSpec
    shard: int
    indices: tuple[int, ...]
    with_mesh: bool
    mesh_sha256: str | None

    @property
    def label(self) -> str:
        """Name of the unit in messages."""
        if not self.indices:
            return f"the mesh of {self.config.label}"
        return f"{self.config.label} views {self.indices[0]} to {self.indices[-1]}"

    def files(self, staging: Staging) -> list[Path]:
        """Return the paths of the requested rows and of the mesh, if it is requested, in a staging folder."""
        return [*map(staging.row, self.indices), *([staging.mesh] if self.with_mesh else [])]


@dataclass(frozen=True)
class ReceivedFile:
    """File of a staging folder elsewhere: path in it, content, and the SHA-256 computed where it was made."""

    name: str
    content: bytes
    sha256: str


@dataclass(frozen=True)
class UnitResult:
    """Result of a unit: worker, seconds by stage, digest of the mesh, and the requested files not staged yet."""

    worker: str
    seconds: Mapping[str, float]
    mesh_sha256: str
    files: tuple[ReceivedFile, ...] = ()


def remaining_units(plan: ConfigPlan) -> list[WorkUnit]:
    """Return the units of the views not staged yet; the first one requests the mesh if that is not staged."""
    known_mesh_sha256 = _known_mesh_sha256(plan.staging)
    needs_mesh = not plan.staging.mesh.is_file()
    views = VIEWS_WITHOUT_COLOUR if plan.spec.colour is None else VIEWS_PER_SHARD
    incomplete = [
        (position * views // VIEWS_PER_SHARD, missing)
        for position, run in enumerate(split_into_shards(plan.indices, views))
        if (missing := tuple(i for i in run if not plan.staging.row(i).is_file()))
    ]
    if needs_mesh and not incomplete:
        incomplete = [(0, ())]
    return [
        WorkUnit(plan.spec, shard, missing, needs_mesh and position == 0, known_mesh_sha256)
        for position, (shard, missing) in enumerate(incomplete)
    ]


def with_files(result: UnitResult, unit: WorkUnit, staging: Staging) -> UnitResult:
    """Return the result of a unit with the content of the files that it requests."""
    contents = {path.relative_to(staging.root).as_posix(): path.read_bytes() for path in unit.files(staging)}
    return replace(
        result, files=tuple(ReceivedFile(name, content, _sha256(content)) for name, content in contents.items())
    )


def accept_result(unit: WorkUnit, result: UnitResult, staging: Staging) -> None:
    """Check a result against its digests and against the mesh of the config, then stage its rows and mesh.

    Raises ``BuildError`` naming config, views and worker if anything is missing or does not match; nothing of the
    result is then staged. The unit is not retried before the next build.
    """
    known_mesh_sha256 = _known_mesh_sha256(staging)
    if problems := [*_problems(unit, result, staging, known_mesh_sha256)]:
        raise BuildError(f"{unit.label}, rendered by {result.worker}: rejected: {'; '.join(problems)}")
    if known_mesh_sha256 is None or not staging.mesh_digest.is_file():
        write_text(staging.mesh_digest, result.mesh_sha256)
    for file in result.files:
        write_bytes(staging.root / file.name, file.content)


def _problems(
    unit: WorkUnit, result: UnitResult, staging: Staging, known_mesh_sha256: str | None
) -> Iterator[str]:
    """Yield what is wrong with a result: its mesh, files that are damaged or not requested, and missing files."""
    if known_mesh_sha256 not in (None, result.mesh_sha256):
        yield (
            f"its mesh has sha256 {result.mesh_sha256}, expected "
            f"{known_mesh_sha256} as for the scene's other views"
        )
    requested = {path.relative_to(staging.root).as_posix(): path for path in unit.files(staging)}
    for file in result.files:
        if file.name not in requested:
            yield f"{file.name} was not requested"
        is_mesh = requested.get(file.name) == staging.mesh
        expected, actual = result.mesh_sha256 if is_mesh else file.sha256, _sha256(file.content)
        if actual != expected:
            yield f"{file.name} was received with sha256 {actual}, expected {expected}"
    arrived = {file.name for file in result.files}
    for name, path in requested.items():
        if name not in arrived and not path.is_file():
            yield f"{name} is missing"


def _known_mesh_sha256(staging: Staging) -> str | None:
    """Return the digest of the mesh that the staged rows were cast against, or None if there is none yet.

    Raises ``InputError`` if the file of the digest holds anything else.
    """
    path = staging.mesh_digest
    if not path.is_file():
        return file_sha256(staging.mesh) if staging.mesh.is_file() else None
    content = read_file(path, TOML_BYTES, "a digest", InputError)
    if not re.fullmatch(rb"[0-9a-f]{64}", content):
        raise InputError(f"{path}: is not a digest, expected 64 hexadecimal digits; delete {staging.root}")
    return content.decode()


def stage_mesh_digest(staging: Staging, sha256: str) -> None:
    """Require that the mesh of all views to be rendered has this digest, unless there is one already."""
    if _known_mesh_sha256(staging) is None:
        write_text(staging.mesh_digest, sha256)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
