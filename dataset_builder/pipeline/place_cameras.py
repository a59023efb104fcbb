"""Placement of the cameras of generated scenes, in several processes.

A cage is generated, and its cameras are placed, only where its scene has to be rendered: this takes about two
seconds for each. It is done before anything is written, so that a cage that cannot be built leaves no folder.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, cast

from dataset_builder.config.camera_placement import with_random_stations
from dataset_builder.config.specs import GeneratedCageSpec, RandomViewsSpec, SceneConfigSpec
from dataset_builder.config.surroundings import SURROUNDINGS
from dataset_builder.pipeline.plan import ConfigPlan
from dataset_builder.scene.assemblies.generated import cage_assembly, spec_cage
from dataset_builder.scene.variants.props import make_props
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.progress import Progress, silent


@dataclass(frozen=True)
class ScenePlan(ConfigPlan):
    """Plan of a generated scene with its cameras: also its bars, and the record of the generator."""

    bars: tuple[Bar, ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict)

    def derived(self) -> dict[str, Any]:
        """Return the family of the cage and the record of the generator."""
        return {"family": self.record["family"], "cage": dict(self.record)}


def place_cameras(plans: Sequence[ConfigPlan], processes: int, progress: Progress = silent) -> list[ConfigPlan]:
    """Return the plans; those of generated scenes have the stations of their cameras.

    Raises ``InputError`` for a cage that cannot be generated, or round which cameras cannot be placed.
    """
    missing = [plan for plan in plans if is_generated(plan)]
    if not missing:
        return list(plans)
    placed: dict[str, ConfigPlan] = {}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(missing)), mp_context=context) as pool:
        futures: list[Future[ConfigPlan]] = [pool.submit(with_cameras, plan) for plan in missing]
        try:
            for done, future in enumerate(futures, start=1):
                plan = future.result()
                placed[plan.key] = plan
                progress("cages and cameras", done, len(missing))
        finally:
            pool.shutdown(cancel_futures=True)
    return [placed.get(plan.key, plan) for plan in plans]


def is_generated(plan: ConfigPlan) -> bool:
    """Return whether a plan is that of a generated scene, whose cameras are not placed yet."""
    return isinstance(plan.spec, SceneConfigSpec) and not isinstance(plan, ScenePlan)


def with_cameras(plan: ConfigPlan) -> ConfigPlan:
    """Return the plan of a generated scene with its cameras, another one as it is. Raises as ``place_cameras``."""
    if not is_generated(plan):
        return plan
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
        record=cage.record,
    )
