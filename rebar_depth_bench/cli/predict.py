"""The commands ``rebar-bench predict`` and ``rebar-bench methods``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from rebar_depth_bench.base.errors import InputError, MethodError
from rebar_depth_bench.base.names import SPLITS, TEST_SPLIT, config_of
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.captures.camera_files import CAMERAS_FILE
from rebar_depth_bench.captures.views import is_capture, open_capture
from rebar_depth_bench.cli.console import (
    InputFile,
    OutputArchive,
    OutputFolder,
    add_data,
    add_expect_digest,
    add_names,
    add_output_file,
    add_seconds,
    positive_number,
    print_verified,
    prints_table,
)
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.methods import METHODS, AnyMethod, MultiViewMethod, all_methods, find_method
from rebar_depth_bench.methods.base import VIEW_TIMEOUT_S, input_class
from rebar_depth_bench.methods.registry import FROM_FOLDER
from rebar_depth_bench.methods.run import dataset_views, predict_views
from rebar_depth_bench.reporting.tables import plain_text, print_line
from rebar_depth_bench.submission.declaration import METRIC

_ALL_VIEWS_NOTE = "prepares a whole config before it predicts any view"
_LIST_WIDTH = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    names = (
        f"{', '.join(METHODS)}, the name of a method of an installed package, my_model.py:METHOD (a Python file), "
        "my_model.toml (an ONNX model), hf:ORG/NAME (a transformers checkpoint) or NAME:FOLDER (a folder with "
        f"weights for {', '.join(FROM_FOLDER)})"
    )
    parser.set_defaults(interrupted="interrupted; run the same command again to resume")
    parser.add_argument("method", type=InputFile, metavar="METHOD", help=names)
    data = "dataset folder, Hub repository, capture (left/, right/, calibration.conf) or images with their cameras"
    add_data(parser, data)
    add_expect_digest(parser)
    archive = "submission archive (zip) to write"
    add_output_file(parser, "--out", archive, kind=OutputArchive, metavar="ARCHIVE", required=True)
    picture = "write each view's depth in colour, with a scale, to DIR/<view id>.png"
    add_output_file(parser, "--pictures", picture, kind=OutputFolder, metavar="DIR")
    cloud = "write each view's points in the colours of the left image, metres, to DIR/<view id>.ply"
    add_output_file(parser, "--ply", cloud, kind=OutputFolder, metavar="DIR")
    add_names(parser, "--config", "configs to predict (default: all in the folder that have the split)")
    parser.add_argument(
        "--split",
        choices=SPLITS,
        help=f"split of the configs that have several (default: {TEST_SPLIT})",
    )
    limit = (
        "time limit on an ONNX model for each view, and for opening it; onnxruntime stops between two operators "
        "of the model. Other methods have no limit"
    )
    add_seconds(parser, "--view-timeout", VIEW_TIMEOUT_S, limit)
    parser.add_argument(
        "--nearest-distance",
        type=partial(positive_number, expected="a distance above 0 m"),
        metavar="METRES",
        help="distance of the nearest surface, known before the capture, from which foundation-stereo:FOLDER "
        "chooses its mode (default: from half of the image width). One measured in the scored depth, masks, "
        "meshes or poses makes the submission a user of ground truth",
    )


def format_note(value: object) -> str:
    """Return a note, a plain JSON value, formatted on one line."""
    if isinstance(value, dict):
        return ", ".join(f"{key.replace('_', ' ')} {format_note(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(format_note, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def run(options: argparse.Namespace) -> None:
    """Predict into an archive; print the method's notes to standard error and the archive's path."""
    method = find_method(options.method, view_timeout_s=options.view_timeout, nearest_m=options.nearest_distance)
    views, notices = _open_views(options, method)
    for option, folder in (("pictures", options.pictures), ("ply", options.ply)):
        for of_config in views if folder is not None else ():
            target = (folder / config_of(of_config.view_ids[0])).resolve()
            if Path(options.data).resolve() in (target, *target.parents):
                raise InputError(f"--{option}: its files would be in {target}, the input; expected another folder")
    info = method.info
    print_notice(f"{info.name}: {info.summary}; from {info.source}; licence {info.licence}")
    for notice in notices:
        print_notice(notice)
    with ProgressBars() as bars:
        prepared = predict_views(
            method, views, options.out, bars.update, pictures=options.pictures, clouds=options.ply
        )
    for config, preparation in prepared.items():
        for key, value in preparation.notes.items():
            print_notice(f"{config}: {key.replace('_', ' ')}: {format_note(value)}")
    if prints_table(options):
        print(options.out)


def _open_views(options: argparse.Namespace, method: AnyMethod) -> tuple[Sequence[Views], list[str]]:
    """Return the views of a dataset, whose verified digests are printed, or of a folder of images, with notices.

    Raises ``InputError`` for a folder that is neither, and for options of datasets with a folder of images.
    """
    path = Path(options.data)
    if not path.is_dir() or (path / MANIFEST_FILE).exists():
        folder = open_folder(options.data, expect_digest=options.expect_digest)
        print_verified(folder)
        return dataset_views(folder, options.config, options.split or TEST_SPLIT), []
    # The readers of cameras and calibrations are imported only for images.

    if not is_capture(path):
        raise InputError(
            f"{path}: has no {MANIFEST_FILE}, no left/, no {CAMERAS_FILE} and no images, "
            "expected a complete dataset folder written by rebar-build, or images with their cameras"
        )
    for option in ("config", "split", "expect_digest"):
        if getattr(options, option) is not None:
            name = f"--{option.replace('_', '-')}"
            raise InputError(f"{options.data}: {name} is given, which is for dataset folders only")
    images = open_capture(path)
    notices = [f"{images.config}: {len(images.view_ids)} views of {images.path}; {images.describe_camera()}"]
    notices += images.calibration.notes
    if images.board_is_assumed and isinstance(method, MultiViewMethod):
        notices.append(f"{images.config}: states no board, so it is taken to be {images.board}")
    return [images], notices


def add_methods_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``methods``."""
    summary = "print one method whole: what it reads, source, licence and untested parts (default: list all)"
    parser.add_argument("name", nargs="?", metavar="NAME", help=summary)


