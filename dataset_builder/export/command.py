"""The ``rebar-build export`` command."""

from __future__ import annotations

import argparse
from pathlib import Path

from rebar_depth_bench.console import ProgressBars
from rebar_depth_bench.view_ids import SPLITS

SUMMARY = "export a dataset folder as plain files, with COLMAP's and nerfstudio's cameras"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="output folder: new, or an earlier export to resume"
    )
    parser.add_argument(
        "--config", nargs="+", action="extend", metavar="NAME", help="configs to export (default: all)"
    )
    parser.add_argument(
        "--split", choices=SPLITS, metavar="NAME", help="split to export: train, validation or test (default: all)"
    )
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="number of views per config, or per scene of a config with splits, evenly spaced over the views of "
        "the folder (default: all)",
    )


def run(options: argparse.Namespace) -> None:
    """Export configs of a dataset folder; print the numbers of files."""
    from dataset_builder.export import export

    with ProgressBars() as bars:
        summary = export(
            options.root,
            options.out,
            options.config,
            options.views,
            progress=bars.update,
            split=options.split,
        )
    for config in summary.configs:
        print(f"{config.config}: {config.views} views, {config.written} files written, {config.kept} kept")
    print(options.out)
