"""IFC files as programs export them, as text: the bars of each style with their expected diameter and length.

``python -m tests.builder.user_files.ifc_exporters`` prints the table of expected and found numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from rebar_depth_bench.base.errors import MeshError
from tests.builder.user_files.ifc_step_text import FEET, GRADS, INCHES, METRES, MILLIMETRES, RADIANS, Step
from tests.builder.user_files.ifc_writer import bars_in_process

Numbers = Sequence[float]


@dataclass(frozen=True)
class Style:
    """One program's way of writing: the file, and what its bars are; ``notes`` are the codes of expected notes."""

    content: str
    bars: int
    diameter_m: float
    length_m: float
    notes: tuple[str, ...] = ()


STYLES: dict[str, Callable[[], Style]] = {}
U_LENGTH = 1000 + 100 * math.pi


def style(name: str) -> Callable[[Callable[[], Style]], Callable[[], Style]]:
    def register(make: Callable[[], Style]) -> Callable[[], Style]:
        STYLES[name] = make
        return make

    return register


def u_curve(step: Step, unit: float = 1.0, straight: float = 500.0, radius: float = 100.0) -> str:
    """Return a U as Revit writes it: two lines and a half circle, trimmed by parameters; mm times ``unit``."""
    straight, radius = straight * unit, radius * unit
    down = step.line((0, 0, 0), (1, 0, 0), straight)
    bend = step.arc((straight, radius, 0), radius, 270 / 180 * math.pi, 450 / 180 * math.pi)
    back = step.line((straight, 2 * radius, 0), (-1, 0, 0), straight)
    return step.composite(down, bend, back)


def revit(units: str, end: float | str, schema: str = "IFC2X3") -> Style:
    """Return Revit's style: one object with one disc, at site coordinates, declared lengths in feet."""
    step = Step(units, schema)
    curve = u_curve(step, 0.001 / step.metre)
    disc = step.disc(curve, 0.006 / step.metre, "0.", end)
    step.bar([disc], 0.012, U_LENGTH / 304.8 * step.metre, at=(38000.0, 41000.0, 12.0))
    return Style(step.text(), 1, 0.012, U_LENGTH / 1000, ("length",))


@style("Revit, line, millimetres")
def _revit_line() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    disc = step.disc(step.composite(step.line((0, 0, 0), (0, 1, 0), 365.0)), 8.0, "0.", 365.0)
    step.bar([disc], 0.016, 0.365, at=(1000.0, 2000.0, 0.0))
    return Style(step.text(), 1, 0.016, 0.365)


@style("Revit, U, metres, sum of ranges 181")
def _revit_metres() -> Style:
    return revit(METRES, 181.0)


@style("Revit, U, metres, rounding noise")
def _revit_noise() -> Style:
    return revit(METRES, 180.99999999999997)


@style("Revit, U, millimetres, 1180")
def _revit_mm() -> Style:
    return revit(MILLIMETRES, 1180.0)


@style("Revit, U, millimetres, lines in feet")
def _revit_mm_feet() -> Style:
    return revit(MILLIMETRES, 1000 / 304.8 + 180)


@style("Revit, U, feet")
def _revit_feet() -> Style:
    return replace(revit(FEET, 1000 / 304.8 + 180), notes=())


@style("Revit, U, inches")
def _revit_inches() -> Style:
    return revit(INCHES, 1000 / 25.4 + 180)


@style("Revit, U, radians")
def _revit_radians() -> Style:
    return revit(RADIANS, 1000 + math.pi)


@style("U, gradians")
def _grads() -> Style:
    return revit(GRADS, 1200.0)


@style("U, end beyond the curve")
def _beyond() -> Style:
    return revit(MILLIMETRES, 99999.0)


@style("U, number of segments, IFC4X3")
def _segments() -> Style:
    return revit(MILLIMETRES, 3.0, "IFC4X3_ADD2")


@style("U, no parameters")
def _no_parameters() -> Style:
    return revit(MILLIMETRES, "$", "IFC4")


@style("U, cut in the middle of the bend")
def _cut() -> Style:
    length_m = 0.5 + 0.05 * math.pi
    return replace(revit(MILLIMETRES, 590.0), length_m=length_m, notes=("cut", "length"))


@style("line, cut at both ends")
def _cut_line() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    disc = step.disc(step.composite(step.line((0, 0, 0), (0, 0, 1), 1000.0)), 5.0, 250.0, 750.0)
    step.bar([disc], 0.010, 1.0)
    return Style(step.text(), 1, 0.010, 0.5, ("cut", "length"))


