"""Command ``rebar-bench study anchor``: scale of an archive from k views of known depth (the paper's Figure 3)."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from rebar_depth_bench.console import ProgressBars, add_data
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.evaluation import open_evaluation
from rebar_depth_bench.scoring.ground_truth import config_truth
from rebar_depth_bench.studies.common import (
    add_output_arguments,
    map_views,
    select_config,
    write_outputs,
)
from rebar_depth_bench.studies.scale_anchor import output
from rebar_depth_bench.studies.scale_anchor.study import (
    AnchorStudy,
    ScaledArchive,
    anchor_row,
    draw_scales,
    errors_at_scales,
    mean_errors,
    view_ratio,
)

SUMMARY = "scale a whole archive from k views of known depth"

DEFAULT_DRAWS = 24
"""Draws for each k."""
DEFAULT_COUNTS = (1, 2, 3, 5, 10, 20, 30, 50, 100, 150, 200, 300)
"""Numbers k of known-depth views."""
MAX_DRAWS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.add_argument("archive", metavar="ARCHIVE", help="submission archive (zip), metric or up to scale")
    add_data(parser)
    parser.add_argument("--config", metavar="NAME", help="config to evaluate (default: the archive's only one)")
    parser.add_argument(
        "--baseline-scale",
        dest="given_scale",
        type=float,
        default=1.0,
        metavar="S",
        help="baseline of all changes: the archive multiplied by S (default: 1)",
    )
    parser.add_argument(
        "--num-anchor-views",
        dest="k",
        type=int,
        nargs="+",
        action="extend",
        metavar="K",
        help=f"numbers of known-depth views (default: {' '.join(map(str, DEFAULT_COUNTS))})",
    )
    parser.add_argument(
        "--draws",
        type=int,
        default=DEFAULT_DRAWS,
        metavar="N",
        help="independent draws for each k (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the draws (default: %(default)s)")
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study and write the requested outputs. Raises the errors of ``run_anchor_study``."""
    with ProgressBars() as bars:
        study = run_anchor_study(
            options.archive,
            options.data,
            config=options.config,
            given_scale=options.given_scale,
            counts=options.k or DEFAULT_COUNTS,
            draws=options.draws,
            seed=options.seed,
            progress=bars.update,
        )
    write_outputs(options, output.to_json(study), output.to_pandas(study), output.to_page(study))


def run_anchor_study(
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    config: str | None = None,
    given_scale: float = 1.0,
    counts: Sequence[int] = DEFAULT_COUNTS,
    draws: int = DEFAULT_DRAWS,
    seed: int = 0,
    progress: Progress = silent,
) -> AnchorStudy:
    """Return the scale-anchor study of one config of an archive.

    For each k in ``counts`` and each draw, the scale is the median of r = median(z / p) over k drawn views. The
    whole archive is multiplied by this scale and scored: mean over views of AbsRel and RMSE, on the scored pixels
    with a prediction. Views without any prediction are never drawn; a k larger than the number of the other views
    is skipped. Changes are relative to the errors at ``given_scale``.

    Raises ``InputError`` for invalid arguments or if fewer views have a prediction than the smallest k;
    ``SubmissionError`` with all problems if the archive is invalid; ``DatasetError`` for the dataset folder.
    """
    _check_arguments(given_scale, counts, draws, seed)
    with open_evaluation(archive, root) as evaluation:
        evaluation.check_entries(progress)
        submission = evaluation.submission
        chosen = select_config(evaluation, config)
        name, truths = chosen.name, config_truth(evaluation.folder, chosen, progress)
        view_ratios = map_views(submission, truths, len(truths), view_ratio, f"ratios of {name}", progress)
        ratios = np.array([view.ratio for view in view_ratios if view.ratio is not None])
        usable_counts = [k for k in sorted(set(counts)) if k <= len(ratios)]
        if not usable_counts:
            raise InputError(
                f"{archive}: {len(ratios)} of {len(truths)} views of {name} have a prediction, expected at least "
                f"{min(counts)}, the smallest k"
            )
        drawn_scales = [draw_scales(ratios, k, draws, seed) for k in usable_counts]
        scales = np.concatenate([[given_scale, np.median(ratios)], *drawn_scales])
        predicted = (truth for truth, view in zip(truths, view_ratios, strict=True) if view.ratio is not None)
        compute_errors = partial(errors_at_scales, scales=scales)
        errors = mean_errors(
            map_views(submission, predicted, len(ratios), compute_errors, f"errors of {name}", progress)
        )
        provenance = evaluation.provenance()
    given, all_views, *rest = map(ScaledArchive, scales.tolist(), errors.abs_rel.tolist(), errors.rmse_cm.tolist())
    per_k = tuple(tuple(rest[start : start + draws]) for start in range(0, len(rest), draws))
    return AnchorStudy(
        provenance=provenance,
        config=name,
        markers=_markers(chosen),
        seed=seed,
        views=len(truths),
        views_without_prediction=tuple(view.view_id for view in view_ratios if view.ratio is None),
        coverage=math.fsum(view.coverage for view in view_ratios) / len(view_ratios),
        given=given,
        all_views=all_views,
        rows=tuple(anchor_row(k, given, k_draws) for k, k_draws in zip(usable_counts, per_k, strict=True)),
        draws=per_k,
        skipped_counts=tuple(k for k in sorted(set(counts)) if k > len(ratios)),
    )


def _markers(config: DatasetConfig) -> int | None:
    """Return the number of markers on the board of a config's scenes; None without a board or if they differ."""
    markers = {scene.board.markers if scene.board else None for scene in config.scenes}
    return markers.pop() if len(markers) == 1 else None


def _check_arguments(given_scale: float, counts: Sequence[int], draws: int, seed: int) -> None:
    checks: list[tuple[str, object, bool, str]] = [
        ("--baseline-scale", given_scale, 0 < given_scale < math.inf, "a finite number above 0"),
        *(("--num-anchor-views", k, k >= 1, "1 or more") for k in counts),
        *([] if counts else [("--num-anchor-views", "no number", False, "one or more")]),
        ("--draws", draws, 1 <= draws <= MAX_DRAWS, f"1 to {MAX_DRAWS}"),
        ("--seed", seed, 0 <= seed < 2**31, f"0 to {2**31 - 1}"),
    ]
    problems = [
        Problem("invalid", option, f"got {value}", expected)
        for option, value, valid, expected in checks
        if not valid
    ]
    if problems:
        raise InputError.from_problems("options", problems)
