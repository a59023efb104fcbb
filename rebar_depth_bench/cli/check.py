"""The commands ``rebar-bench check``, of an archive, and ``rebar-bench verify``, of a dataset."""

from __future__ import annotations

import argparse

from rebar_depth_bench.base.errors import DatasetError, SubmissionError
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.cli.console import add_archive, add_data, add_expect_digest, print_verified
from rebar_depth_bench.data.files import file_problems
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import truth_problems
from rebar_depth_bench.diagnosis.corrections import KeptPredictions
from rebar_depth_bench.diagnosis.diagnose import diagnose
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.submission import SubmissionReader
from rebar_depth_bench.submission.declaration import RANKS_METRIC


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_archive(parser)
    add_data(parser)
    add_expect_digest(parser)


def run(options: argparse.Namespace) -> None:
    """Check an archive, and look for mistakes; raise ``SubmissionError`` with all problems of the archive."""
    folder = open_folder(options.data, expect_digest=options.expect_digest)
    with SubmissionReader(options.archive, folder.expected_views()) as submission:
        with ProgressBars() as bars:
            problems = list(submission.problems(bars.update))
        print_verified(folder)
        for note in submission.notes:
            print_notice(note)
        if problems:
            raise SubmissionError.from_problems(options.archive, problems)
        print(f"{options.archive}: the archive is valid")
        evaluation = Evaluation(folder, submission)
        if problems := evaluation.meta.kind_problems(RANKS_METRIC):
            print_notice(f"not ranked: {problems[0]}")
        kept = [KeptPredictions.of_archive(config, submission) for config in evaluation.configs]
        for mistake in diagnose(kept, evaluation.meta.prediction, evaluation.meta.depth_scale):
            print_notice(f"possible mistake: {mistake.text}")


def add_verify_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``verify``."""
    parser.add_argument("root", metavar="ROOT", help="dataset folder or Hub repository id (ORG/NAME@REVISION)")
    parser.add_argument(
        "--files-only",
        action="store_true",
        help="compare the SHA-256 of the files, and do not decode the views to compare their ground truth",
    )
    add_expect_digest(parser)


def run_verify(options: argparse.Namespace) -> None:
    """Verify a dataset; raise ``DatasetError`` with all of its problems."""
    folder = open_folder(options.root, expect_digest=options.expect_digest)
    with ProgressBars() as bars:
        problems = list(file_problems(folder, bars.update))
        if not problems and not options.files_only:  # Views of damaged files cannot be compared.
            for config in folder.config_by_name.values():
                problems += truth_problems(config, bars.update)
    if problems:
        raise DatasetError.from_problems(options.root, problems)
    views = "" if options.files_only else f", {len(folder.expected_views())} views"
    print(f"{options.root}: no problem found in {len(folder.files)} files{views}; dataset {folder.digest}")
