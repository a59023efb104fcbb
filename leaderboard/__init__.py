"""Leaderboard web service: accepts prediction archives and scores them exactly as the command line does."""
