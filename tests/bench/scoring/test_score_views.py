"""Tests of the arithmetic of a score alone: views in memory, without files, and numbers that are added to it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

import rebar_depth_bench
from rebar_depth_bench.scoring.groups import ViewTraits
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.reference import view_reference
from rebar_depth_bench.scoring.score import Truth, ViewTruth, score_views
from rebar_depth_bench.submission.declaration import Declaration

MASK = np.array([[0, 0, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]], bool)
DEPTH_M = np.array([[0, 0, 0, 0], [1, 1, 1, 1], [1, 2.0, 4.0, 1], [1, 1, 1, 1]], np.float32)
"""A view of 4 x 4 pixels, of which two are scored: those of 2 m and 4 m depth."""


def truth_in_memory(view_ids: tuple[str, ...], split: str | None = None) -> Truth:
    """Return the ground truth of views that all show ``DEPTH_M``."""
    pixels = scored_pixels(MASK, DEPTH_M)
    return Truth(
        view_ids=view_ids,
        read=lambda position: ViewTruth(view_ids[position], pixels, DEPTH_M.ravel()[pixels], 3.0),
        references=[view_reference(DEPTH_M, pixels, 3.0)] * len(view_ids),
        traits=[ViewTraits("wall", 3.0, None)] * len(view_ids),
        split=split,
    )


def test_score_of_two_pixels_by_hand() -> None:
    predicted: dict[str, ndarray] = {"a/0000": np.full((4, 4), 2.0), "a/0001": np.full((4, 4), np.nan)}
    truths = [("a", truth_in_memory(("a/0000", "a/0001")))]
    tables, views = score_views(truths, predicted.__getitem__, Declaration(uses_ground_truth=True))
    first, second = views
    assert (first.scored_px, first.coverage, first.scale) == (2, 1.0, 1.5)
    assert first.rank_error == (0 + (4 - 2) / 4) / 2
    assert first.native is not None
    assert (first.native.abs_rel, first.native.mae_cm) == ((0 + 2 / 4) / 2, 100.0)
    assert (second.coverage, second.rank_error, second.native) == (0.0, 1.0, None)
    table = tables["a"]
    assert (table.views, table.views_scored, table.coverage, table.ranked) == (2, 1, 0.5, False)
    assert table.rank_error == (0.25 + 1) / 2
    assert table.reference.constant.abs_rel == ((3 - 2) / 2 + (4 - 3) / 4) / 2
    assert table.reference.scaled_constant == table.reference.constant


def test_groups_are_those_of_a_config_with_splits() -> None:
    truth = truth_in_memory(("a/test-b-0000",), split="test")
    tables, _ = score_views([("a", truth)], lambda _: DEPTH_M)
    assert list(tables["a"].groups["family"]) == ["wall"]
    assert tables["a"].groups["distance"]["2-4 m"].rank_error == 0


BIAS = {
    "columns.py": {
        "OTHERS: tuple[Column, ...] = ()": """OTHERS = (Column("bias_mm", "bias", "mm", decimals=1),)""",
    },
    "table.py": {
        "    Field,\n": "    Field,\n    PlainSerializer,\n",
        "    scaled_constant: Annotated[": """    bias_mm: Annotated[float | None, PlainSerializer(rounded)] = None
    scaled_constant: Annotated[""",
        "    reference: Reference\n": """    bias_mm: Annotated[float | None, PlainSerializer(rounded)] = None
    reference: Reference
""",
    },
    "score.py": {
        "scaled_constant=constant or": """bias_mm=1000 * float(np.mean(p_m.astype(np.float64) - z_m)),
        scaled_constant=constant or""",
        "        published=published,\n": """        bias_mm=mean([view.bias_mm for view in predicted]),
        published=published,
""",
    },
}
"""Changes of three files that add a signed number outside the depth metrics: new text by old text."""

SCORE = """
import csv, io, json
from rich.console import Console
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.frames import differences_frame, frame_csv
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import (
    DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity, read_result
)
from rebar_depth_bench.scoring.score import score_views
from tests.bench.scoring.test_score_views import DEPTH_M, truth_in_memory

truth = truth_in_memory(tuple(f"a/{12 * n:04}" for n in range(10)))
dataset = DatasetIdentity("sha256:" + "0" * 64, "1")
submission, software = SubmissionIdentity("m", "0" * 64), SoftwareIdentity("1")
results = []
for shift_m in (-0.002, 0.003):
    read = lambda view_id: DEPTH_M + shift_m - int(view_id[2:]) / 1e6
    tables, views = score_views([("a", truth)], read)
    results.append(Result(dataset=dataset, submission=submission, software=software, tables=tables, views=views))
written = results[0].to_json()
assert read_result(written, "x").to_json() == written
[row] = csv.DictReader(io.StringIO(frame_csv(results[0].to_pandas())))
rows = csv.DictReader(io.StringIO(frame_csv(differences_frame([compare(*results).to_dict()]))))
terminal = io.StringIO()
print_table(results[0], Console(file=terminal, width=200))
shown = [terminal.getvalue(), latex_table(results, published=False, intervals=True), render_report(results[0], [])]
print(json.dumps([json.loads(written), row, next(row for row in rows if row["number"] == "bias_mm"), shown]))
"""


@pytest.mark.slow
def test_signed_number_with_interval_is_added_in_three_files(tmp_path: Path) -> None:
    package = Path(rebar_depth_bench.__file__).parent
    shutil.copytree(package, tmp_path / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name, changes in BIAS.items():
        path = tmp_path / package.name / "scoring" / name
        content = path.read_text()
        for old, new in changes.items():
            assert content.count(old) == 1, (name, old)
            content = content.replace(old, new)
        path.write_text(content)
    command = [sys.executable, "-c", SCORE]
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{package.parent}"}
    finished = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=120
    )
    assert finished.returncode == 0, finished.stderr
    document, row, difference, shown = json.loads(finished.stdout)
    table = document["tables"]["a"]
    assert document["views"][0]["bias_mm"] == pytest.approx(-2, abs=0.001)
    assert table["bias_mm"] == pytest.approx(-2.054, abs=0.001)
    low, high = table["ci95"]["bias_mm"]
    assert low < table["bias_mm"] < high
    assert [float(row[name]) for name in ("bias_mm", "bias_mm_low", "bias_mm_high")] == [
        table["bias_mm"],
        low,
        high,
    ]
    assert float(difference["difference"]) == pytest.approx(5, abs=0.001)
    assert difference["verdict"] == "", "neither direction of a signed number is better"
    for text in shown:
        assert "bias" in text
        assert "-2.1" in text
    assert "[-2.1, -2.0]" in shown[1], "LaTeX has the interval"
