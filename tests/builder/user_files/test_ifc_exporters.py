"""IFC files as programs export them: number, diameter and length of their bars, notes, and refusals."""

from __future__ import annotations

import io

import numpy as np
import pytest

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.specs.file_specs import Trust
from dataset_builder.user_files.ifc_file import Answer
from dataset_builder.user_files.ifc_reader import bars as reader_bars
from dataset_builder.user_files.ifc_reader.__main__ import write_answer
from rebar_depth_bench.base.errors import MeshError
from tests.builder.scene.cages import assembly_of
from tests.builder.user_files.ifc_exporters import STYLES, revit, u_curve
from tests.builder.user_files.ifc_step_text import METRES, MILLIMETRES, Step
from tests.builder.user_files.ifc_writer import bars_in_process, checked_bars


def read(content: str, trust: Trust = "declared") -> list[CageBar]:
    stream = io.BytesIO()
    write_answer(content.encode(), stream)
    stream.seek(0)
    return checked_bars(Answer(stream, "a.ifc", trust))


@pytest.mark.parametrize("name", STYLES)
def test_bars_of_style_are_exact(name: str) -> None:
    style = STYLES[name]()
    bars = bars_in_process(style.content.encode())
    assert len(bars) == style.bars
    assert all(bar.mesh is None for bar in bars)
    # Arcs are sampled every 6 degrees, which shortens them by less than 0.05 %.
    np.testing.assert_allclose([bar.bar.length_m for bar in bars], style.length_m, rtol=5e-4)
    np.testing.assert_allclose([bar.bar.diameter_m for bar in bars], style.diameter_m, rtol=1e-9)
    assert {note.code for bar in bars for note in bar.notes} == set(style.notes)


def test_units_give_same_bar() -> None:
    metres, millimetres = (
        read(revit(units, end).content)[0].bar for units, end in [(METRES, 181.0), (MILLIMETRES, 1180.0)]
    )
    offset_m = np.array((38000.0, 41000.0, 12.0)) * 0.999
    np.testing.assert_allclose(np.array(metres.axis_m) - offset_m, millimetres.axis_m, atol=1e-9)


def test_bars_name_their_object_and_roles_their_class() -> None:
    [u] = read(revit(MILLIMETRES, 1180.0).content)
    assert u.source == "0" * 21 + "2"
    assert u.bar.role == "main"
    assert {bar.bar.role for bar in read(STYLES["Fabric, reinforcing mesh of 40 discs"]().content)} == {"mesh"}
    assert [bar.bar.role for bar in read(STYLES["Tendon, B-spline"]().content)] == ["tendon"]


@pytest.mark.parametrize("end", [0.0, -1.0])
def test_parameters_that_are_not_on_the_curve_are_refused(end: float) -> None:
    with pytest.raises(MeshError, match=r"IfcReinforcingBar 0+2 .*is swept from 0.0 to"):
        read(revit(MILLIMETRES, end).content)


def straight_bar(radius: float, diameter_m: float | None) -> str:
    step = Step(MILLIMETRES, "IFC4")
    step.bar([step.disc(step.polyline((0, 0, 0), (1000, 0, 0)), radius, "$", "$")], diameter_m, None)
    return step.text()


def test_diameter_far_from_the_declared_one_is_refused_or_trusted() -> None:
    content = straight_bar(9.5, 0.012)
    with pytest.raises(MeshError, match="19 mm in the geometry, 12 mm as declared") as caught:
        read(content)
    assert [problem.code for problem in caught.value.problems] == ["invalid"]
    [bar] = read(content, "geometry")
    assert bar.bar.diameter_m == 0.019
    assert [note.code for note in bar.notes] == ["diameter"]


@pytest.mark.parametrize(
    ("radius", "codes"), [(6.2, []), (6.4, ["diameter"]), (5.6, ["diameter"]), (7.4, ["diameter"])]
)
def test_small_differences_of_the_diameter_are_noted(radius: float, codes: list[str]) -> None:
    [bar] = read(straight_bar(radius, 0.012))
    assert [note.code for note in bar.notes] == codes


