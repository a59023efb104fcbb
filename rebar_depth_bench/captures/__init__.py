"""Images with known cameras that are no dataset folder: captures, image folders, and KITTI's raw data."""
