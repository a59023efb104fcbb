"""Scoring of accepted archives: workers, the sandboxed scoring process, and dask."""
