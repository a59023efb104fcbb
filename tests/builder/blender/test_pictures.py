"""Rendered colour against the ground truth: right pictures warped to the left, and detected ArUco markers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from dataset_builder.audit.checks import AuditedConfig, AuditedView, Check, RayCache, view_from_row
from dataset_builder.catalog.named_configs import CONFIGS
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from tests.builder.audit.audit_scene import with_K_shift
from tests.builder.blender.markers import detect_view_markers, marker_verdict
from tests.builder.blender.photometric import photometric_fit, photometric_verdict
from tests.building import RunBuild

Pictures = tuple[str, AuditedConfig, Sequence[AuditedView]]
GRID = ("--width", "640", "--height", "360")


def photometric_check(config: AuditedConfig, views: Sequence[AuditedView]) -> Check:
    return photometric_verdict(config, [photometric_fit(config, view) for view in views])


def marker_check(config: AuditedConfig, views: Sequence[AuditedView]) -> Check:
    return marker_verdict(config, [detect_view_markers(config, view) for view in views])


CHECKS = (photometric_check, marker_check)


def pictures(root: Path) -> Iterator[Pictures]:
    """Yield the label and the views of each scene of each config of a folder."""
    steel = read_bars(root / BARS_FILE)
    for config in open_folder(root).config_by_name.values():
        for scene in config.by_scene():
            spec, rays = scene.scene, RayCache()
            audited = AuditedConfig(spec.appearance.variants, steel[spec.name], spec.board)
            yield scene.label, audited, [view_from_row(row, rays) for row in iterate_rows(scene, COLUMNS)]


@pytest.fixture(scope="module")
def lattice(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Pictures:
    """Return two small views of the lattice; in one of them most markers are wide enough to be checked."""
    root = tmp_path_factory.mktemp("pictures") / "dataset"
    process = run_build("--out", root, "--config", "lattice", "--views", "2", *GRID, "--samples", "4")
    assert process.returncode == 0, process.stderr
    (only,) = pictures(root)
    return only


@pytest.mark.parametrize("check", CHECKS)
def test_lattice_is_where_its_ground_truth_says(lattice: Pictures, check: Callable[..., Check]) -> None:
    _, config, views = lattice
    assert check(config, views).passed
    assert check(config, [with_K_shift(view, ("right",), 0, 0.5) for view in views]).problems


@pytest.mark.nightly
def test_every_config_is_where_its_ground_truth_says(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"
    for options in (
        ("--views", "3"),
        ("--config", "lattice", "--variant", "wet", "formwork", "--views", "2"),
        ("--config", "lattice", "--variant", "sensor", "sunset", "--views", "2"),
        ("--scene", "examples/beam.toml", "--views", "2"),
        ("--config", "cages", "--split", "validation", "--scenes", "4", "--views-per-scene", "2"),
    ):
        process = run_build("--out", root, *options, *GRID, "--samples", "8")
        assert process.returncode == 0, process.stderr
    made = {check.__name__: set[str]() for check in CHECKS}
    for label, config, views in pictures(root):
        for check in CHECKS:
            verdict = check(config, views)
            assert not verdict.problems, verdict
            if verdict.passed:
                made[check.__name__].add(label)
    assert made["photometric_check"] >= set(CONFIGS)
    assert made["marker_check"] >= {name for name in CONFIGS if name not in ("pile", "pier")}
