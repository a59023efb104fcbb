"""What comes back from a machine is checked before it counts, and is planned so that nothing is done twice."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dataset_builder.config.catalog import CONFIGS
from dataset_builder.build.plan import ConfigPlan, generator_stamp, plan_config
from dataset_builder.build.work_units import Delivery, StagedRow, Unit, check_stamp, packed, receive, units_of
from rebar_depth_bench.errors import BuildError, InputError

MESH = b"ply: the mesh that rays were cast against"


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def row_of(index: int) -> StagedRow:
    content = f"row {index}".encode()
    return StagedRow(index, content, sha256(content))


def delivery_of(unit: Unit) -> Delivery:
    rows = tuple(row_of(index) for index in unit.indices)
    return Delivery("tcp://far:1", {"colour": 1.0}, sha256(MESH), MESH if unit.with_mesh else None, rows)


def staged(plan: ConfigPlan) -> dict[str, bytes]:
    root = plan.staging.root
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def plan(tmp_path: Path) -> ConfigPlan:
    """Seventeen views: two shards of eight and one of one."""
    return plan_config(CONFIGS["lattice"](), 17, tmp_path)


def test_units_cover_every_view_once_and_ask_for_one_mesh(plan: ConfigPlan) -> None:
    units = units_of(plan)
    assert [len(unit.indices) for unit in units] == [8, 8, 1]
    assert sum((unit.indices for unit in units), ()) == plan.indices
    assert [unit.with_mesh for unit in units] == [True, False, False]
    assert {unit.mesh_sha256 for unit in units} == {None}


def test_what_is_staged_is_not_sent_out_again(plan: ConfigPlan) -> None:
    first, second, third = units_of(plan)
    receive(second, delivery_of(second), plan.staging)
    receive(third, delivery_of(third), plan.staging)
    plan.staging.row(first.indices[3]).write_bytes(b"staged before a kill")
    (left,) = units_of(plan)
    assert left.shard == 0
    assert left.indices == first.indices[:3] + first.indices[4:]
    assert left.with_mesh
    assert left.mesh_sha256 == sha256(MESH)
    receive(left, delivery_of(left), plan.staging)
    assert units_of(plan) == []
    assert plan.staging.mesh.read_bytes() == MESH
    assert plan.staging.row(first.indices[3]).read_bytes() == b"staged before a kill"
    assert plan.staging.row(first.indices[2]).read_bytes() == f"row {first.indices[2]}".encode()


def test_a_lost_mesh_alone_is_asked_for_again(plan: ConfigPlan) -> None:
    for unit in units_of(plan):
        receive(unit, delivery_of(unit), plan.staging)
    plan.staging.mesh.unlink()
    (unit,) = units_of(plan)
    assert (unit.indices, unit.with_mesh, unit.what) == ((), True, "the mesh of lattice")


def damaged_row(delivery: Delivery) -> Delivery:
    first, *others = delivery.rows
    return replace(delivery, rows=(replace(first, content=first.content[:-1] + b"!"), *others))


def cut_row(delivery: Delivery) -> Delivery:
    *others, last = delivery.rows
    return replace(delivery, rows=(*others, replace(last, content=b"")))


def damaged_mesh(delivery: Delivery) -> Delivery:
    return replace(delivery, mesh=MESH + b" ")


def other_mesh(delivery: Delivery) -> Delivery:
    return replace(delivery, mesh=b"another", mesh_sha256=sha256(b"another"))


def without_a_row(delivery: Delivery) -> Delivery:
    return replace(delivery, rows=delivery.rows[1:])


def without_the_mesh(delivery: Delivery) -> Delivery:
    return replace(delivery, mesh=None)


def with_a_row_too_many(delivery: Delivery) -> Delivery:
    return replace(delivery, rows=(*delivery.rows, row_of(3)))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (damaged_row, "view 14 arrived as sha256"),
        (cut_row, f"arrived as sha256 {sha256(b'')}, expected"),
        (damaged_mesh, "the mesh arrived as sha256"),
        (other_mesh, f"its mesh has sha256 {sha256(b'another')}, the config's other views were cast against"),
        (without_a_row, "view 14 is missing"),
        (without_the_mesh, "the mesh is missing"),
        (with_a_row_too_many, "view 3 was not asked for"),
    ],
)
def test_a_delivery_that_does_not_match_is_refused_whole(
    plan: ConfigPlan, spoil: Callable[[Delivery], Delivery], words: str
) -> None:
    first, second, _ = units_of(plan)
    receive(second, delivery_of(second), plan.staging)
    before = staged(plan)
    with pytest.raises(BuildError) as refused:
        receive(first, spoil(delivery_of(first)), plan.staging)
    said = str(refused.value)
    assert f"lattice views {first.indices[0]} to {first.indices[-1]}, rendered by tcp://far:1: refused: " in said
    assert words in said
    assert staged(plan) == before
    receive(first, delivery_of(first), plan.staging)
    assert len(staged(plan)) == len(before) + 9


def test_rows_rendered_here_are_not_carried_but_must_be_there(plan: ConfigPlan) -> None:
    first, *_ = units_of(plan)
    here = Delivery("this machine", {}, sha256(MESH))
    plan.staging.mesh.parent.mkdir(parents=True)
    plan.staging.mesh.write_bytes(MESH)
    with pytest.raises(BuildError, match=f"view {first.indices[-1]} is missing"):
        receive(first, here, plan.staging)
    plan.staging.row(14).parent.mkdir()
    for index in first.indices:
        plan.staging.row(index).write_bytes(row_of(index).content)
    receive(first, here, plan.staging)
    assert packed(here, first, plan.staging) == replace(delivery_of(first), worker="this machine", seconds={})


def test_other_software_is_refused_by_name() -> None:
    ours = dict(generator_stamp())
    check_stamp(ours, "tcp://far:1", dict(ours))
    theirs = {**ours, "embreex": "4.3.0"}
    del theirs["pillow"]
    with pytest.raises(InputError) as refused:
        check_stamp(ours, "tcp://far:1", theirs)
    said = str(refused.value)
    assert said.startswith("worker tcp://far:1 has other software")
    assert f"embreex 4.3.0, expected {ours['embreex']}; pillow missing, expected {ours['pillow']}" in said
    assert "numpy" not in said
