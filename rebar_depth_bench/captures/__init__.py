"""Pictures without ground truth, and their cameras: captures, image files, calibrations."""
