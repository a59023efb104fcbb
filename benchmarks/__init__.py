"""Benchmarks of speed and memory: medians and ratios within one run, printed with a description of the machine."""
