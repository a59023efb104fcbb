"""Tests of ``score`` on a rendered dataset: exact results, determinism and rejected archives."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rebar_depth_bench import DatasetError, SubmissionError, score
from rebar_depth_bench.data.codecs import decode, encode_depth, encode_png
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows, truth_columns, truth_from_row
from rebar_depth_bench.scoring.columns import rounded
from rebar_depth_bench.scoring.protocol import interior
from rebar_depth_bench.scoring.score import ViewTruth, score_view, tabulate
from rebar_depth_bench.scoring.table import Table
from tests.damage import change_manifest, change_rows, first_shard
from tests.ground_truth import truth_of

Depths = dict[str, np.ndarray]
Archive = Callable[..., Path]


def lattice(archive: Path, root: Path) -> Table:
    return score(archive, root).tables["lattice"]


def test_ground_truth_scores_perfectly(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    table = lattice(archive_of(tiny_truth), tiny_root)
    assert table.native is not None
    for metrics in (table.native, table.scaled):
        assert metrics is not None
        assert (metrics.abs_rel, metrics.rmse_cm, metrics.mae_cm, metrics.delta1) == (0.0, 0.0, 0.0, 1.0)
    assert table.scale_median == 1.0
    assert table.coverage == 1.0
    assert table.ranked
    assert set(table.within_mm.values()) == {1.0}


def test_doubled_depth_is_corrected_by_scale(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    table = lattice(archive_of({view: 2 * depth for view, depth in tiny_truth.items()}), tiny_root)
    assert table.native is not None
    assert table.scaled is not None
    assert table.native.abs_rel == 1.0
    assert table.native.delta1 == 0.0
    assert table.scale_median == 0.5
    assert (table.scaled.abs_rel, table.scaled.rmse_cm, table.scaled.delta1) == (0.0, 0.0, 1.0)


def test_negative_predictions_have_null_metrics_and_rank_error_one(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    archive = archive_of({view: -depth - 1 for view, depth in tiny_truth.items()})
    content = json.loads(score(archive, tiny_root).to_json())
    table = content["tables"]["lattice"]
    assert table["coverage"] == 0.0
    assert table["views_scored"] == 0
    assert (table["ranked"], table["rank_error"]) == (True, 1.0)
    assert set(table["native"].values()) == {None}
    assert table["scale_median"] is None
    assert set(table["within_mm"].values()) == {0.0}
    assert content["views"][0]["native"]["abs_rel"] is None


def test_score_agrees_with_independent_evaluation(
    tiny_truth: Depths, tiny_masks: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    rng = np.random.default_rng(5)
    predictions = {
        view: (depth * rng.uniform(0.7, 1.6) + rng.normal(0, 0.01, depth.shape)).astype(np.float32)
        for view, depth in tiny_truth.items()
    }
    table = lattice(archive_of(predictions), tiny_root)
    rows = []
    for view, prediction in predictions.items():
        scored = interior(tiny_masks[view]) & (tiny_truth[view] > 0)
        z = tiny_truth[view][scored].astype(float)
        p = prediction[scored].astype(float)
        s = np.median(z) / np.median(p)
        rows.append(
            [
                np.mean(np.abs(p - z) / z),
                100 * np.sqrt(np.mean((p - z) ** 2)),
                100 * np.mean(np.abs(p - z)),
                np.mean(np.maximum(p / z, z / p) < 1.25),
                np.mean(np.abs(s * p - z) / z),
                np.mean(np.abs(p - z) <= 0.01),
                np.mean(1 - np.minimum(p / z, z / p)),
                s,
            ]
        )
    means = np.mean(rows, axis=0)
    assert table.native is not None
    assert table.scaled is not None
    native = [table.native.abs_rel, table.native.rmse_cm, table.native.mae_cm, table.native.delta1]
    others = [table.scaled.abs_rel, table.within_mm[10], table.rank_error]
    assert [*native, *others] == pytest.approx(means[:7].tolist(), rel=1e-12)
    assert table.scale_median == pytest.approx(np.median([row[7] for row in rows]), rel=1e-12)


@pytest.mark.slow
def test_json_is_identical_for_workers_and_command_line(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    archive = archive_of({view: 1.1 * depth for view, depth in tiny_truth.items()})
    one_worker, four_workers = (score(archive, tiny_root, workers=workers).to_json() for workers in (1, 4))
    assert one_worker == four_workers
    target = tmp_path / "result.json"
    command = [
        sys.executable,
        "-m",
        "rebar_depth_bench",
        "score",
        str(archive),
        "--data",
        str(tiny_root),
        "--json",
        str(target),
    ]
    subprocess.run(command, check=True, capture_output=True)
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
    broken_views = [view for view in tiny_truth if view[-1] in "05"]
    problems = caught.value.problems
    assert [problem.where for problem in problems] == [f"{view}.npy" for view in sorted(broken_views)]
    assert {problem.code for problem in problems} == {"size"}


def test_damaged_entry_of_a_view_without_scored_pixels_rejects_the_archive(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    root = tmp_path / "copy"
    shutil.copytree(tiny_root, root)
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


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 1.0), blank=st.sampled_from([0, -1, np.nan, np.inf]))
def test_blanking_pixels_never_improves_ranking(seed: int, share: float, blank: float) -> None:
    """Check that removing predictions, even the worst, never improves ``within_mm``, coverage or rank."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.2, 0.5, 400).astype(np.float32)
    p = (z * rng.uniform(0.5, 2.0) + rng.normal(0, 0.02, 400)).astype(np.float32)
    truth = ViewTruth("lattice/0000", np.arange(400, dtype=np.uint32), z, float(np.median(z)))
    complete = score_view(truth, p.reshape(20, 20))
    blanked = p.copy()
    worst_first = np.argsort(-np.abs(p - z))
    blanked[worst_first[: int(share * 400)]] = blank
    reduced = score_view(truth, blanked.reshape(20, 20))
    assert all(reduced.within_mm[t] <= complete.within_mm[t] for t in complete.within_mm)
    assert reduced.coverage <= complete.coverage
    errors = [tabulate([view]).rank_error for view in (complete, reduced)]
    assert None not in errors
    assert rounded(errors[0]) <= rounded(errors[1])  # type: ignore[operator]


