"""Scores of detected crossings: matching, average precision, files with problems, and outputs."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.bar_crossings.definition import scene_crossings
from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.detections.crossing_scorer import compare_view, score_crossings
from rebar_depth_bench.detections.matching import CHANCE_DRAWS, LIMITS_MM, SUMS, Points, ViewCrossings
from rebar_depth_bench.detections.reading import MAX_ROWS_PER_VIEW, Detections, read_detections
from rebar_depth_bench.detections.tables import RankedDetections, ViewDetections, tabulate_detections
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.extended.judged import judged_crossings, shown_pixels
from rebar_depth_bench.extended.steel import JudgedCrossings, SceneBars, SteelTruth
from rebar_depth_bench.geometry.cameras import transform
from rebar_depth_bench.scoring.bootstrap import resample
from tests.bench.extended.cage_scenes import NO_CROSSINGS
from tests.mat_dataset import CAGES, CONFIG, SCENES, VIEWS, mat_bars, poses, write_mat_dataset

SEEDS = st.integers(0, 2**32 - 1)


def on_line(*millimetres: float) -> ndarray:
    return np.array([[value / 1000, 0.0, 0.5] for value in millimetres]).reshape(-1, 3)


def scene(tie_point_m: ndarray, judged: Sequence[bool]) -> ViewCrossings:
    """Return crossings of one node each."""
    count = len(tie_point_m)
    return ViewCrossings(tie_point_m, np.arange(count), np.array(judged, bool), np.full(count, 0.02))


def match(
    detected_m: ndarray, crossings: ViewCrossings, confidence: Sequence[float] = (), limit_mm: float = 5
) -> tuple[list[bool], list[bool]]:
    """Return which detections are correct and ignored, none of which shows a bar without axis."""
    distance_m = np.linalg.norm(detected_m[:, None] - crossings.tie_point_m, axis=2)
    nearest = distance_m.argmin(axis=1)
    points = Points(
        detected_m[None],
        nearest[None],
        distance_m[np.arange(len(nearest)), nearest][None],
        np.zeros((1, len(nearest)), bool),
    )
    correct, ignored = points.match(crossings, np.array(confidence or np.ones(len(detected_m))), limit_mm / 1000)
    return correct[0].tolist(), ignored[0].tolist()


def test_a_detection_belongs_to_the_nearest_crossing_only() -> None:
    """The second detection is within 5 mm of the first crossing, too, but nearer to the second, which is taken."""
    crossings = scene(on_line(0.0, 6.0), [True, True])
    assert match(on_line(6.0, 3.5), crossings, [0.9, 0.8])[0] == [True, False]
    assert match(on_line(6.0, 3.5), crossings, [0.8, 0.9])[0] == [False, True]
    assert match(on_line(6.0, 3.5), crossings)[0] == [True, False]  # Equally confident: the nearest.


def test_limit_is_inclusive() -> None:
    assert match(on_line(5.0), scene(on_line(0.0), [True])) == ([True], [False])
    assert match(on_line(5.01), scene(on_line(0.0), [True])) == ([False], [False])
    assert match(on_line(5.01), scene(on_line(0.0), [True]), limit_mm=10) == ([True], [False])


def test_each_unjudged_crossing_ignores_one_detection() -> None:
    """Three detections near an unjudged crossing at 100 mm, one far from all, one near another."""
    crossings = scene(on_line(0.0, 100.0, 130.0), [True, False, False])
    detected = on_line(2.0, 101.0, 99.5, 104.0, 50.0, 126.0)
    expected = [True, False, False, False, False, False]
    assert match(detected, crossings) == (expected, [False, False, True, False, False, True])
    confidence = [0.1, 0.2, 0.1, 0.9, 0.1, 0.1]
    assert match(detected, crossings, confidence) == (expected, [False, False, False, True, False, True])


@given(SEEDS)
def test_order_of_rows_has_no_effect(seed: int) -> None:
    rng = np.random.default_rng(seed)
    crossings = scene(rng.uniform(0, 0.04, (6, 3)), rng.integers(0, 2, 6).tolist())
    detected, confidence = rng.uniform(0, 0.04, (12, 3)), rng.integers(0, 3, 12).astype(float)
    order = rng.permutation(12)
    for limit_mm in (5, 20):
        found = match(detected, crossings, confidence.tolist(), limit_mm)
        expected = tuple([kind[row] for row in order] for kind in found)
        assert match(detected[order], crossings, confidence[order].tolist(), limit_mm) == expected


def test_bias_describes_detections_nearer_than_half_way_to_the_next_crossing(mat: Path) -> None:
    """Move the crossings to points 16 mm apart, and detect 7 and 9 mm beside each of the first two."""
    folder = open_folder(mat)
    truth = load_steel_truth(folder, folder.config(CONFIG)).view(0)
    places_m = on_line(0.0, 16.0, 100.0, 200.0)
    crossings = truth.bars.crossings
    moved = replace(crossings.crossings, tie_point_m=transform(np.linalg.inv(truth.cam_from_world), places_m))
    truth = replace(truth, bars=replace(truth.bars, crossings=replace(crossings, crossings=moved)))
    sums = compare_view(detections(on_line(-7.0, -9.0, 119.0, 121.0)), None, truth).sums
    assert sums["near"] == 2
    assert sums["right_mm"] == pytest.approx(-7 + 19)
    assert sums["square_mm2"] == pytest.approx(49 + 361)


def test_coordinates_that_overflow_are_false(mat: Path) -> None:
    folder = open_folder(mat)
    truth = load_steel_truth(folder, folder.config(CONFIG)).view(0)
    far = replace(detections(np.array([[1e308, 1e308, -1e308], [1.0, 2.0, 1e-320]])), is_world=True)
    for seen in (far, replace(far, is_world=False)):
        assert compare_view(seen, None, truth).sums["false"] == 2


def test_scene_without_crossings_has_false_detections_only(mat: Path) -> None:
    folder = open_folder(mat)
    truth = load_steel_truth(folder, folder.config(CONFIG)).view(0)
    truth = replace(truth, bars=SceneBars.of(mat_bars()), judged=NO_CROSSINGS)
    view = compare_view(detections(on_line(0.0, 10.0)), None, truth)
    assert (view.sums["crossings"], view.sums["false"], view.sums["near"]) == (0, 2, 0)


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


def detections(point_m: ndarray) -> Detections:
    """Return detections of one view in its camera frame, without normals and confidences."""
    count = len(point_m)
    return Detections(["" for _ in point_m], False, point_m, np.full((count, 3), np.nan), np.ones(count), False)


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
    assert result["average_precision"] == {"2": 1.0, "5": 1.0, "10": 1.0}
    assert (result["crossings"], result["detections"], result["matched"]) == (24, 24, 24)
    assert result["submission"]["method"] == "exact"
    assert result["dataset"]["crossings"]["file"] == "crossings.parquet"


@pytest.mark.slow
def test_counts_pool_over_views_by_hand(mat: Path, tmp_path: Path) -> None:
    """Keep the crossings of the first view, one of them 4 mm off and one 30 mm off, and add a point in the air."""
    rows = exact_rows()[:4]
    rows[0]["x"] += 0.004
    rows[1]["x"] += 0.030
    rows.append({**rows[2], "x": 0.5})
    result = score_crossings(write_csv(tmp_path / "a.csv", rows), mat).to_dict()
    assert (result["matched"], result["false"], result["ignored"], result["crossings"]) == (3, 2, 0, 24)
    assert result["precision"] == pytest.approx(3 / 5)
    assert result["recall"] == pytest.approx(3 / 24)
    assert result["f1"] == pytest.approx(6 / 29)
    assert result["position_p95_mm"] == pytest.approx(4)
    assert result["position_mm"] == pytest.approx(0, abs=1e-6)
    # One point of the curve: precision times recall. At 2 mm two of five are correct, at 10 mm three.
    assert result["average_precision"] == pytest.approx({"2": 2 / 5 * 2 / 24, "5": 3 / 5 / 8, "10": 3 / 5 / 8})
    views = {view["view_id"]: view for view in result["views"]}
    assert views[f"{CONFIG}/0001"]["detections"] == 0
    assert len(views) == result["views_scored"] == VIEWS
    assert result["intervals"]["method"] == "expanded-percentile-2"
    assert set(result["ci95"].values()) == {None}, "six consecutive views are one block"


def test_intervals_need_eight_blocks_with_values() -> None:
    """Find all crossings in every second view of a sparse subset: errors of position are those of eight views."""
    found = []
    for index in range(17):
        matched = 4 * (index % 2)
        sums = dict.fromkeys(SUMS, 0.0) | dict.fromkeys(("detections", "matched", "nodes_found"), float(matched))
        random = dict.fromkeys(SUMS, np.zeros(CHANCE_DRAWS))
        view = ViewDetections(
            f"{CONFIG}/{12 * index:04d}",
            sums=sums | {"crossings": 4.0, "nodes": 4.0},
            position_mm=np.full(matched, 1.0 + index),
            normal_deg=np.empty(0),
            confidence=np.ones(matched),
            counts=dict.fromkeys(LIMITS_MM, np.ones(matched, bool)),
            correct=dict.fromkeys(LIMITS_MM, np.ones(matched, bool)),
            chance=random,
            chance_at=dict.fromkeys(LIMITS_MM, np.zeros((CHANCE_DRAWS, 2), np.int64)),
            chance_position_mm=np.empty(0),
        )
        found.append(view)
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
    assert all_["average_precision"] == some["average_precision"] == {"2": 1.0, "5": 1.0, "10": 1.0}


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
        ("view_id,x,y,z\nmat/0000,1,2,3,4\n", [("invalid", "line 2")]),
        ("# method: a\rview_id,x,y,z\rmat/0000,1,2,far\r", [("invalid", "line 3: z")]),
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
    assert content["protocol"] == "rebar-crossings-2"
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
    seen = detections(np.concatenate([points, points[:1] + 0.001, on_bar_1]))

    def counts(of_truth: SteelTruth) -> tuple[float, ...]:
        sums = compare_view(seen, None, of_truth).sums
        return sums["crossings"], sums["matched"], sums["false"], sums["ignored"]

    assert counts(truth) == (4, 4, 2, 0)
    diameter_m = truth.bars.diameter_m.copy()
    diameter_m[1] = np.nan
    assert counts(replace(truth, bars=replace(truth.bars, diameter_m=diameter_m))) == (4, 4, 0, 2)
    unjudged = JudgedCrossings(truth.judged.crossing[1:], truth.judged.pixels[1:])
    assert counts(replace(truth, judged=unjudged)) == (3, 3, 2, 1)


SHIFTS_M = {"right": (0.008, 0, 0), "down": (0, 0.008, 0), "along": (0, 0, 0.008)}


@pytest.mark.slow
@pytest.mark.parametrize("axis", SHIFTS_M)
def test_detections_beside_every_crossing_are_false_and_their_bias_is_told(
    mat: Path, tmp_path: Path, axis: str
) -> None:
    shift_m = dict(zip("xyz", SHIFTS_M[axis], strict=True))
    rows = [{**row, **{name: row[name] + shift_m[name] for name in "xyz"}} for row in exact_rows()]
    result = score_crossings(write_csv(tmp_path / "a.csv", rows), mat).to_dict()
    assert (result["f1"], result["precision"], result["average_precision"]["10"]) == (0.0, 0.0, 1.0)
    expected = {name: 8.0 if name == axis else 0.0 for name in SHIFTS_M}
    assert {name: result[f"{name}_bias_mm"] for name in SHIFTS_M} == pytest.approx(expected, abs=1e-6)
    assert result["spread_mm"] == pytest.approx(0, abs=1e-5)


def test_chance_is_the_mean_of_random_points(mat: Path) -> None:
    """Move the tie points to the surface, and draw the pixels of 60 sets of detections with another generator."""
    folder, rng = open_folder(mat), np.random.default_rng(1)
    truth = load_steel_truth(folder, folder.config(CONFIG)).view(0)
    bars, world_from_cam = truth.bars, np.linalg.inv(truth.cam_from_world)
    shown = shown_pixels(truth, transform(truth.cam_from_world, bars.crossings.crossings.tie_point_m))
    surface_m = truth.depth_m.astype(float)[:, None] * np.column_stack([truth.rays, np.ones(len(truth.index))])
    moved = replace(bars.crossings.crossings, tie_point_m=transform(world_from_cam, surface_m[shown]))
    truth = replace(truth, bars=replace(bars, crossings=replace(bars.crossings, crossings=moved)))
    pixels = np.flatnonzero(truth.interior)
    views = [compare_view(detections(surface_m[rng.choice(pixels, 250)]), None, truth) for _ in range(60)]
    for limit_mm, least in ((2, 0.05), (5, 0.4), (10, 0.8)):
        recall = np.mean([view.correct[limit_mm].sum() for view in views]) / 4
        assert recall == pytest.approx(views[0].chance_at[limit_mm][:, 0].mean() / 4, abs=0.12)
        assert least < recall < least + 0.4
    table = tabulate_detections(views[:1], None)
    assert table.chance["recall"] == pytest.approx(views[0].chance["matched"].mean() / 4)
    average = np.mean([view.correct[5].sum() ** 2 / (250 * 4) for view in views])
    assert table.chance["average_precision_5mm"] == pytest.approx(average, rel=0.3)
    # Detections that are ignored have no random points.
    unjudged = replace(truth, judged=JudgedCrossings(truth.judged.crossing[1:], truth.judged.pixels[1:]))
    exact_m = transform(truth.cam_from_world, moved.tie_point_m)
    view = compare_view(detections(exact_m), None, unjudged)
    assert set(view.chance["detections"]) == {3}
    assert set(view.chance_at[5][:, 1] + view.chance["ignored"]) == {3}
    position_mm = np.median(np.concatenate([view.position_mm for view in views]))
    assert table.chance["position_mm"] == pytest.approx(position_mm, abs=0.8)


@pytest.mark.slow
def test_noise_has_its_spread(mat: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    noisy = [{**row, **{name: row[name] + rng.normal(0, 0.0015) for name in "xyz"}} for row in exact_rows()]
    result = score_crossings(write_csv(tmp_path / "noisy.csv", noisy), mat).to_dict()
    assert result["f1"] > 0.9
    assert result["spread_mm"] == pytest.approx(1.5 * 3**0.5, abs=0.6)


@pytest.mark.slow
def test_crossings_behind_their_own_bar_are_not_judged(mat: Path) -> None:
    """Move the surface at the pixel of one tie point to 61 mm before it; both bars have 20 mm."""
    folder = open_folder(mat)
    truth = load_steel_truth(folder, folder.config(CONFIG)).view(0)
    diameter_m = truth.bars.crossings.diameter_m.copy()
    assert diameter_m[0].tolist() == [0.02, 0.02]
    diameter_m[0, 0] = 0.01  # The larger one counts.
    truth = replace(
        truth, bars=replace(truth.bars, crossings=replace(truth.bars.crossings, diameter_m=diameter_m))
    )
    tie_point_m = transform(truth.cam_from_world, truth.bars.crossings.crossings.tie_point_m)
    first = shown_pixels(truth, tie_point_m)[0]
    depth_m = truth.depth_m.copy()
    for moved_m, judged in ((0.055, [0, 1, 2, 3]), (0.065, [1, 2, 3])):
        depth_m[first] = tie_point_m[0, 2] * (1 - moved_m / np.linalg.norm(tie_point_m[0]))
        assert judged_crossings(replace(truth, depth_m=depth_m)).crossing.tolist() == judged
