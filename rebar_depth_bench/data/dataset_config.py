"""Former place of ``rebar_depth_bench.data.manifest``, until the builder imports from there."""

from rebar_depth_bench.data.manifest import *  # noqa: F403