def test_missing_views_are_rejected(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    fewer = dict(list(tiny_truth.items())[1:])
    with pytest.raises(SubmissionError, match="lattice"):
        score(archive_of(fewer), tiny_root)


def test_config_may_be_omitted(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    assert list(score(archive_of(tiny_truth), tiny_root).tables) == ["lattice"]


def test_damaged_ground_truth_names_view(
    tiny_root: Path, tiny_truth: Depths, archive_of: Archive, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(tiny_root, copy)
    change_manifest(copy, lambda _, config: config["views"][3].update(left="0" * 64))
    view_id = open_folder(copy).config("lattice").view_ids[3]
    with pytest.raises(DatasetError, match=f"view {view_id}: ground truth has digest"):
        score(archive_of(tiny_truth), copy)


@pytest.mark.usefixtures("empty_cache")
@pytest.mark.parametrize(
    ("column", "damage"),
    [
        ("left_depth", lambda cell: encode_depth(decode("depth", cell, (90, 160))[:, 1:])),
        (
            "left_mask",
            lambda cell: cell | {"bytes": encode_png(decode("mask", cell["bytes"], (90, 160)).reshape(-1, 90))},
        ),
    ],
)
def test_ground_truth_images_of_other_size_name_view(
    tiny_root: Path, tmp_path: Path, column: str, damage: Callable[[Any], Any]
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(tiny_root, copy)
    shard = next(copy.glob("lattice-orbit/*.parquet"))
    table = pq.read_table(shard)
    rows = table.to_pylist()
    rows[1][column] = damage(rows[1][column])
    pq.write_table(pa.Table.from_pylist(rows, table.schema), shard)
    with pytest.raises(DatasetError, match=f"view {rows[1]['view_id']}: {column} is damaged: its size is"):
        truth_of(copy, "lattice-orbit")
