"""The commands of ``rebar-bench``, a module each: SUMMARY, ``add_arguments(parser)`` and ``run(options)``."""
