"""Command ``rebar-build``."""
