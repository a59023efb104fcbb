"""Early exit of a Blender process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from dataset_builder.pipeline.blender_process import DepthTask, _send_task


def test_process_exit_before_reading_task_raises_no_error() -> None:
    """Send a task to a dead process: a ``BrokenPipeError`` would end the build as if its output were closed."""
    with subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE) as process:
        process.wait()
        _send_task(process.stdin, DepthTask(Path("mesh.ply"), (), Path("out"), 1))
    assert process.returncode == 0
