"""The leaderboard: a service that takes prediction archives and scores them exactly as the command line does."""
