"""Rows of a local folder as they are read without ``datasets``."""

from __future__ import annotations

from pathlib import Path

from rebar_depth_bench.data.dataset import COLUMNS, ROW_SCHEMA, features, iterate_undecoded, load_undecoded


def test_row_schema_is_that_of_the_features() -> None:
    assert ROW_SCHEMA.equals(features().arrow_schema.remove_metadata())


def test_local_rows_equal_those_of_datasets(tiny_root: Path) -> None:
    streamed = load_undecoded(tiny_root, "lattice", streaming=True, columns=COLUMNS)
    assert list(iterate_undecoded(tiny_root, "lattice", COLUMNS)) == list(streamed)
