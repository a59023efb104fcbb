"""Former place of ``rebar_depth_bench.scoring.table``, until the builder imports from there."""

from rebar_depth_bench.scoring.table import *  # noqa: F403
from rebar_depth_bench.scoring.truth import *  # noqa: F403
