"""``rebar-bench study kitti``: predictions on KITTI's Eigen split, as a check against what is published.

Predictions are one depth map an image at the ground truth's own size: a folder with
``<drive>_<frame>_<side>.npy|npz|exr|png`` (16-bit PNG: metres times 256 unless ``submission.json`` says
otherwise), or an archive in the submission format with the views ``kitti/<drive>_<frame>_<side>``. Other sizes are
refused: to resize a depth map invents depth between a near and a far surface.
"""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from rebar_depth_bench.cli.console import ProgressBars
from rebar_depth_bench.errors import InputError, SubmissionError
from rebar_depth_bench.parallel import ordered_map
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.provenance import ArchiveStamp, Stamp
from rebar_depth_bench.studies.common import add_output_arguments, write_outputs
from rebar_depth_bench.studies.depth_source import DepthSource, open_depths
from rebar_depth_bench.studies.kitti.ground_truth import (
    PNG_SCALE,
    GroundTruth,
    LidarDepth,
    TruthFile,
    find_truth,
    read_truth,
)
from rebar_depth_bench.studies.kitti.metrics import CROPS, ImageScore, KittiImage, eigen_test_images, score_image
from rebar_depth_bench.studies.kitti.output import csv_rows, study_page
from rebar_depth_bench.studies.kitti.result import KittiProtocol, KittiResult, tabulate_images
from rebar_depth_bench.submission import EntryError
from rebar_depth_bench.submission.formats import FORMATS
from rebar_depth_bench.submission.zip_directory import DirectoryError, FileSource, read_directory

PROTOCOL = "rebar-kitti-eigen-1"
SUMMARY = "check a method on KITTI's Eigen split against what is published"
CAP_M = 80.0
_SUFFIXES = ", ".join(FORMATS)
_ANY_SHAPE = (1024, 4096)
"""Bounds the size of an entry whose image has no ground truth: it is allowed and not read."""


