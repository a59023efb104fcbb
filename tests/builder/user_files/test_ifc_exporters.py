"""IFC files as programs export them: number, diameter and length of their bars, notes, and refusals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.specs.file_specs import Trust
from dataset_builder.user_files.ifc_reader import bars as reader_bars
from rebar_depth_bench.base.errors import MeshError
from tests.builder.scene.cages import assembly_of
from tests.builder.user_files.ifc_step_text import FEET, GRADS, INCHES, METRES, MILLIMETRES, RADIANS, Numbers, Step
from tests.builder.user_files.ifc_writer import bars_in_process

U_LENGTH_M = 1.0 + 0.1 * math.pi


@dataclass(frozen=True)
class Style:
    """One program's way of writing: the file, and what its bars are; ``notes`` are the codes of expected notes."""

    content: str
    bars: int
    diameter_m: float
    length_m: float
    notes: Sequence[str] = ()


def u_curve(step: Step, unit: float = 1.0) -> str:
    """Return a U as Revit writes it: two lines and a half circle, trimmed by parameters; mm times ``unit``."""
    straight, radius = 500.0 * unit, 100.0 * unit
    down = step.line((0, 0, 0), (1, 0, 0), straight)
    bend = step.arc((straight, radius, 0), radius, 270 / 180 * math.pi, 450 / 180 * math.pi)
    back = step.line((straight, 2 * radius, 0), (-1, 0, 0), straight)
    return step.composite(down, bend, back)


def revit(
    units: str,
    end: float | str,
    schema: str = "IFC2X3",
    length_m: float = U_LENGTH_M,
    notes: Sequence[str] = ("length",),
) -> Style:
    """Return Revit's style: one object with one disc, at site coordinates, declared lengths in feet."""
    step = Step(units, schema)
    disc = step.disc(u_curve(step, 0.001 / step.metre), 0.006 / step.metre, "0.", end)
    step.bar([disc], 0.012, U_LENGTH_M / 0.3048 * step.metre, at=(38000.0, 41000.0, 12.0))
    return Style(step.text(), 1, 0.012, length_m, notes)


def single(
    item: Callable[[Step], str],
    diameter_m: float,
    length_m: float | None,
    *,
    found_m: tuple[float, float] | None = None,
    notes: Sequence[str] = (),
) -> Style:
    """Return an object with one item; ``found_m``, diameter and length, are the declared ones unless given."""
    step = Step(MILLIMETRES, "IFC4")
    step.bar([item(step)], diameter_m, length_m)
    return Style(step.text(), 1, *(found_m or (diameter_m, length_m or 0.0)), notes)


def mapped(
    item: Callable[[Step], str],
    origins: Sequence[Numbers],
    diameter_m: float,
    length_m: float,
    *,
    units: str = MILLIMETRES,
    schema: str = "IFC2X3",
    declared_m: float | None = None,
) -> Style:
    """Return an object that maps one item to each of ``origins``."""
    step = Step(units, schema)
    step.bar(step.mapped([item(step)], origins), diameter_m, declared_m, at=(0.0, 0.0, 195.0))
    return Style(step.text(), len(origins), diameter_m, length_m)


def straight(step: Step, radius: float, start: object = "$", end: object = "$") -> str:
    return step.disc(step.polyline((0, 0, 0), (1000, 0, 0)), radius, start, end)


HOOK, SIDE, BEND = 60.0, 200.0, 20.0
STIRRUP_MM = 2 * HOOK + 3 * SIDE + BEND * math.pi * (3 * 0.5 + 0.75)


def stirrup(step: Step) -> str:
    r, diagonal = BEND, math.sqrt(0.5)
    down, left = step.line((0, HOOK, 0), (0, -1, 0), HOOK), step.line((r, -r, 0), (1, 0, 0), SIDE)
    first = step.arc((r, 0, 0), r, math.pi, 1.5 * math.pi)
    second = step.arc((r + SIDE, 0, 0), r, 1.5 * math.pi, 2 * math.pi)
    right = step.line((2 * r + SIDE, 0, 0), (0, 1, 0), SIDE)
    third = step.arc((r + SIDE, SIDE, 0), r, 0.0, 0.5 * math.pi)
    top = step.line((r + SIDE, SIDE + r, 0), (-1, 0, 0), SIDE)
    fourth = step.arc((r, SIDE, 0), r, 0.5 * math.pi, 1.25 * math.pi)
    tail = step.line((r - r * diagonal, SIDE - r * diagonal, 0), (diagonal, -diagonal, 0), HOOK)
    curve = step.composite(down, first, left, second, right, third, top, fourth, tail)
    return step.disc(curve, 4.0, "0.", 2 * HOOK + 3 * SIDE + 3 * 90 + 135)


