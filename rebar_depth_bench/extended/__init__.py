"""Measures beyond ``rebar-1``: alignments, thin structure, point clouds, and what inspection asks, bar by bar."""