@dataclass(frozen=True)
class _Outcome:
    """One image: its score (None: no pixel counts), the digest of its ground truth, or what is wrong."""

    score: ImageScore | None = None
    digest: str = ""
    problem: str | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.description = (
        f"{SUMMARY}. Predictions: <drive>_<frame>_<side>.npy|npz|exr|png in a folder (16-bit PNG: metres x 256), "
        "or an archive in the submission format with the views kitti/<drive>_<frame>_<side>; each exactly as "
        "large as its ground truth, never resized."
    )
    parser.add_argument("--predictions", required=True, metavar="DIR_OR_ZIP", help="one depth map an image")
    parser.add_argument("--kitti", required=True, type=Path, metavar="ROOT", help="KITTI's raw data or depth maps")
    parser.add_argument(
        "--ground-truth",
        required=True,
        choices=get_args(GroundTruth),
        help="one laser scan, or several (652 images)",
    )
    parser.add_argument("--crop", choices=tuple(CROPS), default="garg", help="default: %(default)s")
    parser.add_argument("--cap", type=float, default=CAP_M, metavar="M", help="metres (default: %(default)s)")
    parser.add_argument(
        "--lidar-depth",
        choices=get_args(LidarDepth),
        default="camera",
        help="a laser point's depth: z in the camera, or x in the scanner as in Monodepth (default: %(default)s)",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="threads (default: one a core)")
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the check and print its table."""
    protocol = KittiProtocol(options.ground_truth, options.crop, options.cap, options.lidar_depth)
    with ProgressBars() as bars:
        result = kitti_study(
            options.predictions, options.kitti, protocol, workers=options.workers, progress=bars.update
        )
    write_outputs(options, result.to_dict(), csv_rows(result), study_page(result))


def kitti_study(
    predictions: str | Path,
    root: Path,
    protocol: KittiProtocol,
    *,
    images: tuple[KittiImage, ...] | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> KittiResult:
    """Score predictions on the Eigen split's images (or others) that have ground truth below ``root``.

    Raises ``DatasetError`` for KITTI's own files, ``SubmissionError`` for the predictions, each with every problem
    that the predictions have, ``InputError`` for a cap or crop that is none.
    """
    _check(protocol)
    wanted = eigen_test_images() if images is None else images
    truths, missing = find_truth(root, wanted, protocol.ground_truth)
    with _open_predictions(predictions, wanted, truths) as source:
        outcomes: list[_Outcome] = []
        work = ordered_map(lambda truth: _score(truth, source, protocol), truths, workers)
        for done, outcome in enumerate(work, start=1):
            outcomes.append(outcome)
            progress("scoring KITTI", done, len(truths))
        problems = [outcome.problem for outcome in outcomes if outcome.problem]
        if problems:
            raise SubmissionError(str(predictions), problems)
        scores = [outcome.score for outcome in outcomes if outcome.score is not None]
        if not scores:
            raise InputError(f"{root}: no image has ground truth inside the crop {protocol.crop}, expected some")
        archive = ArchiveStamp(source.method, source.sha256())
    version = f"KITTI Eigen test, {protocol.ground_truth}"
    digest = "sha256:" + hashlib.sha256("".join(outcome.digest for outcome in outcomes).encode()).hexdigest()
    return KittiResult(
        stamp=Stamp(PROTOCOL, digest, version, (archive,)),
        method=archive.method,
        protocol=protocol,
        found=len(truths),
        missing=missing,
        table=tabulate_images(scores),
        images=scores,
    )


def _check(protocol: KittiProtocol) -> None:
    if not 0.001 < protocol.cap_m < math.inf:
        raise InputError(f"the cap is {protocol.cap_m} m, expected a finite number above 0.001")
    if protocol.crop not in CROPS:
        raise InputError(f"the crop is {protocol.crop!r}, expected one of {', '.join(CROPS)}")


def _score(truth: TruthFile, source: DepthSource, protocol: KittiProtocol) -> _Outcome:
    depth_m = read_truth(truth, protocol.lidar_depth)
    where = np.flatnonzero(depth_m)
    digest = hashlib.sha256(f"{truth.image.name} {truth.shape}".encode())
    digest.update(where.astype("<u4").data)
    digest.update(depth_m.ravel()[where].astype("<f4").data)
    try:
        prediction_m = source.read(truth.image.view_id)
    except EntryError as error:
        return _Outcome(problem=error.problem)
    score = score_image(truth.image.name, depth_m, prediction_m, CROPS[protocol.crop], protocol.cap_m)
    return _Outcome(score, digest.hexdigest())


def _open_predictions(path: str | Path, images: Sequence[KittiImage], truths: Sequence[TruthFile]) -> DepthSource:
    """Open predictions that must have every image with ground truth and may have the others of the list."""
    expected = {truth.image.view_id: truth.shape for truth in truths}
    also = {image.view_id: _ANY_SHAPE for image in images if image.view_id not in expected}
    if Path(path).is_dir():
        source = open_depths(path, also | expected, PNG_SCALE)
        lacking = sorted(expected.keys() - set(source.view_ids))
        if lacking:
            problems = [
                f"{view_id.partition('/')[2]}: no file, expected one of {_SUFFIXES}" for view_id in lacking
            ]
            raise SubmissionError(str(path), problems)
        return source
    present = _names_in(Path(path), 4 * len(images) + 1024)
    return open_depths(path, {view_id: shape for view_id, shape in also.items() if view_id in present} | expected)


def _names_in(archive: Path, most: int) -> set[str]:
    """Return an archive's entries without their suffixes; none of what is no sound zip, which is said later."""
    try:
        source = FileSource(archive)
    except (OSError, ValueError):
        return set()
    try:
        return {entry.name.rpartition(".")[0] for entry in read_directory(source, most).entries}
    except (DirectoryError, EOFError, ValueError):
        return set()
    finally:
        source.close()
