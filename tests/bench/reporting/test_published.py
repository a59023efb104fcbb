"""Published results of the paper: values and scenes."""

from __future__ import annotations

import json
from importlib.resources import files

import pytest

from rebar_depth_bench.reporting.published import load_published, published_rows

# Table I of the paper, transcribed independently of published.json; columns: lattice, disordered, pier.
TABLE_1 = """
FoundationStereo 1.13 0.021 0.022 1.00 1.53 0.009 0.010 1.00 312.8 0.105 0.103 0.97
COLMAP+ArUco 1.60 0.021 0.028 1.01 2.03 0.012 0.011 1.00 206.7 0.078 0.083 0.98
Metric3D_v2 20.09 0.750 0.061 0.63 20.46 0.275 0.058 1.36 1143 0.888 0.186 12.58
Depth_Pro 91.19 3.145 0.029 0.25 15.46 0.262 0.043 0.92 1151 0.901 0.179 12.17
Depth_Anything_3_Metric 96.93 3.469 0.043 0.23 35.31 0.644 0.051 0.72 1073 0.832 0.147 6.60
UniDepth_v2 151.5 5.883 0.030 0.16 18.52 0.264 0.038 1.25 869.4 0.654 0.154 3.16
"""
TABLE_2 = """
Depth_Anything_3_Metric 31.6 0.62 0.201 0.64 57.2 0.95 0.265 0.54
Depth_Pro 42.8 0.90 0.185 0.61 59.7 0.98 0.231 0.60
UniDepth_v2 45.8 0.98 0.152 0.56 63.4 1.07 0.186 0.56
Metric3D_v2 58.7 1.40 0.253 0.49 72.0 1.54 0.328 0.49
"""


@pytest.mark.parametrize(("scene", "column"), [("lattice", 1), ("pile", 5), ("pier", 9)])
def test_table_1_matches_paper(scene: str, column: int) -> None:
    expected = [line.split() for line in TABLE_1.split("\n") if line]
    rows = published_rows(scene)
    assert [row.method.replace(" ", "_") for row in rows] == [line[0] for line in expected]
    for row, line in zip(rows, expected, strict=True):
        values = [row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale]
        assert values == line[column : column + 4]
        assert row.median_anchored == (scene == "pier" and row.method == "COLMAP+ArUco")


def test_table_2_and_text_figures_match_paper() -> None:
    published = load_published()
    expected = [line.split() for line in TABLE_2.split("\n") if line]
    for column, (name, covered) in zip(
        (1, 5), {"FoundationStereo": "80.3", "COLMAP": "44.4"}.items(), strict=True
    ):
        reference = published.references[name]
        assert reference.coverage_percent == covered
        rows = [[row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale] for row in reference.rows]
        assert rows == [line[column : column + 4] for line in expected]
    kitti = {row.method: (row.abs_rel, row.rmse_m, row.delta1) for row in published.kitti}
    assert kitti == {
        "Metric3D v2": ("0.0926", None, None),
        "UniDepth v2": (None, "3.96", "0.926"),
        "Depth Anything 3 Metric": ("0.1196", None, None),
        "Depth Pro": ("0.1386", None, None),
    }
    stored = json.loads(files("rebar_depth_bench.reporting").joinpath("published.json").read_text("utf-8"))
    names = ("one_view_scale_within_percent", "rmse_cm_6_markers", "rmse_cm_12_markers")
    assert [stored["anchor"][name] for name in names] == ["0.15", "1.60", "1.69"]


def test_parts_state_place_and_origin() -> None:
    published = load_published()
    assert published.title.startswith("Benchmarking Metric Depth for Construction Perception")
    assert {name: part.place for name, part in published.parts.items()} == {
        "synthetic": "Table I",
        "physical": "Table II",
        "kitti": "Sec. III.A",
        "anchor": "Sec. III.C",
    }
    renders = "measured on the authors' renders, which are not the renders of this dataset"
    assert published.parts["synthetic"].mark == published.parts["anchor"].mark == renders
    assert all("authors" in part.mark for part in published.parts.values())