def run_methods(options: argparse.Namespace) -> None:
    """Print one line per method, cut off at 100 columns, or one method whole."""
    console, methods = Console(), all_methods()
    if options.name is not None:
        _print_method(options.name, methods.get(options.name) or find_method(options.name), console)
        return
    rows = [("method", "inputs", "description")]
    for name, method in methods.items():
        if isinstance(method, MethodError):
            rows.append((name, "", f"cannot be used: {method}"))
        else:
            label = f"{name} ‡" if method.info.uses_ground_truth else name
            rows.append((label, input_class(method) or "-", method.info.summary))
    first, second, _ = (max(map(len, column)) for column in zip(*rows, strict=True))
    for name, inputs, description in rows:
        line = plain_text(f"{name:<{first}}  {inputs:<{second}}  {description}")
        line.truncate(min(console.width, _LIST_WIDTH), overflow="ellipsis")
        console.print(line)
    print_line(console, "‡ uses ground truth; its submissions are not ranked")
    print_line(console, "rebar-bench methods NAME prints all about one: source, licence, untested parts")


def _print_method(name: str, method: AnyMethod | MethodError, console: Console) -> None:
    if isinstance(method, MethodError):
        raise method
    info = method.info
    print_line(console, name, style="bold")
    for title, text in {
        "description": info.summary,
        "reads": _format_columns(info.columns),
        "inputs": input_class(method) or "",
        "predicts": "" if info.prediction == METRIC else f"predictions of the kind {info.prediction}",
        "ground truth": "used; submissions are not ranked" if info.uses_ground_truth else "",
        "preparation": _ALL_VIEWS_NOTE if isinstance(method, MultiViewMethod) else "",
        "source": info.source,
        "licence": info.licence,
        "untested": info.untested_note,
    }.items():
        if text:
            print_line(console, f"{title}: {text}")


def _format_columns(columns: Sequence[str]) -> str:
    """Return the dataset columns, with a left/right pair merged: ``both rgb`` for ``left_rgb, right_rgb``."""
    names = set(columns)
    parts = []
    for column in columns:
        eye, _, kind = column.partition("_")
        if eye == "left" and f"right_{kind}" in names:
            parts.append(f"both {kind}")
        elif not (eye == "right" and f"left_{kind}" in names):
            parts.append(column)
    return ", ".join(parts)
