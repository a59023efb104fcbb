"""Studies run in this process as their commands run them."""

from __future__ import annotations

import argparse
from pathlib import Path
from types import ModuleType

from rebar_depth_bench.studies.registry import STUDIES

from rebar_depth_bench.console import add_commands, run_command


def run_study(module: ModuleType, *arguments: str | Path) -> int:
    """Run the study of a command module with its own arguments and return the exit status."""
    parser = argparse.ArgumentParser(prog="study")
    module.add_arguments(parser)
    options = parser.parse_args([str(argument) for argument in arguments])
    return run_command(lambda: module.run(options))


def run_study_command(*arguments: str | Path) -> int:
    """Run ``rebar-bench study`` without the other commands and return the exit status."""
    parser = argparse.ArgumentParser()
    add_commands(parser, STUDIES, "NAME")
    options = parser.parse_args([str(argument) for argument in arguments])
    return run_command(lambda: options.run(options))
