"""Reaches at the crossings of a config, without the other extended measures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended.crossings.evaluate import crossing_samples, view_crossings
from rebar_depth_bench.extended.crossings.reach import Reach, reaches
from rebar_depth_bench.extended.ground_truth import steel_truth
from rebar_depth_bench.extended.measures import Samples
from rebar_depth_bench.extended.predictions import NATIVE, SCALED, aligned_predictions
from rebar_depth_bench.extended.result import CrossingsSource
from rebar_depth_bench.parallel import Progress, map_with_progress, silent
from rebar_depth_bench.scoring.bootstrap import resample_views
from rebar_depth_bench.scoring.evaluation import Evaluation


@dataclass(frozen=True)
class ConfigReaches:
    """Reaches of a submission on one config, by alignment, and the file that the crossings come from."""

    source: CrossingsSource
    by_alignment: Mapping[str, tuple[Reach, ...]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object: the file of the crossings, and the reaches by alignment."""
        reaches = {name: [reach.to_dict() for reach in of_one] for name, of_one in self.by_alignment.items()}
        return {"crossings": asdict(self.source), **reaches}


def config_reaches(
    evaluation: Evaluation,
    config: DatasetConfig,
    scales: Mapping[str, float | None],
    *,
    workers: int | None = None,
    progress: Progress = silent,
) -> ConfigReaches:
    """Return the reaches on a config that ``has_bar_ids``, native and scaled; ``scales`` holds s by view id.

    Raises ``DatasetError`` as ``load_steel_truth``.
    """
    steel = steel_truth(evaluation, config, progress)

    def view_samples(position: int) -> dict[str, Samples]:
        truth = steel.view(position)
        crossings = view_crossings(truth, steel.bars_by_view[truth.view_id].crossings)
        prediction_m = evaluation.submission.read(truth.view_id)
        predictions = aligned_predictions(prediction_m, truth, scales[truth.view_id])
        return {name: crossing_samples(predictions[name], crossings) for name in (NATIVE, SCALED)}

    task = f"crossings of {config.name}"
    views = map_with_progress(view_samples, range(len(steel)), workers, progress, task, len(steel))
    resampling = resample_views(steel.view_ids, by_scene=config.has_splits)
    found = {name: reaches([samples[name] for samples in views], resampling) for name in (NATIVE, SCALED)}
    return ConfigReaches(CrossingsSource(steel.crossings_source, steel.crossings_sha256), found)
