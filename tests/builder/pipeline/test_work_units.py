"""Work units: planning without repeated work, and validation of results returned by workers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.pipeline.plan import ConfigPlan, plan_config
from dataset_builder.pipeline.work_units import (
    ReceivedFile,
    UnitResult,
    WorkUnit,
    accept_result,
    remaining_units,
    with_files,
)
from rebar_depth_bench.base.errors import BuildError

MESH = b"ply: the mesh that rays were cast against"


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def make_row(index: int) -> ReceivedFile:
    content = f"row {index}".encode()
    return ReceivedFile(f"rows/{index:04d}.parquet", content, sha256(content))


def make_result(unit: WorkUnit) -> UnitResult:
    mesh = [ReceivedFile("mesh.ply", MESH, sha256(MESH))] if unit.with_mesh else []
    return UnitResult("tcp://far:1", {"colour": 1.0}, sha256(MESH), (*map(make_row, unit.indices), *mesh))


def staged_files(plan: ConfigPlan) -> dict[str, bytes]:
    root = plan.staging.root
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def plan(tmp_path: Path) -> ConfigPlan:
    """Return a plan of 17 views: two shards of eight and one of one."""
    return plan_config(CONFIGS["lattice"](), 17, tmp_path)


def test_units_cover_views_once_and_request_one_mesh(plan: ConfigPlan) -> None:
    units = remaining_units(plan)
    assert [len(unit.indices) for unit in units] == [8, 8, 1]
    assert sum((unit.indices for unit in units), ()) == plan.indices
    assert [unit.with_mesh for unit in units] == [True, False, False]
    assert {unit.mesh_sha256 for unit in units} == {None}


def test_units_without_colour_cover_several_shards(tmp_path: Path) -> None:
    plan = plan_config(replace(CONFIGS["lattice"](), colour=None), 70, tmp_path)
    units = remaining_units(plan)
    assert [(unit.shard, len(unit.indices)) for unit in units] == [(0, 32), (4, 32), (8, 6)]
    assert sum((unit.indices for unit in units), ()) == plan.indices


def test_staged_views_are_not_planned_again(plan: ConfigPlan) -> None:
    first, second, third = remaining_units(plan)
    accept_result(second, make_result(second), plan.staging)
    accept_result(third, make_result(third), plan.staging)
    plan.staging.row(first.indices[3]).write_bytes(b"staged before a kill")
    (remaining,) = remaining_units(plan)
    assert remaining.shard == 0
    assert remaining.indices == first.indices[:3] + first.indices[4:]
    assert remaining.with_mesh
    assert remaining.mesh_sha256 == sha256(MESH)
    accept_result(remaining, make_result(remaining), plan.staging)
    assert remaining_units(plan) == []
    assert plan.staging.mesh.read_bytes() == MESH
    assert plan.staging.row(first.indices[3]).read_bytes() == b"staged before a kill"
    assert plan.staging.row(first.indices[2]).read_bytes() == f"row {first.indices[2]}".encode()


def test_missing_mesh_is_planned_alone(plan: ConfigPlan) -> None:
    for unit in remaining_units(plan):
        accept_result(unit, make_result(unit), plan.staging)
    plan.staging.mesh.unlink()
    (unit,) = remaining_units(plan)
    assert (unit.indices, unit.with_mesh, unit.label) == ((), True, "the mesh of lattice")


def with_damaged_row(result: UnitResult) -> UnitResult:
    first, *others = result.files
    return replace(result, files=(replace(first, content=first.content[:-1] + b"!"), *others))


def with_empty_row(result: UnitResult) -> UnitResult:
    first, *others = result.files
    return replace(result, files=(replace(first, content=b""), *others))


def with_damaged_mesh(result: UnitResult) -> UnitResult:
    *rows, mesh = result.files
    return replace(result, files=(*rows, replace(mesh, content=MESH + b" ")))


def with_other_mesh(result: UnitResult) -> UnitResult:
    *rows, mesh = result.files
    another = replace(mesh, content=b"another", sha256=sha256(b"another"))
    return replace(result, files=(*rows, another), mesh_sha256=another.sha256)


def with_missing_row(result: UnitResult) -> UnitResult:
    return replace(result, files=result.files[1:])


def with_missing_mesh(result: UnitResult) -> UnitResult:
    return replace(result, files=result.files[:-1])


def with_extra_row(result: UnitResult) -> UnitResult:
    return replace(result, files=(*result.files, make_row(3)))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (with_damaged_row, "rows/0014.parquet was received with sha256"),
        (with_empty_row, f"was received with sha256 {sha256(b'')}, expected"),
        (with_damaged_mesh, "mesh.ply was received with sha256"),
        (with_other_mesh, f"its mesh has sha256 {sha256(b'another')}, expected"),
        (with_missing_row, "rows/0014.parquet is missing"),
        (with_missing_mesh, "mesh.ply is missing"),
        (with_extra_row, "rows/0003.parquet was not requested"),
    ],
)
def test_result_that_does_not_match_unit_is_rejected(
    plan: ConfigPlan, spoil: Callable[[UnitResult], UnitResult], words: str
) -> None:
    first, second, _ = remaining_units(plan)
    accept_result(second, make_result(second), plan.staging)
    before = staged_files(plan)
    with pytest.raises(BuildError) as raised:
        accept_result(first, spoil(make_result(first)), plan.staging)
    message = str(raised.value)
    assert (
        f"lattice views {first.indices[0]} to {first.indices[-1]}, rendered by tcp://far:1: rejected: " in message
    )
    assert words in message
    assert staged_files(plan) == before
    accept_result(first, make_result(first), plan.staging)
    assert len(staged_files(plan)) == len(before) + 9


def test_local_result_without_payload_needs_staged_rows(plan: ConfigPlan) -> None:
    first, *_ = remaining_units(plan)
    local_result = UnitResult("this machine", {}, sha256(MESH))
    plan.staging.mesh.parent.mkdir(parents=True)
    plan.staging.mesh.write_bytes(MESH)
    with pytest.raises(BuildError, match=rf"rows/{first.indices[-1]:04d}\.parquet is missing"):
        accept_result(first, local_result, plan.staging)
    plan.staging.row(14).parent.mkdir()
    for index in first.indices:
        plan.staging.row(index).write_bytes(make_row(index).content)
    accept_result(first, local_result, plan.staging)
    assert with_files(local_result, first, plan.staging) == replace(
        make_result(first), worker="this machine", seconds={}
    )
