"""Former place of ``rebar_depth_bench.software_version``, until the builder imports it from there."""

from rebar_depth_bench import software_version as software_version
