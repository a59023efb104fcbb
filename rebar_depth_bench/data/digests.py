"""SHA-256 digests of files, the views of a config and parameters."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rebar_depth_bench.reading import open_regular

if TYPE_CHECKING:
    from rebar_depth_bench.data.config_tables import ViewRecord

_CHUNK_BYTES = 1 << 20


def file_sha256(path: Path) -> str:
    """Return the hex SHA-256 of a regular file, read in chunks of 1 MiB.

    Raises ``OSError`` if the file is missing or not a regular file.
    """
    digest = hashlib.sha256()
    with open_regular(path) as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def files_digest(paths: Iterable[Path]) -> str:
    """Return the hex SHA-256 over the names and SHA-256 digests of files, in the order of ``paths``.

    Folders do not enter the digest, so that copies elsewhere have the same one. Raises ``OSError`` if a file is
    missing.
    """
    lines = [f"{path.name} {file_sha256(path)}\n" for path in paths]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def views_digest(views: Iterable[ViewRecord]) -> str:
    """Return the ground-truth digest, ``sha256:...``, over the ids and eye digests of the views, sorted by id."""
    lines = sorted(f"{view.view_id} {view.left} {view.right}\n" for view in views)
    return "sha256:" + hashlib.sha256("".join(lines).encode()).hexdigest()


def parameters_digest(parameters: object) -> str:
    """Return the hex SHA-256 of the canonical JSON of ``parameters`` (sorted keys, no whitespace, no NaN)."""
    canonical = json.dumps(parameters, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()
