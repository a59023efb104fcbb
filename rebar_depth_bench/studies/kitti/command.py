"""Command ``rebar-bench study kitti``: comparison of predictions on KITTI's Eigen split with published results.

Predictions are one depth map per image, at the size of its ground truth: either a folder with
``<drive>_<frame>_<side>.npy|npz|exr|png`` (16-bit PNG in metres times 256, unless ``submission.json`` has another
``depth_scale``), or an archive in the submission format with the views ``kitti/<drive>_<frame>_<side>``. Other
sizes are rejected, because resizing a depth map creates false depth between a near and a far surface.
"""

from __future__ import annotations

import argparse
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from rebar_depth_bench.captures.kitti_images import KittiImage, eigen_test_images, read_images
from rebar_depth_bench.console import ProgressBars, add_workers
from rebar_depth_bench.errors import InputError, Problem, SubmissionError
from rebar_depth_bench.parallel import map_with_progress
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.provenance import ArchiveIdentity, Provenance
from rebar_depth_bench.studies.common import add_output_arguments, write_outputs
from rebar_depth_bench.studies.depth_source import DepthSource, open_depths
from rebar_depth_bench.studies.kitti.ground_truth import (
    PNG_SCALE,
    GroundTruthKind,
    LidarDepthConvention,
    TruthFile,
    find_truth,
    read_truth,
)
from rebar_depth_bench.studies.kitti.metrics import CROPS, ImageScore, score_image
from rebar_depth_bench.studies.kitti.output import to_page, to_pandas
from rebar_depth_bench.studies.kitti.result import KittiProtocol, KittiResult, tabulate_images
from rebar_depth_bench.submission import EntryError
from rebar_depth_bench.submission.formats import FORMATS
from rebar_depth_bench.submission.zip_directory import DirectoryError, FileSource, read_directory

PROTOCOL = "rebar-kitti-eigen-1"
SUMMARY = "compare a method on KITTI's Eigen split with published numbers"
DEFAULT_CAP_M = 80.0
"""Default depth cap, metres."""
_SUFFIXES = ", ".join(FORMATS)
_MAX_SHAPE = (1024, 4096)
"""Upper bound (H, W) for entries of images without ground truth, which are accepted but not read."""


