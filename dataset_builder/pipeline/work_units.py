"""Work units of a build, and the checks of their results.

A work unit renders views of one shard of a config. Without colour it renders those of several shards, because
starting a process and building the scene take as long as several views. It is idempotent and contains only views
that are not staged yet. Its result is a ``UnitResult``. A unit rendered on this machine writes its rows to the
staging folder, view by view, and its result contains none; the result of a unit rendered elsewhere contains the
bytes of each row. In both cases ``accept_result`` checks the result before it is used.

The ground truth of all rows of a config is cast against the same mesh. The digest of the mesh is stored with the
first result; the mesh itself, tens of megabytes, is returned only by the one unit that has ``with_mesh`` set.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from dataset_builder.config.specs import ConfigSpec
from dataset_builder.pipeline.plan import ConfigPlan, generator_versions
from dataset_builder.pipeline.shards import VIEWS_PER_SHARD, Staging, split_into_shards
from rebar_depth_bench.atomic_io import write_bytes, write_text
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import BuildError, InputError
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import read_file

VIEWS_WITHOUT_COLOUR = 4 * VIEWS_PER_SHARD
"""Views of a work unit without colour."""
_MESH_DIGEST = "mesh.sha256"


@dataclass(frozen=True)
class WorkUnit:
    """Work unit: views ``indices`` of a config, all of ``shard`` or, without colour, of it and the next ones.

    ``with_mesh`` requests the mesh as well, ``mesh_sha256`` is its required digest (None: not known yet), and
    ``software_versions`` holds the versions of the software that the bytes depend on.
    """

    config: ConfigSpec
    shard: int
    indices: tuple[int, ...]
    with_mesh: bool
    mesh_sha256: str | None
    software_versions: Mapping[str, str]

    @property
    def label(self) -> str:
        """Name of the unit in messages."""
        if not self.indices:
            return f"the mesh of {self.config.label}"
        return f"{self.config.label} views {self.indices[0]} to {self.indices[-1]}"


@dataclass(frozen=True)
class StagedRow:
    """Staged Parquet file of one view: index, content, and the SHA-256 computed where it was rendered."""

    index: int
    content: bytes
    sha256: str


@dataclass(frozen=True)
class UnitResult:
    """Result of a unit: worker, seconds by stage, digest of the mesh, and the mesh and rows not staged yet."""

    worker: str
    seconds: Mapping[str, float]
    mesh_sha256: str
    mesh: bytes | None = None
    rows: tuple[StagedRow, ...] = ()


def remaining_units(plan: ConfigPlan, finished: Collection[int] = ()) -> list[WorkUnit]:
    """Return the units of the views not staged yet; the first one requests the mesh if that is not staged.

    Views with ``finished`` indices are left out.
    """
    known_mesh_sha256, software_versions = _known_mesh_sha256(plan.staging), generator_versions()
    needs_mesh = not plan.staging.mesh.is_file()
    views = VIEWS_WITHOUT_COLOUR if plan.spec.colour is None else VIEWS_PER_SHARD
    incomplete = [
        (position * views // VIEWS_PER_SHARD, missing)
        for position, run in enumerate(split_into_shards(plan.indices, views))
        if (missing := tuple(i for i in run if i not in finished and not plan.staging.row(i).is_file()))
    ]
    if needs_mesh and not incomplete:
        incomplete = [(0, ())]
    return [
        WorkUnit(plan.spec, shard, missing, needs_mesh and position == 0, known_mesh_sha256, software_versions)
        for position, (shard, missing) in enumerate(incomplete)
    ]


def check_software_versions(expected: Mapping[str, str], worker: str, actual: Mapping[str, str]) -> None:
    """Raise ``InputError`` if the software versions ``actual`` on ``worker`` differ from ``expected``."""
    different = [
        f"{name} {actual.get(name, 'missing')}, expected {expected.get(name, 'none')}"
        for name in sorted({*actual, *expected})
        if actual.get(name) != expected.get(name)
    ]
    if different:
        raise InputError(
            f"worker {worker} has other software versions than the building machine: {'; '.join(different)}"
        )


def with_payload(result: UnitResult, unit: WorkUnit, staging: Staging) -> UnitResult:
    """Return the result with the bytes of the rows of the unit, and of the mesh if the unit requests it."""
    contents = {index: staging.row(index).read_bytes() for index in unit.indices}
    rows = tuple(StagedRow(index, content, _sha256(content)) for index, content in contents.items())
    return replace(result, mesh=staging.mesh.read_bytes() if unit.with_mesh else None, rows=rows)


def accept_result(unit: WorkUnit, result: UnitResult, staging: Staging) -> None:
    """Check a result against its digests and against the mesh of the config, then stage its rows and mesh.

    Raises ``BuildError`` naming config, views and worker if anything is missing or does not match; nothing of the
    result is then staged. The unit is not retried before the next build.
    """
    known_mesh_sha256 = _known_mesh_sha256(staging)
    problems = [*_mesh_problems(unit, result, staging, known_mesh_sha256), *_row_problems(unit, result, staging)]
    if problems:
        raise BuildError(f"{unit.label}, rendered by {result.worker}: rejected: {'; '.join(problems)}")
    if known_mesh_sha256 is None or not _mesh_digest_path(staging).is_file():
        write_text(_mesh_digest_path(staging), result.mesh_sha256)
    if result.mesh is not None:
        write_bytes(staging.mesh, result.mesh)
    for row in result.rows:
        write_bytes(staging.row(row.index), row.content)


def _mesh_problems(
    unit: WorkUnit, result: UnitResult, staging: Staging, known_mesh_sha256: str | None
) -> Iterator[str]:
    if known_mesh_sha256 not in (None, result.mesh_sha256):
        yield (
            f"its mesh has sha256 {result.mesh_sha256}, expected "
            f"{known_mesh_sha256} as for the config's other views"
        )
    if result.mesh is not None and _sha256(result.mesh) != result.mesh_sha256:
        yield f"the received mesh has sha256 {_sha256(result.mesh)}, expected {result.mesh_sha256}"
    if unit.with_mesh and result.mesh is None and not staging.mesh.is_file():
        yield "the mesh is missing"


def _row_problems(unit: WorkUnit, result: UnitResult, staging: Staging) -> Iterator[str]:
    arrived = {row.index for row in result.rows}
    for index in unit.indices:
        if index not in arrived and not staging.row(index).is_file():
            yield f"view {index} is missing"
    for row in result.rows:
        if row.index not in unit.indices:
            yield f"view {row.index} was not requested"
        if _sha256(row.content) != row.sha256:
            yield f"view {row.index} was received with sha256 {_sha256(row.content)}, expected {row.sha256}"


def _known_mesh_sha256(staging: Staging) -> str | None:
    """Return the digest of the mesh that the staged rows were cast against, or None if there is none yet.

    Raises ``InputError`` if the file of the digest holds anything else.
    """
    path = _mesh_digest_path(staging)
    if not path.is_file():
        return file_sha256(staging.mesh) if staging.mesh.is_file() else None
    content = read_file(path, TOML_BYTES, "a digest", InputError)
    if not re.fullmatch(rb"[0-9a-f]{64}", content):
        raise InputError(f"{path}: is not a digest, expected 64 hexadecimal digits; delete {staging.root}")
    return content.decode()


def stage_mesh_digest(staging: Staging, sha256: str) -> None:
    """Require that the mesh of all views to be rendered has this digest, unless there is one already."""
    if _known_mesh_sha256(staging) is None:
        write_text(_mesh_digest_path(staging), sha256)


def _mesh_digest_path(staging: Staging) -> Path:
    return staging.root / _MESH_DIGEST


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
