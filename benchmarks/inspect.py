"""Seconds and memory that ``rebar-build inspect`` needs for IFC models with many bars.

python -m benchmarks.inspect [BARS]

The models are written as programs export them: one object per bar, swept along a composite curve of trimmed lines
and circles (Revit), and objects of 40 mapped items each (Tekla). The bars are stirrups with four bends, 0.2 m
apart in columns of 100. CPU seconds are those of the command and its reading process together, peak memory is that
of the larger of both.
"""

from __future__ import annotations

import math
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import ifcopenshell

from benchmarks.timing import machine_description, print_markdown

Numbers = tuple[float, ...]
_LEVELS = 100
"""Stirrups of a column."""
_ITEMS = 40
"""Mapped items of an object."""
_COLUMNS_PER_ROW = 15
_LENGTH_MM = 3 * 300 + 2 * 100 + 4 * 30 * math.pi / 2
"""Length of a stirrup."""
_REFUSED_BY_BUILD = 2
"""Exit status of ``inspect`` for models that a build refuses, here because of their number of triangles."""


def main(bars: str = "20000") -> None:
    """Print a row for each style of writing."""
    print(f"{machine_description()}\n")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, items in (("one object per bar", 1), ("mapped items", _ITEMS)):
            path = Path(folder) / f"{name.replace(' ', '-')}.ifc"
            _model(int(bars), path, items=items)
            rows.append((name, bars, f"{path.stat().st_size / 1e6:.0f}", *_measured(path)))
    print_markdown(["style", "bars", "MB", "seconds", "CPU seconds", "peak memory, GB"], rows)


def _measured(scene: Path) -> tuple[str, str, str]:
    """Return wall-clock seconds, CPU seconds and peak memory (GB) of ``inspect`` with JSON and picture."""
    outputs = ["--json", str(scene.with_suffix(".json")), "--picture", str(scene.with_suffix(".png"))]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "dataset_builder", "inspect", str(scene), *outputs]
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if ended.returncode not in (0, _REFUSED_BY_BUILD):
        raise SystemExit(ended.stderr)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"{seconds:.1f}", f"{cpu_s:.1f}", f"{after.ru_maxrss / 1e6:.2f}"


def _position(bar: int) -> tuple[float, float, float]:
    """Return the place of a stirrup, millimetres."""
    column, level = divmod(bar, _LEVELS)
    row, place = divmod(column, _COLUMNS_PER_ROW)
    return 600.0 * place, 600.0 * row, 200.0 * level


def _stirrup(model: ifcopenshell.file) -> ifcopenshell.entity_instance:
    """Return a disc swept along a stirrup: four bends and two tails, lines and circles trimmed by parameters."""
    r, side, tail = 30.0, 300.0, 100.0
    pieces = [_line(model, (0, r + tail), (0, -1), tail)]
    corners = [((r, r), 180, (r, 0), (1, 0)), ((r + side, r), 270, (2 * r + side, r), (0, 1))]
    corners += [((r + side, r + side), 0, (r + side, 2 * r + side), (-1, 0))]
    corners += [((r, r + side), 90, (0, r + side), (0, -1))]
    for centre, first_deg, start, along in corners:
        circle = model.createIfcCircle(_placement(model, (*centre, 0)), r)
        pieces.append(_trimmed(model, circle, first_deg, first_deg + 90))
        pieces.append(_line(model, start, along, tail if first_deg == 90 else side))
    segments = [model.createIfcCompositeCurveSegment("CONTINUOUS", True, piece) for piece in pieces]
    curve = model.createIfcCompositeCurve(segments, False)
    return model.createIfcSweptDiskSolid(curve, 5.0, None, 0.0, 3 * side + 2 * tail + 4 * 90.0)


def _line(model: ifcopenshell.file, start: Numbers, along: Numbers, length: float) -> ifcopenshell.entity_instance:
    vector = model.createIfcVector(model.createIfcDirection((*map(float, along), 0.0)), 1.0)
    return _trimmed(model, model.createIfcLine(_point(model, (*start, 0)), vector), 0, length)


def _trimmed(
    model: ifcopenshell.file, basis: ifcopenshell.entity_instance, first: float, last: float
) -> ifcopenshell.entity_instance:
    ends = [[model.create_entity("IfcParameterValue", float(value))] for value in (first, last)]
    return model.createIfcTrimmedCurve(basis, *ends, True, "PARAMETER")


def _point(model: ifcopenshell.file, place: Numbers) -> ifcopenshell.entity_instance:
    return model.createIfcCartesianPoint(tuple(map(float, place)))


def _placement(model: ifcopenshell.file, place: Numbers) -> ifcopenshell.entity_instance:
    return model.createIfcAxis2Placement3D(_point(model, place), None, None)


def _model(bars: int, path: Path, *, items: int) -> None:
    """Write a model of objects with a stirrup each, or with ``items`` > 1 mapped ones; millimetres, degrees."""
    model = ifcopenshell.file(schema="IFC2X3")
    context = model.createIfcGeometricRepresentationContext(None, "Model", 3, 1e-5, _placement(model, (0, 0, 0)))
    radian = model.createIfcSIUnit(None, "PLANEANGLEUNIT", None, "RADIAN")
    size = model.createIfcMeasureWithUnit(model.create_entity("IfcPlaneAngleMeasure", math.pi / 180), radian)
    exponents = model.createIfcDimensionalExponents(*(0,) * 7)
    degree = model.createIfcConversionBasedUnit(exponents, "PLANEANGLEUNIT", "DEGREE", size)
    millimetre = model.createIfcSIUnit(None, "LENGTHUNIT", "MILLI", "METRE")
    units = model.createIfcUnitAssignment([millimetre, degree])
    model.createIfcProject(f"{0:022d}", None, "P", None, None, None, None, [context], units)
    for first in range(0, bars, items):
        places = [_position(bar) for bar in range(first, min(first + items, bars))]
        shape = model.createIfcShapeRepresentation(context, "Body", "AdvancedSweptSolid", [_stirrup(model)])
        if items > 1:
            source = model.createIfcRepresentationMap(_placement(model, (0, 0, 0)), shape)
            targets = [
                model.createIfcCartesianTransformationOperator3D(None, None, _point(model, place), 1.0, None)
                for place in places
            ]
            mapped = [model.createIfcMappedItem(source, target) for target in targets]
            shape = model.createIfcShapeRepresentation(context, "Body", "MappedRepresentation", mapped)
        place = model.createIfcLocalPlacement(None, _placement(model, (0, 0, 0) if items > 1 else places[0]))
        body = model.createIfcProductDefinitionShape(None, None, [shape])
        head = (f"{first + 1:022d}", None, "Bar", None, None, place, body, "T1", None)
        model.createIfcReinforcingBar(*head, 10.0, None, _LENGTH_MM, "MAIN", None)
    model.write(str(path))


if __name__ == "__main__":
    main(*sys.argv[1:])
