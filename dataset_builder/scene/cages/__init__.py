"""Generated reinforcement cages: designs drawn from the ranges of the standards, and how they are built."""
