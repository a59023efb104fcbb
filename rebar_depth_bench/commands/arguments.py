"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_archive(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument of one archive."""
    parser.add_argument("archive", metavar="ARCHIVE", help="the submission's zip")


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add ``--data``."""
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add ``--workers``."""
    parser.add_argument("--workers", type=int, metavar="N", help="threads (default: one a core)")


def add_file(parser: argparse.ArgumentParser, option: str, summary: str) -> None:
    """Add an option that names a file to write."""
    parser.add_argument(option, type=Path, metavar="FILE", help=summary)
