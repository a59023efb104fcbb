"""KITTI study: published metrics on the Eigen split."""
