"""Renderer of prepared rows, for builds whose views need not show anything.

The rows are those of ``benchmarks/scale.py``, which tests do not import.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from dataset_builder.pipeline.blender_process import OnViewDone
from dataset_builder.pipeline.plan import ConfigPlan, ScenePlan
from dataset_builder.pipeline.shards import Staging, View, encode_view, stage_row
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.specs.config_specs import ConfigSpec, RandomViewsSpec
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.rows import RenderedEye
from rebar_depth_bench.geometry.cameras import Camera, ideal_K

BARS = tuple(Bar(i + 1, "bar", 0.02, ((0.1 * i, 0.0, 0.0), (0.1 * i, 0.0, 1.0))) for i in range(4))
"""Bars of every scene; they do not cross."""
_STATION = ((0.15, -2.0, 0.5), (0.15, 0.0, 0.5), 0.0)


class PreparedRows:
    """Renderer whose views have bars at a depth that follows from their indices, without rendering anything."""

    def __init__(self) -> None:
        self.rendered: list[str] = []

    def submit(self, unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> Future[UnitResult]:
        """Stage the views and the mesh of a unit at once."""
        result: Future[UnitResult] = Future()
        stage_prepared(unit.config, unit.indices, staging)
        for index in unit.indices:
            on_view_done(index)
        self.rendered += map(unit.config.view_id, unit.indices)
        result.set_result(UnitResult("prepared rows", {}, file_sha256(staging.mesh)))
        return result


def stage_prepared(config: ConfigSpec, indices: Sequence[int], staging: Staging) -> None:
    """Stage views of a config, and its mesh: one triangle, whose bar has the id 1."""
    staging.mesh.parent.mkdir(parents=True, exist_ok=True)
    triangle_m = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 1.0]])
    write_mesh_ply(staging.mesh, WorldMesh(triangle_m, np.array([[0, 1, 2]], np.int32), np.ones(1, np.uint16)))
    width, height = config.rig.width, config.rig.height
    mask = np.broadcast_to(np.arange(width) % 8 < 4, (height, width))
    camera = Camera(ideal_K(width, height), np.zeros(5), np.eye(4), width, height)
    rgb = np.zeros((height, width, 3), np.uint8) if config.colour is not None else None
    for index in indices:
        depth_m = np.where(mask, 0.5 + 0.001 * index, 1.5).astype(np.float32)
        eye = RenderedEye(camera, rgb=rgb, depth_m=depth_m, mask=mask, bars=mask.astype(np.uint16))
        row, record = encode_view(View(config.view_id(index), config.scene.name, eye, eye, config.rig.baseline_m))
        stage_row(staging.row(index), row, record)


def placed(plan: ConfigPlan) -> ConfigPlan:
    """Return the plan of a scene with cameras and bars that are the same for all scenes."""
    protocol = plan.spec.protocol
    if not isinstance(protocol, RandomViewsSpec):
        return plan
    spec = replace(plan.spec, protocol=replace(protocol, stations=(_STATION,) * protocol.views))
    return ScenePlan(spec, plan.indices, plan.key, plan.staging, bars=BARS, record={"family": "column"})
