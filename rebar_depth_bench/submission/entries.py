"""Entries of an archive: their formats, and their views, with reports of unknown, duplicate and missing entries.

A leading ``./``, with which bsdtar (Windows, macOS, FreeBSD) begins names, is dropped before they are compared.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from rebar_depth_bench.base.errors import Problem, escape_text
from rebar_depth_bench.base.names import config_of, split_of
from rebar_depth_bench.submission.declaration import MAX_METADATA_BYTES, METADATA_NAME
from rebar_depth_bench.submission.maps import (
    Depth,
    decode_exr,
    decode_npy,
    decode_npz,
    decode_png,
    max_exr_bytes,
    max_npy_bytes,
    max_npz_bytes,
    max_png_bytes,
)

ExpectedViews = Mapping[str, tuple[int, int]]
"""Mapping of every view_id of a dataset folder to its (H, W) in pixels."""


class CaptureViews(dict[str, tuple[int, int]]):
    """Expected views of a capture, whose ids are names of pictures and never name a split."""


@dataclass(frozen=True, slots=True)
class Format:
    """Decoder and size bound of one entry format.

    ``decode(name, data, (H, W), depth_scale)`` returns the depth in metres and raises ``EntryError``; only PNG has
    units, of ``depth_scale`` metres. ``max_bytes((H, W))`` is the largest acceptable length of ``data`` in bytes.
    """

    decode: Callable[[str, memoryview, tuple[int, int], float], Depth]
    max_bytes: Callable[[tuple[int, int]], int]


FORMATS: Mapping[str, Format] = {
    ".npy": Format(decode_npy, max_npy_bytes),
    ".npz": Format(decode_npz, max_npz_bytes),
    ".exr": Format(decode_exr, max_exr_bytes),
    ".png": Format(decode_png, max_png_bytes),
}
"""Formats of entries by the suffix of their names."""

_ANY_SUFFIX = f"one of {', '.join(FORMATS)}"


def entry_key(name: str, expected: ExpectedViews) -> str | None:
    """Return the view_id that an entry name denotes, ``METADATA_NAME``, or None for any other name."""
    plain = name.removeprefix("./")
    suffix = PurePosixPath(plain).suffix
    view_id = plain.removesuffix(suffix)
    if plain == METADATA_NAME:
        return METADATA_NAME
    return view_id if suffix in FORMATS and view_id in expected else None


def is_system_file(name: str, expected: ExpectedViews) -> bool:
    """Return whether an entry is one that macOS adds to folders and archives, which is ignored."""
    plain = name.removeprefix("./")
    is_system = (
        plain.startswith("__MACOSX/") or re.match(r"\._|\.DS_Store$", PurePosixPath(plain).name) is not None
    )
    return is_system and entry_key(name, expected) is None


def max_entry_bytes(name: str, expected: ExpectedViews) -> int | None:
    """Return the largest acceptable uncompressed size of the named entry, in bytes; None for an unknown entry."""
    key = entry_key(name, expected)
    if key == METADATA_NAME or is_system_file(name, expected):
        return MAX_METADATA_BYTES
    return None if key is None else FORMATS[PurePosixPath(name).suffix].max_bytes(expected[key])


def match_entries(names: Sequence[str], expected: ExpectedViews) -> tuple[dict[str, int], list[Problem]]:
    """Return the index of the only entry of each view, and of ``METADATA_NAME``, and the problems of all others.

    ``names`` are in archive order. If all entries lie in one superfluous top-level folder, only that problem is
    reported.
    """
    entries: dict[str, list[int]] = defaultdict(list)
    unknown: list[str] = []
    folders = {"./", *(f"{prefix}{config_of(view_id)}/" for view_id in expected for prefix in ("", "./"))}
    for index, name in enumerate(names):
        if key := entry_key(name, expected):
            entries[key].append(index)
        elif name not in folders:
            unknown.append(name)
    if not entries and (wrapper := _wrapper_folder_problem(unknown, expected)):
        return {}, [wrapper]
    problems = [_unknown_entry_problem(name, expected) for name in unknown]
    for key, indices in entries.items():
        if len(indices) > 1:
            listed = ", ".join(names[index] for index in indices[:4]) + (", ..." if len(indices) > 4 else "")
            problems.append(Problem("duplicate", key, f"{len(indices)} entries were found ({listed})", "one"))
    problems += _missing_problems(entries, expected)
    return {key: indices[0] for key, indices in entries.items() if len(indices) == 1}, problems


def _wrapper_folder_problem(unknown: Sequence[str], expected: ExpectedViews) -> Problem | None:
    """Return the problem of an archive whose files, all unknown, are valid without one superfluous folder."""
    files = [name.removeprefix("./") for name in unknown if not name.endswith("/")]
    tops = {name.partition("/")[0] for name in files}
    if len(tops) != 1:
        return None
    (top,) = tops
    inner_names = [name.removeprefix(f"{top}/") for name in files]
    if not all(entry_key(name, expected) for name in inner_names):
        return None
    return Problem(
        "unknown",
        escape_text(files[0]),
        f"all {len(files)} entries are inside the folder {escape_text(top)}/",
        f"{escape_text(inner_names[0])} at the top level: zip the folder's contents, not the folder",
    )


def _unknown_entry_problem(name: str, expected: ExpectedViews) -> Problem:
    plain = name.removeprefix("./")
    path = PurePosixPath(plain)
    view_id = plain.removesuffix(path.suffix)
    configs = sorted({config_of(view) for view in expected})
    found, allowed = "unknown entry", f"{METADATA_NAME} or <view_id> with {_ANY_SUFFIX}"
    if view_id in expected:
        found += f", the suffix is {escape_text(path.suffix or 'missing')}"
        allowed = _ANY_SUFFIX
    elif path.suffix in FORMATS and config_of(view_id) in configs and "/" in view_id:
        found += f", the dataset has no view {escape_text(view_id)} in the config {config_of(view_id)}"
        allowed = ""
    elif path.suffix in FORMATS and "/" in view_id:
        found += f", the dataset has no config {escape_text(config_of(view_id))}"
        allowed = f"one of {', '.join(configs)}"
    return Problem("unknown", escape_text(name), found, allowed)


def _missing_problems(found: Collection[str], expected: ExpectedViews) -> Iterator[Problem]:
    """Yield a problem for each missing view, and for ``METADATA_NAME``; ``found`` has the keys of all entries."""
    if METADATA_NAME not in found:
        yield Problem("missing", METADATA_NAME, "missing", '{"method": "name"}')
    split_named_by = (lambda _: None) if isinstance(expected, CaptureViews) else split_of
    parts = {(config_of(view_id), split_named_by(view_id)) for view_id in found if view_id != METADATA_NAME}
    if not parts:
        yield Problem("missing", "", "no view was found", f"<view_id> with {_ANY_SUFFIX} of at least one config")
    for config in sorted({config for config, _ in parts}):
        splits = sorted(split or "" for name, split in parts if name == config)
        if len(splits) > 1:
            conflict = f"the archive has views of the splits {' and '.join(splits)}"
            yield Problem("conflict", config, conflict, "views of one split")
    for view in sorted(expected):
        config, split = config_of(view), split_named_by(view)
        if (config, split) in parts and view not in found:
            because = f"because other views of {config if split is None else f'{config}, {split},'} are included"
            yield Problem("missing", view, "missing", f"{_ANY_SUFFIX}, {because}")
