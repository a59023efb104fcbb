"""Swept solids of IFC: endless curves with parameters, ways of counting, and bars made of several solids."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from ifcopenshell import file, geom

from dataset_builder.audit.geometry import polyline_distance_m
from dataset_builder.scene.assemblies.cage import CageBar
from rebar_depth_bench.base.errors import MeshError
from tests.builder.user_files.ifc_step_text import MILLIMETRES, RADIANS, Numbers, Step
from tests.builder.user_files.ifc_writer import bars_in_process

QUARTER_MM = 50 * math.pi / 2
TEN_LEGS = [(50 + 40 * n, 0, 400) for n in range(11)]


def bars_of(step: Step) -> list[CageBar]:
    return bars_in_process(step.text().encode())


def check_sizes(bars: Sequence[CageBar], *sizes_mm: tuple[float, float]) -> None:
    """Compare the diameter and the length of each bar; arcs are sampled every 6 degrees, which shortens them."""
    found = [(bar.bar.diameter_m * 1000, bar.bar.length_m * 1000) for bar in bars]
    np.testing.assert_allclose(found, sizes_mm, rtol=5e-4)


def codes(bars: Sequence[CageBar]) -> set[str]:
    return {note.code for bar in bars for note in bar.notes}


def one_bar(
    item: Callable[[Step], str], length_mm: float | None = None, units: str = MILLIMETRES, schema: str = "IFC4"
) -> list[CageBar]:
    """Return the bars of an object with one item and a declared length."""
    step = Step(units, schema)
    step.bar([item(step)], 0.012, None if length_mm is None else length_mm / 1000)
    return bars_of(step)


def endless_line(step: Step, magnitude: float) -> str:
    vector = step.add(f"IFCVECTOR({step.direction((0, 0, 3))},{magnitude!r})")
    return step.add(f"IFCLINE({step.point((0, 0, 50))},{vector})")


@pytest.mark.parametrize("schema", ["IFC2X3", "IFC4", "IFC4X3_ADD2"])
@pytest.mark.parametrize(
    ("magnitude", "start", "end", "z_mm"),
    [
        (1.0, 0.0, 1500.0, (50, 1550)),
        (1500.0, 0.0, 1.0, (50, 1550)),
        (2.5, 100.0, 400.0, (300, 1050)),
        (10.0, -20.0, 30.0, (-150, 350)),
    ],
)
def test_line_is_swept_between_its_parameters(
    schema: str, magnitude: float, start: float, end: float, z_mm: Numbers
) -> None:
    """IFC4, IfcLine: a point at the parameter u is Pnt + u Dir, where Dir has the Magnitude of its IfcVector."""
    [bar] = one_bar(lambda step: step.disc(endless_line(step, magnitude), 6.0, start, end), schema=schema)
    np.testing.assert_allclose(np.array(bar.bar.axis_m)[:, 2] * 1000, z_mm, atol=1e-9)
    assert (bar.bar.diameter_m, bar.notes) == (0.012, ())


@pytest.mark.parametrize(("start", "end"), [("$", "1500."), ("0.", "$"), ("$", "$"), ("5.", "5."), ("9.", "1.")])
def test_line_without_two_ends_is_refused(start: str, end: str) -> None:
    with pytest.raises(MeshError, match=r"swept along an IfcLine .*, expected both, the second above the first"):
        one_bar(lambda step: step.disc(endless_line(step, 1.0), 6.0, start, end))


@pytest.mark.parametrize(
    ("units", "start", "end", "first_deg", "last_deg"),
    [
        (MILLIMETRES, 30.0, 120.0, 30, 120),
        (MILLIMETRES, 270.0, 450.0, 270, 450),
        (MILLIMETRES, -45.0, 45.0, -45, 45),
        (MILLIMETRES, 0.0, 90.0, 0, 90),
        (MILLIMETRES, 90.0, 91.0, 90, 91),
        (RADIANS, 0.5, 2.5, math.degrees(0.5), math.degrees(2.5)),
        (MILLIMETRES, "$", "$", 0, 360),
        (MILLIMETRES, 0.0, 360.0, 0, 360),
        (MILLIMETRES, 0.0, 1.0, 0, 360),
    ],
)
def test_circle_is_swept_between_its_angles(
    units: str, start: object, end: object, first_deg: float, last_deg: float
) -> None:
    [bar] = one_bar(lambda step: step.disc(step.circle((0, 0, 0), 400.0), 6.0, start, end), units=units)
    axis_mm = np.array(bar.bar.axis_m) * 1000
    ends = np.radians([first_deg, last_deg])
    np.testing.assert_allclose(axis_mm[[0, -1], :2], 400 * np.stack([np.cos(ends), np.sin(ends)], 1), atol=1e-6)
    assert bar.bar.length_m * 1000 == pytest.approx(400 * (ends[1] - ends[0]), rel=5e-4)
    with pytest.raises(MeshError, match="expected at most one turn"):
        one_bar(lambda step: step.disc(step.circle((0, 0, 0), 400.0), 6.0, 90.0, 460.0))


@pytest.mark.parametrize("ends", [("$", "$"), (0.0, 2.0)])
@pytest.mark.parametrize("trims", [("p", "q", "T"), ("q", "p", "F"), (0.5, 2.5, "T"), (2.5, 0.5, "F")])
def test_trimmed_line_is_swept_from_its_first_trim(
    trims: tuple[object, object, str], ends: tuple[object, object]
) -> None:
    step = Step(MILLIMETRES, "IFC4")
    points = {"p": step.point((0, 0, 100)), "q": step.point((0, 0, 300))}
    first, last = (points.get(str(trim), f"IFCPARAMETERVALUE({trim})") for trim in trims[:2])
    line = endless_line(step, 100.0)  # Its parameters 0.5 and 2.5 are at the heights 100 and 300.
    curve = step.add(f"IFCTRIMMEDCURVE({line},({first}),({last}),.{trims[2]}.,.UNSPECIFIED.)")
    step.bar([step.disc(curve, 6.0, *ends)], 0.012, None)
    [bar] = bars_of(step)
    heights = [0.1, 0.3] if trims[2] == "T" else [0.3, 0.1]
    assert [z for _, _, z in bar.bar.axis_m] == pytest.approx(heights)


def bent(step: Step) -> list[str]:
    """Return the curves of a bar: a leg of 300 mm, a bend, a polyline of ten legs of 40 mm, a leg of 200 mm."""
    up, along = step.direction((0, 1, 0)), step.direction((-1, 0, 0))
    place = step.add(f"IFCAXIS2PLACEMENT3D({step.point((50, 0, 350))},{up},{along})")
    trims = f"(IFCPARAMETERVALUE(0.)),(IFCPARAMETERVALUE({math.pi / 2 / step.angle!r})),.T.,.PARAMETER."
    arc = step.add(f"IFCTRIMMEDCURVE({step.add(f'IFCCIRCLE({place},50.)')},{trims})")
    first, last = step.polyline((0, 0, 50), (0, 0, 350)), step.polyline((450, 0, 400), (650, 0, 400))
    return [first, arc, step.polyline(*TEN_LEGS), last]


WHOLE_MM = 300 + QUARTER_MM + 400 + 200
CUT_MM = 300 + QUARTER_MM + 2 * 40


def bent_bar(step: Step, end: float, start: float = 0.0) -> str:
    return step.disc(step.composite(*bent(step)), 6.0, start, end)


def polylines(step: Step, start: float, end: float) -> str:
    """Return a bar of polylines of 3, 1 and 2 legs: 100, 100, 100, 500, 150 and 50 mm."""
    curves = [(0, 100, 200, 300), (300, 800), (800, 950, 1000)]
    lines = [step.polyline(*((x, 0, 0) for x in row)) for row in curves]
    return step.disc(step.composite(*lines), 6.0, start, end)


def indexed(step: Step, start: float, end: float) -> str:
    """Return a bar of three legs (100, 100, 100 mm), a quarter circle and a leg of 200 mm by indices of points."""
    middle = (300 + 50 * math.sin(math.pi / 4), 50 - 50 * math.cos(math.pi / 4), 0)
    points = step.points(*((x, 0, 0) for x in (0, 100, 200, 300)), middle, (350, 50, 0), (350, 250, 0))
    segments = "(IFCLINEINDEX((1,2,3,4)),IFCARCINDEX((4,5,6)),IFCLINEINDEX((6,7)))"
    return step.disc(step.add(f"IFCINDEXEDPOLYCURVE({points},{segments},.F.)"), 6.0, start, end)


def arc_and_legs(step: Step, end: float) -> str:
    """Return a bar of a quarter circle and a polyline of three legs of 40 mm."""
    return step.disc(step.composite(bent(step)[1], step.polyline(*TEN_LEGS[:4])), 6.0, 0.0, end)


@pytest.mark.parametrize(
    ("item", "declared_mm", "length_mm", "notes"),
    [
        # 1 + 90 + 1 + 1 is the whole curve where a polyline counts 1; legs count 1 + 90 + 10 + 1 by ISO 10303-42.
        (lambda step: bent_bar(step, 93.0), 978.54, WHOLE_MM, {"parameters"}),
        (lambda step: bent_bar(step, 93.0), 985.0, WHOLE_MM, {"parameters"}),
        (lambda step: bent_bar(step, 93.0), CUT_MM, CUT_MM, {"cut"}),
        (lambda step: bent_bar(step, 93.0), None, CUT_MM, {"cut"}),
        (lambda step: bent_bar(step, 93.0), 700.0, CUT_MM, {"cut", "length"}),
        (lambda step: bent_bar(step, 102.0), 978.54, WHOLE_MM, set()),
        (lambda step: bent_bar(step, 92.5), WHOLE_MM - 100, WHOLE_MM - 100, {"cut", "parameters"}),
        (lambda step: bent_bar(step, 93.0, 1.0), WHOLE_MM - 300, WHOLE_MM - 300, {"cut", "parameters"}),
        (lambda step: bent_bar(step, 4.0, 2.0), 600.0, 600.0, {"cut", "parameters"}),
        (lambda step: bent_bar(step, WHOLE_MM), WHOLE_MM, WHOLE_MM, {"parameters"}),
        (lambda step: arc_and_legs(step, 91.0), QUARTER_MM + 120, QUARTER_MM + 120, {"parameters"}),
        (lambda step: arc_and_legs(step, 91.0), QUARTER_MM + 40, QUARTER_MM + 40, {"cut"}),
        (lambda step: indexed(step, 0.0, 92.0), 500 + QUARTER_MM, 500 + QUARTER_MM, {"parameters"}),
        (lambda step: indexed(step, 1.0, 3.0), 200 + QUARTER_MM, 200 + QUARTER_MM, {"cut", "parameters"}),
        (lambda step: indexed(step, 1.0, 3.0), 200.0, 200.0, {"cut"}),
        (lambda step: polylines(step, 1.0, 3.0), 700.0, 700.0, {"cut", "parameters"}),
        (lambda step: polylines(step, 1.0, 3.0), 200.0, 200.0, {"cut"}),
        (lambda step: polylines(step, 1.0, 3.0), None, 200.0, {"cut"}),
    ],
)
def test_counting_that_agrees_with_the_declared_length_is_taken(
    item: Callable[[Step], str], declared_mm: float | None, length_mm: float, notes: set[str]
) -> None:
    bars = one_bar(item, declared_mm)
    check_sizes(bars, (12.0, length_mm))
    assert codes(bars) == notes


def test_counting_in_radians_and_at_the_scale_of_each_map() -> None:
    bars = one_bar(lambda step: bent_bar(step, 3 + math.pi / 2), WHOLE_MM, RADIANS)
    check_sizes(bars, (12.0, WHOLE_MM))
    step = Step(MILLIMETRES, "IFC4")
    disc = bent_bar(step, 93.0)
    for scale, length_mm in ((0.5, WHOLE_MM / 2), (1.0, CUT_MM)):  # One solid, whose objects declare two lengths.
        step.bar(step.mapped([disc], [(0, 500, 0)], scale=scale), 0.012 * scale, length_mm / 1000)
    check_sizes(bars_of(step), (6.0, WHOLE_MM / 2), (12.0, CUT_MM))


def leg(step: Step, start: Numbers, end: Numbers, radius: float = 6.0) -> str:
    return step.disc(step.polyline(start, end), radius, "$", "$")


def extruded(step: Step, start: Numbers, along: Numbers, length: float) -> str:
    """Return a circle extruded from ``start`` along a direction other than y."""
    axes = f"{step.direction(along)},{step.direction((0, 1, 0))}"
    place = step.add(f"IFCAXIS2PLACEMENT3D({step.point(start)},{axes})")
    profile = step.add("IFCCIRCLEPROFILEDEF(.AREA.,$,$,6.)")
    return step.add(f"IFCEXTRUDEDAREASOLID({profile},{place},{step.direction((0, 0, 1))},{length!r})")


def revolved(step: Step, start: Numbers, along: Numbers, to_centre: Numbers, angle: float = 90.0) -> str:
    """Return a bend of 50 mm from ``start`` in the direction ``along``; its centre is in another one from there.

    The profile's x axis points to the centre. Turns about y lead from z to x, so the profile moves along z.
    """
    axes = f"{step.direction(along)},{step.direction(to_centre)}"
    place = step.add(f"IFCAXIS2PLACEMENT3D({step.point(start)},{axes})")
    axis = step.add(f"IFCAXIS1PLACEMENT({step.point((50, 0, 0))},{step.direction((0, 1, 0))})")
    flat = step.add(f"IFCAXIS2PLACEMENT2D({step.point((0, 0))},$)")
    profile = step.add(f"IFCCIRCLEPROFILEDEF(.AREA.,$,{flat},6.)")
    return step.add(f"IFCREVOLVEDAREASOLID({profile},{place},{axis},{angle!r})")


def arc_disc(step: Step, centre: Numbers, first_deg: float, last_deg: float) -> str:
    """Return a bend, clockwise if its first angle is the larger one."""
    trims = f"(IFCPARAMETERVALUE({first_deg:.1f})),(IFCPARAMETERVALUE({last_deg:.1f}))"
    sense = "T" if first_deg < last_deg else "F"
    arc = step.add(f"IFCTRIMMEDCURVE({step.circle(centre, 50.0)},{trims},.{sense}.,.PARAMETER.)")
    return step.disc(arc, 6.0, "$", "$")


def u_pieces(step: Step) -> list[str]:
    """Return the solids of a U: legs of 500, 300 and 500 mm with two bends of 50 mm, some from end to start."""
    return [
        leg(step, (0, 500, 0), (0, 0, 0)),
        arc_disc(step, (50, 0, 0), 180, 270),
        leg(step, (350, -50, 0), (50, -50, 0)),
        arc_disc(step, (350, 0, 0), 360, 270),
        leg(step, (400, 500, 0), (400, 0, 0)),
    ]


U_MM = 1300 + 2 * QUARTER_MM


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (4, 3, 2, 1, 0), (2, 0, 4, 1, 3), (3, 0, 1, 4, 2)])
def test_legs_and_bends_of_one_object_are_one_bar(order: Sequence[int]) -> None:
    step = Step(MILLIMETRES, "IFC4")
    pieces = u_pieces(step)
    step.bar([pieces[number] for number in order], 0.012, U_MM / 1000)
    [bar] = bars_of(step)
    check_sizes([bar], (12.0, U_MM))
    axis_mm = np.array(bar.bar.axis_m) * 1000
    assert sorted(axis_mm[[0, -1], 0]) == pytest.approx([0, 400], abs=1e-6)
    assert len(axis_mm) == 2 * 16 + 2
    assert codes([bar]) == {"joined"}


def test_solids_of_other_classes_are_joined() -> None:
    """Two extruded legs and a revolved bend: from (0, 0, 0) up by 300 mm, to (50, 0, 350), and 200 mm along x."""
    step = Step(MILLIMETRES, "IFC4")
    bend = revolved(step, (0, 0, 300), (0, 0, 1), (1, 0, 0))
    items = [extruded(step, (250, 0, 350), (-1, 0, 0), 200.0), bend, extruded(step, (0, 0, 0), (0, 0, 1), 300.0)]
    step.bar(items, 0.012, None)
    [bar] = bars_of(step)
    check_sizes([bar], (12.0, 500 + QUARTER_MM))
    ends = sorted(map(tuple, np.round(np.array(bar.bar.axis_m)[[0, -1]] * 1000, 6)))
    assert ends == [(0, 0, 0), (250, 0, 350)]


@pytest.mark.slow
def test_revolved_circle_is_that_of_the_geometry_kernel() -> None:
    step = Step(MILLIMETRES, "IFC4")
    solid = revolved(step, (10, 20, 300), (0, 0.6, 0.8), (1, 0, 0), angle=75.0)
    step.bar([solid], 0.012, None)
    [bar] = bars_of(step)
    settings = geom.settings()
    settings.set("mesher-linear-deflection", 1e-5)
    model = file.from_string(step.text())
    shape = geom.create_shape(settings, model.by_id(int(solid[1:])))
    distance_m = polyline_distance_m(np.array(shape.verts).reshape(-1, 3), np.array(bar.bar.axis_m))
    np.testing.assert_allclose(distance_m[distance_m > 0.003], 0.006, atol=1e-4)
    assert bar.bar.length_m * 1000 == pytest.approx(50 * math.radians(75), rel=5e-4)


def link_pieces(step: Step) -> list[str]:
    """Return the solids of a closed link of 200 x 300 mm between bends of 50 mm."""
    return [
        leg(step, (0, 0, 0), (200, 0, 0)),
        arc_disc(step, (200, 50, 0), 270, 360),
        leg(step, (250, 350, 0), (250, 50, 0)),
        arc_disc(step, (200, 350, 0), 0, 90),
        leg(step, (200, 400, 0), (0, 400, 0)),
        arc_disc(step, (0, 350, 0), 90, 180),
        leg(step, (-50, 350, 0), (-50, 50, 0)),
        arc_disc(step, (0, 50, 0), 180, 270),
    ]


LINK_MM = 1000 + 4 * QUARTER_MM


@pytest.mark.parametrize("seed", range(3))
def test_closed_link_of_several_solids_is_one_ring(seed: int) -> None:
    step = Step(MILLIMETRES, "IFC4")
    items = [str(item) for item in np.random.default_rng(seed).permutation(link_pieces(step))]
    step.bar(items, 0.012, LINK_MM / 1000)
    [bar] = bars_of(step)
    assert bar.bar.length_m * 1000 == pytest.approx(LINK_MM, rel=5e-4)
    assert bar.bar.axis_m[0] == bar.bar.axis_m[-1]


def test_each_use_of_a_map_is_joined_on_its_own() -> None:
    """Three uses of a map of two coaxial pieces, of which two meet end to end; a nested map; pieces of a type."""
    step = Step(MILLIMETRES, "IFC4")
    pieces = [leg(step, (0, 0, 0), (300, 0, 0)), leg(step, (500, 0, 0), (300, 0, 0))]
    step.bar(step.mapped(pieces, [(0, 0, 0), (500, 0, 0), (0, 100, 0)]), 0.012, 0.5)
    step.bar(step.mapped(step.mapped(u_pieces(step), [(0, 0, 0), (0, 0, 200)]), [(0, 0, 0)]), 0.012, None)
    kind = step.bar_type(u_pieces(step), 0.012, U_MM / 1000)
    step.typed(kind, [step.bar(None, None, None, at=(0.0, 0.0, 900.0 * n)) for n in range(2)])
    check_sizes(bars_of(step), *[(12.0, 500.0)] * 3, *[(12.0, U_MM)] * 4)


def test_ten_parallel_bars_of_three_solids_stay_ten() -> None:
    step = Step(MILLIMETRES, "IFC4")
    rows = [[(0, 100 * n, 0), (200, 100 * n, 0), (350, 100 * n, 0), (600, 100 * n, 0)] for n in range(10)]
    items = [leg(step, *ends) for row in rows for ends in itertools.pairwise(row)]
    step.bar(items[::3] + items[1::3] + items[2::3], 0.012, None)
    check_sizes(bars_of(step), *[(12.0, 600.0)] * 10)


@pytest.mark.parametrize(
    ("start", "end", "radius", "bars", "notes"),
    [
        ((500, 0, 0), (900, 0, 0), 6.0, 1, {"joined"}),
        ((502.4, 0, 0), (900, 0, 0), 6.0, 1, {"joined", "gap"}),
        ((500, 2, 0), (900, 2, 0), 6.0, 1, {"joined", "gap"}),
        ((504, 0, 0), (900, 0, 0), 6.0, 2, set()),
        ((500, 4, 0), (900, 4, 0), 6.0, 2, set()),
        ((500, 0, 0), (900, 400 * math.tan(math.radians(0.9)), 0), 6.0, 1, {"joined"}),
        ((500, 0, 0), (900, 400 * math.tan(math.radians(1.2)), 0), 6.0, 2, set()),
        ((500, 0, 0), (500, 400, 0), 6.0, 2, set()),
        ((500, 0, 0), (900, 0, 0), 5.0, 2, set()),
        ((200, 12, 0), (900, 12, 0), 6.0, 2, set()),  # A lap splice.
        ((500, 0, 0), (100, 0, 0), 6.0, 2, set()),  # It lies in the other.
    ],
)
def test_solids_are_joined_only_where_they_continue_each_other(
    start: Numbers, end: Numbers, radius: float, bars: int, notes: set[str]
) -> None:
    step = Step(MILLIMETRES, "IFC4")
    step.bar([leg(step, (0, 0, 0), (500, 0, 0)), leg(step, start, end, radius)], None, None)
    found = bars_of(step)
    assert (len(found), codes(found)) == (bars, notes)


def test_bars_that_meet_stay_two_if_they_are_two_objects_or_of_the_declared_length() -> None:
    step = Step(MILLIMETRES, "IFC4")
    for x in (0, 500):
        step.bar([leg(step, (x, 0, 0), (x + 500, 0, 0))], 0.012, 0.5)
    step.bar([leg(step, (x, 100, 0), (x + 500, 100, 0)) for x in (0, 500, 1000)], 0.012, 0.5)
    twice = [leg(step, (0, 200, 0), (500, 200, 0)) for _ in range(2)]
    step.bar([*twice, leg(step, (500, 200, 0), (900, 200, 0))], 0.012, None)
    check_sizes(bars_of(step), *[(12.0, 500.0)] * 7, (12.0, 400.0))
