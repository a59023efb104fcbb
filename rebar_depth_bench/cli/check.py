"""The ``rebar-bench check`` command."""

from __future__ import annotations

import argparse

from rebar_depth_bench.base.errors import SubmissionError
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.cli.console import add_archive, add_data, add_expect_digest, print_verified
from rebar_depth_bench.data.manifest import open_folder
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
        print(f"{options.archive}: no problem found")
        evaluation = Evaluation(folder, submission)
        if problems := evaluation.meta.kind_problems(RANKS_METRIC):
            print_notice(f"not ranked: {problems[0]}")
        for mistake in diagnose(evaluation):
            print_notice(f"possible mistake: {mistake.text}")
