"""Archives of configs with splits: only the split test is accepted and scored, and its result has groups."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from leaderboard.scoring.sandbox import check, score
from rebar_depth_bench.base.errors import SubmissionError
from rebar_depth_bench.data.manifest import open_folder
from tests.synthetic_dataset import write_split_dataset


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_split_dataset(tmp_path / "dataset", {"a": "train", "b": "test", "c": "test"}, 2, families={"b": "wall"})
    return tmp_path / "dataset"


def write_archive(root: Path, archive: Path, split: str) -> Path:
    with rdb.SubmissionWriter(archive, "exact") as writer:
        for row in rdb.load(root, "cages", split=split, columns=["view_id", "left_depth"]):
            writer.add(row["view_id"], row["left_depth"] * np.float32(1.25))
    return archive


@pytest.mark.slow
def test_only_the_split_test_is_accepted(root: Path, tmp_path: Path) -> None:
    with pytest.raises(SubmissionError) as refused:
        check(write_archive(root, tmp_path / "train.zip", "train"), str(root))
    [problem] = refused.value.problems
    assert (problem.code, problem.where) == ("conflict", "cages")
    assert "split train" in str(problem)
    accepted = check(write_archive(root, tmp_path / "test.zip", "test"), str(root))
    assert accepted.method == "exact"


@pytest.mark.slow
def test_scored_archive_has_the_groups_of_the_command_line(root: Path, tmp_path: Path) -> None:
    archive = write_archive(root, tmp_path / "test.zip", "test")
    outcome = score(archive, str(root), open_folder(root).digest, 0, False)
    expected = rdb.score(archive, root).to_json()
    assert outcome.result == expected
    assert list(json.loads(expected)["tables"]["cages"]["groups"]["family"]) == ["wall"]
