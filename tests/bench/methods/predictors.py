"""Methods for tests: loading of single-view ones, one that counts its calls, and interruption of runs."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.methods import (
    AnyMethod,
    Method,
    MethodInfo,
    MultiViewMethod,
    Predictor,
    Prepared,
    Views,
    find_method,
)


def load_predictor(method: AnyMethod | str) -> Predictor:
    """Load a single-view method, given by name or as an object."""
    single_view_method = find_method(method) if isinstance(method, str) else method
    assert isinstance(single_view_method, Method)
    return single_view_method.load()


def stop_after(views: int, task: str = "") -> Progress:
    """Return a progress function that interrupts a task of this name, or any, after so many steps."""

    def progress(name: str, done: int, _: int) -> None:
        if done == views and task in name:
            raise KeyboardInterrupt

    return progress


def metadata_of(archive: Path) -> dict[str, Any]:
    """Return the metadata of an archive."""
    with zipfile.ZipFile(archive) as source:
        metadata: dict[str, Any] = json.loads(source.read("submission.json"))
    return metadata


def orbit_view_ids(root: Path) -> list[str]:
    """Return the view ids of ``lattice-orbit``."""
    manifest = json.loads((root / "manifest.json").read_text())
    return [view["view_id"] for view in manifest["configs"]["lattice-orbit"]["views"]]


def counting_method(log: list[str]) -> MultiViewMethod:
    """Return a multi-view method that predicts the number of views of a config and logs its calls."""

    def check(views: Views) -> None:
        log.append(f"check {views.config}")

    def prepare(views: Views, work: Path, progress: Progress) -> Prepared:
        log.append(f"prepare {views.config} {(work / 'kept').exists()}")
        (work / "kept").touch()
        progress("preparing", 1, 1)
        counted = sum(row["left_K"].shape == (3, 3) for row in views.rows("left_K"))
        assert counted == len(views.view_ids)

        def run(row: Mapping[str, Any]) -> np.ndarray:
            assert set(row) == {"view_id"}
            log.append(row["view_id"])
            return np.full(views.grid, counted, np.float32)

        return Prepared(run, {"counted": counted})

    return MultiViewMethod(MethodInfo("whole", "a test", (), False, "here", "MIT"), prepare, check)
