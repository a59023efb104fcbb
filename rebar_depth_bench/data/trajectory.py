"""Former place of ``rebar_depth_bench.data.schema``, until the builder imports from there."""

from rebar_depth_bench.data.schema import *  # noqa: F403
