"""Scores of a rendered dataset and of views in memory: exact results, references and rejected archives."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

import rebar_depth_bench
from rebar_depth_bench import DatasetError, SubmissionError, score
from rebar_depth_bench.data.codecs import encode_png
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows, truth_columns, truth_from_row
from rebar_depth_bench.scoring.groups import ViewTraits
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import interior, scored_pixels
from rebar_depth_bench.scoring.reference import (
    NO_REFERENCE,
    UNDEFINED,
    Errors,
    Reference,
    mean_reference,
    view_reference,
)
from rebar_depth_bench.scoring.score import Truth, ViewTruth, score_views
from rebar_depth_bench.submission.declaration import Declaration
from tests.damage import change_manifest, change_rows, copy_dataset, first_shard

Depths = dict[str, ndarray]
Archive = Callable[..., Path]


def test_ground_truth_scores_perfectly(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    [(config, table)] = score(archive_of(tiny_truth), tiny_root).tables.items()
    for metrics in (table.native, table.scaled):
        assert metrics == DepthMetrics(abs_rel=0.0, rmse_cm=0.0, mae_cm=0.0, delta1=1.0)
    assert (config, table.scale_median, table.coverage, table.ranked) == ("lattice", 1.0, 1.0, True)
    assert set(table.within_mm.values()) == {1.0}


def test_doubled_depth_is_corrected_by_scale(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    doubled = archive_of({view: 2 * depth for view, depth in tiny_truth.items()})
    table = score(doubled, tiny_root).tables["lattice"]
    assert table.native is not None
    assert (table["native.abs_rel"], table["native.delta1"], table.scale_median) == (1.0, 0.0, 0.5)
    assert table.scaled == DepthMetrics(abs_rel=0.0, rmse_cm=0.0, mae_cm=0.0, delta1=1.0)


def test_negative_predictions_have_null_metrics_and_rank_error_one(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    archive = archive_of({view: -depth - 1 for view, depth in tiny_truth.items()})
    content = json.loads(score(archive, tiny_root).to_json())
    table = content["tables"]["lattice"]
    assert (table["coverage"], table["views_scored"], table["ranked"], table["rank_error"]) == (0.0, 0, True, 1.0)
    assert set(table["native"].values()) == {None}
    assert table["scale_median"] is None
    assert set(table["within_mm"].values()) == {0.0}
    assert content["views"][0]["native"]["abs_rel"] is None
    assert table["reference"]["scaled_constant"] == {"abs_rel": None, "rmse_cm": None}
    assert table["reference"]["constant"]["abs_rel"] > 0


def test_score_agrees_with_independent_evaluation(
    tiny_truth: Depths, tiny_masks: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    """A tenth of the pixels have no prediction."""
    rng = np.random.default_rng(5)
    predictions = {
        view: (depth * rng.uniform(0.7, 1.6) + rng.normal(0, 0.01, depth.shape)).astype(np.float32)
        for view, depth in tiny_truth.items()
    }
    rows = []
    for view, prediction in predictions.items():
        prediction[rng.random(prediction.shape) < 0.1] = np.nan
        scored = interior(tiny_masks[view]) & (tiny_truth[view] > 0)
        valid = scored & ~np.isnan(prediction)
        z, p = tiny_truth[view][valid].astype(float), prediction[valid].astype(float)
        s = np.median(z) / np.median(p)
        native = [np.mean(np.abs(p - z) / z), 100 * np.sqrt(np.mean((p - z) ** 2)), 100 * np.mean(np.abs(p - z))]
        delta1, share = np.mean(np.maximum(p / z, z / p) < 1.25), valid.sum() / scored.sum()
        ranked = share * np.mean(1 - np.minimum(p / z, z / p)) + 1 - share
        within = share * np.mean(np.abs(p - z) <= 0.01)
        rows.append([*native, delta1, np.mean(np.abs(s * p - z) / z), within, share, ranked, s])
    table = score(archive_of(predictions), tiny_root).tables["lattice"]
    assert table.native is not None
    assert table.scaled is not None
    errors = [table["native.abs_rel"], table["native.rmse_cm"], table["native.mae_cm"], table["native.delta1"]]
    found = [*errors, table["scaled.abs_rel"], table.within_mm[10], table.coverage, table.rank_error]
    assert found == pytest.approx(np.mean(rows, axis=0)[:-1].tolist(), rel=1e-12)
    assert table.scale_median == pytest.approx(np.median([row[-1] for row in rows]), rel=1e-12)


@pytest.mark.slow
def test_json_is_identical_for_workers_and_command_line(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = archive_of({view: 1.1 * depth for view, depth in tiny_truth.items()})
    one_worker, four_workers = (score(archive, tiny_root, workers=workers).to_json() for workers in (1, 4))
    assert one_worker == four_workers
    target = tmp_path / "result.json"
    command = ["rebar-bench", "score", str(archive), "--data", str(tiny_root), "--json", str(target)]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit, match="0"):
        runpy.run_module("rebar_depth_bench", run_name="__main__")
    assert target.read_bytes() == one_worker


def damaged(archive: Path, ends: tuple[str, ...]) -> Path:
    """Write a copy of an archive in which the entries that end with one of ``ends`` are cut off."""
    bad = archive.with_name("bad.zip")
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(name, content[:-7] if name.endswith(ends) else content)
    return bad


def test_damaged_entries_reject_whole_archive(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    with pytest.raises(SubmissionError) as caught:
        score(damaged(archive_of(tiny_truth), ("0.npy", "5.npy")), tiny_root)
    expected = [("size", f"{view}.npy") for view in sorted(tiny_truth) if view[-1] in "05"]
    assert [(problem.code, problem.where) for problem in caught.value.problems] == expected


def test_damaged_entry_of_a_view_without_scored_pixels_rejects_the_archive(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    root = copy_dataset(tiny_root, tmp_path / "copy")
    config = open_folder(root).config("lattice")
    no_steel = {"bytes": encode_png(np.zeros(config.grid, bool)), "path": None}
    change_rows(first_shard(root, "lattice"), lambda rows: rows[1].update(left_mask=no_steel))
    _, row, *_ = iterate_rows(config, truth_columns("left"))
    record = {"left": truth_from_row(row, "left").digest(), "steel_px": 0, "scored_px": 0}
    change_manifest(root, lambda _, entry: entry["views"][1].update(record))
    archive, hidden = archive_of(tiny_truth), config.view_ids[1]
    assert hidden not in {view.view_id for view in score(archive, root).views}
    with pytest.raises(SubmissionError) as caught:
        score(damaged(archive, (f"{hidden}.npy",)), root)
    assert [problem.where for problem in caught.value.problems] == [f"{hidden}.npy"]


def test_damaged_ground_truth_names_view(
    tiny_root: Path, tiny_truth: Depths, archive_of: Archive, tmp_path: Path
) -> None:
    copy = copy_dataset(tiny_root, tmp_path / "copy")
    change_manifest(copy, lambda _, config: config["views"][3].update(left="0" * 64))
    view_id = open_folder(copy).config("lattice").view_ids[3]
    with pytest.raises(DatasetError, match=f"view {view_id}: left ground truth has digest"):
        score(archive_of(tiny_truth), copy)


def independent_reference(depth_m: ndarray, is_scored: ndarray) -> list[float]:
    """Return the four errors of a view from whole images in float64."""
    image = depth_m.astype(np.float64)
    z = image[is_scored]
    errors = [np.abs(np.median(z) - z)]
    values = [float(np.mean(errors[0] / z)), float(100 * np.sqrt(np.mean(errors[0] ** 2)))]
    shifted = []
    for axis, step in ((1, 1), (1, -1), (0, 1), (0, -1)):
        neighbour = np.roll(image, step, axis)[is_scored]
        known = neighbour > 0
        if known.any():
            error = np.abs(neighbour[known] - z[known])
            shifted.append([np.mean(error / z[known]), 100 * np.sqrt(np.mean(error**2))])
    return [*values, *np.mean(shifted, axis=0).tolist()]


def test_tables_have_the_reference_errors_of_the_dataset(
    tiny_truth: Depths, tiny_masks: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    result = score(archive_of(tiny_truth), tiny_root)
    expected = []
    for view_id, depth_m in tiny_truth.items():
        is_scored = np.zeros(depth_m.size, bool)
        is_scored[scored_pixels(tiny_masks[view_id], depth_m)] = True
        expected.append(independent_reference(depth_m, is_scored.reshape(depth_m.shape)))
    found = result.to_dict()["tables"]["lattice"]["reference"]
    assert list(found) == ["constant", "one_pixel", "scaled_constant"]
    assert found["scaled_constant"] == found["constant"], "of complete predictions"
    numbers = [value for errors in (found["constant"], found["one_pixel"]) for value in errors.values()]
    assert numbers == pytest.approx(np.mean(expected, axis=0).tolist(), rel=1e-11)
    again = score(archive_of(tiny_truth), tiny_root)  # From the cache.
    assert again.to_json() == result.to_json()


def test_scaled_constant_is_on_the_predicted_pixels(
    tiny_truth: Depths, tiny_masks: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    """Predict the nearer half of each view, and nothing in the first view."""
    predictions: dict[str, ndarray] = {}
    expected = []
    for view_id, depth_m in tiny_truth.items():
        pixels = scored_pixels(tiny_masks[view_id], depth_m)
        near = depth_m <= np.median(depth_m.ravel()[pixels])
        predictions[view_id] = np.where(near & bool(predictions), 1.7 * depth_m, np.nan)
        z = depth_m.ravel()[pixels][near.ravel()[pixels]].astype(np.float64)
        error = np.abs(np.median(z) - z)
        expected.append((np.mean(error / z), 100 * np.sqrt(np.mean(error**2))))
    table = score(archive_of(predictions), tiny_root).to_dict()["tables"]["lattice"]
    found = table["reference"]["scaled_constant"]
    assert list(found.values()) == pytest.approx(np.mean(expected[1:], axis=0).tolist(), rel=1e-11)
    assert found["abs_rel"] < 0.8 * table["reference"]["constant"]["abs_rel"]


def test_neighbours_without_depth_are_skipped() -> None:
    depth_m = np.full((3, 3), 2.0, np.float32)
    depth_m[1, 0], depth_m[1, 2], depth_m[0, 1] = 1.0, 0.0, 0.0
    reference = view_reference(depth_m, np.array([4], np.uint32), 2.0)
    assert reference == (0.0, 0.0, 0.25, 50.0)
    alone = np.zeros((3, 3), np.float32)
    alone[1, 1] = 2.0
    undefined = view_reference(alone, np.array([4], np.uint32), 2.0)
    assert undefined == (0.0, 0.0, UNDEFINED, UNDEFINED)
    assert mean_reference([undefined]) == Reference(Errors(0.0, 0.0), Errors())
    assert mean_reference([reference, undefined]) == Reference(Errors(0.0, 0.0), Errors(0.25, 50.0))
    assert mean_reference([]) == NO_REFERENCE
    assert NO_REFERENCE.to_dict()["constant"] == {"abs_rel": None, "rmse_cm": None}


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
    assert (first["native.abs_rel"], first["native.mae_cm"]) == ((0 + 2 / 4) / 2, 100.0)
    assert (second.coverage, second.rank_error, second.native) == (0.0, 1.0, None)
    table = tables["a"]
    assert (table.views, table.views_scored, table.coverage, table.ranked) == (2, 1, 0.5, False)
    assert table.rank_error == (0.25 + 1) / 2
    assert table["reference.constant.abs_rel"] == ((3 - 2) / 2 + (4 - 3) / 4) / 2
    assert table.reference.scaled_constant == table.reference.constant


BIAS_FIELD = "    bias_mm: Annotated[float | None, PlainSerializer(rounded)] = None\n"
BIAS_CHANGES = (
    ("columns.py", "OTHERS: tuple[Column, ...] = ()", 'OTHERS = (Column("bias_mm", "bias", "mm", decimals=1),)'),
    ("table.py", "    Field,\n", "    Field,\n    PlainSerializer,\n"),
    ("table.py", "    scaled_constant: Annotated[", f"{BIAS_FIELD}    scaled_constant: Annotated["),
    ("table.py", "    reference: Reference\n", f"{BIAS_FIELD}    reference: Reference\n"),
    (
        "score.py",
        "scaled_constant=constant",
        "bias_mm=1000 * np.mean(p_m - z_m.astype(float)), scaled_constant=constant",
    ),
    (
        "score.py",
        "scale_median=statistics",
        "bias_mm=mean([view.bias_mm for view in predicted]), scale_median=statistics",
    ),
)
"""Changes of three files that add a signed number outside the depth metrics: old and new text."""

SCORE = """
import csv, io, json
from dataclasses import replace
from rich.console import Console
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.spreadsheet import frame_csv
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.scoring.score import score_views
from tests.bench.reporting.results import result as result_of
from tests.bench.scoring.test_scoring import DEPTH_M, truth_in_memory

