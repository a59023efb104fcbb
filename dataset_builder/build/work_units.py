"""Units of work: runs of views of one config, rendered somewhere and received here.

A unit is idempotent and covers only views that are not staged yet. What comes back is a ``Delivery``. A unit
rendered on this machine leaves its rows in the staging folder, view by view, and its delivery carries none; a
unit rendered elsewhere carries each row's bytes. Either way nothing counts before ``receive`` has checked it.

All rows of a config are cast against one mesh. Its digest is written down with the first delivery, since the
mesh itself, tens of megabytes, travels only with the one unit that was asked for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from dataset_builder.build.plan import ConfigPlan, generator_stamp
from dataset_builder.build.shards import Staging, runs_of_views
from dataset_builder.config.specs import ConfigSpec
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import BuildError, InputError
from rebar_depth_bench.atomic_io import write_bytes, write_text

_MESH_DIGEST = "mesh.sha256"


@dataclass(frozen=True)
class Unit:
    """Render some views of one config's shard.

    ``with_mesh`` asks for the mesh as well, ``mesh_sha256`` is the digest it must have where that is known, and
    ``stamp`` holds the software versions that the bytes depend on.
    """

    config: ConfigSpec
    shard: int
    indices: tuple[int, ...]
    with_mesh: bool
    mesh_sha256: str | None
    stamp: Mapping[str, str]

    @property
    def what(self) -> str:
        """What the unit renders, in words."""
        if not self.indices:
            return f"the mesh of {self.config.name}"
        return f"{self.config.name} views {self.indices[0]} to {self.indices[-1]}"


@dataclass(frozen=True)
class StagedRow:
    """One view's staged Parquet file: the view's index, the file's bytes and their SHA-256 where it was made."""

    index: int
    content: bytes
    sha256: str


@dataclass(frozen=True)
class Delivery:
    """What came of a unit: who rendered it, seconds by stage, its mesh's digest, and what is not staged yet."""

    worker: str
    seconds: Mapping[str, float]
    mesh_sha256: str
    mesh: bytes | None = None
    rows: tuple[StagedRow, ...] = ()


def units_of(plan: ConfigPlan) -> list[Unit]:
    """Return what is left to render of a plan; the first unit is asked for the mesh where it is not staged."""
    known, stamp = _known_mesh_sha256(plan.staging), generator_stamp()
    needs_mesh = not plan.staging.mesh.is_file()
    left = [
        (shard, missing)
        for shard, run in enumerate(runs_of_views(plan.indices))
        if (missing := tuple(index for index in run if not plan.staging.row(index).is_file()))
    ]
    if needs_mesh and not left:
        left = [(0, ())]
    return [
        Unit(plan.spec, shard, missing, needs_mesh and place == 0, known, stamp)
        for place, (shard, missing) in enumerate(left)
    ]


def check_stamp(expected: Mapping[str, str], worker: str, found: Mapping[str, str]) -> None:
    """Raise ``InputError`` where the software ``found`` on a worker is not the one the parent expects."""
    different = [
        f"{name} {found.get(name, 'missing')}, expected {expected.get(name, 'none')}"
        for name in sorted({*found, *expected})
        if found.get(name) != expected.get(name)
    ]
    if different:
        raise InputError(
            f"worker {worker} has other software than the machine that builds: {'; '.join(different)}"
        )


def packed(delivery: Delivery, unit: Unit, staging: Staging) -> Delivery:
    """Return the delivery with the bytes of the unit's rows, and of the mesh where it was asked for."""
    contents = {index: staging.row(index).read_bytes() for index in unit.indices}
    return Delivery(
        delivery.worker,
        delivery.seconds,
        delivery.mesh_sha256,
        mesh=staging.mesh.read_bytes() if unit.with_mesh else None,
        rows=tuple(StagedRow(index, content, _sha256(content)) for index, content in contents.items()),
    )


def receive(unit: Unit, delivery: Delivery, staging: Staging) -> None:
    """Check a delivery against its digests and against the config's mesh, then stage what it carries.

    Raises ``BuildError`` that names config, views and worker where anything is missing or does not match; then
    nothing of the delivery is staged. The unit is not sent out again: the next build does that.
    """
    known = _known_mesh_sha256(staging)
    problems = [*_mesh_problems(unit, delivery, staging, known), *_row_problems(unit, delivery, staging)]
    if problems:
        raise BuildError(f"{unit.what}, rendered by {delivery.worker}: refused: {'; '.join(problems)}")
    if known is None or not _mesh_digest(staging).is_file():
        write_text(_mesh_digest(staging), delivery.mesh_sha256)
    if delivery.mesh is not None:
        write_bytes(staging.mesh, delivery.mesh)
    for row in delivery.rows:
        write_bytes(staging.row(row.index), row.content)


def _mesh_problems(unit: Unit, delivery: Delivery, staging: Staging, known: str | None) -> Iterator[str]:
    if known not in (None, delivery.mesh_sha256):
        yield f"its mesh has sha256 {delivery.mesh_sha256}, the config's other views were cast against {known}"
    if delivery.mesh is not None and _sha256(delivery.mesh) != delivery.mesh_sha256:
        yield f"the mesh arrived as sha256 {_sha256(delivery.mesh)}, expected {delivery.mesh_sha256}"
    if unit.with_mesh and delivery.mesh is None and not staging.mesh.is_file():
        yield "the mesh is missing"


def _row_problems(unit: Unit, delivery: Delivery, staging: Staging) -> Iterator[str]:
    arrived = {row.index for row in delivery.rows}
    for index in unit.indices:
        if index not in arrived and not staging.row(index).is_file():
            yield f"view {index} is missing"
    for row in delivery.rows:
        if row.index not in unit.indices:
            yield f"view {row.index} was not asked for"
        if _sha256(row.content) != row.sha256:
            yield f"view {row.index} arrived as sha256 {_sha256(row.content)}, expected {row.sha256}"


def _known_mesh_sha256(staging: Staging) -> str | None:
    """Return the digest of the mesh that the staged rows were cast against, None while there is none."""
    if _mesh_digest(staging).is_file():
        return _mesh_digest(staging).read_text()
    return file_sha256(staging.mesh) if staging.mesh.is_file() else None


def _mesh_digest(staging: Staging) -> Path:
    return staging.root / _MESH_DIGEST


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
