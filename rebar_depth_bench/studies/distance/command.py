"""Command ``rebar-bench study distance``: scale, error and reach at crossings of predictions over distance."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.console import ProgressBars, add_archive, add_data
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.extended.crossings.config import config_reaches
from rebar_depth_bench.extended.ground_truth import has_bar_ids
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.ground_truth import config_truth
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.score import score_evaluation
from rebar_depth_bench.scoring.single_bar import score_single_bar
from rebar_depth_bench.scoring.view_score import protocol_indices
from rebar_depth_bench.studies.common import add_output_arguments, write_outputs
from rebar_depth_bench.studies.distance import output
from rebar_depth_bench.studies.distance.study import (
    ALL_CONFIGS,
    DistancePoint,
    DistanceStudy,
    bin_views,
    fit_scale_slope,
)

SUMMARY = "scale factor and error of predictions over distance, and the reach at crossings of bars"

DEFAULT_BINS_PER_DECADE = 10
"""Distance bins per factor of ten, evenly spaced in the logarithm."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    add_archive(parser)
    add_data(parser)
    parser.add_argument(
        "--config",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="configs to evaluate (default: all in the archive)",
    )
    parser.add_argument(
        "--bins-per-decade",
        type=int,
        default=DEFAULT_BINS_PER_DECADE,
        metavar="N",
        help="number of distance bins from 1 m to 10 m, equal in log distance (default: %(default)s)",
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study and write the requested outputs. Raises the errors of ``run_distance_study``."""
    with ProgressBars() as bars:
        study = run_distance_study(
            options.archive,
            options.data,
            configs=options.config,
            bins_per_decade=options.bins_per_decade,
            progress=bars.update,
        )
    write_outputs(options, output.to_json(study), output.to_pandas(study), output.to_page(study))


def run_distance_study(
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    configs: Sequence[str] | None = None,
    bins_per_decade: int = DEFAULT_BINS_PER_DECADE,
    progress: Progress = silent,
) -> DistanceStudy:
    """Return the distance study of an archive over one or more configs, such as the distance sweeps.

    ``configs`` defaults to all configs of the archive. The distance of a view is the median true depth of its
    scored pixels.

    Raises ``InputError`` for a config that is not in the archive or has no view with scored pixels, and the errors
    of ``score``.
    """
    if not 1 <= bins_per_decade <= 100:
        raise InputError(f"--bins-per-decade is {bins_per_decade}, expected 1 to 100")
    with open_evaluation(archive, root) as evaluation:
        result = score_evaluation(evaluation, progress=progress)
        names = _select_configs(archive, result, configs)
        config_by_name = {config.name: config for config in evaluation.configs}
        points = {name: _distance_points(evaluation, result, config_by_name[name]) for name in names}
        scales = {view.view_id: view.scale for view in result.views}
        reaches = {
            name: config_reaches(evaluation, config_by_name[name], scales, progress=progress)
            for name in names
            if has_bar_ids(config_by_name[name])
        }
        provenance = evaluation.provenance()
    empty = [name for name, views in points.items() if not views]
    if empty:
        raise InputError(f"{archive}: {', '.join(empty)} has no view with a scored pixel, expected one or more")
    slopes = [fit_scale_slope(name, {name: views}) for name, views in points.items()]
    if len(points) > 1:
        slopes.append(fit_scale_slope(ALL_CONFIGS, points))
    return DistanceStudy(
        provenance=provenance,
        bins_per_decade=bins_per_decade,
        points=tuple(point for views in points.values() for point in views),
        bins=tuple(bin_ for views in points.values() for bin_ in bin_views(views, bins_per_decade)),
        slopes=tuple(slopes),
        reaches=reaches,
    )


def _select_configs(archive: str | os.PathLike[str], result: Result, configs: Sequence[str] | None) -> list[str]:
    wanted = list(dict.fromkeys(configs)) if configs else list(result.tables)
    unknown = [name for name in wanted if name not in result.tables]
    if unknown:
        raise InputError(
            f"{archive}: has no config {', '.join(map(repr, unknown))}"
            f", expected some of {', '.join(result.tables)}"
        )
    return wanted


def _distance_points(evaluation: Evaluation, result: Result, config: DatasetConfig) -> list[DistancePoint]:
    truths = config_truth(evaluation.folder, config)
    scores = {view.view_id: view for view in result.views}
    points = []
    for position, index in enumerate(protocol_indices(truths.view_ids)):
        truth, score = truths.view(position), scores[truths.view_ids[position]]
        prediction_m = evaluation.submission.read(truth.view_id)
        single_bar = score_single_bar(truth, truths.single_bar(position), prediction_m, score.scale)
        points.append(DistancePoint(config.name, index, truth.median_m, score, single_bar))
    return points
