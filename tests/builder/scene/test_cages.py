"""Generated cages: reproducible, clear of each other, within the ranges and tolerances, and tied together."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from dataset_builder.scene.cages import as_built as as_built_module
from dataset_builder.scene.cages import generate as generate_module
from dataset_builder.scene.cages.as_built import (
    BOW_TOLERANCE,
    END_TOLERANCE_M,
    MIN_CLEAR_M,
    PLACE_TOLERANCE_M,
    SPACING_TOLERANCE_M,
    build_as,
    lowest_steel_m,
)
from dataset_builder.scene.cages.design import LEAST_COVER_M, Design, DesignBar, InfeasibleError, straight
from dataset_builder.scene.cages.generate import (
    FAMILIES,
    MAX_BARS,
    Family,
    GeneratedCage,
    cage_assembly,
    drawn_family,
    generate_cage,
)
from dataset_builder.scene.cages.rules import DIAMETERS_M
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import Clearances
from dataset_builder.specs.config_specs import GeneratedCageSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.names import SPLITS
from tests.builder.scene.cages import gaps_m, generated, line_length_m

TIED_WITHIN_M = 0.012
"""Largest clear distance between a bar and the nearest other one that tie wire spans."""
BETWEEN_MATS = ("chair", "tie", "u-bar")
"""Roles of bars of walls and slabs that are longer or shorter where the mats are farther apart or closer."""
MOST_SAG_M = 0.007
"""Sag of a mat on supports about 1 m apart."""
OUTWARD = {name: (axis, 1) for axis, name in enumerate("xyz")}
OUTWARD |= {"lower": (2, -1), "upper": (2, 1), "front": (1, -1), "back": (1, 1)}
"""Axis and sign of the direction to the face of a mat or a cage, by its name."""

EVERY_FAMILY = pytest.mark.parametrize("family", FAMILIES)


def both(family: str) -> list[GeneratedCage]:
    return [generated(family, number) for number in range(2)]


@pytest.mark.slow
@EVERY_FAMILY
def test_same_numbers_give_the_same_cage_in_the_middle_of_the_ground(family: str) -> None:
    first, second = map(cage_assembly, both(family))
    again = make_assembly(GeneratedCageSpec("train", 1, 3, family))
    assert (again.bars, again.vertices_m.tobytes()) == (second.bars, second.vertices_m.tobytes())
    assert first.bars != second.bars
    for assembly, cage in zip((first, second), both(family), strict=True):
        low, high = assembly.vertices_m.min(axis=0), assembly.vertices_m.max(axis=0)
        assert 0 < low[2] < 0.08
        assert np.abs(low + high)[:2].max() < 0.1
        assert (high - low).max() < 5
        assert [bar.role for bar in assembly.bars] == [bar.role for bar in cage.bars]


@pytest.mark.slow
@EVERY_FAMILY
def test_axes_are_whole_nanometres(family: str) -> None:
    for cage in both(family):
        lines = [line for bar in cage.bars for line in (bar.line_m, bar.nominal_m) if line is not None]
        lines += [np.array(bar["nominal_axis"]) for bar in cage.record["left_out"]]
        for line_m in lines:
            assert np.array_equal(line_m, np.round(line_m, 9))
            assert not np.signbit(line_m[line_m == 0]).any()


@pytest.mark.slow
@EVERY_FAMILY
def test_bars_are_clear_of_each_other_and_tied(family: str) -> None:
    for cage in both(family):
        radii_m = [outer_radius_m(bar.diameter_m) for bar in cage.bars]
        clear_m = gaps_m([bar.line_m for bar in cage.bars], radii_m, TIED_WITHIN_M)
        assert clear_m.min() >= MIN_CLEAR_M
        loose = [cage.bars[index].role for index in np.flatnonzero(clear_m.min(axis=1) > TIED_WITHIN_M)]
        assert not loose, f"{cage.record['parameters']}: {loose}"


def mats_m(cage: GeneratedCage) -> float:
    """Return how far bars are off at most with the mats of a cage, or the cage in both directions."""
    return float(np.linalg.norm([np.abs(mat["deviation_m"]).max() for mat in cage.record["mats"]]))


@pytest.mark.slow
@EVERY_FAMILY
def test_deviations_are_within_the_tolerances(family: str) -> None:
    for cage in both(family):
        built = [(bar, bar.nominal_m) for bar in cage.bars if bar.nominal_m is not None]
        assert len(cage.bars) - len(built) == cage.record["doubled"]
        most_m = 0.0
        for bar, nominal_m in built:
            off_m = float(np.linalg.norm(bar.line_m[[0, -1]] - nominal_m[[0, -1]], axis=1).max())
            assert off_m <= SPACING_TOLERANCE_M + PLACE_TOLERANCE_M + END_TOLERANCE_M + mats_m(cage)
            length_m = line_length_m(nominal_m)
            if len(nominal_m) == 2:
                chord = bar.line_m[-1] - bar.line_m[0]
                from_chord = np.cross(bar.line_m - bar.line_m[0], chord / np.linalg.norm(chord))
                assert np.linalg.norm(from_chord, axis=1).max() <= BOW_TOLERANCE * length_m + MOST_SAG_M
            if bar.role not in BETWEEN_MATS:
                assert line_length_m(bar.line_m) == pytest.approx(length_m, rel=1e-3)
            most_m = max(most_m, off_m)
        assert most_m > 0.003, "nothing deviates"


@pytest.fixture
def only_mats(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing but mats and whole cages deviate."""
    names = ("SPACING_TOLERANCE_M", "PLACE_TOLERANCE_M", "TILT_TOLERANCE_DEG", "BOW_TOLERANCE")
    for name in (*names, "_LEFT_OUT", "_DOUBLED"):
        monkeypatch.setattr(as_built_module, name, 0.0)


