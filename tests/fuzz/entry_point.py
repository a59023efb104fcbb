"""Description of an entry point: a reader or command with sound inputs, and the files to damage."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rebar_depth_bench.cli.console import EXIT_DONE, EXIT_INPUT, check_outputs
from rebar_depth_bench.cli.main import argument_parser
from tests.fuzz.workspace import Workspace


@dataclass(frozen=True)
class EntryPoint:
    """Entry point under test.

    ``prepare`` writes sound inputs into the folder of a workspace and may run commands; ``run`` reads them and
    raises ``RebarDepthError`` for unsound ones. ``targets`` are glob patterns, below the work folder, of the files
    to damage. ``share`` is its number of cases per 200.

    ``result`` returns what an accepted case has found. It equals that of the sound inputs in every case if a
    digest covers the targets (``covered``), and in cases with a truncated file if the format of the targets
    ``shows_truncation``. ``check`` examines the outputs of an accepted case and raises ``AssertionError``.

    ``statuses`` are the allowed exit statuses, ``kept_outputs`` patterns of outputs that may stay after a failure,
    and ``may_change`` patterns of other paths that may change. Without ``special_files`` only content is damaged.
    """

    name: str
    share: int
    prepare: Callable[[Workspace], object]
    run: Callable[[Workspace], object]
    targets: Sequence[str]
    result: Callable[[Workspace], bytes] | None = None
    covered: bool = False
    shows_truncation: bool = False
    check: Callable[[Workspace], object] | None = None
    statuses: Sequence[int] = (EXIT_DONE, EXIT_INPUT)
    kept_outputs: Sequence[str] = ()
    may_change: Sequence[str] = ()
    special_files: bool = True
    names: Sequence[str] = ()

    def files(self, root: Path) -> list[Path]:
        """Return the files to damage below a work folder, sorted."""
        found = {path for pattern in self.targets for path in root.glob(pattern) if path.is_file()}
        assert found, f"{self.name}: no file matches {', '.join(self.targets)}"
        return sorted(found)


def bench(*arguments: str | Path) -> None:
    """Run ``rebar-bench`` with these arguments; unlike its ``main`` this raises the errors."""
    run_options(argument_parser(), *arguments)


def run_options(parser: argparse.ArgumentParser, *arguments: str | Path) -> None:
    """Run the command that a parser selects."""
    options = parser.parse_args([str(argument) for argument in arguments])
    check_outputs(vars(options))
    options.run(options)
