"""Registry of the studies by name, and their subcommands of ``rebar-bench study``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Protocol

from rebar_depth_bench.studies.distance import command as distance
from rebar_depth_bench.studies.kitti import command as kitti
from rebar_depth_bench.studies.pseudo_reference import command as pseudo_reference
from rebar_depth_bench.studies.scale_anchor import command as anchor


class Study(Protocol):
    """Interface of a study's command module: a one-line summary, its arguments and its entry point."""

    SUMMARY: str

    @property
    def add_arguments(self) -> Callable[[argparse.ArgumentParser], None]:
        """Add the study's arguments to its parser."""

    @property
    def run(self) -> Callable[[argparse.Namespace], None]:
        """Run the study: results go to standard output, progress to standard error.

        Raises ``RebarDepthError``.
        """


STUDIES: Mapping[str, Study] = {
    "anchor": anchor,
    "distance": distance,
    "pseudo-reference": pseudo_reference,
    "kitti": kitti,
}


def add_study_commands(parser: argparse.ArgumentParser) -> None:
    """Add a subcommand for each study to the parser of ``rebar-bench study``.

    Each subcommand sets the default ``run`` to the entry point of its study.
    """
    commands = parser.add_subparsers(required=True, metavar="NAME")
    for name, study in STUDIES.items():
        command = commands.add_parser(name, help=study.SUMMARY, description=study.SUMMARY)
        study.add_arguments(command)
        command.set_defaults(run=study.run)
