"""The benchmark of filters: worlds, runs, figures, records, leaderboard."""
