"""The studies of the paper, each a command: ``rebar-bench study NAME``.

A study module has ``SUMMARY`` (one line), ``add_arguments(parser)`` and ``run(options)``; its pure part returns a
frozen result that knows its stamp.
"""
