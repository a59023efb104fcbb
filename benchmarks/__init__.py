"""Speed and memory, measured and not asserted: ratios within one run, medians, the machine noted."""
