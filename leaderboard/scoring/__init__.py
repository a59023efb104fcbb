"""Scoring of accepted archives: queue workers, the sandboxed scoring process and the dask backend."""
