"""Generated cages: reproducible, clear of each other, within the ranges and tolerances, and tied together."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages import generate as generate_module
from dataset_builder.scene.cages.as_built import (
    BOW_TOLERANCE,
    END_TOLERANCE_M,
    MIN_CLEAR_M,
    PLACE_TOLERANCE_M,
    SPACING_TOLERANCE_M,
    build_as,
)
from dataset_builder.scene.cages.design import Design, DesignBar, InfeasibleError, straight
from dataset_builder.scene.cages.generate import (
    FAMILIES,
    MAX_BARS,
    Family,
    GeneratedCage,
    drawn_family,
    generate_cage,
)
from dataset_builder.scene.cages.rules import DIAMETERS_M
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import NEAR_M, Clearances
from dataset_builder.specs.config_specs import GeneratedCageSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.names import SPLITS
from tests.builder.scene.test_pile import segment_distances_m

Line = Float64[ndarray, "n 3"]
TIED_WITHIN_M = 0.012
"""Largest clear distance between a bar and the nearest other one that tie wire spans."""


@pytest.fixture(scope="module")
def cages() -> Mapping[str, list[GeneratedCage]]:
    return {family: [generate_cage("train", number, 3, family) for number in range(2)] for family in FAMILIES}


def clearances_m(cage: GeneratedCage) -> Float64[ndarray, "n n"]:
    """Return the clear distance of all pairs of bars, by comparing all of their segments."""
    n = len(cage.bars)
    clear_m = np.full((n, n), np.inf)
    for i, a in enumerate(cage.bars):
        for j, b in enumerate(cage.bars[:i]):
            gap = np.maximum(a.line_m.min(0) - b.line_m.max(0), b.line_m.min(0) - a.line_m.max(0)).max()
            if gap < 0.1:  # Farther boxes cannot hold the nearest bars.
                distance_m = segment_distances_m(a.line_m, b.line_m).min()
                clear_m[i, j] = clear_m[j, i] = (
                    distance_m - outer_radius_m(a.diameter_m) - outer_radius_m(b.diameter_m)
                )
    return clear_m


def cage_state(split: str, number: int, seed: int) -> tuple[int, int]:
    """Return the state and the increment of the random generator with which a cage starts."""
    state = generate_module._cage_rng(split, number, seed).bit_generator.state["state"]
    return state["state"], state["inc"]


@pytest.mark.parametrize("family", FAMILIES)
def test_same_numbers_give_the_same_cage(cages: Mapping[str, list[GeneratedCage]], family: str) -> None:
    again = generate_cage("train", 1, 3, family)
    expected = cages[family][1]
    assert json.dumps(again.record) == json.dumps(expected.record)
    assert [bar.line_m.tobytes() for bar in again.bars] == [bar.line_m.tobytes() for bar in expected.bars]
    others = [cages[family][0], generate_cage("test", 1, 3, family), generate_cage("train", 1, 4, family)]
    assert all(other.record["parameters"] != expected.record["parameters"] for other in others)


@pytest.mark.parametrize("family", FAMILIES)
def test_bars_are_clear_of_each_other_and_tied(cages: Mapping[str, list[GeneratedCage]], family: str) -> None:
    for cage in cages[family]:
        clear_m = clearances_m(cage)
        assert clear_m.min() >= MIN_CLEAR_M
        loose = [cage.bars[index].role for index in np.flatnonzero(clear_m.min(axis=1) > TIED_WITHIN_M)]
        assert not loose, f"{cage.record['parameters']}: {loose}"


@pytest.mark.parametrize("family", FAMILIES)
def test_cages_stand_on_the_ground_and_in_the_middle(
    cages: Mapping[str, list[GeneratedCage]], family: str
) -> None:
    for cage in cages[family]:
        assembly = make_assembly(GeneratedCageSpec("train", cages[family].index(cage), 3, family))
        low, high = assembly.vertices_m.min(axis=0), assembly.vertices_m.max(axis=0)
        assert 0 < low[2] < 0.08
        assert np.abs(low + high)[:2].max() < 0.1
        assert (high - low).max() < 5
        assert [bar.role for bar in assembly.bars] == [bar.role for bar in cage.bars]


@pytest.mark.parametrize("family", FAMILIES)
def test_deviations_are_within_the_tolerances(cages: Mapping[str, list[GeneratedCage]], family: str) -> None:
    for cage in cages[family]:
        without_design = [bar for bar in cage.bars if bar.nominal_m is None]
        assert len(without_design) == cage.record["doubled"]
        most_m = 0.0
        for bar in cage.bars:
            if bar.nominal_m is None:
                continue
            length_m = float(np.linalg.norm(np.diff(bar.nominal_m, axis=0), axis=1).sum())
            off_m = float(np.linalg.norm(bar.line_m[[0, -1]] - bar.nominal_m[[0, -1]], axis=1).max())
            assert off_m <= SPACING_TOLERANCE_M + PLACE_TOLERANCE_M + END_TOLERANCE_M
            if len(bar.nominal_m) == 2:
                chord = bar.line_m[-1] - bar.line_m[0]
                from_chord = np.cross(bar.line_m - bar.line_m[0], chord / np.linalg.norm(chord))
                assert np.linalg.norm(from_chord, axis=1).max() <= BOW_TOLERANCE * length_m + 1e-9
            built_m = float(np.linalg.norm(np.diff(bar.line_m, axis=0), axis=1).sum())
            assert built_m == pytest.approx(length_m, rel=2e-4)
            most_m = max(most_m, off_m)
        assert most_m > 0.003, "nothing deviates"


@pytest.mark.parametrize("family", FAMILIES)
def test_diameters_and_records_are_those_of_the_rules(
    cages: Mapping[str, list[GeneratedCage]], family: str
) -> None:
    for cage in cages[family]:
        assert {bar.diameter_m for bar in cage.bars} <= set(DIAMETERS_M)
        assert cage.family == cage.record["family"] == family
        assert 7 <= len(cage.bars) + len(cage.record["left_out"]) - cage.record["doubled"] <= MAX_BARS
        assert json.loads(json.dumps(cage.record)) == cage.record
        for missing in cage.record["left_out"]:
            assert len(missing["nominal_axis"]) >= 2


@pytest.mark.parametrize("split", SPLITS)
def test_family_is_known_without_the_cage(split: str) -> None:
    for number in range(2):
        assert generate_cage(split, number, 5).family == drawn_family(split, number, 5)
    drawn = [drawn_family(split, number) for number in range(350)]
    assert min(drawn.count(family) for family in FAMILIES) >= 25
    assert set(drawn) == set(FAMILIES)


def test_no_two_cages_share_their_random_numbers() -> None:
    """Seeds past 32 bits are those that NumPy's seed sequence of several integers would confuse."""
    seeds, numbers = [0, 1, 7, 2**32, 1 + 2**32, 2**40, 2**64 - 1], [*range(400), 2**32, 1 + 2**32]
    states = [cage_state(split, number, seed) for split, number, seed in itertools.product(SPLITS, numbers, seeds)]
    assert len(states) == len(set(states)) == len(SPLITS) * len(numbers) * len(seeds)