truth = truth_in_memory(tuple(f"a/{12 * n:04}" for n in range(10)))
tables, views = score_views([("a", truth)], lambda view_id: DEPTH_M - 0.002 - int(view_id[2:]) / 1e6)
result = replace(result_of(), tables=tables, views=views)
written = result.to_json()
assert read_result(written, "x").to_json() == written
[row] = csv.DictReader(io.StringIO(frame_csv(result.to_pandas())))
[compared] = [row for row in compare(result, result).to_dict()["configs"]["a"] if row["name"] == "bias_mm"]
terminal = io.StringIO()
print_table(result, Console(file=terminal, width=200))
shown = [terminal.getvalue(), latex_table([result], published=False, intervals=True), render_report(result, [])]
print(json.dumps([json.loads(written), row, compared, shown]))
"""


@pytest.mark.slow
def test_signed_number_with_interval_is_added_in_three_files(tmp_path: Path) -> None:
    package = Path(rebar_depth_bench.__file__).parent
    shutil.copytree(package, tmp_path / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    for name, old, new in BIAS_CHANGES:
        path = tmp_path / package.name / "scoring" / name
        content = path.read_text()
        assert content.count(old) == 1, (name, old)
        path.write_text(content.replace(old, new))
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{package.parent}"}
    finished = subprocess.run(
        [sys.executable, "-c", SCORE], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    document, row, compared, shown = json.loads(finished.stdout)
    table = document["tables"]["a"]
    assert document["views"][0]["bias_mm"] == pytest.approx(-2, abs=0.001)
    assert table["bias_mm"] == pytest.approx(-2.054, abs=0.001)
    low, high = table["ci95"]["bias_mm"]
    assert low < table["bias_mm"] < high
    assert [float(row[f"bias_mm{end}"]) for end in ("", "_low", "_high")] == [table["bias_mm"], low, high]
    assert compared["verdict"] == "", "neither direction of a signed number is better"
    assert all("bias" in text and "-2.1" in text for text in shown)
    assert "[-2.1, -2.0]" in shown[1], "LaTeX has the interval"
