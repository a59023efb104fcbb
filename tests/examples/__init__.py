"""Scripts of ``examples``, run on small data."""
