"""The ``rebar-build import`` command."""

from __future__ import annotations

import argparse
from pathlib import Path

from rebar_depth_bench.console import ProgressBars

SUMMARY = "import images with depth from other programs as a config of a dataset folder"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("layout", type=Path, metavar="LAYOUT", help="TOML file that describes the data")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="ROOT", help="dataset folder: new, or one to add the config to"
    )
    parser.add_argument("--config", required=True, metavar="NAME", help="name of the config")
    parser.add_argument(
        "--overwrite",
        nargs="+",
        default=(),
        metavar="NAME",
        help="config of ROOT that may be replaced, if it was imported from other data",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="check the layout and show what it describes; nothing is written",
    )


def run(options: argparse.Namespace) -> None:
    """Check the layout, print what is imported, and import it unless this is a dry run."""
    from dataset_builder.importing.config_import import plan_import, run_import

    source = plan_import(options.layout, options.config)
    (height, width), views = source.views.grid, source.views.names
    print(f"{source.name}: {len(views)} views of {width} x {height}, sigma {source.layout.truth_sigma_m} m")
    if source.absent_columns:
        print(f"absent: {', '.join(source.absent_columns)}")
    if source.bars:
        print(f"surveyed bars: {len(source.bars)}")
    if not options.dry_run:
        with ProgressBars() as bars:
            run_import(source, options.out, bars.update, overwrite=options.overwrite)
        print(options.out)