ANGLES = [2 * math.pi * n / 60 for n in range(5 * 60 + 1)]
SPIRAL = [(200 * math.cos(angle), 200 * math.sin(angle), 100 * angle / (2 * math.pi)) for angle in ANGLES]
SPIRAL_MM = sum(math.dist(a, b) for a, b in pairwise(SPIRAL))


def indexed(step: Step) -> str:
    middle = (500 + 100 * math.sin(math.pi / 4), 100 - 100 * math.cos(math.pi / 4), 0)
    points = step.points((0, 0, 0), (500, 0, 0), middle, (600, 100, 0), (600, 400, 0))
    segments = "(IFCLINEINDEX((1,2)),IFCARCINDEX((2,3,4)),IFCLINEINDEX((4,5)))"
    return step.disc(step.add(f"IFCINDEXEDPOLYCURVE({points},{segments},.F.)"), 5.0, "$", "$")


def filleted(step: Step) -> str:
    line = step.polyline((0, 0, 0), (500, 0, 0), (500, 300, 0))
    return step.add(f"IFCSWEPTDISKSOLIDPOLYGONAL({line},6.,$,0.,2.,50.)")


def with_gap(step: Step, start: float) -> str:
    lines = (step.line((x, 0, 0), (1, 0, 0), 499.0) for x in (0, start))
    return step.disc(step.composite(*lines), 6.0, "$", "$")


def typed() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    kind = step.bar_type([step.disc(step.polyline((0, 0, 0), (0, 0, 2500)), 12.5, "$", "$")], 0.025, 2.5)
    step.typed(kind, [step.bar(None, None, None, at=(300.0 * n, 0.0, 0.0)) for n in range(4)])
    return Style(step.text(), 4, 0.025, 2.5)


def fabric() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    at = [100.0 * n for n in range(20)]
    lines = [step.polyline((x, 0, 0), (x, 1900, 0)) for x in at]
    lines += [step.polyline((0, y, 6), (1900, y, 6)) for y in at]
    step.mesh([step.disc(line, 3.0, "0.", 1900.0) for line in lines], 0.006)
    return Style(step.text(), 40, 0.006, 1.9)


def tendon() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    step.tendon([step.disc(step.polyline((0, 0, 0), (6000, 0, 0)), 7.5, "$", "$")], 0.015)
    return Style(step.text(), 1, 0.015, 6.0)


STYLES = {
    "Revit, U, metres, sum of ranges 181": revit(METRES, 181.0),
    "Revit, U, metres, rounding noise": revit(METRES, 180.99999999999997),
    "Revit, U, millimetres, 1180": revit(MILLIMETRES, 1180.0),
    "Revit, U, millimetres, lines in feet": revit(MILLIMETRES, 1000 / 304.8 + 180),
    "Revit, U, feet": revit(FEET, 1000 / 304.8 + 180, notes=()),
    "Revit, U, inches": revit(INCHES, 1000 / 25.4 + 180),
    "Revit, U, radians": revit(RADIANS, 1000 + math.pi),
    "U, gradians": revit(GRADS, 1200.0),
    "U, end beyond the curve": revit(MILLIMETRES, 99999.0),
    "U, number of segments, IFC4X3": revit(MILLIMETRES, 3.0, "IFC4X3_ADD2"),
    "U, no parameters": revit(MILLIMETRES, "$", "IFC4"),
    "U, cut in the bend": revit(MILLIMETRES, 590.0, length_m=0.5 + 0.05 * math.pi, notes=("cut", "length")),
    "Tekla, stirrup with hooks": single(stirrup, 0.008, STIRRUP_MM / 1000),
    "Tekla, set of 12 mapped polylines, length": mapped(
        lambda step: step.disc(step.polyline((0, 0, 0), (1200, 0, 0), (1200, 0, 983.675)), 10.0, "0.", 2183.675),
        [(0, 150.0 * n, 0) for n in range(12)],
        0.020,
        2.183675,
        declared_m=2.183675,
    ),
    "Allplan, mapped polylines, 0 to 1": mapped(
        lambda step: step.disc(step.polyline((0, 0, 0), (3, 0, 0), (3, 1, 0)), 0.005, "0.", "1."),
        [(0, 0, 0.2 * n) for n in range(7)],
        0.010,
        4.0,
        units=METRES,
    ),
    "Geometry Gym, mapped from type, indexed curve": mapped(
        indexed, [(0, 0, 0), (0, 0, 100)], 0.010, 0.8 + 0.05 * math.pi, schema="IFC4"
    ),
    "Geometry Gym, type with geometry, instances without diameter": typed(),
    "Fabric, reinforcing mesh of 40 discs": fabric(),
    "Tendon": tendon(),
    "Spiral, polyline of 60 chords a turn": single(
        lambda step: step.disc(step.polyline(*SPIRAL), 5.0, "0.", SPIRAL_MM), 0.010, SPIRAL_MM / 1000
    ),
    "Ring, whole circle": single(
        lambda step: step.disc(step.circle((0, 0, 0), 300.0), 5.0, "0.", 360.0),
        0.010,
        None,
        found_m=(0.010, 0.6 * math.pi),
    ),
    "Filleted polygon": single(filleted, 0.012, None, found_m=(0.012, 0.7 + 0.025 * math.pi)),
    "Segments with gaps of 2 mm": single(lambda step: with_gap(step, 501.0), 0.012, 1.0, notes=("gap",)),
    "Map with uniform scale 0.5": single(
        lambda step: step.mapped([straight(step, 10.0, "0.", "1.")], [(0, 0, 0)], scale=0.5)[0], 0.010, 0.5
    ),
    "Hollow bar": single(
        lambda step: step.add(f"IFCSWEPTDISKSOLID({step.polyline((0, 0, 0), (1000, 0, 0))},16.,8.,$,$)"),
        0.032,
        1.0,
        notes=("hollow",),
    ),
}


