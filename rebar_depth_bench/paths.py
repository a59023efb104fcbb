"""Former place of ``rebar_depth_bench.names``, until the builder imports from there."""

from rebar_depth_bench.names import *  # noqa: F403
from rebar_depth_bench.reading import *  # noqa: F403
