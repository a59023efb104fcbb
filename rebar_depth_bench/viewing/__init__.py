"""One view in 3D: ground truth, predictions, bars and cameras in the world frame, as a recording of rerun."""
