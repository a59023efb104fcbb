"""SHA-256 digests of files, decoded ground truth and parameters."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt16
from numpy import ndarray

from rebar_depth_bench.data.manifest import ViewRecord

_CHUNK_BYTES = 1 << 20


def file_sha256(path: Path) -> str:
    """Return the hex SHA-256 of a file, read in chunks of 1 MiB."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
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


def eye_digest(
    depth_m: Float32[ndarray, "h w"],
    mask: Bool[ndarray, "h w"],
    bars: UInt16[ndarray, "h w"],
    K: Float64[ndarray, "3 3"],
    distortion: Float64[ndarray, 5],
    cam_from_world: Float64[ndarray, "4 4"],
) -> str:
    """Return the hex SHA-256 of the ground truth of one camera of a view.

    It covers the image size and the decoded values, not their encoding.
    """
    digest = hashlib.sha256(np.array(depth_m.shape, "<u4").tobytes())
    arrays = (
        (depth_m, "<f4"),
        (mask, "u1"),
        (bars, "<u2"),
        (K, "<f8"),
        (distortion, "<f8"),
        (cam_from_world, "<f8"),
    )
    for array, dtype in arrays:
        digest.update(np.ascontiguousarray(array, dtype=dtype).data)
    return digest.hexdigest()


def views_digest(views: Iterable[ViewRecord]) -> str:
    """Return the ground-truth digest, ``sha256:...``, over the ids and eye digests of the views, sorted by id."""
    lines = sorted(f"{view.view_id} {view.left} {view.right}\n" for view in views)
    return "sha256:" + hashlib.sha256("".join(lines).encode()).hexdigest()


def parameters_digest(parameters: object) -> str:
    """Return the hex SHA-256 of the canonical JSON of ``parameters`` (sorted keys, no whitespace, no NaN)."""
    canonical = json.dumps(parameters, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()
