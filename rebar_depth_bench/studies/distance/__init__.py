"""Distance study: scale and error against distance."""
