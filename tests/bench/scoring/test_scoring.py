"""Scores of a rendered dataset and of views in memory: exact results, references and rejected archives."""

from __future__ import annotations

import json
import math
import runpy
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from rebar_depth_bench import DatasetError, SubmissionError, score
from rebar_depth_bench.data.codecs import encode_png
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows, truth_columns, truth_from_row
from rebar_depth_bench.scoring.columns import METRICS, WITHIN
from rebar_depth_bench.scoring.groups import ViewTraits
from rebar_depth_bench.scoring.protocol import interior, scored_pixels
from rebar_depth_bench.scoring.reference import UNDEFINED, references, view_reference
from rebar_depth_bench.scoring.table import Frame, Truth, tabulate
from rebar_depth_bench.scoring.view_numbers import ViewTruth, view_numbers
from rebar_depth_bench.submission.declaration import Declaration
from tests.damage import change_manifest, change_rows, copy_dataset, first_shard

Depths = dict[str, ndarray]
Archive = Callable[..., Path]


def test_ground_truth_scores_perfectly(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    [(config, table)] = score(archive_of(tiny_truth), tiny_root).tables.items()
    for alignment in ("native", "scaled"):
        assert [table[f"{alignment}.{name}"] for name in METRICS] == [0.0, 0.0, 0.0, 1.0]
    assert (config, table["scale_median"], table["coverage"], table.ranked) == ("lattice", 1.0, 1.0, True)
    assert {table[column.place] for column in WITHIN} == {1.0}


def test_doubled_depth_is_corrected_by_scale(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    doubled = archive_of({view: 2 * depth for view, depth in tiny_truth.items()})
    table = score(doubled, tiny_root).tables["lattice"]
    assert (table["native.abs_rel"], table["native.delta1"], table["scale_median"]) == (1.0, 0.0, 0.5)
    assert [table[f"scaled.{name}"] for name in METRICS] == [0.0, 0.0, 0.0, 1.0]


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
    errors = [table["native.abs_rel"], table["native.rmse_cm"], table["native.mae_cm"], table["native.delta1"]]
    found = [*errors, table["scaled.abs_rel"], table["within_mm.10"], table["coverage"], table["rank_error"]]
    assert found == pytest.approx(np.mean(rows, axis=0)[:-1].tolist(), rel=1e-12)
    assert table["scale_median"] == pytest.approx(np.median([row[-1] for row in rows]), rel=1e-12)


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
    frame = Frame.of_rows({"a/0000": references(reference), "a/0001": references(undefined)})
    mean = tabulate(frame, truth_in_memory(frame.view_ids)).to_dict()["reference"]
    assert mean["constant"] == {"abs_rel": 0.0, "rmse_cm": 0.0}
    assert mean["one_pixel"] == {"abs_rel": 0.25, "rmse_cm": 50.0}, "of the view that has neighbours"
    assert mean["scaled_constant"] == {"abs_rel": None, "rmse_cm": None}


MASK = np.array([[0, 0, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1], [1, 1, 1, 1]], bool)
DEPTH_M = np.array([[0, 0, 0, 0], [1, 1, 1, 1], [1, 2.0, 4.0, 1], [1, 1, 1, 1]], np.float32)
"""A view of 4 x 4 pixels, of which two are scored: those of 2 m and 4 m depth."""


def truth_in_memory(view_ids: tuple[str, ...], split: str | None = None) -> Truth:
    """Return the ground truth of views that all show ``DEPTH_M``."""
    pixels = scored_pixels(MASK, DEPTH_M)
    return Truth(
        view_ids=view_ids,
        views=[ViewTruth(view_id, pixels, DEPTH_M.ravel()[pixels], 3.0) for view_id in view_ids],
        references=[references(view_reference(DEPTH_M, pixels, 3.0))] * len(view_ids),
        traits=[ViewTraits("wall", 3.0, None)] * len(view_ids),
        split=split,
    )


def test_score_of_two_pixels_by_hand() -> None:
    truth = truth_in_memory(("a/0000", "a/0001"))
    predictions = (np.full((4, 4), 2.0), np.full((4, 4), np.nan))
    rows = [view_numbers(prediction, view) for prediction, view in zip(predictions, truth.views, strict=True)]
    frame = Frame.of_rows({
        view_id: {**row, **reference}
        for view_id, row, reference in zip(truth.view_ids, rows, truth.references, strict=True)
    })  # fmt: skip
    first, second = frame.views()
    assert (first["scored_px"], first["coverage"], first["scale"]) == (2, 1.0, 1.5)
    assert first["rank_error"] == (0 + (4 - 2) / 4) / 2
    assert (first["native.abs_rel"], first["native.mae_cm"]) == ((0 + 2 / 4) / 2, 100.0)
    assert (second["coverage"], second["rank_error"]) == (0.0, 1.0)
    assert math.isnan(second["native.abs_rel"])
    table = tabulate(frame, truth, declaration=Declaration(uses_ground_truth=True))
    assert (table.views, table.views_scored, table["coverage"], table.ranked) == (2, 1, 0.5, False)
    assert table["rank_error"] == (0.25 + 1) / 2
    assert table["reference.constant.abs_rel"] == ((3 - 2) / 2 + (4 - 3) / 4) / 2
    assert table["reference.scaled_constant.abs_rel"] == table["reference.constant.abs_rel"]
