"""Commands run in this process, which is much faster than a new interpreter for each."""

from __future__ import annotations

import io
import subprocess
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path


def run_in_process(
    main: Callable[[Sequence[str]], int], *arguments: str | Path
) -> subprocess.CompletedProcess[str]:
    """Call the ``main`` function of a command and return exit status and output as ``subprocess.run`` does."""
    stdout, stderr = io.StringIO(), io.StringIO()
    command = [str(argument) for argument in arguments]
    with redirect_stdout(stdout), redirect_stderr(stderr):
        try:
            status = main(command)
        except SystemExit as exit_:
            status = exit_.code if isinstance(exit_.code, int) else 1
    return subprocess.CompletedProcess(command, status, stdout.getvalue(), stderr.getvalue())
