"""``rebar-bench study pseudo-reference``: what a method's score owes to the reference it is held against.

The paper's Table II: monocular models on a physical sequence, scored on the full frame against two estimates of
its depth (FoundationStereo and COLMAP). Where a dataset folder's exact depth is known, the same scores against it
show what each pseudo-reference hides.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from rebar_depth_bench.cli.console import ProgressBars
from rebar_depth_bench.data.ground_truth import checked_rows
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError, problem_summary
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.provenance import ArchiveStamp, Stamp
from rebar_depth_bench.scoring.result import tabulate
from rebar_depth_bench.studies.common import add_output_arguments, write_outputs
from rebar_depth_bench.studies.depth_source import DepthSource, open_depths
from rebar_depth_bench.studies.pseudo_reference.capture import LAYOUT, Capture, is_capture, open_capture
from rebar_depth_bench.studies.pseudo_reference.output import csv_rows, study_page
from rebar_depth_bench.studies.pseudo_reference.result import AgreementRow, PseudoReferenceResult, Reference, Row
from rebar_depth_bench.studies.pseudo_reference.study import (
    EXACT,
    DepthRange,
    FrameOutcome,
    FrameView,
    score_views,
)
from rebar_depth_bench.submission import ExpectedViews, config_of

PROTOCOL = "rebar-pseudo-reference-1"
SUMMARY = "score methods on the full frame against two pseudo-references (the paper's Table II)"
NEAR_M, FAR_M = 0.1, 20.0

Views = Iterator[FrameView]


@dataclass(frozen=True)
class _Data:
    """What is scored on: its views, in words, and what goes on the stamp."""

    name: str
    views: ExpectedViews
    archive_views: ExpectedViews
    folder: DatasetFolder | None
    capture: Capture | None

    def frames(self, exact: bool) -> Views:
        """Yield the views, with their exact depth, held against the manifest's digests, if asked for."""
        if self.folder is not None and exact:
            config = config_of(next(iter(self.views)))
            for row, _ in checked_rows(self.folder, config, silent, "full frame"):
                yield FrameView(row["view_id"], row["left_depth"].shape, row["left_depth"])
        else:
            for view_id, shape in self.views.items():
                yield FrameView(view_id, shape)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.description = (
        f"{SUMMARY}. A real capture is a folder with {LAYOUT}; its view ids are <folder>/<name>. A folder of "
        "depth files may name them by <name> alone, and hold a submission.json with method and, for 16-bit PNG, "
        "depth_scale."
    )
    maps = "archive in the submission format, or a folder of <view_id>.npy|npz|exr|png"
    parser.add_argument("methods", nargs="+", metavar="METHOD", help=f"the methods' depth: {maps}")
    parser.add_argument(
        "--reference",
        nargs="+",
        required=True,
        metavar="DEPTH",
        help=f"the pseudo-references, usually two: {maps}",
    )
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder, Hub repository or capture")
    parser.add_argument(
        "--config", metavar="NAME", help="which config of a dataset folder (default: its only one)"
    )
    parser.add_argument(
        "--near", type=float, default=NEAR_M, metavar="M", help="evaluation range (default: %(default)s)"
    )
    parser.add_argument(
        "--far", type=float, default=FAR_M, metavar="M", help="evaluation range (default: %(default)s)"
    )
    parser.add_argument("--no-exact", action="store_true", help="leave a dataset folder's exact depth out")
    parser.add_argument("--workers", type=int, metavar="N", help="threads (default: one a core)")
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study and print its tables."""
    with ProgressBars() as bars:
        result = pseudo_reference_study(
            options.methods,
            options.reference,
            options.data,
            config=options.config,
            allowed=DepthRange(options.near, options.far),
            exact=not options.no_exact,
            workers=options.workers,
            progress=bars.update,
        )
    write_outputs(options, result.to_dict(), csv_rows(result), study_page(result))


def pseudo_reference_study(
    methods: Sequence[str],
    references: Sequence[str],
    data: str,
    *,
    config: str | None = None,
    allowed: DepthRange = DepthRange(NEAR_M, FAR_M),  # noqa: B008 frozen
    exact: bool = True,
    workers: int | None = None,
    progress: Progress = silent,
) -> PseudoReferenceResult:
    """Score methods on the full frame against pseudo-references, and against exact depth where there is any.

    Methods and references are archives in the submission format or folders of depth files
    (``depth_source.open_depths``). The first reference is what the others' ratios and rankings are held against.

    Raises ``DatasetError`` or ``InputError`` for the data, a refused archive or folder, or a reference that has no
    depth in range.
    """
    on = _open_data(data, config)
    with ExitStack() as stack:
        opened = [
            stack.enter_context(open_depths(path, on.views if Path(path).is_dir() else on.archive_views))
            for path in (*methods, *references)
        ]
        sources = _labelled(opened, on.views)
        names = list(sources)
        by_method = {name: sources[name] for name in names[: len(methods)]}
        by_reference = {name: sources[name] for name in names[len(methods) :]}
        outcomes = score_views(
            on.frames(exact), len(on.views), by_method, by_reference, allowed, workers, progress
        )
        _refuse(outcomes, sources)
        stamps = [ArchiveStamp(name, source.sha256()) for name, source in sources.items()]
    held_against = _references(outcomes, by_reference)
    _refuse_empty(held_against, allowed)
    digest, version = (None, None) if on.folder is None else (on.folder.digest, on.folder.version)
    return PseudoReferenceResult(
        stamp=Stamp(PROTOCOL, digest, version, stamps),
        data=on.name,
        camera=None if on.capture is None else on.capture.camera_words(),
        allowed=allowed,
        references=held_against,
        rows=_rows(outcomes),
        agreements=_agreements(outcomes),
    )


def _open_data(data: str, config: str | None) -> _Data:
    if is_capture(data):
        if config is not None:
            raise InputError(f"{data}: is a capture, expected no --config (found {config!r})")
        capture = open_capture(data)
        views = capture.expected_views()
        return _Data(f"capture {capture.path.resolve().name}", views, views, None, capture)
    folder = open_folder(data)
    if config is None and len(folder.configs) != 1:
        raise InputError(
            f"{data}: has {len(folder.configs)} configs, expected --config with one of {', '.join(folder.configs)}"
        )
    name = config or folder.configs[0]
    views = {view.view_id: folder.grid(name) for view in folder.views(name)}
    return _Data(f"config {name}", views, folder.expected_views(), folder, None)


def _labelled(sources: Sequence[DepthSource], views: ExpectedViews) -> dict[str, DepthSource]:
    """Return the sources by method; where two have one name, by method and file, then with a number too.

    Raises ``InputError`` for a source without any of the views.
    """
    labelled: dict[str, DepthSource] = {}
    methods = [source.method for source in sources]
    for source in sources:
        if not any(view_id in views for view_id in source.view_ids):
            raise InputError(f"{source.path}: has no view of this data, expected some such as {next(iter(views))}")
        label = source.method
        if methods.count(label) > 1 or label.startswith(EXACT):
            label = f"{source.method} ({source.path.name})"
        number = 2
        while label in labelled:
            label, number = f"{source.method} ({source.path.name}) #{number}", number + 1
        labelled[label] = source
    return labelled


def _refuse(outcomes: Sequence[FrameOutcome], sources: Mapping[str, DepthSource]) -> None:
    """Raise ``InputError`` with what is wrong with the entries, each under its archive or folder."""
    found = [problem for outcome in outcomes for problem in outcome.problems]
    if found:
        raise InputError(problem_summary([f"{sources[label].path}: {sentence}" for label, sentence in found]))


def _references(outcomes: Sequence[FrameOutcome], pseudo: Mapping[str, DepthSource]) -> list[Reference]:
    shares = {name: [outcome.shares[name] for outcome in outcomes] for name in outcomes[0].shares}
    return [
        Reference(name, name not in pseudo, len(values), sum(value > 0 for value in values), _mean(values) or 0.0)
        for name, values in shares.items()
    ]


def _refuse_empty(references: Sequence[Reference], allowed: DepthRange) -> None:
    empty = [one.name for one in references if one.views_with == 0]
    if empty:
        raise InputError(
            f"{', '.join(map(formatting.printable, empty))}: no pixel of any view is {allowed.words()}, "
            "expected some to score against"
        )


def _rows(outcomes: Sequence[FrameOutcome]) -> list[Row]:
    rows = []
    for method, reference in outcomes[0].scores:
        frames = [outcome.scores[method, reference] for outcome in outcomes]
        table = tabulate([frame.score for frame in frames if frame.score is not None])
        rows.append(Row(method, reference, table, _mean([frame.frame_share for frame in frames]) or 0.0))
    return rows


def _agreements(outcomes: Sequence[FrameOutcome]) -> list[AgreementRow]:
    rows = []
    for pair in outcomes[0].agreements:
        of_views = [outcome.agreements[pair] for outcome in outcomes]
        errors = [one.abs_rel for one in of_views if one.abs_rel is not None]
        ratios = [one.median_ratio for one in of_views if one.median_ratio is not None]
        share = _mean([one.common_share for one in of_views]) or 0.0
        rows.append(AgreementRow(*pair, len(errors), share, _mean(errors), median(ratios) if ratios else None))
    return rows


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None
