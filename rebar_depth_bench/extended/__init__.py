"""Extended measures: depth alignments, thin structure, point clouds and per-bar inspection; they never rank."""
