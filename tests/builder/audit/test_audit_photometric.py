"""Colour against ground truth: the right picture fits the left one where depth and cameras say, and only there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rebar_depth_bench as rdb
from dataset_builder.audit.photometric import best_shift_px, photometric_verdict, view_fit
from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedView, RayMemory, audited_view
from dataset_builder.build.bars_table import read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from tests.builder.audit.audit_scene import RIGS, config, view, with_baseline, with_depth, with_K_shift

Damage = Callable[[AuditedView], AuditedView]
DAMAGES: dict[str, Damage] = {
    "depth 1 % off": lambda seen: with_depth(seen, 1.01),
    "baseline 2 mm off": lambda seen: with_baseline(seen, 0.002),
    "K half a pixel off along u": lambda seen: with_K_shift(seen, ("right",), 0, 0.5),
    "K half a pixel off along v": lambda seen: with_K_shift(seen, ("right",), 1, 0.5),
}
GRID = pytest.mark.parametrize("rig", RIGS)


def verdict(audited: AuditedConfig, views: list[AuditedView]) -> Check:
    return photometric_verdict(audited, [view_fit(audited, seen) for seen in views])


@GRID
def test_good_pictures_fit_to_a_twentieth_of_a_pixel(rig: str) -> None:
    fit = view_fit(config(), view(rig))
    assert fit.pixels > 5000
    assert max(abs(best_shift_px(cost)) for cost in fit.cost) < 0.05
    assert fit.correlation[0] > 0.95
    assert verdict(config(), [view(rig)]).passed


@GRID
@pytest.mark.parametrize("damage", DAMAGES)
def test_little_that_is_off_is_noticed_on_every_grid(rig: str, damage: str) -> None:
    assert not verdict(config(), [DAMAGES[damage](view(rig))]).passed


def test_the_shift_of_K_is_measured() -> None:
    cost = view_fit(config(), with_K_shift(view("ideal"), ("right",), 0, 0.5)).cost
    assert best_shift_px(cost[0]) == pytest.approx(-0.5, abs=0.05)


def test_a_picture_of_another_view_is_noticed() -> None:
    good = view("ideal")
    swapped = replace(good, right=replace(good.right, rgb=np.roll(good.right.rgb, 40, axis=1)))
    check = verdict(config(), [good, good, good, good, swapped])
    assert any("of one view" in problem for problem in check.problems), check


def test_pictures_without_texture_are_left_out() -> None:
    good = view("ideal")
    plain = AuditedView("x", *(replace(eye, rgb=np.full_like(eye.rgb, 99)) for eye in good.eyes.values()))
    check = verdict(config(), [plain])
    assert (check.passed, check.bound) == (True, "left out")
    assert "only 0 pixels" in check.found


@pytest.fixture(scope="module")
def tiny(tiny_root: Path) -> tuple[AuditedConfig, list[AuditedView]]:
    """Nine real views at 160 x 90 and one sample: as noisy as it gets."""
    steel = read_bars(tiny_root / "bars.parquet")["lattice"]
    audited = AuditedConfig("lattice", open_folder(tiny_root).config("lattice"), steel, BoardSpec())
    rays = RayMemory()
    return audited, [audited_view(row, rays) for row in rdb.load(tiny_root, "lattice")]


def test_tiny_noisy_pictures_give_no_false_alarm(tiny: tuple[AuditedConfig, list[AuditedView]]) -> None:
    assert verdict(*tiny).passed


@pytest.mark.parametrize("damage", DAMAGES)
def test_little_that_is_off_is_noticed_in_tiny_noisy_pictures(
    tiny: tuple[AuditedConfig, list[AuditedView]], damage: str
) -> None:
    audited, views = tiny
    assert not verdict(audited, [DAMAGES[damage](seen) for seen in views]).passed


@given(st.floats(-2.4, 2.4), st.floats(0.1, 100), st.floats(0, 1e4))
def test_the_vertex_of_a_parabola_is_found(shift: float, steepness: float, floor: float) -> None:
    cost = floor + steepness * (np.arange(-3, 4) - shift) ** 2
    assert best_shift_px(cost) == pytest.approx(shift, abs=1e-6)


def test_a_least_cost_at_the_end_is_a_shift_of_at_least_that() -> None:
    assert best_shift_px(np.array([1.0, 2, 3, 4, 5, 6, 7])) == -3.0
    assert best_shift_px(np.zeros(7)) == 0.0
