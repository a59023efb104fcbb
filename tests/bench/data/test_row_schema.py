"""Rows of a local folder as they are read without ``datasets``."""

from __future__ import annotations

from pathlib import Path

import datasets
import numpy as np
import pytest

from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS, ROW_SCHEMA, features
from rebar_depth_bench.data.shards import encoded_rows
from tests.damage import change_rows, copy_dataset, first_shard


def test_row_schema_is_that_of_the_features() -> None:
    assert ROW_SCHEMA.equals(features().arrow_schema.remove_metadata())


def test_local_rows_equal_those_of_datasets(tiny_root: Path) -> None:
    config = open_folder(tiny_root).config("lattice")
    loaded = datasets.load_dataset(str(tiny_root), "lattice", split="test")
    assert list(encoded_rows(config, COLUMNS)) == loaded.data.to_pylist()


@pytest.mark.parametrize("row_group_size", [1, 3])
@pytest.mark.parametrize("turned", [False, True])
def test_rows_of_some_views_are_found_wherever_they_are(
    tiny_root: Path, tmp_path: Path, row_group_size: int, turned: bool
) -> None:
    columns, root = ("view_id", "left_depth"), copy_dataset(tiny_root, tmp_path / "copy")
    expected = {
        row["view_id"]: row["left_depth"] for row in iterate_rows(open_folder(root).config("lattice"), columns)
    }
    for shard in root.glob("lattice/*.parquet"):
        change_rows(shard, list.reverse if turned else list.copy, row_group_size=row_group_size)
    config = open_folder(root).config("lattice")
    for view_ids in (*([view_id] for view_id in expected), config.view_ids[1::3], config.view_ids):
        rows = list(iterate_rows(config, columns, view_ids))
        assert sorted(row["view_id"] for row in rows) == list(view_ids)
        assert all(np.array_equal(row["left_depth"], expected[row["view_id"]]) for row in rows)


def test_missing_row_of_some_views_is_named(tiny_root: Path, tmp_path: Path) -> None:
    root = copy_dataset(tiny_root, tmp_path / "copy")
    change_rows(first_shard(root, "lattice"), list.pop)
    config = open_folder(root).config("lattice")
    missing = config.view_ids[7]
    with pytest.raises(DatasetError, match=f"lattice lacks 1 views, among them {missing}"):
        list(iterate_rows(config, ("view_id",), [missing]))