def read(content: str, trust: Trust = "declared") -> list[CageBar]:
    return bars_in_process(content.encode(), trust)


@pytest.mark.parametrize("name", STYLES)
def test_bars_of_style_are_exact(name: str) -> None:
    style = STYLES[name]
    bars = read(style.content)
    assert len(bars) == style.bars
    assert all(bar.mesh is None for bar in bars)
    # Arcs are sampled every 6 degrees, which shortens them by less than 0.05 %.
    np.testing.assert_allclose([bar.bar.length_m for bar in bars], style.length_m, rtol=5e-4)
    np.testing.assert_allclose([bar.bar.diameter_m for bar in bars], style.diameter_m, rtol=1e-9)
    assert {note.code for bar in bars for note in bar.notes} == set(style.notes)


def test_bars_name_their_object_and_roles_their_class() -> None:
    [u] = read(revit(MILLIMETRES, 1180.0).content)
    assert u.source == "0" * 21 + "2"
    assert u.bar.role == "main"
    assert {bar.bar.role for bar in read(fabric().content)} == {"mesh"}
    assert [bar.bar.role for bar in read(tendon().content)] == ["tendon"]


@pytest.mark.parametrize("end", [0.0, -1.0])
def test_parameters_that_are_not_on_the_curve_are_refused(end: float) -> None:
    with pytest.raises(MeshError, match=r"IfcReinforcingBar 0+2 .*is swept from 0.0 to"):
        read(revit(MILLIMETRES, end).content)


def straight_bar(radius: float) -> str:
    return single(lambda step: straight(step, radius), 0.012, None).content


def test_diameter_far_from_the_declared_one_is_refused_or_trusted() -> None:
    content = straight_bar(9.5)
    with pytest.raises(MeshError, match="19 mm in the geometry, 12 mm as declared") as caught:
        read(content)
    assert [problem.code for problem in caught.value.problems] == ["invalid"]
    [bar] = read(content, "geometry")
    assert bar.bar.diameter_m == 0.019
    assert [note.code for note in bar.notes] == ["diameter"]


@pytest.mark.parametrize(("radius", "is_noted"), [(6.2, False), (6.4, True), (5.6, True), (7.4, True)])
def test_small_differences_of_the_diameter_are_noted_once(radius: float, is_noted: bool) -> None:
    bars = read(straight_bar(radius))
    notes = [("diameter", True)] if is_noted else []
    assert [(note.code, "IfcReinforcingBar" in note.source) for note in assembly_of(bars, "a.ifc").notes] == notes


def test_diameter_of_the_type_is_compared() -> None:
    step = Step(MILLIMETRES, "IFC4")
    kind = step.bar_type([straight(step, 10.0)], 0.040, 1.0)
    step.typed(kind, [step.bar(None, None, None)])
    with pytest.raises(MeshError, match="20 mm in the geometry, 40 mm as declared"):
        read(step.text())


def multiplied(step: Step) -> str:
    curve = step.composite(step.line((0, 0, 0), (1, 0, 0), 500.0))
    for _ in range(12):
        curve = step.composite(*[curve] * 10)
    return step.disc(curve, 6.0, "$", "$")


