"""The Blender process: one pickled task in, events as JSON lines out, Blender's own prints to a log."""

from __future__ import annotations

import json
import os
import pickle
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

from rebar_depth_bench.errors import BuildError, InputError

Report = Callable[[Mapping[str, Any]], None]


def main() -> int:
    """Run the task that stands on standard input; ``sys.argv[1]`` is the log's path."""
    report = _claim_standard_output(sys.argv[1])
    task = pickle.load(sys.stdin.buffer)
    _end_with_parent(sys.stdin.buffer)
    try:
        _runner(task)(task, report)
    except InputError as error:
        report({"input_error": str(error)})
    except BuildError as error:
        report({"build_error": str(error)})
    return 0


def _runner(task: object) -> Callable[[Any, Report], None]:
    """Return the function that runs a task. Imported late: by now Blender's prints go to the log."""
    from dataset_builder.blender.depth_task import run_depth_task
    from dataset_builder.blender.render_task import run_render_task
    from dataset_builder.build.blender_process import DepthTask, RenderTask

    runners: Mapping[type, Callable[[Any, Report], None]] = {
        RenderTask: run_render_task,
        DepthTask: run_depth_task,
    }
    return runners[type(task)]


def _claim_standard_output(log: str) -> Report:
    """Send file descriptors 1 and 2 to the log and return a function that writes events to the old 1."""
    events = os.fdopen(os.dup(1), "w", buffering=1)
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    return lambda event: print(json.dumps(event), file=events, flush=True)


def _end_with_parent(stream: BinaryIO) -> None:
    """End this process at once when its standard input closes: its parent is gone."""

    def wait() -> None:
        while stream.read(1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    sys.stdout.flush()
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # Blender's own teardown can crash after the work is done
