"""The ``rebar-bench view`` command."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rebar_depth_bench.cli.dataset_options import add_expect_digest, print_verified
from rebar_depth_bench.console import positive_number, print_notice
from rebar_depth_bench.data.bars import with_axis
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError, SubmissionError, printable
from rebar_depth_bench.output_options import add_output_file, prints_table
from rebar_depth_bench.outputs import is_stream, write_output
from rebar_depth_bench.scoring.evaluation import open_evaluation
from rebar_depth_bench.submission import EntryError
from rebar_depth_bench.viewing.clouds import (
    MAX_DEPTH_RATIO,
    PredictionClouds,
    archive_colour,
    prediction_clouds,
)
from rebar_depth_bench.viewing.view import ShownView, read_view
from rebar_depth_bench.viewing.viewer import show_recording

SUMMARY = "show ground truth and predictions of one view in 3D, with the bars and cameras"
SUFFIX = ".rrd"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("root", metavar="ROOT", help="dataset folder or Hub repository id (ORG/NAME@REVISION)")
    parser.add_argument("view", metavar="VIEW", help="id of the view, such as lattice/0000")
    parser.add_argument(
        "archives", metavar="ARCHIVE", nargs="*", help="submission archives (zip), a colour for each"
    )
    parser.add_argument(
        "--signed-error",
        type=partial(positive_number, expected="a length above 0 mm"),
        metavar="MM",
        help="colour predictions by their error instead: from MM too near (blue) to MM too far (brown)",
    )
    add_output_file(parser, "--out", f"write a recording ({SUFFIX}) instead of opening rerun's viewer")
    add_expect_digest(parser)


def run(options: argparse.Namespace) -> None:
    """Show a view in the viewer, or write the recording and print its path."""
    out: Path | None = options.out
    if out is not None and not is_stream(out) and (out.suffix != SUFFIX or out.is_dir()):
        raise InputError(f"--out names {out}, expected a file that ends with {SUFFIX}")
    try:
        from rebar_depth_bench.viewing.recording import record_view
    except ImportError as error:
        raise InputError(f"the view needs rerun ({error}): pip install 'rebar-depth-bench[view]'") from None
    folder = open_folder(options.root, expect_digest=options.expect_digest)
    view = read_view(folder, options.view)
    print_verified(folder, f"view {view.view_id} and bars verified")
    _print_view_notes(view)
    limit_m = None if options.signed_error is None else options.signed_error / 1000
    predictions = _predictions(folder, view, options.archives, limit_m)
    recording = record_view(view, predictions)
    if out is None:
        show_recording(recording)
        return
    write_output(out, recording)
    if prints_table(options):
        print(out)


def _print_view_notes(view: ShownView) -> None:
    without_axis = len(view.bars) - len(with_axis(view.bars))
    if without_axis:
        print_notice(f"{without_axis} of {len(view.bars)} bars have no axis and are not drawn")
    if view.left.camera.distortion.any():
        print_notice("raw grid: points follow the distorted rays; the cameras are drawn without distortion")


def _predictions(
    folder: DatasetFolder, view: ShownView, archives: Sequence[str], error_limit_m: float | None
) -> list[PredictionClouds]:
    """Return the clouds of the archives, and print their scales and how many of their points are left out.

    Raises ``SubmissionError`` for an invalid archive, and for one that lacks the view.
    """
    predictions: list[PredictionClouds] = []
    for index, archive in enumerate(archives):
        with open_evaluation(archive, folder.root) as evaluation:
            try:
                predicted_m = evaluation.submission.read(view.view_id)
            except EntryError as error:
                raise SubmissionError.from_problems(archive, error.problems) from None
            name = printable(evaluation.method)
        if any(name == earlier.name for earlier in predictions):
            name = f"{name} ({index + 1})"
        clouds = prediction_clouds(view, name, predicted_m, archive_colour(index), error_limit_m)
        predictions.append(clouds)
        scale = "no valid prediction to scale" if clouds.scale is None else f"scale {clouds.scale:.4g}"
        far = f"; {clouds.too_far} points beyond {MAX_DEPTH_RATIO:g} times the largest depth left out"
        print_notice(f"{name}: {scale}{far if clouds.too_far else ''}")
    return predictions
