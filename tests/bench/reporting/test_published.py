"""Published results of the paper: values and scenes."""

from __future__ import annotations

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


@pytest.mark.parametrize(("scene", "column"), [("lattice", 1), ("pile", 5), ("pier", 9)])
def test_table_1_matches_paper(scene: str, column: int) -> None:
    expected = [line.split() for line in TABLE_1.split("\n") if line]
    rows = published_rows(scene)
    assert [row.method.replace(" ", "_") for row in rows] == [line[0] for line in expected]
    for row, line in zip(rows, expected, strict=True):
        values = [row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale]
        assert values == line[column : column + 4]
        assert row.median_anchored == (scene == "pier" and row.method == "COLMAP+ArUco")


def test_parts_state_place_and_origin() -> None:
    published = load_published()
    assert published.title.startswith("Benchmarking Metric Depth for Construction Perception")
    assert {name: part.place for name, part in published.parts.items()} == {"synthetic": "Table I"}
    renders = "measured on the authors' renders, which are not the renders of this dataset"
    assert published.parts["synthetic"].mark == renders
