"""Former place of ``rebar_depth_bench.data.rows``, until the builder imports from there."""

from rebar_depth_bench.data.rows import *  # noqa: F403
from rebar_depth_bench.data.views import *  # noqa: F403
