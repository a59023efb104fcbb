"""Module entry point: ``python -m dataset_builder`` runs ``rebar-build``."""

from dataset_builder.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
