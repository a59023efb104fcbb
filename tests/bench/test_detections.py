"""Scores of detected crossings: matching, average precision, files with problems, and outputs."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.bar_crossings.definition import scene_crossings
from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.detections.crossing_scorer import SeenDetections, compare_view, score_crossings
from rebar_depth_bench.detections.matching import excused, greedy_matches, matched_pairs
from rebar_depth_bench.detections.reading import MAX_ROWS_PER_VIEW, read_detections
from rebar_depth_bench.detections.tables import RankedDetections, ViewDetections, tabulate_detections
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.extended.steel import JudgedCrossings
from rebar_depth_bench.geometry.cameras import transform
from rebar_depth_bench.scoring.bootstrap import resample
from tests.mat_dataset import CAGES, CONFIG, SCENES, VIEWS, mat_bars, poses, write_mat_dataset

SEEDS = st.integers(0, 2**32 - 1)


def on_line(*millimetres: float) -> ndarray:
    return np.array([[value / 1000, 0.0, 0.5] for value in millimetres]).reshape(-1, 3)


def test_most_pairs_come_before_least_distance() -> None:
    """Detection 0 is nearest to tie point 0, which is the only one that detection 1 reaches."""
    pairs = matched_pairs(on_line(1.0, -9.0), on_line(0.0, 9.0))
    assert pairs.tolist() == [[0, 1], [1, 0]]
    assert matched_pairs(on_line(1.0), on_line(0.0, 9.0)).tolist() == [[0, 0]]


def test_limit_is_ten_millimetres_inclusive() -> None:
    assert matched_pairs(on_line(10.0), on_line(0.0)).tolist() == [[0, 0]]
    assert matched_pairs(on_line(10.01), on_line(0.0)).tolist() == []
    assert matched_pairs(on_line(), on_line(0.0)).shape == matched_pairs(on_line(0.0), on_line()).shape == (0, 2)


@settings(max_examples=40)
@given(SEEDS)
def test_matching_agrees_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    detected, true = (rng.uniform(0, 0.02, (int(rng.integers(1, 6)), 3)) for _ in range(2))
    pairs = matched_pairs(detected, true)
    distance = np.linalg.norm(detected[:, None] - true, axis=2)
    found = (-len(pairs), distance[pairs[:, 0], pairs[:, 1]].sum())
    small, large = sorted((len(detected), len(true)))
    table = distance if len(detected) <= len(true) else distance.T
    best = (0, 0.0)
    for columns in permutations(range(large), small):
        used = [table[row, column] for row, column in enumerate(columns) if table[row, column] <= 0.010]
        best = min(best, (-len(used), sum(used)))
    assert found == pytest.approx(best)
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)


def test_greedy_takes_the_most_confident_first() -> None:
    """The confident detection takes the tie point that the other one needs."""
    detected, true = on_line(4.0, 0.0), on_line(3.0)
    assert greedy_matches(detected, np.array([0.9, 0.8]), true, 0.005).tolist() == [True, False]
    assert greedy_matches(detected, np.array([0.8, 0.9]), true, 0.005).tolist() == [False, True]
    assert greedy_matches(detected, np.ones(2), true, 0.005).tolist() == [True, False]  # Equal: the nearest.


@given(SEEDS)
def test_order_of_rows_has_no_effect(seed: int) -> None:
    rng = np.random.default_rng(seed)
    detected, true = rng.uniform(0, 0.04, (12, 3)), rng.uniform(0, 0.04, (6, 3))
    confidence = rng.integers(0, 3, 12).astype(float)
    order = rng.permutation(12)
    for limit in (0.005, 0.02):
        expected = greedy_matches(detected, confidence, true, limit)[order]
        assert greedy_matches(detected[order], confidence[order], true, limit).tolist() == expected.tolist()


def test_each_unjudged_crossing_excuses_one_detection() -> None:
    """Three detections near an unjudged crossing at 100 mm, one near a judged one, one far from all."""
    all_m, judged = on_line(0.0, 100.0, 130.0), np.array([True, False, False])
    detected = on_line(2.0, 101.0, 99.5, 108.0, 50.0, 125.0)
    left_over = np.ones(6, dtype=bool)
    found = excused(detected, left_over, all_m, judged, np.zeros(6))
    assert found.tolist() == [False, False, True, False, False, True]
    found = excused(detected, left_over, all_m, judged, np.array([0, 0.2, 0.1, 0.9, 0, 0]))
    assert found.tolist() == [False, False, False, True, False, True]
    assert not excused(on_line(), np.empty(0, bool), all_m, judged, np.empty(0)).any()
    assert not excused(detected, left_over, on_line(), np.empty(0, bool), np.zeros(6)).any()


def ranked(
    confidence: list[float], correct: list[bool], positives: list[int], view: list[int]
) -> RankedDetections:
    return RankedDetections(np.array(confidence), np.array(correct), np.array(view, int), np.array(positives))


def test_average_precision_by_hand() -> None:
    """Correct, false, correct of three crossings: precision 1 to recall 1/3, then 2/3 to recall 2/3."""
    found = ranked([0.9, 0.8, 0.7], [True, False, True], [3], [0, 0, 0])
    recall, precision = found.curve()
    assert recall == pytest.approx([1 / 3, 1 / 3, 2 / 3])
    assert precision == pytest.approx([1, 1 / 2, 2 / 3])
    assert found.average() == pytest.approx(1 / 3 + 2 / 9)
    # Equal confidences are one point of the curve: precision 2/3 at recall 2/3, in any order.
    for correct in ([True, False, True], [False, True, True]):
        assert ranked([0.5] * 3, correct, [3], [0] * 3).average() == pytest.approx(4 / 9)
    assert ranked([], [], [3], []).average() == 0
    assert ranked([0.5], [False], [0], [0]).average() is None
    assert ranked([], [], [3], []).drawn_points() == []


def test_interval_of_average_precision_covers_different_views() -> None:
    views = 20
    correct = [view % 2 == 0 for view in range(views)]
    found = ranked([0.5] * views, correct, [1] * views, list(range(views)))
    ends = found.interval(resample(range(0, 100 * views, 100)))
    assert ends is not None
    assert ends[0] < 0.25 < ends[1]
    assert found.average() == pytest.approx(0.25)  # Precision and recall of a half.
    same = ranked([0.5] * views, [True] * views, [1] * views, list(range(views)))
    assert same.interval(resample(range(0, 100 * views, 100))) == (1.0, 1.0)


Rows = list[dict[str, Any]]


@pytest.fixture(scope="module")
def mat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("mat")
    write_mat_dataset(root)
    return root


def exact_rows(*, world: bool = False) -> Rows:
    """Return exact detections of all crossings in all views of the mat, with normals."""
    found, names = scene_crossings(mat_bars()), ("world_x", "world_y", "world_z") if world else ("x", "y", "z")
    rows = []
    for index, pose in enumerate(poses(VIEWS)):
        points = found.tie_point_m if world else transform(pose, found.tie_point_m)
        normals = found.normal if world else found.normal @ pose[:3, :3].T
        for point, normal in zip(points, normals, strict=True):
            cells = dict(zip((*names, "nx", "ny", "nz"), (*point.tolist(), *(-2 * normal).tolist()), strict=True))
            rows.append({"view_id": f"{CONFIG}/{index:04d}", **cells})
    return rows


def write_csv(path: Path, rows: Rows, head: str = "") -> Path:
    with path.open("w", newline="") as stream:
        stream.write(head)
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_parquet(path: Path, rows: Rows, metadata: dict[str, str] | None = None) -> Path:
    pq.write_table(pa.Table.from_pylist(rows).replace_schema_metadata(metadata), path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("world", [False, True])
@pytest.mark.parametrize("write", [write_csv, write_parquet])
def test_exact_detections_are_perfect(
    mat: Path, tmp_path: Path, world: bool, write: Callable[[Path, Rows], Path]
) -> None:
    result = score_crossings(write(tmp_path / "exact.table", exact_rows(world=world)), mat).to_dict()
    assert [result[name] for name in ("precision", "recall", "f1", "node_recall")] == [1.0] * 4
    assert result["position_mm"] == pytest.approx(0, abs=1e-6)
    assert result["normal_p95_deg"] == pytest.approx(0, abs=1e-4)  # Undirected, of any length.
    assert result["average_precision"] == {"5": 1.0, "10": 1.0, "20": 1.0}
    assert (result["crossings"], result["detections"], result["matched"]) == (24, 24, 24)
    assert result["submission"]["method"] == "exact"
    assert result["dataset"]["crossings"]["file"] == "crossings.parquet"


@pytest.mark.slow
def test_counts_pool_over_views_by_hand(mat: Path, tmp_path: Path) -> None:
    """Keep the crossings of the first view, one of them 6 mm off and one 30 mm off, and add a point in the air."""
    rows = exact_rows()[:4]
    rows[0]["x"] += 0.006
    rows[1]["x"] += 0.030
    rows.append({**rows[2], "x": 0.5})
    result = score_crossings(write_csv(tmp_path / "a.csv", rows), mat).to_dict()
    assert (result["matched"], result["false"], result["ignored"], result["crossings"]) == (3, 2, 0, 24)
    assert result["precision"] == pytest.approx(3 / 5)
    assert result["recall"] == pytest.approx(3 / 24)
    assert result["f1"] == pytest.approx(6 / 29)
    assert result["position_p95_mm"] == pytest.approx(6)
    assert result["position_mm"] == pytest.approx(0, abs=1e-6)
    # One point of the curve: precision times recall. At 5 mm two of five are correct, at 20 mm three.
    assert result["average_precision"] == pytest.approx({"5": 2 / 5 * 2 / 24, "10": 3 / 5 / 8, "20": 3 / 5 / 8})
    views = {view["view_id"]: view for view in result["views"]}
    assert views[f"{CONFIG}/0001"]["detections"] == 0
    assert len(views) == result["views_scored"] == VIEWS
    assert result["intervals"]["method"] == "expanded-percentile-2"
    assert set(result["ci95"].values()) == {None}, "six consecutive views are one block"


def test_intervals_need_eight_blocks_with_values() -> None:
    """Find all crossings in every second view of a sparse subset: errors of position are those of eight views."""
    found = [
        ViewDetections(
            f"{CONFIG}/{12 * index:04d}",
            *(4, 4, 4 * (index % 2), 4 * (index % 2), 4 * (index % 2), 0),
            position_mm=np.full(4 * (index % 2), 1.0 + index),
            normal_deg=np.empty(0),
            confidence=np.ones(4 * (index % 2)),
            counts=dict.fromkeys((5, 10, 20), np.ones(4 * (index % 2), bool)),
            correct=dict.fromkeys((5, 10, 20), np.ones(4 * (index % 2), bool)),
        )
        for index in range(17)
    ]
    for views, has_errors in ((found, True), (found[:15], False)):
        intervals = tabulate_detections(views, resample(range(0, 12 * len(views), 12))).intervals
        low, high = intervals["recall"] or (0, 0)
        assert 0.1 < low < 0.5 < high < 0.9
        assert (intervals["position_mm"] is not None) == has_errors
        assert intervals["average_precision_5mm"] is not None
        assert intervals["normal_deg"] is None


@pytest.mark.slow
def test_confidence_selects_matches_but_not_average_precision(mat: Path, tmp_path: Path) -> None:
    rows = [{**row, "confidence": 0.2 + 0.1 * (number % 4)} for number, row in enumerate(exact_rows())]
    path = write_csv(tmp_path / "a.csv", rows)
    all_, some = (score_crossings(path, mat, confidence=least).to_dict() for least in (None, 0.35))
    assert (all_["recall"], some["recall"], some["precision"]) == (1.0, 0.5, 1.0)
    assert all_["average_precision"] == some["average_precision"] == {"5": 1.0, "10": 1.0, "20": 1.0}


@pytest.mark.slow
def test_views_without_rows_and_configs_of_several_scenes(mat: Path, tmp_path: Path) -> None:
    found = scene_crossings(mat_bars((-0.06, 0.0)))
    pose = poses(2)[0]
    rows = [
        {"view_id": f"{CAGES}/test-first-0000", **dict(zip("xyz", point.tolist(), strict=True))}
        for point in transform(pose, found.tie_point_m)
    ]
    result = score_crossings(write_csv(tmp_path / "a.csv", rows), mat).to_dict()
    assert (result["precision"], result["crossings"], result["views_scored"]) == (1.0, 16, 4)
    assert list(result["tables"]) == [CAGES]
    empty = tmp_path / "none.csv"
    empty.write_text("view_id,x,y,z\n")
    with pytest.raises(InputError, match="has no rows, expected some, or --config"):
        score_crossings(empty, mat)
    result = score_crossings(empty, mat, configs=[CONFIG, CAGES]).to_dict()
    assert (result["precision"], result["recall"], result["f1"]) == (None, 0.0, 0.0)
    assert result["position_mm"] is None
    with pytest.raises(InputError, match=f"has rows of {CAGES}, expected only those of {CONFIG}"):
        score_crossings(tmp_path / "a.csv", mat, configs=[CONFIG])


@pytest.mark.slow
def test_metadata_of_file_and_options(mat: Path, tmp_path: Path) -> None:
    rows = exact_rows()
    head = "# method: my detector\n# inputs: rgb+K\n# uses_ground_truth: false\n# note: anything\n"
    declared = {"method": "my detector", "inputs": "rgb+K", "uses_ground_truth": "false"}
    for path in (
        write_csv(tmp_path / "a.csv", rows, head),
        write_parquet(tmp_path / "a.parquet", rows, declared),
    ):
        submission = score_crossings(path, mat).to_dict()["submission"]
        assert submission["method"] == "my detector"
        assert (submission["inputs"], submission["uses_ground_truth"]) == ("rgb+K", False)
        other = score_crossings(path, mat, declared={"uses_ground_truth": True}).to_dict()["submission"]
        assert (other["method"], other["uses_ground_truth"]) == ("my detector", True)


def problems(path: Path) -> list[tuple[str, str]]:
    """Return code and place of every problem of a file."""
    ids = [f"{CONFIG}/{index:04d}" for index in range(VIEWS)]
    ids += [f"{CAGES}/{split}-{scene}-0000" for scene, split in SCENES.items()]
    with pytest.raises(SubmissionError) as raised:
        read_detections(path, dict.fromkeys(ids, (1, 1)))
    assert str(raised.value).startswith(f"{path}: ")
    return [(problem.code, problem.where) for problem in raised.value.problems]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", [("missing", "view_id"), ("missing", "")]),
        ("view_id,x,y\n", [("missing", "z")]),
        ("view_id,x,y,z,world_x,world_y,world_z\n", [("conflict", "")]),
        ("view_id,x,y,z,nx\n", [("missing", "ny")]),
        ("view_id,x,x,y,z\n", [("duplicate", "x")]),
        ("view_id,x,y,z\nmat/0000,1,2\n", [("invalid", "line 2")]),
        ("view_id,x,y,z\nmat/0000,1,2,far\n", [("invalid", "line 2: z")]),
        ("view_id,x,y,z\n\nmat/0000,1,,3\n", [("invalid", "line 3")]),
        ("view_id,x,y,z\nmat/0000,1,2,1e999\n", [("invalid", "line 2")]),
        ("view_id,x,y,z,nx,ny,nz\nmat/0000,1,2,3,0,0,0\nmat/0000,1,2,3,,,\n", [("invalid", "line 2")]),
        ("view_id,x,y,z,confidence\nmat/0000,1,2,3,\n", [("invalid", "line 2")]),
        ("view_id,x,y,z\nmat/0009,1,2,3\nmat/0000,1,2,nan\n", [("invalid", "line 3: z"), ("unknown", "line 2")]),
        ("view_id,x,y,z\ncages/train-third-0000,1,2,3\ncages/test-first-0000,1,2,3\n", [("conflict", "cages")]),
        ("# inputs: radar\nview_id,x,y,z\nmat/0000,1,2,3\n", [("invalid", "metadata.inputs")]),
        ('view_id,x,y,z\n"mat/0000,1,2,3\n', [("syntax", "line 2")]),
        ('# method: foo,"bar\nview_id,x,y,z\nmat/0000,1,2,far\n', [("invalid", "line 3: z")]),
        ('# note: "\nview_id,x,y,z\n"mat/0000,1,2,3\n', [("syntax", "line 3")]),
    ],
)
def test_every_problem_of_a_csv_is_named(tmp_path: Path, text: str, expected: Sequence[tuple[str, str]]) -> None:
    path = tmp_path / "detections.csv"
    path.write_text(text)
    assert problems(path) == list(expected)


def test_hostile_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "detections"
    assert problems(path) == [("unreadable", "")]
    path.write_bytes(b"\xff\xfe\x00view")
    assert problems(path) == [("syntax", "")]
    path.write_bytes(b"PAR1 and no more")
    assert problems(path) == [("damaged", "")]
    row = {"view_id": "mat/0000", "x": 0.0, "y": 0.0, "z": 1.0}
    assert problems(write_parquet(path, [row] * (MAX_ROWS_PER_VIEW + 1))) == [("size", "mat/0000")]
    assert problems(write_parquet(path, [{**row, "x": "a"}])) == [("damaged", "")]
    schema = pa.schema([("view_id", pa.string()), *((name, pa.float64()) for name in "xyz")])
    pq.write_table(pa.Table.from_pylist([{**row, "view_id": None, "x": None}], schema), path)
    assert problems(path) == [("invalid", "row 1"), ("unknown", "row 1")]
    monkeypatch.setenv("REBAR_MAX_DETECTIONS_BYTES", "10")
    path.write_text("view_id,x,y,z\n")
    assert problems(path) == [("size", "")]


@pytest.mark.slow
def test_command_writes_json_table_and_page(mat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{**row, "confidence": 0.5 + 0.01 * number} for number, row in enumerate(exact_rows())]
    rows[0]["z"] += 0.02
    path = write_csv(tmp_path / "a.csv", rows, "# method: <b>it</b>\n")
    outputs = ["--json", str(tmp_path / "a.json"), "--html", str(tmp_path / "a.html")]
    assert main(["score-crossings", str(path), "--data", str(mat), *outputs]) == 0
    printed = capsys.readouterr().out
    assert "<b>it</b>: detected crossings of bars" in printed
    assert "95.8" in printed
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["protocol"] == "rebar-crossings-1"
    assert content["precision"] == content["recall"] == pytest.approx(23 / 24)
    assert content["precision_recall"]["10"][-1] == pytest.approx([23 / 24, 23 / 24])
    page = (tmp_path / "a.html").read_text()
    assert "<b>it</b>" not in page
    assert page.count("<svg") == 1
    first = (tmp_path / "a.json").read_bytes()
    assert main(["score-crossings", str(path), "--data", str(mat), *outputs, "--workers", "1"]) == 0
    assert (tmp_path / "a.json").read_bytes() == first


@pytest.mark.slow
def test_command_refuses_bad_files_without_output(
    mat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("view_id,x,y,z\nmat/0000,1,2,\x1b[31m\n")
    assert main(["score-crossings", str(path), "--data", str(mat), "--json", str(tmp_path / "a.json")]) == 2
    error = capsys.readouterr().err
    assert "line 2: z: got '\\x1b[31m', expected a number" in error
    assert not (tmp_path / "a.json").exists()
    assert main(["score-crossings", str(path), "--data", str(mat), "--confidence", "nan"]) == 2


@pytest.mark.slow
def test_points_on_a_bar_without_axis_and_near_unjudged_crossings_are_ignored(mat: Path, tmp_path: Path) -> None:
    """Score the mat with a table of bars in which bar 1 has no axis: its crossings are not known."""
    folder = open_folder(mat)
    steel = load_steel_truth(folder, folder.config(CONFIG))
    truth = steel.view(0)
    points = transform(truth.cam_from_world, truth.bars.crossings.crossings.tie_point_m)
    on_bar_1 = transform(truth.cam_from_world, np.array([[-0.06, 0.0, 0.01]]))
    seen = np.concatenate([points, points[:1] + 0.001, on_bar_1])
    detected = SeenDetections(seen, np.full_like(seen, np.nan), np.ones(len(seen)))
    view = compare_view(detected, truth, None)
    assert (view.matched, view.false, view.ignored) == (4, 2, 0)
    diameter_m = truth.bars.diameter_m.copy()
    diameter_m[1] = np.nan
    view = compare_view(detected, replace(truth, bars=replace(truth.bars, diameter_m=diameter_m)), None)
    assert (view.matched, view.false, view.ignored) == (4, 0, 2)  # Both show bar 1.
    unjudged = replace(truth, judged=JudgedCrossings(truth.judged.crossing[1:], truth.judged.pixels[1:]))
    view = compare_view(detected, unjudged, None)
    assert (view.judged, view.matched, view.false, view.ignored) == (3, 3, 2, 1)
    assert [int(view.counts[limit].sum()) for limit in (5, 10, 20)] == [5, 5, 5]
