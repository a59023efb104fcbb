"""Schema of the rows that Blender processes stage."""

from __future__ import annotations

from dataset_builder.pipeline.shards import ROW_SCHEMA
from rebar_depth_bench.data.dataset import features


def test_row_schema_is_that_of_the_features() -> None:
    assert ROW_SCHEMA.equals(features().arrow_schema.remove_metadata())
