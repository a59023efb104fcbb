"""One build at a time in a dataset folder."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rebar_depth_bench.errors import InputError

LOCK = "lock"


@contextmanager
def build_lock(folder: Path) -> Iterator[None]:
    """Hold ``folder/lock``; raise ``InputError`` if another process does. A killed holder lets go of it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder.parent}: cannot be made or written to: {error.strerror}") from None
    with (folder / LOCK).open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{folder.parent}: another rebar-build is at work there") from None
        yield
