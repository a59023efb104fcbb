"""``rebar-bench study distance``: the scale that predictions need, and their error, over distance."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.cli.console import ProgressBars
from rebar_depth_bench.data.ground_truth import config_truth
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.provenance import ArchiveStamp, Stamp
from rebar_depth_bench.scoring.result import Result, protocol_indices
from rebar_depth_bench.scoring.score import score
from rebar_depth_bench.studies.common import add_output_arguments, write_outputs
from rebar_depth_bench.studies.distance import output as words
from rebar_depth_bench.studies.distance.study import ALL, DistanceStudy, ViewPoint, bins_of, slope_of

SUMMARY = "the scale that predictions need, and their error, over distance"

BINS_PER_DECADE = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.add_argument("archive", metavar="ARCHIVE", help="the submission's zip")
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")
    parser.add_argument(
        "--config", nargs="+", action="extend", metavar="NAME", help="which configs (default: all of the archive)"
    )
    parser.add_argument(
        "--bins-per-decade",
        type=int,
        default=BINS_PER_DECADE,
        metavar="N",
        help="bins of distance from 1 m to 10 m, evenly in log (default: %(default)s)",
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study and write what is asked for. Raises as ``study_distance``."""
    with ProgressBars() as bars:
        study = study_distance(
            options.archive,
            options.data,
            configs=options.config,
            bins_per_decade=options.bins_per_decade,
            progress=bars.update,
        )
    write_outputs(options, words.content(study), words.rows(study), words.page(study))


def study_distance(
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    configs: Sequence[str] | None = None,
    bins_per_decade: int = BINS_PER_DECADE,
    progress: Progress = silent,
) -> DistanceStudy:
    """Return the study of an archive over one or more configs (default: all it holds), such as the sweeps.

    A view's distance is the median true depth of its scored pixels. Raises ``InputError`` for a config that the
    archive has not or without any view in the protocol, and as ``score`` does.
    """
    if not 1 <= bins_per_decade <= 100:
        raise InputError(f"--bins-per-decade is {bins_per_decade}, expected 1 to 100")
    folder = open_folder(root)
    result = score(archive, root, progress=progress)
    names = _chosen(archive, result, configs)
    points = {name: _points(result, folder, name) for name in names}
    empty = [name for name, views in points.items() if not views]
    if empty:
        raise InputError(f"{archive}: {', '.join(empty)} has no view with a scored pixel, expected one or more")
    slopes = [slope_of(name, {name: views}) for name, views in points.items()]
    if len(points) > 1:
        slopes.append(slope_of(ALL, points))
    return DistanceStudy(
        stamp=Stamp(
            PROTOCOL,
            result.dataset_digest,
            result.dataset_version,
            (ArchiveStamp(result.method, result.submission_sha256),),
        ),
        bins_per_decade=bins_per_decade,
        points=tuple(point for views in points.values() for point in views),
        bins=tuple(one for views in points.values() for one in bins_of(views, bins_per_decade)),
        slopes=tuple(slopes),
    )


def _chosen(archive: str | os.PathLike[str], result: Result, configs: Sequence[str] | None) -> list[str]:
    wanted = list(dict.fromkeys(configs)) if configs else list(result.tables)
    unknown = [name for name in wanted if name not in result.tables]
    if unknown:
        raise InputError(
            f"{archive}: has no config {', '.join(map(repr, unknown))}"
            f", expected some of {', '.join(result.tables)}"
        )
    return wanted


def _points(result: Result, folder: DatasetFolder, config: str) -> list[ViewPoint]:
    truths = config_truth(folder, config)
    distances_m = dict(zip(truths.view_ids, truths.medians_m, strict=True))
    views = [view for view in result.views if view.view_id in distances_m]
    indices = protocol_indices([view.view_id for view in views])
    return [
        ViewPoint(config, index, distances_m[view.view_id], view)
        for index, view in zip(indices, views, strict=True)
    ]
