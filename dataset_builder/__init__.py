"""Dataset builder: scenes, camera trajectories, rendered colour, exact ground truth and Parquet shards."""
