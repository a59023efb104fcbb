"""The version of this software, as installed or as in the source tree's metadata."""

from importlib.metadata import version

DISTRIBUTION = "rebar-depth-bench"


def software_version() -> str:
    """Return the installed distribution's version."""
    return version(DISTRIBUTION)