@dataclass(frozen=True)
class _ImageOutcome:
    """Outcome of one image: its score and the digest of its ground truth, or a problem with its prediction.

    ``score`` is None if the image has no scored pixel or a problem.
    """

    score: ImageScore | None = None
    digest: str = ""
    problem: Problem | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.description = (
        f"{SUMMARY}. Predictions: <drive>_<frame>_<side>.npy|npz|exr|png in a folder (16-bit PNG: metres x 256), "
        "or an archive in the submission format with the views kitti/<drive>_<frame>_<side>. Each map must "
        "have the size of its ground truth; maps are not resized."
    )
    parser.add_argument("--predictions", required=True, metavar="DIR_OR_ZIP", help="one depth map per image")
    parser.add_argument("--kitti", required=True, type=Path, metavar="ROOT", help="KITTI's raw data or depth maps")
    parser.add_argument(
        "--ground-truth",
        required=True,
        choices=get_args(GroundTruthKind),
        help="raw: one laser scan; improved: several scans (652 images)",
    )
    parser.add_argument(
        "--images",
        type=Path,
        metavar="FILE",
        help="list of images, one <date>/<drive> <frame> l|r per line (default: the Eigen test split)",
    )
    parser.add_argument("--crop", choices=tuple(CROPS), default="garg", help="default: %(default)s")
    parser.add_argument(
        "--cap", type=float, default=DEFAULT_CAP_M, metavar="M", help="metres (default: %(default)s)"
    )
    parser.add_argument(
        "--lidar-depth",
        choices=get_args(LidarDepthConvention),
        default="camera",
        help="a laser point's depth: z in the camera, or x in the scanner as in Monodepth (default: %(default)s)",
    )
    add_workers(parser)
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study, write the requested outputs and print the tables."""
    protocol = KittiProtocol(options.ground_truth, options.crop, options.cap, options.lidar_depth)
    with ProgressBars() as bars:
        images = None if options.images is None else read_images(options.images)
        result = run_kitti_study(
            options.predictions,
            options.kitti,
            protocol,
            images=images,
            workers=options.workers,
            progress=bars.update,
        )
    write_outputs(options, result.to_dict(), to_pandas(result), to_page(result))


def run_kitti_study(
    predictions: str | Path,
    root: Path,
    protocol: KittiProtocol,
    *,
    images: tuple[KittiImage, ...] | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> KittiResult:
    """Score predictions on the images of the Eigen split that have ground truth below ``root``.

    ``images`` replaces the Eigen split by another list of images.

    Raises ``DatasetError`` for missing or damaged KITTI files, ``SubmissionError`` with all problems of the
    predictions, and ``InputError`` for an invalid cap or crop or if no image has a scored pixel.
    """
    _check_protocol(protocol)
    split = eigen_test_images() if images is None else images
    truths, missing = find_truth(root, split, protocol.ground_truth)
    with _open_predictions(predictions, split, truths) as source:
        work = partial(_score_file, source=source, protocol=protocol)
        outcomes = map_with_progress(work, truths, workers, progress, "scoring KITTI", len(truths))
        problems = [outcome.problem for outcome in outcomes if outcome.problem]
        if problems:
            raise SubmissionError.from_problems(predictions, problems)
        scores = [outcome.score for outcome in outcomes if outcome.score is not None]
        if not scores:
            raise InputError(
                f"{root}: no image has ground truth inside the crop {protocol.crop}, expected at least one"
            )
        archive = ArchiveIdentity(source.method, source.sha256())
    version = f"KITTI {'Eigen test' if images is None else 'list of images'}, {protocol.ground_truth}"
    digest = "sha256:" + hashlib.sha256("".join(outcome.digest for outcome in outcomes).encode()).hexdigest()
    return KittiResult(
        provenance=Provenance(PROTOCOL, digest, version, (archive,)),
        method=archive.method,
        protocol=protocol,
        images_with_truth=len(truths),
        missing=missing,
        table=tabulate_images(scores),
        images=scores,
    )


def _check_protocol(protocol: KittiProtocol) -> None:
    if not 0.001 < protocol.cap_m < math.inf:
        raise InputError(f"the cap is {protocol.cap_m} m, expected a finite number above 0.001")
    if protocol.crop not in CROPS:
        raise InputError(f"the crop is {protocol.crop!r}, expected one of {', '.join(CROPS)}")


def _score_file(truth: TruthFile, source: DepthSource, protocol: KittiProtocol) -> _ImageOutcome:
    depth_m = read_truth(truth, protocol.lidar_depth)
    index = np.flatnonzero(depth_m)
    digest = hashlib.sha256(f"{truth.image.name} {truth.shape}".encode())
    digest.update(index.astype("<u4").data)
    digest.update(depth_m.ravel()[index].astype("<f4").data)
    try:
        prediction_m = source.read(truth.image.view_id)
    except EntryError as error:
        return _ImageOutcome(problem=error.problem)
    score = score_image(truth.image.name, depth_m, prediction_m, CROPS[protocol.crop], protocol.cap_m)
    return _ImageOutcome(score, digest.hexdigest())


def _open_predictions(path: str | Path, images: Sequence[KittiImage], truths: Sequence[TruthFile]) -> DepthSource:
    """Open the predictions: images with ground truth are required, the other images of the split are optional.

    Raises ``SubmissionError`` with all problems if a required prediction is missing or the archive is damaged.
    """
    expected = {truth.image.view_id: truth.shape for truth in truths}
    optional = {image.view_id: _MAX_SHAPE for image in images if image.view_id not in expected}
    if Path(path).is_dir():
        source = open_depths(path, optional | expected, PNG_SCALE)
        missing = sorted(expected.keys() - set(source.view_ids))
        if missing:
            names = (view_id.partition("/")[2] for view_id in missing)
            problems = [Problem("missing", name, "no file", f"one of {_SUFFIXES}") for name in names]
            raise SubmissionError.from_problems(path, problems)
        return source
    present = _entry_stems(Path(path), 4 * len(images) + 1024)
    return open_depths(
        path, {view_id: shape for view_id, shape in optional.items() if view_id in present} | expected
    )


def _entry_stems(archive: Path, max_entries: int) -> set[str]:
    """Return the entry names of an archive without their suffixes.

    The set is empty for a file that is not a valid zip; ``open_depths`` reports that error later.
    """
    try:
        source = FileSource(archive)
    except (OSError, ValueError):
        return set()
    try:
        return {entry.name.rpartition(".")[0] for entry in read_directory(source, max_entries).entries}
    except (DirectoryError, EOFError, ValueError):
        return set()
    finally:
        source.close()
