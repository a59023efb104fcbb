"""Command ``rebar-bench study pseudo-reference``: dependence of scores on the reference depth.

The paper's Table II scores monocular models on a physical sequence, on the full frame, against two estimates of
its depth (FoundationStereo and COLMAP). For a dataset folder with exact depth, the same scores against the exact
depth show the errors that each pseudo-reference hides.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from rebar_depth_bench.captures.folder import CAPTURE_LAYOUT, is_capture, open_capture
from rebar_depth_bench.console import ProgressBars, add_workers
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.parallel import map_with_progress
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.ground_truth import verified_views
from rebar_depth_bench.scoring.metrics import mean
from rebar_depth_bench.scoring.provenance import ArchiveIdentity, Provenance
from rebar_depth_bench.scoring.result import tabulate
from rebar_depth_bench.studies.common import add_output_arguments, write_outputs
from rebar_depth_bench.studies.depth_source import DepthSource, open_depths
from rebar_depth_bench.studies.pseudo_reference.output import to_page, to_pandas
from rebar_depth_bench.studies.pseudo_reference.result import (
    AgreementRow,
    DepthReference,
    MethodRow,
    PseudoReferenceResult,
)
from rebar_depth_bench.studies.pseudo_reference.study import (
    EXACT_LABEL,
    DepthRange,
    FrameOutcome,
    FrameView,
    score_frame_view,
)
from rebar_depth_bench.submission import ExpectedViews
from rebar_depth_bench.view_ids import config_of, split_of

PROTOCOL = "rebar-pseudo-reference-1"
SUMMARY = "score methods on the full frame against two pseudo-references (the paper's Table II)"
DEFAULT_NEAR_M, DEFAULT_FAR_M = 0.1, 20.0
"""Ends of the default evaluation range, metres."""


@dataclass(frozen=True)
class _StudyData:
    """Opened dataset config or capture.

    ``views`` are the views to score; ``archive_views`` are all views that an archive may contain. ``config``,
    ``digest`` and ``version`` are those of a dataset folder, ``camera`` describes the camera of a capture.
    """

    name: str
    views: ExpectedViews
    archive_views: ExpectedViews
    config: DatasetConfig | None = None
    digest: str | None = None
    version: str | None = None
    camera: str | None = None

    def of_split(self, sources: Sequence[DepthSource]) -> _StudyData:
        """Return the data restricted to the split that the sources cover, if they are a config with splits.

        Raises ``InputError`` if sources cover different splits.
        """
        if self.config is None or not self.config.has_splits:
            return self
        covered: dict[str, str] = {}
        for source in sources:
            for view_id in source.view_ids:
                split = split_of(view_id)
                if config_of(view_id) == self.config.name and split is not None:
                    covered.setdefault(split, source.method)
        if len(covered) > 1:
            found = " and ".join(f"{method} the split {split}" for split, method in covered.items())
            raise InputError(f"config {self.config.name}: {found}, expected one split in all depth maps")
        if not covered:
            return self
        config = self.config.of_split(*covered)
        views = dict.fromkeys(config.view_ids, config.grid)
        return replace(self, name=f"config {config.name} ({config.scenes[0].split})", views=views, config=config)

    def frames(self, exact: bool) -> Iterator[FrameView]:
        """Yield the views to score.

        If ``exact`` is true and the data are a dataset folder, the views have their exact depth, verified against
        the digests of the manifest.
        """
        if self.config is not None and exact:
            for view_id, left, _ in verified_views(self.config, silent, "full frame"):
                yield FrameView(view_id, (left.camera.height, left.camera.width), left.depth_m)
        else:
            for view_id, shape in self.views.items():
                yield FrameView(view_id, shape)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study's arguments."""
    parser.description = (
        f"{SUMMARY}. A real capture is a folder with {CAPTURE_LAYOUT}; its view ids are <folder>/<name>. Depth "
        "files in a folder may be named by <name> alone; the folder may contain a submission.json with method "
        "and, for 16-bit PNG, depth_scale."
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
    parser.add_argument("--config", metavar="NAME", help="config of a dataset folder (default: its only one)")
    parser.add_argument(
        "--near",
        type=float,
        default=DEFAULT_NEAR_M,
        metavar="M",
        help="smallest depth scored, m (default: %(default)s)",
    )
    parser.add_argument(
        "--far",
        type=float,
        default=DEFAULT_FAR_M,
        metavar="M",
        help="largest depth scored, m (default: %(default)s)",
    )
    parser.add_argument(
        "--no-exact", action="store_true", help="do not compare with the exact depth of a dataset folder"
    )
    add_workers(parser)
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> None:
    """Run the study, write the requested outputs and print the tables."""
    with ProgressBars() as bars:
        result = run_pseudo_reference_study(
            options.methods,
            options.reference,
            options.data,
            config=options.config,
            depth_range=DepthRange(options.near, options.far),
            exact=not options.no_exact,
            workers=options.workers,
            progress=bars.update,
        )
    write_outputs(options, result.to_dict(), to_pandas(result), to_page(result))


def run_pseudo_reference_study(
    methods: Sequence[str],
    references: Sequence[str],
    data: str,
    *,
    config: str | None = None,
    depth_range: DepthRange = DepthRange(DEFAULT_NEAR_M, DEFAULT_FAR_M),  # noqa: B008 frozen
    exact: bool = True,
    workers: int | None = None,
    progress: Progress = silent,
) -> PseudoReferenceResult:
    """Score methods on the full frame against pseudo-references, and against exact depth if available.

    Methods and references are archives in the submission format or folders of depth files
    (``depth_source.open_depths``). Ratios and rankings under the other references are relative to the first one.

    Raises ``DatasetError`` or ``InputError`` for invalid data, an invalid archive or folder, or a reference
    without depth in range.
    """
    study_data = _open_data(data, config)
    with ExitStack() as stack:
        depth_sources = [
            stack.enter_context(
                open_depths(path, study_data.views if Path(path).is_dir() else study_data.archive_views)
            )
            for path in (*methods, *references)
        ]
        study_data = study_data.of_split(depth_sources)
        sources = _label_sources(depth_sources, study_data.views)
        names = list(sources)
        by_method = {name: sources[name] for name in names[: len(methods)]}
        by_reference = {name: sources[name] for name in names[len(methods) :]}
        outcomes = map_with_progress(
            lambda view: score_frame_view(view, by_method, by_reference, depth_range),
            study_data.frames(exact),
            workers,
            progress,
            "scoring the full frame",
            len(study_data.views),
        )
        _raise_problems(outcomes, sources)
        stamps = [ArchiveIdentity(name, source.sha256()) for name, source in sources.items()]
    depth_references = _depth_references(outcomes, by_reference)
    _check_references_have_depth(depth_references, depth_range)
    return PseudoReferenceResult(
        provenance=Provenance(PROTOCOL, study_data.digest, study_data.version, stamps),
        data=study_data.name,
        camera=study_data.camera,
        depth_range=depth_range,
        references=depth_references,
        rows=_method_rows(outcomes, study_data),
        agreements=_agreement_rows(outcomes),
    )


def _open_data(data: str, config: str | None) -> _StudyData:
    if is_capture(data):
        if config is not None:
            raise InputError(f"{data}: is a capture, expected no --config (found {config!r})")
        capture = open_capture(data)
        captured = capture.expected_views()
        name = f"capture {capture.config}"
        return _StudyData(name, captured, captured, camera=capture.describe_camera())
    folder = open_folder(data)
    if config is None and len(folder.configs) != 1:
        raise InputError(
            f"{data}: has {len(folder.configs)} configs, expected --config with one of {', '.join(folder.configs)}"
        )
    chosen = folder.config(config or folder.configs[0])
    views = dict.fromkeys(chosen.view_ids, chosen.grid)
    archive_views = folder.expected_views()
    return _StudyData(f"config {chosen.name}", views, archive_views, chosen, folder.digest, folder.version)


def _label_sources(sources: Sequence[DepthSource], views: ExpectedViews) -> dict[str, DepthSource]:
    """Return the sources by unique label.

    The label is the method's name. If several sources have the same name, or if it could be confused with the
    exact depth, the file name is appended, and then a number if necessary.

    Raises ``InputError`` for a source without any of the views.
    """
    labelled: dict[str, DepthSource] = {}
    methods = [source.method for source in sources]
    for source in sources:
        if not any(view_id in views for view_id in source.view_ids):
            raise InputError(
                f"{source.path}: has none of the views of this data, expected views such as {next(iter(views))}"
            )
        label = source.method
        if methods.count(label) > 1 or label.startswith(EXACT_LABEL):
            label = f"{source.method} ({source.path.name})"
        number = 2
        while label in labelled:
            label, number = f"{source.method} ({source.path.name}) #{number}", number + 1
        labelled[label] = source
    return labelled


def _raise_problems(outcomes: Sequence[FrameOutcome], sources: Mapping[str, DepthSource]) -> None:
    """Raise ``InputError`` with the problems of all entries, each prefixed by its archive or folder, if any."""
    problems = [
        replace(problem, where=f"{sources[label].path}: {problem.where}")
        for outcome in outcomes
        for label, problem in outcome.problems
    ]
    if problems:
        raise InputError.from_problems("depth maps", problems)


def _depth_references(outcomes: Sequence[FrameOutcome], pseudo: Mapping[str, DepthSource]) -> list[DepthReference]:
    shares = {name: [outcome.shares[name] for outcome in outcomes] for name in outcomes[0].shares}
    return [
        DepthReference(
            name, name not in pseudo, len(values), sum(value > 0 for value in values), mean(values) or 0.0
        )
        for name, values in shares.items()
    ]


def _check_references_have_depth(references: Sequence[DepthReference], depth_range: DepthRange) -> None:
    empty = [reference.name for reference in references if reference.views_with == 0]
    if empty:
        raise InputError(
            f"{', '.join(map(printable, empty))}: no pixel of any view is {depth_range.describe()}, "
            "expected at least one to score against"
        )


def _method_rows(outcomes: Sequence[FrameOutcome], data: _StudyData) -> list[MethodRow]:
    split = data.config.scenes[0].split if data.config is not None and data.config.has_splits else None
    rows = []
    for method, reference in outcomes[0].scores:
        frames = [outcome.scores[method, reference] for outcome in outcomes]
        table = tabulate([frame.score for frame in frames if frame.score is not None], split=split)
        rows.append(MethodRow(method, reference, table, mean([frame.frame_share for frame in frames]) or 0.0))
    return rows


def _agreement_rows(outcomes: Sequence[FrameOutcome]) -> list[AgreementRow]:
    rows = []
    for pair in outcomes[0].agreements:
        view_agreements = [outcome.agreements[pair] for outcome in outcomes]
        errors = [view.abs_rel for view in view_agreements if view.abs_rel is not None]
        ratios = [view.median_ratio for view in view_agreements if view.median_ratio is not None]
        share = mean([view.common_share for view in view_agreements]) or 0.0
        rows.append(AgreementRow(*pair, len(errors), share, mean(errors), median(ratios) if ratios else None))
    return rows
