"""What a Blender process that ends before its time leaves behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from dataset_builder.build.blender_process import _send
from dataset_builder.build.blender_process import DepthTask


def test_a_process_that_dies_before_it_reads_its_task_leaves_no_broken_pipe() -> None:
    """The error would end a build without a word, as if the reader of its output had gone."""
    with subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE) as process:
        process.wait()
        _send(process.stdin, DepthTask(Path("mesh.ply"), (), Path("out"), 1))
    assert process.returncode == 0
