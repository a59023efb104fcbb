"""Former place of ``rebar_depth_bench.data.torch``, until the builder imports from there."""

from rebar_depth_bench.data.torch import *  # noqa: F403
