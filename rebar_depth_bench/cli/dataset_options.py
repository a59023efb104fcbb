"""Option ``--expect-digest``, and the line that says which digests of a dataset were verified."""

from __future__ import annotations

import argparse

from rebar_depth_bench.console import print_notice
from rebar_depth_bench.data.manifest import DatasetFolder


def add_expect_digest(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--expect-digest``."""
    parser.add_argument(
        "--expect-digest",
        metavar="DIGEST",
        help="refuse any other dataset than that with this ground-truth digest (sha256:...)",
    )


def print_verified(
    folder: DatasetFolder, verified: str = "files and views not read (rebar-bench verify does)"
) -> None:
    """Print to standard error which digests of a dataset were verified, in one line."""
    print_notice(f"dataset {folder.digest} of {folder.root}: manifest consistent; {verified}")
