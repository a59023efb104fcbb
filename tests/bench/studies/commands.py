"""A study run as its command runs it, in this process."""

from __future__ import annotations

import argparse
from pathlib import Path
from types import ModuleType

from rebar_depth_bench.cli.console import run_command


def study(module: ModuleType, *arguments: str | Path) -> int:
    """Return the exit status."""
    parser = argparse.ArgumentParser(prog="study")
    module.add_arguments(parser)
    options = parser.parse_args([str(argument) for argument in arguments])
    return run_command(lambda: module.run(options))
