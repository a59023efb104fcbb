"""Assignment of archive entries to dataset views, with reports of unknown, duplicate and missing entries."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from rebar_depth_bench.errors import escape_text
from rebar_depth_bench.submission.formats import FORMATS
from rebar_depth_bench.submission.metadata import MAX_METADATA_BYTES, METADATA_NAME

ExpectedViews = Mapping[str, tuple[int, int]]
"""Mapping of every view_id (``<config>/<0000>``) of a dataset folder to its (H, W) in pixels."""

_SUFFIXES = ", ".join(FORMATS)
_ZIP_HINT = "zip with: zip -r submission.zip submission.json <config> -x '*.DS_Store'"


@dataclass(frozen=True, slots=True)
class MatchedEntries:
    """Entry indices of the views and of ``submission.json``, and the problems of all other entries.

    ``views`` maps the view_id of each view with exactly one entry to that entry's index; ``metadata`` is the index
    of ``submission.json``, None if it is missing or duplicated.
    """

    views: Mapping[str, int]
    metadata: int | None
    problems: tuple[str, ...]


def config_of(view_id: str) -> str:
    """Return the config of a view: the part of ``view_id`` before the slash."""
    return view_id.partition("/")[0]


def entry_view_id(name: str, expected: ExpectedViews) -> str | None:
    """Return the view_id that an entry name denotes, or None if it denotes no expected view."""
    path = PurePosixPath(name)
    view_id = name.removesuffix(path.suffix)
    return view_id if path.suffix in FORMATS and view_id in expected else None


def max_entry_bytes(name: str, expected: ExpectedViews) -> int | None:
    """Return the largest acceptable uncompressed size of the named entry, in bytes; None for an unknown entry."""
    if name == METADATA_NAME:
        return MAX_METADATA_BYTES
    view_id = entry_view_id(name, expected)
    return None if view_id is None else FORMATS[PurePosixPath(name).suffix].max_bytes(expected[view_id])


def match_entries(names: Sequence[str], expected: ExpectedViews) -> MatchedEntries:
    """Assign entry names, in archive order, to the expected views.

    If all entries lie in one superfluous top-level folder, only that problem is reported.
    """
    candidates: dict[str, list[int]] = defaultdict(list)
    unknown_entries: list[str] = []
    folders = {f"{parent}/" for view_id in expected for parent in PurePosixPath(view_id).parents}
    for index, name in enumerate(names):
        key = METADATA_NAME if name == METADATA_NAME else entry_view_id(name, expected)
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


def _wrapper_folder_problem(names: Sequence[str], expected: ExpectedViews) -> str | None:
    """Return the problem of an archive whose valid entries all lie in one superfluous folder, or None."""
    files = [name for name in names if not name.endswith("/") and not _is_macos_metadata(name)]
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
    return (
        f"{escape_text(files[0])}: all {len(files)} entries are inside the folder {escape_text(top)}/, expected "
        f"{escape_text(inner_names[0])} at the top level: zip the folder's contents, not the folder"
    )


def _unknown_entry_problems(unknown_entries: Sequence[str], expected: ExpectedViews) -> list[str]:
    macos = [name for name in unknown_entries if _is_macos_metadata(name)]
    problems = [_unknown_entry_problem(name, expected) for name in unknown_entries if not _is_macos_metadata(name)]
    if macos:
        problems.append(
            f"{escape_text(macos[0])}: {len(macos)} entries made by macOS were found, expected none; {_ZIP_HINT}"
        )
    return problems


def _unknown_entry_problem(name: str, expected: ExpectedViews) -> str:
    path = PurePosixPath(name)
    view_id = name.removesuffix(path.suffix)
    configs = sorted({config_of(view) for view in expected})
    if view_id in expected:
        reason = f"the suffix is {escape_text(path.suffix or 'missing')}, expected one of {_SUFFIXES}"
    elif path.suffix in FORMATS and config_of(name) in configs and "/" in name:
        reason = f"the dataset has no view {escape_text(view_id)} in the config {config_of(name)}"
    elif path.suffix in FORMATS and "/" in name:
        reason = f"the dataset has no config {escape_text(config_of(name))}, expected one of {', '.join(configs)}"
    else:
        reason = f"expected {METADATA_NAME} or <view_id> with one of {_SUFFIXES}"
    return f"{escape_text(name)}: unknown entry, {reason}"


def _duplicate_problems(candidates: Mapping[str, Sequence[int]], names: Sequence[str]) -> list[str]:
    return [
        f"{key}: {len(indices)} entries were found ({', '.join(names[index] for index in indices[:4])}"
        f"{', ...' if len(indices) > 4 else ''}), expected one"
        for key, indices in candidates.items()
        if len(indices) > 1
    ]


def _missing_problems(candidates: Mapping[str, Sequence[int]], expected: ExpectedViews) -> list[str]:
    problems = [] if METADATA_NAME in candidates else [f'{METADATA_NAME}: missing, expected {{"method": "name"}}']
    configs = {config_of(view_id) for view_id in candidates if view_id != METADATA_NAME}
    if not configs:
        return [
            *problems,
            f"no view was found, expected <view_id> with one of {_SUFFIXES} of at least one config",
        ]
    missing = (view for view in sorted(expected) if config_of(view) in configs and view not in candidates)
    return problems + [
        f"{view}: missing, expected one of {_SUFFIXES}, because other views of {config_of(view)} are included"
        for view in missing
    ]


def _is_macos_metadata(name: str) -> bool:
    return name.startswith("__MACOSX/") or PurePosixPath(name).name == ".DS_Store"