@pytest.mark.slow
@pytest.mark.usefixtures("only_mats")
@EVERY_FAMILY
def test_mats_are_off_through_the_thickness_as_recorded_and_bars_keep_their_distances(family: str) -> None:
    for number in range(3):
        cage = generate_cage("train", number, 5, family)
        nominal = [bar.nominal_m for bar in cage.bars if bar.nominal_m is not None]
        radii_m = [outer_radius_m(bar.diameter_m) for bar in cage.bars]
        before_m, after_m = (gaps_m(lines, radii_m, 0.01) for lines in (nominal, [b.line_m for b in cage.bars]))
        is_near = before_m < 0.004
        assert np.abs(after_m[is_near] - before_m[is_near]).max(initial=0.0) < 1.2e-4
        for mat in cage.record["mats"]:
            axis, outward = OUTWARD[mat["name"]]
            found_m = []
            for bar, nominal_m in zip(cage.bars, nominal, strict=True):
                is_other = family == "slab" and bar.role != mat["name"]
                is_other |= family == "wall" and nominal_m[0, 1] * outward < 0
                if len(nominal_m) == 2 and not is_other:
                    along = np.linspace(0, 1, len(bar.line_m))[:, None]
                    place_m = nominal_m[0] + along * (nominal_m[1] - nominal_m[0])
                    found_m += (outward * (place_m - bar.line_m)[:, axis]).tolist()
            least_m, most_m = mat["deviation_m"]
            if found_m:
                assert least_m - 1e-8 <= min(found_m) <= max(found_m) <= most_m + 1e-8
            if family not in ("column", "footing"):  # Their straight bars may end before the others.
                assert (min(found_m), max(found_m)) == pytest.approx((least_m, most_m), abs=2e-3)


TOLERANCES_M = {1: {0.150: 0.010, 0.400: 0.015, 2.500: 0.025}, 2: {0.150: 0.005, 0.400: 0.010, 2.500: 0.020}}
"""Permitted plus deviations of the cover by class and size of the member, EN 13670."""


