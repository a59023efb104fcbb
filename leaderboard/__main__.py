"""Entry point of ``python -m leaderboard``, equivalent to ``rebar-leaderboard``."""

import sys

if __name__ == "__main__":  # The processes that check archives import this module again, but need no command.
    from leaderboard.cli import main

    sys.exit(main())
