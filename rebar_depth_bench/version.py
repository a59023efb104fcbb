"""Software version, read from the metadata of the installed distribution."""

from importlib.metadata import version

DISTRIBUTION = "rebar-depth-bench"


def software_version() -> str:
    """Return the version of the installed distribution."""
    return version(DISTRIBUTION)
