"""Audit of a config of generated scenes: bars against the generator, their gaps, cameras, and merged checks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy import ndarray

from dataset_builder.audit.geometry import polyline_distance_m
from dataset_builder.audit.report import Check
from dataset_builder.config.camera_placement import RANDOM_RULES
from dataset_builder.config.manifest_specs import cage_spec, trajectory_spec
from dataset_builder.config.specs import RandomViewsSpec
from dataset_builder.scene.assemblies import assembly_bars
from dataset_builder.scene.cages.generate import VERSION
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import Clearances
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.dataset_config import DatasetConfig

_AXIS_TOLERANCE_M = 1e-9
"""Largest difference of a coordinate from that of the generator, which differs by this much between machines."""


def cage_checks(scene: DatasetConfig, bars: Sequence[Bar]) -> Iterator[Check]:
    """Yield the checks of one generated scene that need no images; ``bars`` are those of ``bars.parquet``."""
    yield _bars_check(scene, bars)
    yield _gap_check(scene, bars)
    yield _steel_check(scene)
    yield _clearance_check(scene, bars)


def merged_checks(config: str, checks: Sequence[Check]) -> Iterator[Check]:
    """Yield one check for all checks of the same name, which begins with the label of a scene and a colon.

    A check that is skipped in all scenes is skipped for the reason of the first one.
    """
    by_name: dict[str, list[Check]] = {}
    for check in checks:
        by_name.setdefault(check.name.partition(": ")[2], []).append(check)
    for name, group in by_name.items():
        made = [check for check in group if not check.skipped]
        if not made:
            yield Check.skip(f"{config}: {name}", group[0].measured)
            continue
        problems = (f"{check.name.partition(': ')[0]}: {problem}" for check in made for problem in check.problems)
        measured = f"{sum(check.passed for check in made)} of {len(made)} scenes, such as: {made[0].measured}"
        yield Check(f"{config}: {name}", measured, made[0].bound, tuple(problems))


def _bars_check(scene: DatasetConfig, bars: Sequence[Bar]) -> Check:
    """Return the check of the bars against those that the generator makes from the parameters in the manifest."""
    name = f"{scene.label}: bars and their designs"
    spec = cage_spec(scene)
    if spec.version != VERSION:
        return Check.skip(name, f"made by version {spec.version} of the generator, this is {VERSION}")
    expected = assembly_bars(spec)
    if [_identity(bar) for bar in bars] != [_identity(bar) for bar in expected]:
        problem = f"{len(bars)} bars differ from the {len(expected)} of the generator in number, role or diameter"
        return Check(name, "other bars", "those of the generator", (problem,))
    pairs = [pair for a, b in zip(bars, expected, strict=True) for pair in _lines(a, b)]
    off_m = max(float(np.abs(found - wanted).max(initial=0.0)) for found, wanted in pairs)
    problems = () if off_m <= _AXIS_TOLERANCE_M else (f"axes are {off_m:.2e} m off those of the generator",)
    return Check(name, f"{len(bars)} bars: at most {off_m:.1e} m off", f"{_AXIS_TOLERANCE_M:g} m", problems)


def _identity(bar: Bar) -> tuple[int, str, float, int, int]:
    return bar.bar_id, bar.role, bar.diameter_m, len(bar.axis_m), len(bar.nominal_axis_m)


def _lines(a: Bar, b: Bar) -> list[tuple[ndarray, ndarray]]:
    lines = (a.axis_m, b.axis_m), (a.nominal_axis_m, b.nominal_axis_m)
    return [(np.array(found), np.array(wanted)) for found, wanted in lines]


def _gap_check(scene: DatasetConfig, bars: Sequence[Bar]) -> Check:
    """Return the check that no two bars touch, ribs included."""
    lines, radii = [np.array(bar.axis_m) for bar in bars], [outer_radius_m(bar.diameter_m) for bar in bars]
    clearances = Clearances(lines, radii)
    least_m = min(
        clearances.least_m(line, radius, i) for i, (line, radius) in enumerate(zip(lines, radii, strict=True))
    )
    problems = () if least_m > 0 else (f"two bars penetrate each other by {-least_m * 1000:.2f} mm",)
    return Check(f"{scene.label}: gaps of bars", f"{least_m * 1000:.2f} mm or more", "above 0 mm", problems)


def _steel_check(scene: DatasetConfig) -> Check:
    """Return the check that every view shows steel in its left image, as the manifest counts it."""
    without = [view.view_id for view in scene.views if not view.steel_px]
    least = min((view.steel_px or 0) for view in scene.views) / (scene.rig.width * scene.rig.height)
    problems = tuple(f"{view_id} shows no steel" for view_id in without)
    return Check(f"{scene.label}: steel in every view", f"{least:.1%} of the frame or more", "above 0", problems)


def _clearance_check(scene: DatasetConfig, bars: Sequence[Bar]) -> Check:
    """Return the check that the left cameras of random views are clear of all bars."""
    name, views = f"{scene.label}: cameras clear of steel", trajectory_spec(scene)
    if not isinstance(views, RandomViewsSpec):
        return Check.skip(name, "no random views")
    centres_m = np.array([centre_m for centre_m, *_ in views.stations])
    nearest_m = min(
        float((polyline_distance_m(centres_m, np.array(bar.axis_m)) - outer_radius_m(bar.diameter_m)).min())
        for bar in bars
    )
    bound_m = RANDOM_RULES.clearance_m(views.distances_m[0])
    problems = () if nearest_m >= bound_m else (f"a camera is {nearest_m:.3f} m from steel",)
    return Check(name, f"{nearest_m:.2f} m or more", f"{bound_m:g} m", problems)
