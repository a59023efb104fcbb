"""``rebar-bench demo``."""

from __future__ import annotations

import argparse
from pathlib import Path

from rebar_depth_bench.demo import DEMO_FOLDER, DEMO_VIEWS, run_demo

SUMMARY = "render a small lattice set, predict, score and report"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--out", type=Path, default=Path(DEMO_FOLDER), help="folder to work in (default: %(default)s)"
    )
    parser.add_argument(
        "--views", type=int, default=DEMO_VIEWS, help="stereo views to render (default: %(default)s)"
    )


def run(options: argparse.Namespace) -> None:
    """Run the demo."""
    run_demo(options.out, options.views)
