"""Configs of several scenes and splits: loading, archives, scoring, and methods that see one scene at a time."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import DatasetError, InputError, SubmissionError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import ConfigViews, Views, truth_problems
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.methods.base import Method, MethodInfo, MultiViewMethod, Prepared
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.reading import read_result
from tests.synthetic_dataset import HEIGHT, WIDTH, write_dataset, write_split_dataset

SCENES = {"a": "train", "b-1": "train", "c": "validation", "d": "test", "e": "test"}
VIEWS = 3
SPLIT_VIEWS = {"train": 6, "validation": 3, "test": 6}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "dataset"
    write_split_dataset(folder, SCENES, VIEWS)
    return folder


def view_ids(split: str) -> list[str]:
    return [
        f"cages/{split}-{scene}-{index:04d}"
        for scene, of_split in SCENES.items()
        for index in range(VIEWS)
        if of_split == split
    ]


def write_truth(root: Path, archive: Path, split: str, *, leave_out: int = 0, factor: float = 1.0) -> Path:
    rows = list(rdb.load(root, "cages", split=split, streaming=True, columns=["view_id", "left_depth"]))
    with rdb.SubmissionWriter(archive, "truth") as writer:
        for row in rows[leave_out:]:
            writer.add(row["view_id"], row["left_depth"] * np.float32(factor))
    return archive


@pytest.fixture(scope="module")
def archives(root: Path) -> dict[str, Path]:
    """Write the ground truth of each split as an archive."""
    return {split: write_truth(root, root.parent / f"{split}.zip", split) for split in SPLIT_VIEWS}


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("options", [{}, *({"split": split} for split in SPLIT_VIEWS)])
def test_load_returns_the_views_of_a_split_or_of_test(root: Path, options: Any, streaming: bool) -> None:
    loaded = rdb.load(root, "cages", streaming=streaming, columns=["view_id", "scene"], **options)
    expected = options.get("split", "test")
    assert str(loaded.split) == expected
    rows = list(loaded)
    assert [row["view_id"] for row in rows] == view_ids(expected)
    assert all(row["view_id"] == f"cages/{expected}-{row['scene']}-{row['view_id'][-4:]}" for row in rows)


def test_missing_split_and_one_scene_of_several_are_refused(root: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path / "one", ["lattice"], 2)
    with pytest.raises(DatasetError, match="no split train, expected test"):
        rdb.load(tmp_path / "one", "lattice", split="train")
    with pytest.raises(DatasetError, match=r"no split '\\x1b\[m'"):
        rdb.load(root, "cages", split="\x1b[m")
    with pytest.raises(DatasetError, match="cages has 5 scenes, expected one"):
        open_folder(root).config("cages").scene  # noqa: B018


@pytest.mark.parametrize("split", SPLIT_VIEWS)
def test_truth_of_one_split_is_perfect(root: Path, archives: dict[str, Path], split: str) -> None:
    result = rdb.score(archives[split], root)
    table = result.tables["cages"]
    assert (table.split, table.views, table["rank_error"]) == (split, SPLIT_VIEWS[split], 0.0)
    assert json.loads(result.to_json())["tables"]["cages"]["split"] == split
    assert read_result(result.to_json(), "result").to_json() == result.to_json()
    assert [view.view_id for view in result.views] == view_ids(split)


def test_archive_covers_exactly_one_split(root: Path, tmp_path: Path) -> None:
    with rdb.SubmissionWriter(tmp_path / "both.zip", "both") as writer:
        for split in ("train", "test"):
            for view_id in view_ids(split):
                writer.add(view_id, np.ones((HEIGHT, WIDTH), np.float32))
    with pytest.raises(SubmissionError) as caught:
        rdb.score(tmp_path / "both.zip", root)
    assert [(problem.code, problem.where) for problem in caught.value.problems] == [("conflict", "cages")]


def test_split_that_is_present_must_be_complete(root: Path, tmp_path: Path) -> None:
    with pytest.raises(SubmissionError) as caught:
        rdb.score(write_truth(root, tmp_path / "a.zip", "test", leave_out=2), root)
    missing = [("missing", view_id) for view_id in view_ids("test")[:2]]
    assert [(problem.code, problem.where) for problem in caught.value.problems] == missing


def test_results_of_different_splits_are_not_compared(root: Path, archives: dict[str, Path]) -> None:
    results = [rdb.score(archives[split], root) for split in ("train", "test")]
    with pytest.raises(InputError, match="covers the split test of cages, expected train"):
        compare(*results)


def test_reports_name_the_split_and_show_its_views(root: Path, archives: dict[str, Path], tmp_path: Path) -> None:
    result = rdb.score(archives["validation"], root)
    result.to_html(tmp_path / "report.html")
    pictured = re.findall(r"<article.*?<h3>(.*?)</h3>", (tmp_path / "report.html").read_text(), re.DOTALL)
    assert pictured == view_ids("validation")
    assert latex_table([result], published=True).count("cages (validation)") == 2  # Caption and heading.


INFO = MethodInfo("shifted", "test", ("left_depth", "scene"), False, "here", "none", uses_ground_truth=True)


def multi_view_method(prepared: list[Views]) -> MultiViewMethod:
    """Return a method that predicts the mean depth of all views of the scene, and records what it was given."""

    def prepare(views: Views, work: Path, progress: Any) -> Prepared:
        prepared.append(views)
        assert isinstance(views, ConfigViews)
        rows = list(views.rows("left_depth", "scene"))
        assert {row["scene"] for row in rows} == {views.source.scene.name}
        assert [row["view_id"] for row in rows] == list(views.view_ids)
        mean_m = np.mean([row["left_depth"] for row in rows], axis=0).astype(np.float32)
        return Prepared(lambda _: mean_m, {"scene": views.source.scene.name})

    return MultiViewMethod(INFO, prepare, lambda _: None)


def test_multi_view_method_receives_one_scene_at_a_time(root: Path, tmp_path: Path) -> None:
    prepared: list[Views] = []
    reports = predict(multi_view_method(prepared), root, tmp_path / "a.zip", split="train")
    assert [views.config for views in prepared] == ["cages.train-a", "cages.train-b-1"]
    assert {label: report.notes for label, report in reports.items()} == {
        "cages.train-a": {"scene": "a"},
        "cages.train-b-1": {"scene": "b-1"},
    }
    table = rdb.score(tmp_path / "a.zip", root).tables["cages"]
    assert table.split == "train"
    assert 0 < table["native.mae_cm"] < 3  # The views of a scene differ by centimetres.


def test_interrupted_prediction_of_scenes_resumes(root: Path, tmp_path: Path) -> None:
    prepared: list[Views] = []
    method = multi_view_method(prepared)

    def stop(what: str, done: int, total: int) -> None:
        if what.endswith("test-e"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        predict(method, root, tmp_path / "a.zip", progress=stop)
    assert not (tmp_path / "a.zip").exists()
    predict(method, root, tmp_path / "a.zip")
    assert [views.config for views in prepared] == ["cages.test-d", "cages.test-e", "cages.test-e"]
    predict(method, root, tmp_path / "b.zip")
    assert rdb.score(tmp_path / "a.zip", root).tables == rdb.score(tmp_path / "b.zip", root).tables


@pytest.mark.parametrize("split", SPLIT_VIEWS)
def test_single_view_method_predicts_the_chosen_split(root: Path, tmp_path: Path, split: str) -> None:
    method = Method(INFO, lambda: lambda row: row["left_depth"], lambda row: {"first": row["scene"]})
    reports = predict(method, root, tmp_path / "a.zip", split=split)
    assert [*reports] == ["cages.validation-c" if split == "validation" else f"cages.{split}"]
    result = rdb.score(tmp_path / "a.zip", root)
    assert [view.view_id for view in result.views] == view_ids(split)


def test_prediction_of_a_split_that_no_config_has_is_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path / "one", ["lattice"], 2)
    method = Method(INFO, lambda: lambda row: row["left_depth"])
    with pytest.raises(DatasetError, match="no config has the split train"):
        predict(method, tmp_path / "one", tmp_path / "a.zip", split="train")
    with pytest.raises(DatasetError, match="lattice has no split train"):
        predict(method, tmp_path / "one", tmp_path / "a.zip", split="train", configs=["lattice"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one"]


@pytest.mark.parametrize("streaming", [False, True])
def test_shards_without_the_column_scene_are_refused(tmp_path: Path, streaming: bool) -> None:
    write_dataset(tmp_path / "new", ["lattice"], 2)
    for shard in (tmp_path / "new" / "lattice").glob("*.parquet"):
        pq.write_table(pq.read_table(shard).drop_columns(["scene"]), shard, row_group_size=1)
    with pytest.raises(DatasetError, match="no columns named scene"):
        list(rdb.load(tmp_path / "new", "lattice", streaming=streaming))


def test_rows_under_another_scene_are_refused(tmp_path: Path) -> None:
    write_split_dataset(tmp_path / "new", SCENES, 1)
    shard = tmp_path / "new" / "cages" / "test-d.parquet"
    table = pq.read_table(shard)
    position = table.schema.get_field_index("scene")
    pq.write_table(table.set_column(position, "scene", pa.array(["e"])), shard)
    for read in (
        lambda: rdb.load(tmp_path / "new", "cages"),
        lambda: rdb.load(tmp_path / "new", "cages", streaming=True),
        lambda: truth_problems(open_folder(tmp_path / "new").config("cages")),
    ):
        with pytest.raises(DatasetError, match="scene is damaged: got 'e', expected d"):
            list(read())


def test_extended_measures_of_a_split_use_the_bars_of_each_scene(root: Path, tmp_path: Path) -> None:
    folder = open_folder(root)
    steel = load_steel_truth(folder, folder.config("cages").of_split("train"))
    assert len(steel) == SPLIT_VIEWS["train"]
    diameters = {view_id: bars.diameter_m[1] for view_id, bars in steel.bars_by_view.items()}
    assert diameters == {view_id: 0.001 if "train-a-" in view_id else 0.002 for view_id in view_ids("train")}
    archive = write_truth(root, tmp_path / "a.zip", "validation", factor=1.25)
    extended = rdb.score(archive, root, extended=True).extended
    assert extended is not None
    numbers = extended.tables["cages"].numbers["native"]
    assert extended.tables["cages"].views == SPLIT_VIEWS["validation"]
    assert numbers["single_bar_share"].value == 1.0
    assert numbers["single_bar_abs_rel"].value == pytest.approx(0.25)
