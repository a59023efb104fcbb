"""Details of generated cages that an engineer checks: what holds each bar, and what a bar holds."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.spatial import ConvexHull

from dataset_builder.scene.cages.design import Design, DesignBar, InfeasibleError
from dataset_builder.scene.cages.generate import FAMILIES, generate_cage
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.bending import resample_polyline_m
from dataset_builder.scene.shapes.capsules import Clearances
from tests.builder.scene.cages import line_length_m, point_distances_m, segments_m

TOUCH_M = 0.006
"""Largest clear distance of bars that are tied to each other in a design; links are 3 mm wider than their bars."""

SHAPES = [(family, shape) for family, kind in FAMILIES.items() for shape in kind.shapes]
IN_LINKS = [pair for pair in SHAPES if pair[0] in ("column", "beam", "pile-cage", "joint")]
DESIGNS, MAX_DRAWS = 2, 60


@cache
def designs(family: str, shape: str) -> tuple[Design, ...]:
    """Return designs of a shape whose bars do not touch."""
    rng, found = np.random.default_rng(sum((family + shape).encode())), []
    for _ in range(MAX_DRAWS):
        try:
            design = FAMILIES[family].draw(rng, shape)
        except InfeasibleError:
            continue
        bars = Clearances(
            [bar.line_m for bar in design.bars], [outer_radius_m(bar.diameter_m) for bar in design.bars]
        )
        if bars.are_all(1e-4):
            found.append(design)
        if len(found) == DESIGNS:
            return tuple(found)
    raise AssertionError(f"{family} {shape}: {len(found)} designs in {MAX_DRAWS}")


def of(design: Design, *roles: str) -> list[DesignBar]:
    return [bar for bar in design.bars if bar.role in roles]


def touched(bar: DesignBar, others: Sequence[DesignBar], within_m: float = TOUCH_M) -> Bool[ndarray, " n"]:
    """Return, for points every 5 mm along a bar, whether another bar is within this clear distance."""
    points_m = resample_polyline_m(bar.line_m, 0.005)
    is_touched = np.zeros(len(points_m), bool)
    for other in others:
        reach_m = outer_radius_m(bar.diameter_m) + outer_radius_m(other.diameter_m) + within_m
        low, high = other.line_m.min(axis=0) - reach_m, other.line_m.max(axis=0) + reach_m
        near = np.flatnonzero(((points_m >= low) & (points_m <= high)).all(axis=1))
        if other is not bar and len(near):
            pieces_m = segments_m(other.line_m)
            low, high = points_m[near].min(axis=0) - reach_m, points_m[near].max(axis=0) + reach_m
            is_near = ((pieces_m.min(axis=1) <= high) & (pieces_m.max(axis=1) >= low)).all(axis=1)
            is_touched[near] |= point_distances_m(points_m[near], pieces_m[is_near]) < reach_m
    return is_touched


def outline(link: DesignBar, axes: list[int]) -> ConvexHull:
    """Return the outline of the axis of a link in the plane of these axes."""
    return ConvexHull(link.line_m[:, axes])


def inside_m(hull: ConvexHull, points: Float64[ndarray, "n 2"]) -> Float64[ndarray, " n"]:
    """Return how far inside of an outline points are, negative outside."""
    return np.asarray(-(points @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1))


@pytest.mark.slow
@pytest.mark.parametrize(("family", "shape"), SHAPES)
def test_every_bar_is_held_along_its_length(family: str, shape: str) -> None:
    for design in designs(family, shape):
        for bar in design.bars:
            is_touched = touched(bar, design.bars)
            at = np.flatnonzero(is_touched)
            what = f"{bar.role} of {design.parameters}"
            assert len(at), f"floating {what}"
            assert np.ptp(at) * 0.005 > 0.01, f"held at one place: {what}"
            step_m = line_length_m(bar.line_m) / (len(is_touched) - 1)
            most_m = 0.75
            assert np.diff(at).max(initial=0) * step_m < most_m, f"held too seldom: {what}"
            free_m = max(at[0], len(is_touched) - 1 - at[-1]) * step_m
            anchored_m = 0.6 if family == "joint" and bar.role in ("top", "bottom") else 0.0
            assert free_m < 0.15 + 22 * bar.diameter_m + anchored_m, f"{free_m:.2f} m of a {what} are free"


@pytest.mark.parametrize(("family", "shape"), IN_LINKS)
def test_links_enclose_the_bars_and_their_hooks_point_inwards(family: str, shape: str) -> None:
    for design in designs(family, shape):
        checked = 0
        for link in of(design, "link"):
            axis = int(np.ptp(link.line_m, axis=0).argmin())
            axes, level_m = [n for n in range(3) if n != axis], link.line_m[:, axis].mean()
            hull = outline(link, axes)
            if shape not in ("round-ties", "rings"):  # The ends of rings lap.
                assert inside_m(hull, link.line_m[[0, -1]][:, axes]).min() > 2 * link.diameter_m
            roles = {0: ("top", "bottom", "side"), 2: ("main", "starter")} if family != "pile-cage" else None
            for bar in of(design, *(roles[axis] if roles else ("main",))):
                along = bar.line_m[:, axis]
                if along.min() < level_m < along.max():
                    segment = np.flatnonzero((along[:-1] - level_m) * (along[1:] - level_m) <= 0)[0]
                    share = (level_m - along[segment]) / (along[segment + 1] - along[segment])
                    place = bar.line_m[segment] + share * (bar.line_m[segment + 1] - bar.line_m[segment])
                    clear_m = inside_m(hull, place[None, axes])[0]
                    assert clear_m > outer_radius_m(bar.diameter_m) + outer_radius_m(link.diameter_m)
                    checked += 1
        assert checked > 20 or shape == "spiral"


@pytest.mark.parametrize("shape", FAMILIES["beam"].shapes)
def test_hooks_of_beam_bars_stay_within_the_outline_of_the_links(shape: str) -> None:
    for design in designs("beam", shape):
        hull = outline(of(design, "link")[0], [1, 2])
        for bar in of(design, "top", "bottom", "side", "spacer"):
            assert inside_m(hull, bar.line_m[:, 1:]).min() > outer_radius_m(bar.diameter_m)


@pytest.mark.slow
def test_chairs_stand_on_the_lower_mat_carry_the_upper_one_and_do_not_fall_over() -> None:
    for number, seed in itertools.product(range(9), (3, 4)):
        cage = generate_cage("train", number, seed, "slab")
        built = [DesignBar(bar.role, bar.diameter_m, bar.line_m) for bar in cage.bars]
        mats = {role: [bar for bar in built if bar.role == role] for role in ("lower", "upper", "chair")}
        assert len(mats["chair"]) >= 3
        for chair in mats["chair"]:
            points_m = resample_polyline_m(chair.line_m, 0.005)
            heights_m = points_m[:, 2]
            stands = points_m[touched(chair, mats["lower"], 0.002) & (heights_m < heights_m.min() + 0.012)]
            carries = points_m[touched(chair, mats["upper"], 0.002) & (heights_m > heights_m.max() - 0.012)]
            assert len(carries) or [bar["role"] for bar in cage.record["left_out"]] == ["upper"]
            middle_y = (chair.line_m[0, 1] + chair.line_m[-1, 1]) / 2
            for side in (1, -1):
                away_m = side * (stands[:, 1] - middle_y)
                assert away_m.max(initial=0.0) > 0.04, "a foot stands on no bar, or is in the plane of the chair"
            for foot in mats["lower"]:
                assert np.ptp(foot.line_m, axis=0).argmax() != 2


@pytest.mark.parametrize(
    ("family", "shape"), [("column", shape) for shape in FAMILIES["column"].shapes] + [("wall", "laps")]
)
def test_laps_have_their_length_and_touch(family: str, shape: str) -> None:
    lapped = [design for design in designs(family, shape) if of(design, "starter")]
    for design in lapped:
        uppers = of(design, "main", "upright")
        for starter in of(design, "starter"):
            is_touched = touched(starter, uppers, 0.001)
            assert is_touched.sum() * 0.005 > 40 * starter.diameter_m - 0.01
            assert starter.line_m[:, 2].min() == 0.0
        assert len(uppers) == len(of(design, "starter"))
        hull = ConvexHull(np.concatenate([bar.line_m[-1:, :2] for bar in of(design, "starter")]))
        for upper in uppers:  # Starters stand inside of the bars, which the links hold.
            assert inside_m(hull, upper.line_m[-1:, :2])[0] < -0.005
    assert lapped or family == "column"


def test_feet_of_starters_lie_on_bars_of_the_mat() -> None:
    for shape in FAMILIES["footing"].shapes:
        for design in designs("footing", shape):
            mat = of(design, "lower", "upper")
            for starter in of(design, "starter"):
                points_m = resample_polyline_m(starter.line_m, 0.005)
                is_touched = touched(starter, mat, 0.001)
                assert (is_touched & (points_m[:, 2] < points_m[:, 2].min() + 0.001)).any()
                outward = starter.line_m[0, :2] - starter.line_m[-1, :2]
                assert outward @ starter.line_m[-1, :2] > 0


@pytest.mark.parametrize("shape", FAMILIES["joint"].shapes)
def test_links_of_a_column_go_on_past_its_beam(shape: str) -> None:
    for design in designs("joint", shape):
        parameters = design.parameters
        links = [bar for bar in of(design, "link") if np.ptp(bar.line_m, axis=0).argmin() == 2]
        levels_m = np.sort([bar.line_m[:, 2].mean() for bar in links])
        low, depth_m = float(parameters["level_m"]), float(parameters["beam_side_y_m"])
        assert ((levels_m > low) & (levels_m < low + depth_m)).any()
        assert np.diff(levels_m).max() < float(parameters["spacing_m"]) + 0.15
        column = outline(links[0], [0, 1])
        for bar in of(design, "top", "bottom"):
            ends = bar.line_m[np.abs(bar.line_m[:, 0]) < float(parameters["side_x_m"]) / 2, :2]
            assert inside_m(column, ends).min(initial=1.0) > -0.05 if shape == "passing" else True
            if shape == "corner":
                assert inside_m(column, bar.line_m[[bar.line_m[:, 0].argmin()], :2])[0] > 2 * bar.diameter_m


def test_bars_of_a_second_layer_lie_on_spacers() -> None:
    checked, rng = 0, np.random.default_rng(5)
    for _ in range(60):
        try:
            design = FAMILIES["beam"].draw(rng, "straight")
        except InfeasibleError:
            continue
        spacers = of(design, "spacer")
        if design.parameters["layers"] != 2.0 or checked > 3:
            assert checked > 3 or not spacers
            continue
        checked += 1
        assert len(spacers) >= 2
        for spacer in spacers:
            touching = [bar for bar in of(design, "bottom") if touched(bar, [spacer], 0.005).any()]
            above = [bar for bar in touching if bar.line_m[0, 2] > spacer.line_m[0, 2]]
            assert len(above) == float(design.parameters["bars_x"])
            assert len(touching) > len(above)
        starts_m = np.sort([spacer.line_m[0, 0] for spacer in spacers])
        assert np.diff(starts_m).max() < 1.5
    assert checked
