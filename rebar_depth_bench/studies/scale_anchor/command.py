"""``rebar-bench study anchor``: how many views of known depth give an archive its scale (the paper's Figure 3)."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from rebar_depth_bench.cli.console import ProgressBars
from rebar_depth_bench.data.ground_truth import config_truth
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.studies.common import (
    add_output_arguments,
    archive_stamp,
    map_views,
    one_config,
    opened,
    write_outputs,
)
from rebar_depth_bench.studies.scale_anchor import output as words
from rebar_depth_bench.studies.scale_anchor.study import (
    AnchorStudy,
    ScaledArchive,
    anchor_row,
    drawn_scales,
    errors_at,
    mean_errors,
    view_ratio,
)

SUMMARY = "how many views of known depth give a whole archive its scale"

DRAWS = 24
COUNTS = (1, 2, 3, 5, 10, 20, 30, 50, 100, 150, 200, 300)
MAX_DRAWS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.add_argument("archive", metavar="ARCHIVE", help="a submission's zip, metric or up to scale")
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")
    parser.add_argument("--config", metavar="NAME", help="which config (default: the archive's only one)")
    parser.add_argument(
        "--given-scale",
        type=float,
        default=1.0,
        metavar="S",
        help="what changes are told against: the archive times S (default: 1, as it stands)",
    )
    parser.add_argument(
        "--k",
        type=int,
        nargs="+",
        action="extend",
        metavar="K",
        help=f"numbers of known-depth views (default: {' '.join(map(str, COUNTS))})",
    )
    parser.add_argument(
        "--draws", type=int, default=DRAWS, metavar="N", help="independent draws for each k (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the draws (default: %(default)s)")
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study and write what is asked for. Raises as ``study_anchor``."""
    with ProgressBars() as bars:
        study = study_anchor(
            options.archive,
            options.data,
            config=options.config,
            given_scale=options.given_scale,
            counts=options.k or COUNTS,
            draws=options.draws,
            seed=options.seed,
            progress=bars.update,
        )
    write_outputs(options, words.content(study), words.rows(study), words.page(study))


def study_anchor(
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    config: str | None = None,
    given_scale: float = 1.0,
    counts: Sequence[int] = COUNTS,
    draws: int = DRAWS,
    seed: int = 0,
    progress: Progress = silent,
) -> AnchorStudy:
    """Return the study of one config of an archive.

    For each k of ``counts`` and each draw, the scale is the median over k drawn views of r = median(z / p), and
    the whole archive times it is scored (mean over views of AbsRel and RMSE, on scored pixels with a prediction).
    Views without any prediction are never drawn; a k larger than the number of the others is left out.

    Raises ``InputError`` for arguments that cannot be, or where no view has a prediction; ``SubmissionError`` with
    every problem where ``score`` would refuse the archive; ``DatasetError`` for the folder.
    """
    _check(given_scale, counts, draws, seed)
    folder = open_folder(root)
    with opened(archive, folder, progress) as submission:
        name = one_config(submission, folder, config)
        truths = config_truth(folder, name, progress)
        found = map_views(submission, truths, len(truths), view_ratio, f"ratios of {name}", progress)
        ratios = np.array([one.ratio for one in found if one.ratio is not None])
        possible = [k for k in sorted(set(counts)) if k <= len(ratios)]
        if not possible:
            raise InputError(
                f"{archive}: {len(ratios)} of {len(truths)} views of {name} have a prediction, expected at least "
                f"{min(counts)}, the smallest k"
            )
        drawn = [drawn_scales(ratios, k, draws, seed) for k in possible]
        scales = np.concatenate([[given_scale, np.median(ratios)], *drawn])
        predicted = (truth for truth, one in zip(truths, found, strict=True) if one.ratio is not None)
        work = partial(errors_at, scales=scales)
        errors = mean_errors(map_views(submission, predicted, len(ratios), work, f"errors of {name}", progress))
        stamp = archive_stamp(submission, folder)
    given, all_views, *rest = map(ScaledArchive, scales.tolist(), errors.abs_rel.tolist(), errors.rmse_cm.tolist())
    per_k = tuple(tuple(rest[start : start + draws]) for start in range(0, len(rest), draws))
    return AnchorStudy(
        stamp=stamp,
        config=name,
        seed=seed,
        views=len(truths),
        unpredicted=tuple(one.view_id for one in found if one.ratio is None),
        coverage=math.fsum(one.coverage for one in found) / len(found),
        given=given,
        all_views=all_views,
        rows=tuple(anchor_row(k, given, ones) for k, ones in zip(possible, per_k, strict=True)),
        draws=per_k,
        left_out=tuple(k for k in sorted(set(counts)) if k > len(ratios)),
    )


def _check(given_scale: float, counts: Sequence[int], draws: int, seed: int) -> None:
    wrong = []
    if not (math.isfinite(given_scale) and given_scale > 0):
        wrong.append(f"--given-scale is {given_scale:g}, expected a finite number above 0")
    wrong += [f"--k has {k}, expected 1 or more" for k in counts if k < 1]
    if not counts:
        wrong.append("--k names no number of views, expected one or more")
    if not 1 <= draws <= MAX_DRAWS:
        wrong.append(f"--draws is {draws}, expected 1 to {MAX_DRAWS}")
    if not 0 <= seed < 2**31:
        wrong.append(f"--seed is {seed}, expected 0 to {2**31 - 1}")
    if wrong:
        raise InputError("; ".join(wrong))