def test_curves_of_too_many_pieces_and_wide_gaps_are_refused() -> None:
    with pytest.raises(MeshError, match="more than 10000 pieces"):
        read(single(multiplied, 0.012, None).content)
    with pytest.raises(MeshError, match="4 apart"):  # More than a quarter of the diameter.
        read(single(lambda step: with_gap(step, 503.0), 0.012, None).content)


@pytest.mark.slow
def test_circular_curves_and_maps_and_uneven_scales_are_refused() -> None:
    step = Step(MILLIMETRES, "IFC4")
    curve = step.composite(step.line((0, 0, 0), (1, 0, 0), 500.0))
    step.bar([step.disc(curve, 6.0, "$", "$")], None, None)
    segment = step.text().split("IFCCOMPOSITECURVESEGMENT(.CONTINUOUS.,.T.,")[1].split(")")[0]
    circular = step.text().replace(f".CONTINUOUS.,.T.,{segment})", f".CONTINUOUS.,.T.,{curve})")
    with pytest.raises(MeshError, match=r"IfcReinforcingBar .*nested more than"):
        read(circular)
    step = Step(MILLIMETRES, "IFC4")
    [item] = step.mapped([step.disc(u_curve(step), 6.0, "$", "$")], [(0, 0, 0)])
    step.bar([item], None, None)
    inner = step.text().split("'AdvancedSweptSolid',(")[1].split(")")[0]
    with pytest.raises(MeshError, match="circular maps"):
        read(step.text().replace(f"'AdvancedSweptSolid',({inner}))", f"'AdvancedSweptSolid',({item}))", 1))
    text = STYLES["Map with uniform scale 0.5"].content
    text = text.replace("TIONOPERATOR3D(", "TIONOPERATOR3DNONUNIFORM(").replace(",0.5,$)", ",0.5,$,0.7,$)")
    with pytest.raises(MeshError, match=r"IfcReinforcingBar .*a map scales by 0.5, 0.7"):
        read(text)


def test_number_of_points_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_bars, "MAX_POINTS", 20)
    with pytest.raises(MeshError, match=r"7 bars of 21 points .* expected at most"):
        read(STYLES["Tekla, set of 12 mapped polylines, length"].content)


def test_reversed_senses_and_trimmed_polylines() -> None:
    step = Step(MILLIMETRES, "IFC4")
    circle = step.circle((0, 0, 0), 100.0)
    line = step.polyline((300, 0, 0), (200, 0, 0), (100, 0, 0))
    segments = []
    for basis, first, last, trim_sense, sense in ((circle, 90, 0, "F", "T"), (line, 0.5, 2, "T", "F")):
        trims = f"(IFCPARAMETERVALUE({first:.1f})),(IFCPARAMETERVALUE({last:.1f}))"
        curve = step.add(f"IFCTRIMMEDCURVE({basis},{trims},.{trim_sense}.,.PARAMETER.)")
        segments.append(step.add(f"IFCCOMPOSITECURVESEGMENT(.CONTINUOUS.,.{sense}.,{curve})"))
    step.bar([step.disc(step.add(f"IFCCOMPOSITECURVE(({','.join(segments)}),.F.)"), 6.0, "$", "$")], None, None)
    [bar] = read(step.text())
    axis_mm = np.array(bar.bar.axis_m) * 1000
    np.testing.assert_allclose(axis_mm[[0, -1]], [(0, 100, 0), (250, 0, 0)], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(axis_mm[:16], axis=1), 100, atol=1e-12)


@pytest.mark.parametrize("is_trimmed", [False, True])
@pytest.mark.parametrize("kind", ["IfcEllipse", "IfcBSplineCurveWithKnots"])
def test_other_curves_are_refused_by_name(kind: str, is_trimmed: bool) -> None:
    step = Step(MILLIMETRES, "IFC4")
    control = f"({step.point((0, 0, 0))},{step.point((500, 0, 0))})"
    spline = f"1,{control},.UNSPECIFIED.,.F.,.F.,(2,2),(0.,1.),.UNSPECIFIED."
    curve = step.add(f"{kind.upper()}({f'{step.axes},200.,100.' if kind == 'IfcEllipse' else spline})")
    if is_trimmed:
        trims = "(IFCPARAMETERVALUE(0.)),(IFCPARAMETERVALUE(1.))"
        curve = step.add(f"IFCTRIMMEDCURVE({curve},{trims},.T.,.PARAMETER.)")
    step.bar([step.disc(curve, 6.0, "$", "$")], None, None)
    with pytest.raises(MeshError, match=rf"IfcReinforcingBar 0+2 .*{kind}.* expected .*lines?"):
        read(step.text())
