"""``python -m dataset_builder`` is ``rebar-build``."""

from dataset_builder.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
