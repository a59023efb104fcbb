"""Former place of ``rebar_depth_bench.parallel``, until the builder imports from there."""

from rebar_depth_bench.parallel import *  # noqa: F403
