"""The ``rebar-bench cache`` command."""

from __future__ import annotations

import argparse

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import CACHE_BYTES
from rebar_depth_bench.data.cache import cache_folder, clear, entries, total_bytes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--clear", action="store_true", help="delete all entries; they are written again when needed"
    )


def run(options: argparse.Namespace) -> None:
    """Print folder, number of entries, size and limit of the cache, or delete its entries and print their size."""
    folder = cache_folder()
    try:
        files = clear(folder) if options.clear else entries(folder)
    except OSError as error:
        raise InputError(f"{error.filename or folder}: {error.strerror}") from None
    size = f"{len(files)} {'file' if len(files) == 1 else 'files'}, {total_bytes(files)} bytes"
    if options.clear:
        print(f"{folder}: deleted {size}")
    else:
        print(f"{folder}: {size} of at most {CACHE_BYTES.value()} ({CACHE_BYTES.variable})")