@style("Tekla, set of 12 mapped polylines, length")
def _tekla_polylines() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    disc = step.disc(step.polyline((0, 0, 0), (1200, 0, 0), (1200, 0, 983.675)), 10.0, "0.", 2183.675)
    step.bar(step.mapped([disc], [(0, 150.0 * n, 0) for n in range(12)]), 0.020, 2.183675)
    return Style(step.text(), 12, 0.020, 2.183675)


@style("Tekla, set of 5 mapped U, mixed sum")
def _tekla_mixed() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    disc = step.disc(u_curve(step), 6.0, "0.", 1180.0)
    step.bar(step.mapped([disc], [(0, 0, 200.0 * n) for n in range(5)]), 0.012, U_LENGTH / 1000)
    return Style(step.text(), 5, 0.012, U_LENGTH / 1000)


@style("Tekla, stirrup with hooks")
def _stirrup() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    r, side, hook = 20.0, 200.0, 60.0
    down, left = step.line((0, hook, 0), (0, -1, 0), hook), step.line((r, -r, 0), (1, 0, 0), side)
    first = step.arc((r, 0, 0), r, math.pi, 1.5 * math.pi)
    second = step.arc((r + side, 0, 0), r, 1.5 * math.pi, 2 * math.pi)
    right = step.line((2 * r + side, 0, 0), (0, 1, 0), side)
    third = step.arc((r + side, side, 0), r, 0.0, 0.5 * math.pi)
    top = step.line((r + side, side + r, 0), (-1, 0, 0), side)
    fourth = step.arc((r, side, 0), r, 0.5 * math.pi, 1.25 * math.pi)
    diagonal = math.sqrt(0.5)
    tail = step.line((r - r * diagonal, side - r * diagonal, 0), (diagonal, -diagonal, 0), hook)
    curve = step.composite(down, first, left, second, right, third, top, fourth, tail)
    length = 2 * hook + 3 * side + r * math.pi * (3 * 0.5 + 0.75)
    step.bar([step.disc(curve, 4.0, "0.", 2 * hook + 3 * side + 3 * 90 + 135)], 0.008, length / 1000)
    return Style(step.text(), 1, 0.008, length / 1000)


@style("Allplan, mapped polylines, 0 to 1")
def _allplan() -> Style:
    step = Step(METRES, "IFC2X3")
    disc = step.disc(step.polyline((0, 0, 0), (3, 0, 0), (3, 1, 0)), 0.005, "0.", "1.")
    step.bar(step.mapped([disc], [(0, 0, 0.2 * n) for n in range(7)]), 0.010, None, at=(0.0, 0.0, 195.0))
    return Style(step.text(), 7, 0.010, 4.0)


@style("Geometry Gym, type with geometry, instances without diameter")
def _geometry_gym() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    kind = step.bar_type([step.disc(step.polyline((0, 0, 0), (0, 0, 2500)), 12.5, "$", "$")], 0.025, 2.5)
    step.typed(kind, [step.bar(None, None, None, at=(300.0 * n, 0.0, 0.0)) for n in range(4)])
    return Style(step.text(), 4, 0.025, 2.5)


@style("Geometry Gym, mapped from type, indexed curve")
def _indexed() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    middle = (500 + 100 * math.sin(math.pi / 4), 100 - 100 * math.cos(math.pi / 4), 0)
    points = step.points((0, 0, 0), (500, 0, 0), middle, (600, 100, 0), (600, 400, 0))
    segments = "(IFCLINEINDEX((1,2)),IFCARCINDEX((2,3,4)),IFCLINEINDEX((4,5)))"
    disc = step.disc(step.add(f"IFCINDEXEDPOLYCURVE({points},{segments},.F.)"), 5.0, "$", "$")
    step.bar(step.mapped([disc], [(0, 0, 0), (0, 0, 100)]), 0.010, None)
    return Style(step.text(), 2, 0.010, 0.8 + 0.05 * math.pi)


@style("Fabric, reinforcing mesh of 40 discs")
def _fabric() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    along = [
        step.disc(step.polyline((100.0 * n, 0, 0), (100.0 * n, 1900, 0)), 3.0, "0.", 1900.0) for n in range(20)
    ]
    across = [
        step.disc(step.polyline((0, 100.0 * n, 6), (1900, 100.0 * n, 6)), 3.0, "0.", 1900.0) for n in range(20)
    ]
    step.mesh([*along, *across], 0.006)
    return Style(step.text(), 40, 0.006, 1.9)


@style("Precast, extruded circles, 6 in one object")
def _extruded() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    step.bar([step.extrusion(7.0, 2400.0, 150.0 * n) for n in range(6)], 0.014, 2.4)
    return Style(step.text(), 6, 0.014, 2.4)


