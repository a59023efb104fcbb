"""Commands of ``rebar-bench``, one module each, with ``add_arguments(parser)`` and ``run(options)``."""
