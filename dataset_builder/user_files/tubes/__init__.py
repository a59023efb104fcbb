"""Axis and diameter of round bars from their surfaces."""
