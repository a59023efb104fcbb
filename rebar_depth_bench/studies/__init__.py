"""Studies of the paper, each available as the command ``rebar-bench study NAME``.

Each study is a package. Its ``command`` module has ``SUMMARY`` (one line), ``add_arguments(parser)`` and
``run(options)``; a function without I/O on the command line computes a frozen result that carries its provenance
(``scoring.provenance.Provenance``).
"""
