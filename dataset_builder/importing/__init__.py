"""Import of images with measured or rendered depth from other programs as a config of a dataset folder."""
