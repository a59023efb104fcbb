"""Entry point of ``python -m rebar_depth_bench``, the same as ``rebar-bench``."""

from rebar_depth_bench.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
