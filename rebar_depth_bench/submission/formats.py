"""Former place of ``rebar_depth_bench.submission.entries``, until the builder imports from there."""

from rebar_depth_bench.submission.entries import *  # noqa: F403
from rebar_depth_bench.submission.maps import *  # noqa: F403
