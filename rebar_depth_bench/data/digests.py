"""Former place of ``rebar_depth_bench.data.files``, until the builder imports from there."""

from rebar_depth_bench.data.files import *  # noqa: F403
