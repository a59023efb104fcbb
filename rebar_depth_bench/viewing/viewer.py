"""Start of rerun's viewer on a recording, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

from rebar_depth_bench.atomic_io import scratch_folder
from rebar_depth_bench.errors import InputError, RebarDepthError

_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_PROGRAM = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
"""Rerun's program; ``python -m rerun_cli`` loses its exit status."""


def show_recording(recording: bytes) -> None:
    """Show the content of an ``.rrd`` file in the viewer, and return when it is closed.

    The viewer contacts no other machine: usage statistics are disabled in a settings folder of its own, and the
    welcome screen, which loads a list of examples, is hidden. Raises ``InputError`` without a display, and
    ``RebarDepthError`` if the viewer fails.
    """
    if not any(os.environ.get(name) for name in _DISPLAYS):
        raise InputError(
            f"no display was found ({' and '.join(_DISPLAYS)} are not set), expected one for the viewer; "
            "--out FILE.rrd writes a file for rerun on another machine"
        )
    program = [sys.executable, "-c", _PROGRAM]
    with scratch_folder() as folder:
        environment = {**os.environ, "XDG_CONFIG_HOME": str(folder)}
        file = folder / "view.rrd"
        file.write_bytes(recording)
        viewer = ["--hide-welcome-screen", "--bind", "127.0.0.1", "--port", "0", str(file)]
        disabled = subprocess.run(
            [*program, "analytics", "disable"], env=environment, capture_output=True, check=False
        )
        status = (
            disabled.returncode or subprocess.run([*program, *viewer], env=environment, check=False).returncode
        )
    if status:
        raise RebarDepthError(f"rerun's viewer ended with exit status {status}")
