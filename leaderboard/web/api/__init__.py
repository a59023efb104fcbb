"""HTTP API below ``/api/v1``, with health and metrics endpoints."""
