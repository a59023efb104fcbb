"""Inspection measures: cylinders fitted to bars, bar spacing, and tolerances of standards."""
