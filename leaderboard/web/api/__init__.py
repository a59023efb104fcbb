"""HTTP API below ``/api/v1``, with the health endpoint."""
