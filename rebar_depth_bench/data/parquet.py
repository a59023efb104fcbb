"""Former place of ``rebar_depth_bench.data.shards``, until the builder imports from there."""

from rebar_depth_bench.data.shards import *  # noqa: F403