@style("Tendon, B-spline")
def _tendon() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    control = ",".join(step.point(p) for p in [(0, 0, 0), (2000, 0, 0), (4000, 0, 0), (6000, 0, 0)])
    spline = step.add(f"IFCBSPLINECURVEWITHKNOTS(3,({control}),.UNSPECIFIED.,.F.,.F.,(4,4),(0.,1.),.UNSPECIFIED.)")
    step.tendon([step.disc(spline, 7.5, "$", "$")], 0.015)
    return Style(step.text(), 1, 0.015, 6.0)


def spiral_points(turns: int, per_turn: int, radius: float, pitch: float) -> list[tuple[float, float, float]]:
    angles = [2 * math.pi * n / per_turn for n in range(turns * per_turn + 1)]
    return [(radius * math.cos(a), radius * math.sin(a), pitch * a / (2 * math.pi)) for a in angles]


@style("Spiral, polyline of 60 chords a turn")
def _spiral() -> Style:
    step = Step(MILLIMETRES, "IFC2X3")
    points = spiral_points(5, 60, 200.0, 100.0)
    length = sum(math.dist(a, b) for a, b in pairwise(points))
    step.bar([step.disc(step.polyline(*points), 5.0, "0.", length)], 0.010, length / 1000)
    return Style(step.text(), 1, 0.010, length / 1000)


@style("Ring, whole circle")
def _ring() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    circle = step.circle((0, 0, 0), 300.0)
    step.bar([step.disc(circle, 5.0, "0.", 360.0)], 0.010, None)
    return Style(step.text(), 1, 0.010, 0.6 * math.pi)


@style("Filleted polygon")
def _filleted() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    line = step.polyline((0, 0, 0), (500, 0, 0), (500, 300, 0))
    disc = step.add(f"IFCSWEPTDISKSOLIDPOLYGONAL({line},6.,$,0.,2.,50.)")
    step.bar([disc], 0.012, None)
    return Style(step.text(), 1, 0.012, 0.7 + 0.025 * math.pi)


@style("Segments with gaps of 2 mm")
def _gaps() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    curve = step.composite(step.line((0, 0, 0), (1, 0, 0), 499.0), step.line((501, 0, 0), (1, 0, 0), 499.0))
    step.bar([step.disc(curve, 6.0, "$", "$")], 0.012, 1.0)
    return Style(step.text(), 1, 0.012, 1.0, ("gap",))


@style("Map with uniform scale 0.5")
def _scaled() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    disc = step.disc(step.polyline((0, 0, 0), (1000, 0, 0)), 10.0, "0.", "1.")
    step.bar(step.mapped([disc], [(0, 0, 0)], scale=0.5), 0.010, 0.5)
    return Style(step.text(), 1, 0.010, 0.5)


@style("Outer diameter of the ribs modelled")
def _outer_ribs() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    step.bar([step.disc(step.polyline((0, 0, 0), (1000, 0, 0)), 11.0, "$", "$")], 0.020, 1.0)
    return Style(step.text(), 1, 0.022, 1.0, ("diameter",))


@style("Hollow bar")
def _hollow() -> Style:
    step = Step(MILLIMETRES, "IFC4")
    disc = step.add(f"IFCSWEPTDISKSOLID({step.polyline((0, 0, 0), (1000, 0, 0))},16.,8.,$,$)")
    step.bar([disc], 0.032, 1.0)
    return Style(step.text(), 1, 0.032, 1.0, ("hollow",))


def main() -> None:
    """Print the table: bars, diameter and length, expected and found."""
    print(
        "| style | bars | found | diameter | found | length | found | notes |\n|---|---|---|---|---|---|---|---|"
    )
    for name, make in STYLES.items():
        expected = make()
        try:
            bars = bars_in_process(expected.content.encode())
        except MeshError as error:
            print(f"| {name} | {expected.bars} | refused: {str(error)[:120]} |")
            continue
        diameters = sorted({f"{bar.bar.diameter_m * 1000:.4g}" for bar in bars})
        lengths = sorted({f"{bar.bar.length_m:.5f}" for bar in bars})
        notes = sorted({note.code for bar in bars for note in bar.notes})
        diameter, length = f"{expected.diameter_m * 1000:.4g} mm", f"{expected.length_m:.5f} m"
        print(
            f"| {name} | {expected.bars} | {len(bars)} | {diameter} | {', '.join(diameters)} "
            f"| {length} | {', '.join(lengths)} | {', '.join(notes)} |"
        )


if __name__ == "__main__":
    main()
