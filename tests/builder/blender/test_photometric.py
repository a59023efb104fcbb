"""Photometric check on synthetic pictures: sound ones pass, and small errors of cameras and depth are reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rebar_depth_bench as rdb
from dataset_builder.audit.checks import AuditedConfig, AuditedView, Check, RayCache, view_from_row
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from tests.builder.audit.audit_scene import RIGS, config, view, with_baseline, with_depth, with_K_shift
from tests.builder.blender.photometric import best_shift_px, photometric_fit, photometric_verdict

pytestmark = pytest.mark.nightly

Damage = Callable[[AuditedView], AuditedView]
DAMAGES: dict[str, Damage] = {
    "depth 1 % off": lambda original: with_depth(original, 1.01),
    "baseline 2 mm off": lambda original: with_baseline(original, 0.002),
    "K half a pixel off along u": lambda original: with_K_shift(original, ("right",), 0, 0.5),
    "K half a pixel off along v": lambda original: with_K_shift(original, ("right",), 1, 0.5),
}
EVERY_GRID = pytest.mark.parametrize("rig", RIGS)


def verdict(audited: AuditedConfig, views: list[AuditedView]) -> Check:
    return photometric_verdict(audited, [photometric_fit(audited, audited_view) for audited_view in views])


@EVERY_GRID
def test_correct_images_fit_within_0_05_px(rig: str) -> None:
    fit = photometric_fit(config(), view(rig))
    assert fit.pixels > 5000
    assert max(abs(best_shift_px(cost)) for cost in fit.cost) < 0.05
    assert fit.correlation[0] > 0.95
    assert verdict(config(), [view(rig)]).passed


@EVERY_GRID
@pytest.mark.parametrize("damage", DAMAGES)
def test_small_errors_are_reported_on_every_grid(rig: str, damage: str) -> None:
    assert not verdict(config(), [DAMAGES[damage](view(rig))]).passed


def test_shift_of_K_is_measured() -> None:
    cost = photometric_fit(config(), with_K_shift(view("ideal"), ("right",), 0, 0.5)).cost
    assert best_shift_px(cost[0]) == pytest.approx(-0.5, abs=0.05)


def test_image_of_another_view_is_reported() -> None:
    correct = view("ideal")
    assert correct.right.rgb is not None
    swapped = replace(correct, right=replace(correct.right, rgb=np.roll(correct.right.rgb, 40, axis=1)))
    check = verdict(config(), [correct, correct, correct, correct, swapped])
    assert any("of one view" in problem for problem in check.problems), check


def test_images_without_texture_are_skipped() -> None:
    good = view("ideal")
    grey = np.full((*good.left.mask.shape, 3), 99, np.uint8)
    plain = AuditedView("x", *(replace(eye, rgb=grey) for eye in good.eyes.values()))
    check = verdict(config(), [plain])
    assert (check.passed, check.skipped) == (False, True)
    assert "only 0 textured pixels" in check.measured


@pytest.fixture(scope="module")
def tiny(tiny_root: Path) -> tuple[AuditedConfig, list[AuditedView]]:
    """Return the config and its nine rendered views of 160 x 90 pixels with one sample per pixel (very noisy)."""
    steel = read_bars(tiny_root / "bars.parquet")["lattice"]
    audited = AuditedConfig((), steel, BoardSpec())
    rays = RayCache()
    return audited, [view_from_row(row, rays) for row in rdb.load(tiny_root, "lattice")]


def test_small_noisy_images_pass(tiny: tuple[AuditedConfig, list[AuditedView]]) -> None:
    assert verdict(*tiny).passed


@pytest.mark.parametrize("damage", DAMAGES)
def test_small_errors_are_reported_in_small_noisy_images(
    tiny: tuple[AuditedConfig, list[AuditedView]], damage: str
) -> None:
    audited, views = tiny
    assert not verdict(audited, [DAMAGES[damage](audited_view) for audited_view in views]).passed


@given(st.floats(-2.4, 2.4), st.floats(0.1, 100), st.floats(0, 1e4))
def test_best_shift_is_vertex_of_parabola(shift: float, steepness: float, floor: float) -> None:
    cost = floor + steepness * (np.arange(-3, 4) - shift) ** 2
    assert best_shift_px(cost) == pytest.approx(shift, abs=1e-6)


def test_minimum_at_end_of_range_is_returned() -> None:
    assert best_shift_px(np.array([1.0, 2, 3, 4, 5, 6, 7])) == -3.0
    assert best_shift_px(np.zeros(7)) == 0.0
