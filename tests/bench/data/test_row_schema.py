"""Rows of a local folder as they are read without ``datasets``."""

from __future__ import annotations

from pathlib import Path

import datasets

from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import COLUMNS, ROW_SCHEMA, features
from rebar_depth_bench.data.shards import encoded_rows


def test_row_schema_is_that_of_the_features() -> None:
    assert ROW_SCHEMA.equals(features().arrow_schema.remove_metadata())


def test_local_rows_equal_those_of_datasets(tiny_root: Path) -> None:
    config = open_folder(tiny_root).config("lattice")
    loaded = datasets.load_dataset(str(tiny_root), "lattice", split="test")
    assert list(encoded_rows(config, COLUMNS)) == loaded.data.to_pylist()
