"""Tests of captures: images with known cameras that are no dataset folder."""
