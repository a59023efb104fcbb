"""STEP text of small IFC files, written without an IFC library."""

from __future__ import annotations

import math
from collections.abc import Sequence

Numbers = Sequence[float]
METRES, MILLIMETRES, FEET, INCHES, RADIANS, GRADS = "m", "mm", "ft", "in", "mm rad", "mm gon"
_METRE = {"m": 1.0, "mm": 0.001, "ft": 0.3048, "in": 0.0254, "mm rad": 0.001, "mm gon": 0.001}
_ANGLE = {"mm rad": 1.0, "mm gon": math.pi / 200}


class Step:
    """IFC file under construction; coordinates are in its unit, and sizes of bars are declared in metres."""

    def __init__(self, units: str, schema: str) -> None:
        self.schema, self.metre = schema, _METRE[units]
        self.angle = _ANGLE.get(units, math.pi / 180)
        self._lines: list[str] = []
        self._rooted = 0
        self.axes = self.add(f"IFCAXIS2PLACEMENT3D({self.point((0, 0, 0))},$,$)")
        self.context = self.add(f"IFCGEOMETRICREPRESENTATIONCONTEXT($,'Model',3,1.E-5,{self.axes},$)")
        prefix = ".MILLI." if self.metre == 0.001 else "$"
        length = self.add(f"IFCSIUNIT(*,.LENGTHUNIT.,{prefix},.METRE.)")
        if units in (FEET, INCHES):
            length = self._conversion(".LENGTHUNIT.", "IFCLENGTHMEASURE", self.metre, length)
        angle = self.add("IFCSIUNIT(*,.PLANEANGLEUNIT.,$,.RADIAN.)")
        if self.angle != 1.0:
            angle = self._conversion(".PLANEANGLEUNIT.", "IFCPLANEANGLEMEASURE", self.angle, angle)
        assignment = self.add(f"IFCUNITASSIGNMENT(({length},{angle}))")
        self.add(f"IFCPROJECT({self._root()},'P',$,$,$,$,({self.context}),{assignment})")

    def add(self, instance: str) -> str:
        self._lines.append(f"#{len(self._lines) + 1}={instance};\n")
        return f"#{len(self._lines)}"

    def text(self) -> str:
        header = (
            "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\n"
            f"FILE_NAME('','',(''),(''),'','','');\nFILE_SCHEMA(('{self.schema}'));\nENDSEC;\nDATA;\n"
        )
        return f"{header}{''.join(self._lines)}ENDSEC;\nEND-ISO-10303-21;\n"

    def _root(self) -> str:
        self._rooted += 1
        return f"'{self._rooted:022d}',$"

    def _conversion(self, kind: str, measure: str, factor: float, base: str) -> str:
        size = self.add(f"IFCMEASUREWITHUNIT({measure}({factor!r}),{base})")
        dimensions = self.add("IFCDIMENSIONALEXPONENTS(0,0,0,0,0,0,0)")
        return self.add(f"IFCCONVERSIONBASEDUNIT({dimensions},{kind},'UNIT',{size})")

    def point(self, xyz: Numbers) -> str:
        return self.add(f"IFCCARTESIANPOINT(({','.join(repr(float(v)) for v in xyz)}))")

    def points(self, *rows: Numbers) -> str:
        text = ",".join(f"({','.join(repr(float(v)) for v in row)})" for row in rows)
        return self.add(f"IFCCARTESIANPOINTLIST3D(({text}))")

    def direction(self, xyz: Numbers) -> str:
        return self.add(f"IFCDIRECTION(({','.join(repr(float(v)) for v in xyz)}))")

    def placement(self, xyz: Numbers) -> str:
        return self.add(f"IFCAXIS2PLACEMENT3D({self.point(xyz)},$,$)")

    def polyline(self, *points: Numbers) -> str:
        return self.add(f"IFCPOLYLINE(({','.join(self.point(p) for p in points)}))")

    def line(self, start: Numbers, along: Numbers, length: float) -> str:
        vector = self.add(f"IFCVECTOR({self.direction(along)},1.)")
        line = self.add(f"IFCLINE({self.point(start)},{vector})")
        return self._trimmed(line, 0.0, length)

    def circle(self, centre: Numbers, radius: float) -> str:
        return self.add(f"IFCCIRCLE({self.placement(centre)},{radius!r})")

    def arc(self, centre: Numbers, radius: float, first_rad: float, last_rad: float) -> str:
        first, last = (round(angle / self.angle, 9) for angle in (first_rad, last_rad))
        return self._trimmed(self.circle(centre, radius), first, last)

    def _trimmed(self, basis: str, first: float, last: float) -> str:
        trims = ",".join(f"(IFCPARAMETERVALUE({value!r}))" for value in (first, last))
        return self.add(f"IFCTRIMMEDCURVE({basis},{trims},.T.,.PARAMETER.)")

    def composite(self, *curves: str) -> str:
        segments = [self.add(f"IFCCOMPOSITECURVESEGMENT(.CONTINUOUS.,.T.,{curve})") for curve in curves]
        return self.add(f"IFCCOMPOSITECURVE(({','.join(segments)}),.F.)")

    def disc(self, curve: str, radius: float, start: object, end: object) -> str:
        return self.add(f"IFCSWEPTDISKSOLID({curve},{radius!r},$,{start},{end})")

    def shape(self, items: Sequence[str], kind: str = "AdvancedSweptSolid") -> str:
        return self.add(f"IFCSHAPEREPRESENTATION({self.context},'Body','{kind}',({','.join(items)}))")

    def mapped(self, items: Sequence[str], origins: Sequence[Numbers], scale: float = 1.0) -> list[str]:
        source = self.add(f"IFCREPRESENTATIONMAP({self.axes},{self.shape(items)})")
        kind = "IFCCARTESIANTRANSFORMATIONOPERATOR3D"
        targets = [self.add(f"{kind}($,$,{self.point(origin)},{scale!r},$)") for origin in origins]
        return [self.add(f"IFCMAPPEDITEM({source},{target})") for target in targets]

    def _product(self, items: Sequence[str] | None, at: Numbers) -> str:
        placement = self.add(f"IFCLOCALPLACEMENT($,{self.placement(at)})")
        if items is None:
            return f"{self._root()},'Bar',$,$,{placement},$,'T1',$"
        body = self.add(f"IFCPRODUCTDEFINITIONSHAPE($,$,({self.shape(items)}))")
        return f"{self._root()},'Bar',$,$,{placement},{body},'T1',$"

    def _size(self, size_m: float | None) -> str:
        return "$" if size_m is None else repr(size_m / self.metre)

    def bar(
        self,
        items: Sequence[str] | None,
        diameter_m: float | None,
        length_m: float | None,
        at: Numbers = (0, 0, 0),
    ) -> str:
        sizes = f"{self._size(diameter_m)},$,{self._size(length_m)}"
        return self.add(f"IFCREINFORCINGBAR({self._product(items, at)},{sizes},.MAIN.,$)")

    def mesh(self, items: Sequence[str], diameter_m: float) -> str:
        size, last = self._size(diameter_m), "" if self.schema == "IFC2X3" else ",$"
        return self.add(f"IFCREINFORCINGMESH({self._product(items, (0, 0, 0))},$,$,{size},{size},$,$,$,${last})")

    def tendon(self, items: Sequence[str], diameter_m: float) -> str:
        sizes = f"{self._size(diameter_m)},$,$,$,$,$,$"
        return self.add(f"IFCTENDON({self._product(items, (0, 0, 0))},.STRAND.,{sizes})")

    def bar_type(self, items: Sequence[str], diameter_m: float, length_m: float) -> str:
        source = self.add(f"IFCREPRESENTATIONMAP({self.axes},{self.shape(items)})")
        sizes = f"{self._size(diameter_m)},$,{self._size(length_m)}"
        return self.add(f"IFCREINFORCINGBARTYPE({self._root()},'T',$,$,$,({source}),$,$,.MAIN.,{sizes},$,$,$)")

    def typed(self, kind: str, objects: Sequence[str]) -> str:
        return self.add(f"IFCRELDEFINESBYTYPE({self._root()},$,$,({','.join(objects)}),{kind})")
