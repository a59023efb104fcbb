"""Designs of generated cages against the clauses of the codes, read from the geometry of their bars.

Clauses without a standard are those of EN 1992-1-1:2004 with its recommended values, concrete C30/37, steel B500
and aggregate of 20 mm. Nothing of the builder's rules is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import Design, DesignBar, InfeasibleError
from dataset_builder.scene.cages.generate import FAMILIES, MAX_BARS
from tests.builder.scene.cages import (
    EPSILON_M,
    apart_m,
    area_m2,
    check_bends,
    check_clear,
    check_cover,
    check_held,
    check_hooks,
    check_lap,
    check_spacing,
    crossing,
    levels_m,
    of,
    places,
    turned,
)

DESIGNS = 200
LEAST_TENSION = 0.26 * 0.3 * 30 ** (2 / 3) / 500
"""0.26 fctm / fyk (9.2.1.1 (1)), more than 0.0013."""


def designs(family: str) -> Iterator[Design]:
    """Yield designs of a family, of its shapes in turn."""
    rng, shapes, found = np.random.default_rng(58), FAMILIES[family].shapes, 0
    while found < DESIGNS:
        with suppress(InfeasibleError, ValueError):
            design = FAMILIES[family].draw(rng, shapes[found % len(shapes)])
            if len(design.bars) <= MAX_BARS:
                found += 1
                yield design


def check_column(
    design: Design, bars: Sequence[DesignBar], sides: tuple[float, float], dense: Sequence[tuple[float, float]]
) -> None:
    """Check the bars of a column or its starters, z up; links are closer together within the heights ``dense``."""
    mains, links, ties = of(bars, "main", "starter"), of(bars, "link", "spiral"), of(bars, "tie")
    is_round, size_m = "diameter_m" in design.parameters, mains[0].diameter_m
    half = np.array(sides) / 2
    high = max(bar.line_m[:, 2].max() for bar in mains) - 0.001
    tops = crossing(mains, high)
    concrete_m2 = np.pi / 4 * sides[0] ** 2 if is_round else sides[0] * sides[1]
    assert 0.002 <= area_m2(tops) / concrete_m2 <= 0.04  # 9.5.2
    assert size_m >= 0.008
    bundles = apart_m(tops, high).min(axis=1) < 0.3 * size_m
    covered = [
        DesignBar("bundle" if is_in else "", size_m, bar.line_m) for bar, is_in in zip(tops, bundles, strict=True)
    ]

    def depth_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        if is_round:
            return np.asarray(half[0] - np.linalg.norm(line_m[:, :2], axis=1))
        return np.asarray((half - np.abs(line_m[:, :2])).min(axis=1))

    check_cover([*covered, *links, *ties], depth_m)
    check_clear(tops, high)
    assert links[0].diameter_m >= max(0.006, size_m / 4)  # 9.5.3 (1)
    most_m = min(20 * size_m, *sides, 0.400)  # 9.5.3 (3)
    if links[0].role == "spiral":
        line_m = links[0].line_m
        angle = np.unwrap(np.arctan2(line_m[:, 1], line_m[:, 0]))
        turns = np.arange(angle[0], angle[-1], 2 * np.pi)
        links = [
            DesignBar("link", links[0].diameter_m, np.tile([0.0, 0.0, z], (2, 1)))
            for z in np.interp(turns, angle, line_m[:, 2])
        ]
    elif not is_round:
        check_hooks(links, 270)
        check_hooks(ties, 0)
        if of(mains, "main"):  # Starters are compressed once the bars of the column are there.
            check_held(tops, ties, high)
    levels = levels_m(links)
    check_spacing(levels, most_m)
    for low, top in dense:  # 9.5.3 (4)
        check_spacing(levels, 0.6 * most_m, low, top)
    for starter in of(mains, "starter"):
        others = of(mains, "main")
        if not others:
            continue
        lap_at = starter.line_m[:, 2].max() - 0.001
        near = apart_m([starter, *crossing(others, lap_at)], lap_at)[0, 1:]
        bar = crossing(others, lap_at)[int(near.argmin())]
        assert near.min() < max(0.050, 4 * size_m)
        check_lap(starter, bar, links, links=True)
        if size_m > 0.014:
            check_spacing(levels, 0.6 * most_m, bar.line_m[:, 2].min(), starter.line_m[:, 2].max())
    if of(mains, "starter") and of(mains, "main"):
        lap_at = 0.1
        check_clear(crossing(mains, lap_at), lap_at)


def column(design: Design) -> None:
    parameters = design.parameters
    names = ("diameter_m", "diameter_m") if "diameter_m" in parameters else ("side_x_m", "side_y_m")
    sides = (float(parameters[names[0]]), float(parameters[names[1]]))
    height_m = max(bar.line_m[:, 2].max() for bar in design.bars)
    check_column(design, design.bars, sides, [(0, max(sides)), (height_m - max(sides), height_m)])


def check_beam(bars: Sequence[DesignBar], size_m: tuple[float, float], low_m: float, *, hogging: bool) -> None:
    """Check the bars of a beam along z, whose concrete is ``size_m`` wide and deep, from y = ``low_m`` up."""
    (width_m, depth_m), links = size_m, of(bars, "link")
    middle = float(np.median(levels_m(links)))
    along = crossing(of(bars, "bottom", "top", "side"), middle)

    def cover_depth_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        faces = [
            line_m[:, 0] + width_m / 2,
            width_m / 2 - line_m[:, 0],
            line_m[:, 1] - low_m,
            low_m + depth_m - line_m[:, 1],
        ]
        return np.asarray(np.min(faces, axis=0))

    check_cover([*along, *links], cover_depth_m)
    check_clear(along, middle)
    tension, other = (of(along, role) for role in (("top", "bottom") if hogging else ("bottom", "top")))
    heights = places(tension, middle)[:, 1] - low_m
    effective_m = float((heights if hogging else depth_m - heights).mean())
    share = area_m2(tension) / (width_m * effective_m)
    assert share >= LEAST_TENSION  # 9.2.1.1 (1)
    assert area_m2(tension) <= 0.04 * width_m * depth_m  # 9.2.1.1 (3)
    assert area_m2(other) >= (0.25 if hogging else 0.15) * area_m2(tension)  # 9.2.1.4 (1), 9.2.1.2 (1)
    check_hooks(links, 270)
    assert links[0].diameter_m >= 0.006
    legs_m = np.ptp(links[0].line_m[:, 0])
    assert legs_m <= min(0.75 * effective_m, 0.600) + EPSILON_M  # 9.2.2 (8)
    most_m = min(0.75 * effective_m, 2 * area_m2(links[:1]) / (0.08 * 30**0.5 / 500 * width_m))  # 9.2.2 (5), (6)
    check_spacing(levels_m(links), most_m)


def beam(design: Design) -> None:
    parameters = design.parameters
    size_m = (float(parameters["side_x_m"]), float(parameters["side_y_m"]))
    check_beam(turned(design.bars, (1, 2, 0)), size_m, 0.0, hogging=False)


def joint(design: Design) -> None:
    parameters = design.parameters
    side_m, low_m = float(parameters["side_x_m"]), float(parameters["level_m"])
    size_m = (float(parameters["beam_side_x_m"]), float(parameters["beam_side_y_m"]))
    is_beam = [np.ptp(bar.line_m[:, 0]) < 0.02 for bar in design.bars]
    links = [bar for bar, is_one in zip(design.bars, is_beam, strict=True) if is_one and bar.role == "link"]
    column_bars = [bar for bar in of(design.bars, "main", "tie", "link") if not any(bar is link for link in links)]
    height_m, top_m = float(parameters["length_m"]), low_m + size_m[1]
    dense = [(0, side_m), (low_m - side_m, low_m), (top_m, top_m + side_m), (height_m - side_m, height_m)]
    check_column(design, column_bars, (side_m, side_m), dense)
    for sign in (1, -1):
        arm = [link for link in links if sign * link.line_m[:, 0].mean() > 0]
        if arm:
            bars = turned([*of(design.bars, "top", "bottom", "side"), *arm], (1, 2, 0))
            check_beam(bars, size_m, low_m, hogging=True)


def spacing_m(bars: Sequence[DesignBar], axis: int) -> tuple[float, float]:
    """Return the least and largest distance of straight parallel bars along an axis."""
    steps = np.diff(np.sort([bar.line_m[0, axis] for bar in bars]))
    return float(steps.min()), float(steps.max())


def wall(design: Design) -> None:
    parameters, bars = design.parameters, design.bars
    thickness_m = float(parameters["thickness_m"])
    check_cover(bars, lambda line_m: thickness_m / 2 - np.abs(line_m[:, 1]))
    shares = []
    for roles, axis, most_m in ((("upright",), 0, min(3 * thickness_m, 0.4)), (("level",), 2, 0.4)):
        for sign in (1, -1):  # 9.6.2 (2): half of the steel at each face
            face = [bar for bar in of(bars, *roles) if sign * bar.line_m[0, 1] > 0]
            least_m, largest_m = spacing_m(face, axis)
            assert largest_m <= most_m + EPSILON_M  # 9.6.2 (3), 9.6.3 (2)
            assert least_m - face[0].diameter_m > max(face[0].diameter_m, 0.025)
            shares.append(
                (area_m2(face[:1]) / (largest_m * thickness_m), area_m2(face[:1]) / (least_m * thickness_m))
            )
    upright = shares[0][1] + shares[1][1]
    assert shares[0][0] + shares[1][0] >= 0.002  # 9.6.2 (1)
    assert upright <= 0.02  # More would need links as in columns, 9.6.4 (1).
    assert shares[2][0] + shares[3][0] >= max(0.25 * upright, 0.001) - 1e-9  # 9.6.3 (1)
    check_hooks(of(bars, "tie"), 0)
    starters = of(bars, "starter")
    if starters:
        lap_at = starters[0].line_m[:, 2].max() - 0.001
        both = crossing(of(bars, "starter", "upright"), lap_at)
        check_clear(both, lap_at)
        check_lap(
            starters[0],
            crossing(of(bars, "upright"), lap_at)[0],
            of(bars, "level")[: len(of(bars, "level")) // 2],
            links=False,
        )
    for u_bar in of(bars, "u-bar"):
        leg_m = np.linalg.norm(np.diff(u_bar.line_m, axis=0), axis=1)[[0, -1]].min()
        assert leg_m >= max(40 * u_bar.diameter_m, 0.200) - EPSILON_M
        assert (
            float(parameters["length_m"]) / 2 - np.abs(u_bar.line_m[:, 0]).max() - u_bar.diameter_m / 2
            >= u_bar.diameter_m + 0.01 - EPSILON_M
        )


def check_mat(bars: Sequence[DesignBar], axis: int, depth_m: float) -> None:
    """Check parallel bars of a layer of a slab or footing whose concrete is ``depth_m`` deep (9.3.1.1)."""
    least_m, largest_m = spacing_m(bars, axis)
    size_m = bars[0].diameter_m
    assert size_m >= 0.008
    assert largest_m <= min(3 * depth_m, 0.400)
    assert least_m - size_m > max(size_m, 0.025)
    heights = np.median([bar.line_m[:, 2].min() for bar in bars])
    effective_m = max(heights, depth_m - heights)
    assert LEAST_TENSION <= area_m2(bars[:1]) / (largest_m * effective_m) <= 0.04


def slab(design: Design) -> None:
    depth_m = float(design.parameters["thickness_m"])
    check_cover(design.bars, lambda line_m: np.minimum(line_m[:, 2], depth_m - line_m[:, 2]))
    for role in ("lower", "upper"):
        for axis in (0, 1):
            layer = [bar for bar in of(design.bars, role) if np.ptp(bar.line_m[:, axis]) < 1e-9]
            check_mat(layer, axis, depth_m)


def footing(design: Design) -> None:
    parameters, bars = design.parameters, design.bars
    depth_m, column_m = float(parameters["depth_m"]), float(parameters["column_m"])
    sides = np.array([float(parameters["side_x_m"]), float(parameters["side_y_m"])])
    mat = of(bars, "lower", "upper", "edge")

    def cover_depth_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        return np.asarray(np.minimum(line_m[:, 2], (sides / 2 - np.abs(line_m[:, :2])).min(axis=1)))

    check_cover([*mat, *of(bars, "starter")], cover_depth_m, 0.040)  # 4.4.1.3 (4)
    assert max(bar.line_m[:, 2].max() for bar in mat) <= depth_m - 0.040 + EPSILON_M
    check_mat(of(bars, "lower"), 1, depth_m)
    check_mat(of(bars, "upper"), 0, depth_m)
    starters = of(bars, "starter")
    for bar in [*of(bars, "lower", "upper"), *starters]:
        ends_m = np.linalg.norm(np.diff(bar.line_m, axis=0), axis=1)[[0, -1]]
        assert ends_m.min() > max(10 * bar.diameter_m, 0.070) - EPSILON_M  # 8.5 (1)
    assert min(bar.line_m[:, 2].max() for bar in starters) - depth_m >= 40 * starters[0].diameter_m
    upright = [
        DesignBar(bar.role, bar.diameter_m, np.array([[*bar.line_m[-1, :2], 0], bar.line_m[-1]]))
        for bar in starters
    ]
    above = [link for link in of(bars, "link") if link.line_m[:, 2].min() > depth_m]
    check_column(design, [*upright, *above], (column_m, column_m), [(depth_m, np.inf)])
    assert len(of(bars, "link")) - len(above) >= 2


def pile_cage(design: Design) -> None:
    parameters, bars = design.parameters, list(design.bars)
    if parameters["lies"]:
        bars = turned(bars, (1, 2, 0))
    diameter_m, mains = float(parameters["diameter_m"]), of(bars, "main")
    size_m, links = mains[0].diameter_m, of(bars, "link", "spiral")
    least_m = 0.060 if diameter_m > 0.6 else 0.050  # EN 1536
    check_cover(bars, lambda line_m: diameter_m / 2 - np.linalg.norm(line_m[:, :2], axis=1), least_m)
    middle = float(np.mean(mains[0].line_m[:, 2]))
    radius_m = np.linalg.norm(places(mains, middle), axis=1).mean()
    assert apart_m(mains, middle).min() >= 0.100 - EPSILON_M  # EN 1536
    assert 2 * np.pi * radius_m / len(mains) - size_m <= 0.200 + EPSILON_M  # 9.8.5 (3), and the next two
    assert len(mains) >= 6
    assert size_m >= 0.016
    concrete_m2 = np.pi / 4 * diameter_m**2
    steel_m2 = 0.005 * concrete_m2 if concrete_m2 <= 0.5 else max(0.0025, 0.0025 * concrete_m2)  # Table 9.6N
    assert steel_m2 <= area_m2(mains) <= 0.04 * concrete_m2
    assert links[0].diameter_m >= max(0.006, size_m / 4)
    if links[0].role == "link":
        check_spacing(levels_m(links), min(20 * size_m, diameter_m, 0.400))


CHECKS: dict[str, Callable[[Design], None]] = {
    "column": column,
    "beam": beam,
    "wall": wall,
    "slab": slab,
    "footing": footing,
    "pile-cage": pile_cage,
    "joint": joint,
}


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_designs_are_within_the_codes(family: str) -> None:
    for design in designs(family):
        try:
            check_bends(design.bars)
            CHECKS[family](design)
        except AssertionError as error:
            raise AssertionError(f"{design.parameters}: {error}") from error
