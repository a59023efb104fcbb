"""Entry point of ``rebar-leaderboard`` and ``python -m leaderboard``.

The processes that read archives import this module again, but need no command.
"""

import sys

_EXTRA_MODULES = (
    "fastapi",
    "multipart",
    "sqlalchemy",
    "structlog",
    "uvicorn",
)


def main() -> int:
    """Run the command line; return its exit status."""
    from rebar_depth_bench.base.errors import require_extra
    from rebar_depth_bench.cli.console import run_command

    if status := run_command(lambda: require_extra("server", _EXTRA_MODULES)):
        return status
    from leaderboard.cli import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