def test_diameter_of_the_type_is_compared() -> None:
    step = Step(MILLIMETRES, "IFC4")
    disc = step.disc(step.polyline((0, 0, 0), (1000, 0, 0)), 10.0, "$", "$")
    kind = step.bar_type([disc], 0.040, 1.0)
    step.typed(kind, [step.bar(None, None, None)])
    with pytest.raises(MeshError, match="20 mm in the geometry, 40 mm as declared"):
        read(step.text())


def test_notes_reach_the_assembly_once() -> None:
    bars = read(straight_bar(6.4, 0.012))
    [note] = assembly_of(bars, "a.ifc").notes
    assert note.code == "diameter"
    assert "IfcReinforcingBar" in note.source


def test_gap_of_more_than_a_quarter_of_the_diameter_is_refused() -> None:
    step = Step(MILLIMETRES, "IFC4")
    curve = step.composite(step.line((0, 0, 0), (1, 0, 0), 499.0), step.line((503, 0, 0), (1, 0, 0), 499.0))
    step.bar([step.disc(curve, 6.0, "$", "$")], 0.012, None)
    with pytest.raises(MeshError, match="4 apart"):
        read(step.text())


def test_circular_curves_maps_and_units_are_refused() -> None:
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


def test_map_with_different_scales_is_refused() -> None:
    text = STYLES["Map with uniform scale 0.5"]().content
    text = text.replace("TIONOPERATOR3D(", "TIONOPERATOR3DNONUNIFORM(").replace(",0.5,$)", ",0.5,$,0.7,$)")
    with pytest.raises(MeshError, match=r"IfcReinforcingBar .*a map scales by 0.5, 0.7"):
        read(text)


def test_number_of_points_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    content = STYLES["Tekla, set of 12 mapped polylines, length"]().content
    monkeypatch.setattr(reader_bars, "MAX_POINTS", 20)
    with pytest.raises(MeshError, match=r"7 bars of 21 points .* expected at most"):
        read(content)


def test_ellipses_reversed_senses_and_trimmed_polylines() -> None:
    step = Step(MILLIMETRES, "IFC4")
    ellipse = step.add(f"IFCELLIPSE({step.axes},200.,100.)")
    quarter = step.add(
        f"IFCTRIMMEDCURVE({ellipse},(IFCPARAMETERVALUE(90.)),(IFCPARAMETERVALUE(0.)),.F.,.PARAMETER.)"
    )
    line = step.polyline((400, 0, 0), (300, 0, 0), (200, 0, 0))
    part = step.add(f"IFCTRIMMEDCURVE({line},(IFCPARAMETERVALUE(0.5)),(IFCPARAMETERVALUE(2.)),.T.,.PARAMETER.)")
    segments = ",".join(
        step.add(f"IFCCOMPOSITECURVESEGMENT(.CONTINUOUS.,{sense},{curve})")
        for sense, curve in [(".T.", quarter), (".F.", part)]
    )
    step.bar([step.disc(step.add(f"IFCCOMPOSITECURVE(({segments}),.F.)"), 6.0, "$", "$")], None, None)
    [bar] = read(step.text())
    axis_mm = np.array(bar.bar.axis_m) * 1000
    np.testing.assert_allclose(axis_mm[[0, -1]], [(0, 100, 0), (350, 0, 0)], atol=1e-9)
    on_ellipse = axis_mm[:16]
    np.testing.assert_allclose(np.hypot(on_ellipse[:, 0] / 200, on_ellipse[:, 1] / 100), 1, atol=1e-12)


def test_multiplied_curves_are_refused() -> None:
    step = Step(MILLIMETRES, "IFC4")
    curve = step.composite(step.line((0, 0, 0), (1, 0, 0), 500.0))
    for _ in range(12):
        curve = step.composite(*[curve] * 10)
    step.bar([step.disc(curve, 6.0, "$", "$")], None, None)
    with pytest.raises(MeshError, match="more than 10000 pieces"):
        read(step.text())
