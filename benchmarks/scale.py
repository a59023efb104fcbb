"""Cost of a build, of opening and of an audit by the number of scenes, with rows that are prepared, not rendered.

python -m benchmarks.scale [--scenes N ...] [--audit N ...] [--work DIR]

Prints seconds and opened files, in all and per scene, of folders of small generated scenes with one view each:

- ``plan``: specs, keys and disk space of all scenes in a new folder;
- ``publish``: shards, manifest, bars, crossings, card and pictures of the staged scenes;
- ``open``: validation of the manifest;
- ``continue``: plan of the finished folder, whose files are compared with their digests;
- ``add``: publication of one scene of another split;
- ``audit``: all checks without Blender, for the numbers of scenes of ``--audit``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.timing import machine_description, print_markdown
from dataset_builder.audit import audit
from dataset_builder.catalog.cages_config import CAGES, CagesRequest
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.build import plan_build
from dataset_builder.pipeline.disk_space import check_readable, spaces_by_config
from dataset_builder.pipeline.folder import remove_build_folder, remove_stagings
from dataset_builder.pipeline.plan import BUILD_FOLDER, ConfigPlan, ScenePlan
from dataset_builder.pipeline.publish import publish_plans
from dataset_builder.pipeline.retained import Finished, kept_scenes
from dataset_builder.pipeline.shards import Staging, View, encode_view, stage_row
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.specs.config_specs import ConfigSpec, RandomViewsSpec
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import RenderedEye
from rebar_depth_bench.geometry.cameras import Camera, ideal_K

WIDTH, HEIGHT = 32, 18
BARS = tuple(Bar(i + 1, "bar", 0.02, ((0.1 * i, 0.0, 0.0), (0.1 * i, 0.0, 1.0))) for i in range(4))
"""Bars of every scene; they do not cross."""
_STATION = ((0.15, -2.0, 0.5), (0.15, 0.0, 0.5), 0.0)
_HEADS = ["scenes", "step", "s", "ms per scene", "files opened", "per scene"]
_Result = TypeVar("_Result")


def stage_prepared(config: ConfigSpec, indices: Sequence[int], staging: Staging) -> None:
    """Stage views of a config, and its mesh: one triangle, whose bar has the id 1."""
    staging.mesh.parent.mkdir(parents=True, exist_ok=True)
    triangle_m = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 1.0]])
    write_mesh_ply(staging.mesh, WorldMesh(triangle_m, np.array([[0, 1, 2]], np.int32), np.ones(1, np.uint16)))
    width, height = config.rig.width, config.rig.height
    mask = np.broadcast_to(np.arange(width) % 8 < 4, (height, width))
    camera = Camera(ideal_K(width, height), np.zeros(5), np.eye(4), width, height)
    rgb = np.zeros((height, width, 3), np.uint8) if config.colour is not None else None
    for index in indices:
        depth_m = np.where(mask, 0.5 + 0.001 * index, 1.5).astype(np.float32)
        eye = RenderedEye(camera, rgb=rgb, depth_m=depth_m, mask=mask, bars=mask.astype(np.uint16))
        row, record = encode_view(View(config.view_id(index), config.scene.name, eye, eye, config.rig.baseline_m))
        stage_row(staging.row(index), row, record)


def request(scenes: int, split: str) -> BuildRequest:
    """Return the request for scenes of a split with one view each."""
    return BuildRequest((CAGES,), None, WIDTH, HEIGHT, None, cages=CagesRequest(split, scenes, 1))


def placed(plan: ConfigPlan) -> ConfigPlan:
    """Return the plan of a scene with cameras and bars that are the same for all scenes."""
    protocol = plan.spec.protocol
    if not isinstance(protocol, RandomViewsSpec):
        return plan
    spec = replace(plan.spec, protocol=replace(protocol, stations=(_STATION,) * protocol.views))
    return ScenePlan(spec, plan.indices, plan.key, plan.staging, bars=BARS, record={"family": "column"})


def plan_missing(out: Path, scenes: int, split: str = "test") -> tuple[Finished, list[ConfigPlan]]:
    """Return what the folder has, and the plans of the scenes that are missing."""
    plans, finished = plan_build(request(scenes, split), out)
    missing = [plan for plan in plans if not finished.has(plan)]
    spaces_by_config(missing)  # Not compared: it is that of real scenes.
    return finished, missing


def publish_missing(out: Path, finished: Finished, missing: Sequence[ConfigPlan]) -> None:
    """Publish staged scenes beside those that the folder has."""
    check_readable(missing, finished)
    publish_plans(out, finished.folder, missing, kept_scenes(finished.configs.get(CAGES), missing))
    remove_stagings(out, missing)
    remove_build_folder(out / BUILD_FOLDER)


class _Opened:
    """Number of files opened in this process since the start."""

    def __init__(self) -> None:
        self.files = 0
        sys.addaudithook(self._count)

    def _count(self, event: str, _: tuple[Any, ...]) -> None:
        self.files += event == "open"


def _measured(scenes: int, step: str, opened: _Opened, work: Callable[[], _Result]) -> _Result:
    """Return the result of a step, and print its row."""
    files, start = opened.files, time.perf_counter()
    result = work()
    seconds, files = time.perf_counter() - start, opened.files - files
    row = (scenes, step, f"{seconds:.2f}", f"{1000 * seconds / scenes:.2f}", files, f"{files / scenes:.2f}")
    print(f"| {' | '.join(map(str, row))} |", flush=True)
    return result


def measure(out: Path, scenes: int, with_audit: bool, opened: _Opened) -> None:
    """Print the rows of a folder of some scenes, which is written to ``out``."""
    finished, missing = _measured(scenes, "plan", opened, lambda: plan_missing(out, scenes))
    plans = [placed(plan) for plan in missing]
    for plan in plans:
        stage_prepared(plan.spec, plan.indices, plan.staging)
    _measured(scenes, "publish", opened, lambda: publish_missing(out, finished, plans))
    _measured(scenes, "open", opened, lambda: open_folder(out))
    _, missing = _measured(scenes, "continue", opened, lambda: plan_missing(out, scenes))
    assert not missing
    finished, [added] = plan_missing(out, 1, "train")
    plan = placed(added)
    stage_prepared(plan.spec, plan.indices, plan.staging)
    _measured(scenes, "add", opened, lambda: publish_missing(out, finished, [plan]))
    if with_audit:
        _measured(scenes, "audit", opened, lambda: audit(out, depth_views=0))


@contextmanager
def _work_folder(path: Path | None) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rebar-scale-", dir=path) as folder:
        yield Path(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, nargs="*", default=[100, 1000, 10_000])
    parser.add_argument("--audit", type=int, nargs="*", default=[100, 300, 1000])
    parser.add_argument("--work", type=Path, help="folder for the datasets (default: that for temporary files)")
    options = parser.parse_args()
    print(machine_description())
    opened = _Opened()
    print_markdown(_HEADS, [])
    for scenes in sorted({*options.scenes, *options.audit}):
        with _work_folder(options.work) as folder:
            measure(folder / "dataset", scenes, scenes in options.audit, opened)


if __name__ == "__main__":
    main()
