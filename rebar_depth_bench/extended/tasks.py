"""Tasks of a robot or an inspector, and the working ranges of a method for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rebar_depth_bench.extended.frames import AlignedSamples, SteelFrames
from rebar_depth_bench.extended.measures import NATIVE
from rebar_depth_bench.extended.working_range import TaskSamples, WorkingRange, working_range

LASER = "laser"
"""Alignment by one laser reading per view: the reading at the centre pixel over the prediction there."""

MIN_DIAMETER_WIDTH_PX = 12.0
"""Least apparent width of the bars whose diameter is judged."""

TASKS = {
    "tie_5mm": "ties within 5 mm",
    "tie_2mm": "ties within 2 mm",
    "spacing_10mm": "spacing within 10 mm",
    "layer_5mm": "layer distance within 5 mm",
    "cover_5mm": "cover within 5 mm",
    "diameter_1mm": f"diameter within 1 mm (bars of {MIN_DIAMETER_WIDTH_PX:g} px or more)",
}
"""Titles of all tasks by name, in report order."""


@dataclass(frozen=True)
class ConfigTasks:
    """Working ranges of a method on the views of a config, by name of the task and by alignment.

    ``laser_views`` have true depth at the centre pixel and are judged with the laser alignment; ``unread_views``
    of them have no prediction there and fail.
    """

    views: int
    laser_views: int
    unread_views: int
    ranges: Mapping[str, Mapping[str, WorkingRange]]

    @property
    def is_tested(self) -> bool:
        """Whether any bin of any task is tested."""
        return any(one.runs for by_alignment in self.ranges.values() for one in by_alignment.values())

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the working ranges, by task and alignment."""
        return {
            task: {alignment: found.to_dict() for alignment, found in by_alignment.items()}
            for task, by_alignment in self.ranges.items()
        }


def config_tasks(frames: SteelFrames, views: int) -> ConfigTasks:
    """Return the working ranges that the samples of the views of a config show."""
    samples = {NATIVE: task_samples(frames.native), LASER: task_samples(frames.laser)}
    ranges = {
        task: {alignment: working_range(of_tasks[task]) for alignment, of_tasks in samples.items()}
        for task in TASKS
    }
    return ConfigTasks(views, frames.laser_views, frames.unread_views, ranges)


def task_samples(aligned: AlignedSamples) -> dict[str, TaskSamples]:
    """Return the samples of each task with one alignment."""
    depths = (aligned.predicted, aligned.exact, aligned.plane)
    bars, spacings, crossings = depths[0].bars, depths[0].spacings, depths[0].crossings
    covered = ~np.isnan(bars.true_cover_mm)
    wide = bars.diameter_judged & (bars.width_px >= MIN_DIAMETER_WIDTH_PX)
    ties_mm = [one.crossings.tie_error_mm for one in depths]
    spacings_mm = [one.spacings.spacing_mm - one.spacings.true_spacing_mm for one in depths]
    layers_mm = [one.crossings.layer_mm - one.crossings.true_layer_mm for one in depths]
    covers_mm = [(one.bars.cover_mm - one.bars.true_cover_mm)[covered] for one in depths]
    diameters_mm = [(one.bars.diameter_mm - one.bars.true_diameter_mm)[wide] for one in depths]
    at_crossings = (crossings.view, crossings.distance_m)
    ties = replace(TaskSamples(5.0, *at_crossings, *ties_mm), signed_mm=crossings.tie_along_mm)
    return {
        "tie_5mm": ties,
        "tie_2mm": replace(ties, limit_mm=2.0),
        "spacing_10mm": TaskSamples(10.0, spacings.view, spacings.distance_m, *spacings_mm),
        "layer_5mm": TaskSamples(5.0, *at_crossings, *layers_mm),
        "cover_5mm": TaskSamples(5.0, bars.view[covered], bars.distance_m[covered], *covers_mm),
        "diameter_1mm": TaskSamples(1.0, bars.view[wide], bars.distance_m[wide], *diameters_mm),
    }
