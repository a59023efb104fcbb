"""Entry point of ``python -m leaderboard``, equivalent to ``rebar-leaderboard``."""

import sys

from leaderboard.cli import main

if __name__ == "__main__":
    sys.exit(main())
