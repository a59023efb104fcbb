"""Entry point of ``rebar-leaderboard`` and ``python -m leaderboard``.

The processes that read archives import this module again, but need no command.
"""

import sys


def main() -> int:
    """Run the command line."""
    from leaderboard.cli import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
