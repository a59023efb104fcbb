"""The place of the leaderboard service, which stands on ``rebar_depth_bench`` and never on the builder."""
