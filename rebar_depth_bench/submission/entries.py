"""Entries of an archive: their formats, and their views, with reports of unknown, duplicate and missing entries.

A leading ``./``, with which bsdtar (Windows, macOS, FreeBSD) begins names, is dropped before they are compared.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from rebar_depth_bench.errors import Problem, escape_text
from rebar_depth_bench.names import config_of, split_of
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
_ZIP_HINT = "zip with: zip -r submission.zip submission.json <config> -x '*.DS_Store'"


@dataclass(frozen=True, slots=True)
class MatchedEntries:
    """Entry indices of the views and of ``submission.json``, and the problems of all other entries.

    ``views`` maps the view_id of each view with exactly one entry to that entry's index; ``metadata`` is the index
    of ``submission.json``, None if it is missing or duplicated.
    """

    views: Mapping[str, int]
    metadata: int | None
    problems: tuple[Problem, ...]


def plain_name(name: str) -> str:
    """Return an entry name without one leading ``./``."""
    return name.removeprefix("./")


def entry_view_id(name: str, expected: ExpectedViews) -> str | None:
    """Return the view_id that an entry name denotes, or None if it denotes no expected view."""
    suffix = PurePosixPath(name).suffix
    view_id = plain_name(name).removesuffix(suffix)
    return view_id if suffix in FORMATS and view_id in expected else None


def max_entry_bytes(name: str, expected: ExpectedViews) -> int | None:
    """Return the largest acceptable uncompressed size of the named entry, in bytes; None for an unknown entry."""
    if plain_name(name) == METADATA_NAME:
        return MAX_METADATA_BYTES
    view_id = entry_view_id(name, expected)
    return None if view_id is None else FORMATS[PurePosixPath(name).suffix].max_bytes(expected[view_id])


def match_entries(names: Sequence[str], expected: ExpectedViews) -> MatchedEntries:
    """Assign entry names, in archive order, to the expected views.

    If all entries lie in one superfluous top-level folder, only that problem is reported.
    """
    candidates: dict[str, list[int]] = defaultdict(list)
    unknown_entries: list[str] = []
    folders = {"./", *(f"{prefix}{config_of(view_id)}/" for view_id in expected for prefix in ("", "./"))}
    for index, name in enumerate(names):
        key = METADATA_NAME if plain_name(name) == METADATA_NAME else entry_view_id(name, expected)
        if key is not None:
            candidates[key].append(index)
        elif name not in folders:
            unknown_entries.append(name)
    wrapper_problem = _wrapper_folder_problem(names, expected)
    if wrapper_problem is not None:
        return MatchedEntries({}, None, (wrapper_problem,))
    views = {key: indices[0] for key, indices in candidates.items() if len(indices) == 1 and key != METADATA_NAME}
    problems = [
        *_unknown_entry_problems(unknown_entries, expected),
        *_duplicate_problems(candidates, names),
        *_missing_problems(candidates, expected),
    ]
    metadata = candidates.get(METADATA_NAME, [])
    return MatchedEntries(views, metadata[0] if len(metadata) == 1 else None, tuple(problems))


def _wrapper_folder_problem(names: Sequence[str], expected: ExpectedViews) -> Problem | None:
    """Return the problem of an archive whose valid entries all lie in one superfluous folder, or None."""
    files = [plain_name(name) for name in names if not name.endswith("/") and not _is_macos_metadata(name)]
    tops = {name.partition("/")[0] for name in files}
    if len(tops) != 1:
        return None
    (top,) = tops
    inner_names = [name.removeprefix(f"{top}/") for name in files]
    expected_names = [name for name in inner_names if name == METADATA_NAME or entry_view_id(name, expected)]
    if (
        len(expected_names) < len(inner_names)
        or any(entry_view_id(name, expected) for name in files)
        or METADATA_NAME in files
    ):
        return None
    return Problem(
        "unknown",
        escape_text(files[0]),
        f"all {len(files)} entries are inside the folder {escape_text(top)}/",
        f"{escape_text(inner_names[0])} at the top level: zip the folder's contents, not the folder",
    )


def _unknown_entry_problems(unknown_entries: Sequence[str], expected: ExpectedViews) -> Iterator[Problem]:
    macos = [name for name in unknown_entries if _is_macos_metadata(name)]
    for name in unknown_entries:
        if not _is_macos_metadata(name):
            yield _unknown_entry_problem(name, expected)
    if macos:
        found = f"entries made by macOS were found ({len(macos)})"
        yield Problem("unknown", escape_text(macos[0]), found, f"none; {_ZIP_HINT}")


def _unknown_entry_problem(name: str, expected: ExpectedViews) -> Problem:
    path = PurePosixPath(plain_name(name))
    view_id = plain_name(name).removesuffix(path.suffix)
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


def _duplicate_problems(candidates: Mapping[str, Sequence[int]], names: Sequence[str]) -> Iterator[Problem]:
    for key, indices in candidates.items():
        if len(indices) > 1:
            listed = ", ".join(names[index] for index in indices[:4]) + (", ..." if len(indices) > 4 else "")
            yield Problem("duplicate", key, f"{len(indices)} entries were found ({listed})", "one")


def _missing_problems(candidates: Mapping[str, Sequence[int]], expected: ExpectedViews) -> Iterator[Problem]:
    if METADATA_NAME not in candidates:
        yield Problem("missing", METADATA_NAME, "missing", '{"method": "name"}')
    split_named_by = (lambda _: None) if isinstance(expected, CaptureViews) else split_of
    parts = {(config_of(view_id), split_named_by(view_id)) for view_id in candidates if view_id != METADATA_NAME}
    if not parts:
        yield Problem("missing", "", "no view was found", f"<view_id> with {_ANY_SUFFIX} of at least one config")
    for config, splits in _splits_by_config(parts).items():
        if len(splits) > 1:
            found = f"the archive has views of the splits {' and '.join(sorted(splits))}"
            yield Problem("conflict", config, found, "views of one split")
    for view in sorted(expected):
        config, split = config_of(view), split_named_by(view)
        if (config, split) in parts and view not in candidates:
            because = f"because other views of {config if split is None else f'{config}, {split},'} are included"
            yield Problem("missing", view, "missing", f"{_ANY_SUFFIX}, {because}")


def _splits_by_config(parts: Iterable[tuple[str, str | None]]) -> dict[str, set[str]]:
    splits: dict[str, set[str]] = defaultdict(set)
    for config, split in parts:
        splits[config].add(split or "")
    return splits


def _is_macos_metadata(name: str) -> bool:
    return plain_name(name).startswith("__MACOSX/") or PurePosixPath(name).name == ".DS_Store"
