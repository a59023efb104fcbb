"""Client of the leaderboard."""
