"""Run a method over a dataset folder into a submission archive."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.dataset import iterate
from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.methods import Method
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.submission import SubmissionWriter


def predict(
    method: Method,
    root: str | Path,
    archive: str | Path,
    *,
    configs: Sequence[str] | None = None,
    progress: Progress = silent,
) -> None:
    """Predict every view of the named configs (default: all) and write the archive, whole or not at all.

    Raises ``DatasetError`` for an unknown folder or config, ``MethodError`` for what the method lacks.
    """
    folder = open_folder(root)
    names = tuple(dict.fromkeys(configs or folder.configs))
    totals = {name: len(folder.views(name)) for name in names}
    run = method.load()
    info = method.info
    with SubmissionWriter(
        archive, method=info.name, description=info.summary, uses_intrinsics=info.uses_intrinsics
    ) as writer:
        for name in names:
            rows = iterate(root, name, ("view_id", *info.columns))
            for done, row in enumerate(rows, start=1):
                writer.add(row["view_id"], run(row))
                progress(f"{info.name} on {name}", done, totals[name])
