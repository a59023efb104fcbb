"""Inspection measures: cylinders fitted to bars, spacings, tolerances."""