@pytest.mark.parametrize(("split", "family"), [("val", None), ("train", "bridge")])
def test_unknown_names_are_refused(split: str, family: str | None) -> None:
    with pytest.raises(InputError, match="expected one of"):
        generate_cage(split, 0, family=family)
    with pytest.raises(InputError, match="expected 0 or more"):
        drawn_family("train", -1)


def test_cage_that_cannot_be_made_is_refused_with_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    def impossible(_: np.random.Generator, shape: str) -> Design:
        raise InfeasibleError(f"no bar fits {shape}")

    monkeypatch.setattr(generate_module, "FAMILIES", {"wall": Family(impossible, ("plain",))})
    with pytest.raises(InputError, match=r"no bar fits plain \(200\)"):
        generate_cage("train", 0)


def test_designs_of_too_many_bars_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate_module, "MAX_BARS", 40)
    cages = [generate_cage("train", number, 0, "slab") for number in range(3)]
    assert any(cage.record["designs_refused"].get("too many bars") for cage in cages)
    assert max(len(cage.bars) - cage.record["doubled"] for cage in cages) <= 40


def test_design_whose_bars_touch_is_refused() -> None:
    lines = [straight((0, 0, 0), (1, 0, 0)), straight((0.5, -0.5, 0.0105), (0.5, 0.5, 0.0105))]
    design = Design("x", tuple(DesignBar("bar", 0.010, line) for line in lines), {}, 0.01)
    with pytest.raises(InfeasibleError, match="touch"):
        build_as(design, np.random.default_rng(0))


def test_other_version_of_the_generator_is_refused() -> None:
    assert GeneratedCageSpec("train", 0).version == generate_module.VERSION
    with pytest.raises(InputError, match="version 0"):
        make_assembly(GeneratedCageSpec("train", 0, version=0))


COORDINATES_M = st.integers(-100, 100).map(lambda mm: mm / 1000)
LINES: st.SearchStrategy[Line] = st.lists(
    st.tuples(*[COORDINATES_M] * 3), min_size=4, max_size=4, unique=True
).map(np.array)


@given(st.lists(LINES, min_size=2, max_size=5), st.integers(0, 4))
@settings(max_examples=150)
def test_clearance_is_that_of_all_segments(lines: list[Line], index: int) -> None:
    index %= len(lines)
    radii = [0.002 + 0.001 * number for number in range(len(lines))]
    expected = min(
        segment_distances_m(lines[index], line).min() - radii[index] - radii[other]
        for other, line in enumerate(lines)
        if other != index
    )
    found = Clearances(lines, radii).least_m(lines[index], radii[index], index)
    if expected < NEAR_M:
        assert found == pytest.approx(expected, abs=1e-9)
    else:
        assert found >= NEAR_M - 1e-9


@example([straight((0, 0, 0), (1, 0, 0)), straight((0, 0.09, 0), (1, 0.09, 0))], np.array([0, 0.06, 0]))
@given(
    st.lists(LINES, min_size=2, max_size=5),
    st.tuples(*[st.integers(-30, 30).map(lambda mm: mm / 1000)] * 3).map(np.array),
)
@settings(max_examples=100)
def test_neighbours_are_enough_for_lines_within_the_margin(
    lines: list[Line], shift_m: Float64[ndarray, " 3"]
) -> None:
    clearances = Clearances(lines, [0.004] * len(lines))
    near = clearances.neighbours(lines[0], 0.004, 0, float(np.linalg.norm(shift_m)))
    assert near.bar_clearance_m(lines[0] + shift_m, 0.004) == clearances.least_m(lines[0] + shift_m, 0.004, 0)
