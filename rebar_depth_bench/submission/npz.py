"""``.npz`` entries: a zip inside the zip, held to the same rules as the outer one."""

from __future__ import annotations

from rebar_depth_bench.submission.npy import Depth, decode_npy, max_npy_bytes
from rebar_depth_bench.submission.problems import EntryError, show
from rebar_depth_bench.submission.sources import MemorySource
from rebar_depth_bench.submission.zip_checks import check_entries
from rebar_depth_bench.submission.zip_data import read_data
from rebar_depth_bench.submission.zip_directory import DirectoryError, read_directory

# More than the one array that is expected, so that a wrong file can still be described.
_MAX_MEMBERS = 256
_CONTAINER_BYTES = 64 * 1024


def max_npz_bytes(shape: tuple[int, int]) -> int:
    """Return the size of the largest acceptable ``.npz`` of that (H, W), in bytes."""
    values = max_npy_bytes(shape)
    return values + values // 1024 + _CONTAINER_BYTES


def decode_npz(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the one array of (H, W) inside, as ``decode_npy`` does. Raises ``EntryError``."""
    source = MemorySource(data)
    try:
        directory = read_directory(source, _MAX_MEMBERS)
    except DirectoryError as error:
        raise EntryError(f"{name}: inside the .npz, {error}") from error
    members = [show(entry.name) for entry in directory.entries]
    if len(members) != 1:
        listed = f" ({', '.join(members[:4])}{', ...' if len(members) > 4 else ''})" if members else ""
        raise EntryError(f"{name}: the .npz holds {len(members)} arrays{listed}, expected exactly one")
    (checked,) = check_entries(source, directory, lambda _: max_npy_bytes(shape))
    if checked.problems:
        raise EntryError(f"{name}: inside the .npz, {'; '.join(checked.problems)}")
    if not checked.entry.name.endswith(".npy"):
        raise EntryError(f"{name}: the .npz holds {members[0]}, expected one .npy array")
    try:
        values = read_data(source, checked)
    except EntryError as error:
        raise EntryError(f"{name}: inside the .npz, {error.problem}") from error
    return decode_npy(f"{name} ({members[0]})", values, shape, depth_scale)