@pytest.mark.slow
def test_a_tenth_of_the_mats_is_beyond_the_tolerance_and_none_reaches_the_ground() -> None:
    mats = []
    for number, family in itertools.product(range(80), ("slab", "beam")):
        cage = generate_cage("train", number, 6, family)
        parameters = cage.record["parameters"]
        sizes_m = {"y": "side_x_m", "z": "side_y_m"}
        for mat in cage.record["mats"]:
            size_m = float(parameters[sizes_m.get(mat["name"], "thickness_m")])
            table = TOLERANCES_M[mat["class"]]
            plus_m = float(np.interp(size_m, list(table), list(table.values())))
            minus_m = 0.010
            if family == "beam":  # What one face gains the other loses.
                plus_m = minus_m = min(plus_m, minus_m)
            assert mat["tolerance_m"] == pytest.approx([-minus_m, plus_m])
            least_m, most_m = mat["deviation_m"]
            assert mat["beyond"] == (least_m < -minus_m or most_m > plus_m)
            mats.append(mat)
        lowest_m = min(float(bar.line_m[:, 2].min()) - outer_radius_m(bar.diameter_m) for bar in cage.bars)
        assert lowest_m >= LEAST_COVER_M
    beyond = [mat for mat in mats if mat["beyond"]]
    assert 0.06 < len(beyond) / len(mats) < 0.14
    assert {mat["deviation_m"][0] < mat["tolerance_m"][0] for mat in beyond} == {True, False}, "at both sides"


@pytest.mark.slow
@EVERY_FAMILY
def test_designs_and_not_their_lowest_bars_are_at_the_nominal_height(family: str) -> None:
    for cage in both(family):
        nominal = [(bar.nominal_m, bar.diameter_m) for bar in cage.bars if bar.nominal_m is not None]
        lowest_m = min(lowest_steel_m(line_m, diameter_m) for line_m, diameter_m in nominal)
        lies = family in ("beam", "slab", "footing")
        cover_m = float(cage.record["parameters"]["cover_m"])
        assert lowest_m == pytest.approx(
            cover_m if lies else 1e-4, abs=2e-4 if not cage.record["left_out"] else 0.02
        )


@pytest.mark.slow
@EVERY_FAMILY
def test_diameters_and_records_are_those_of_the_rules(family: str) -> None:
    for cage in both(family):
        assert {bar.diameter_m for bar in cage.bars} <= set(DIAMETERS_M)
        assert cage.family == cage.record["family"] == family
        assert 7 <= len(cage.bars) + len(cage.record["left_out"]) - cage.record["doubled"] <= MAX_BARS
        assert json.loads(json.dumps(cage.record)) == cage.record
        assert all(len(missing["nominal_axis"]) >= 2 for missing in cage.record["left_out"])


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_family_is_known_without_the_cage(split: str) -> None:
    assert generate_cage(split, 0, 5).family == drawn_family(split, 0, 5)
    drawn = [drawn_family(split, number) for number in range(350)]
    assert min(drawn.count(family) for family in FAMILIES) >= 25
    assert set(drawn) == set(FAMILIES)


def test_no_two_cages_share_their_random_numbers() -> None:
    """Seeds past 32 bits are those that NumPy's seed sequence of several integers would confuse."""
    seeds, numbers = [0, 1, 7, 2**32, 1 + 2**32, 2**40, 2**64 - 1], [*range(100), 2**32, 1 + 2**32]
    states = [
        str(generate_module._cage_rng(*key).bit_generator.state)
        for key in itertools.product(SPLITS, numbers, seeds)
    ]
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


@pytest.mark.slow
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
    with pytest.raises(InputError, match="version 0"):
        make_assembly(GeneratedCageSpec("train", 0, version=0))


def test_neighbours_are_enough_for_lines_within_the_margin() -> None:
    lines = [straight((0, 0, 0), (1, 0, 0)), straight((0, 0.09, 0), (1, 0.09, 0))]
    near = Clearances(lines, [0.004] * 2).neighbours(lines[0], 0.004, 0, margin_m=0.08)
    assert near.bar_clearance_m(lines[0] + [0, 0.08, 0], 0.004) == pytest.approx(0.002, abs=1e-12)
