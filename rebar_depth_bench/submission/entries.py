"""Which entry of an archive is which view: unknown, duplicate and missing ones, and what to do about them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from rebar_depth_bench.errors import show
from rebar_depth_bench.submission.formats import FORMATS
from rebar_depth_bench.submission.metadata import MAX_METADATA_BYTES, METADATA_NAME

ExpectedViews = Mapping[str, tuple[int, int]]
"""Every view_id (``<config>/<0000>``) of a dataset folder with its (H, W) in pixels."""

_SUFFIXES = ", ".join(FORMATS)
_ZIP_HINT = "zip with: zip -r submission.zip submission.json <config> -x '*.DS_Store'"


@dataclass(frozen=True, slots=True)
class Layout:
    """The index of every view's only entry and of ``submission.json``, and what does not fit."""

    views: Mapping[str, int]
    metadata: int | None
    problems: tuple[str, ...]


def config_of(view_id: str) -> str:
    """Return the config that a view belongs to: the part before the slash."""
    return view_id.partition("/")[0]


def view_of(name: str, expected: ExpectedViews) -> str | None:
    """Return the view whose entry may have this name, or None."""
    path = PurePosixPath(name)
    view_id = name.removesuffix(path.suffix)
    return view_id if path.suffix in FORMATS and view_id in expected else None


def size_limit(name: str, expected: ExpectedViews) -> int | None:
    """Return the largest uncompressed size in bytes that the entry of this name needs; None if unknown."""
    if name == METADATA_NAME:
        return MAX_METADATA_BYTES
    view_id = view_of(name, expected)
    return None if view_id is None else FORMATS[PurePosixPath(name).suffix].max_bytes(expected[view_id])


def lay_out(names: Sequence[str], expected: ExpectedViews) -> Layout:
    """Assign entry names, in the archive's order, to the expected views."""
    claims: dict[str, list[int]] = defaultdict(list)
    strangers: list[str] = []
    folders = {f"{parent}/" for view_id in expected for parent in PurePosixPath(view_id).parents}
    for index, name in enumerate(names):
        key = METADATA_NAME if name == METADATA_NAME else view_of(name, expected)
        if key is not None:
            claims[key].append(index)
        elif name not in folders:
            strangers.append(name)
    wrapper = _wrapping_folder(names, expected)
    if wrapper is not None:
        return Layout({}, None, (wrapper,))
    views = {key: at[0] for key, at in claims.items() if len(at) == 1 and key != METADATA_NAME}
    about = [
        *_stranger_problems(strangers, expected),
        *_duplicate_problems(claims, names),
        *_missing_problems(claims, expected),
    ]
    metadata = claims.get(METADATA_NAME, [])
    return Layout(views, metadata[0] if len(metadata) == 1 else None, tuple(about))


def _wrapping_folder(names: Sequence[str], expected: ExpectedViews) -> str | None:
    """Return the problem of an archive whose right entries all sit in one folder too many."""
    files = [name for name in names if not name.endswith("/") and not _from_macos(name)]
    tops = {name.partition("/")[0] for name in files}
    if len(tops) != 1:
        return None
    (top,) = tops
    inner = [name.removeprefix(f"{top}/") for name in files]
    right = [name for name in inner if name == METADATA_NAME or view_of(name, expected)]
    if len(right) < len(inner) or any(view_of(name, expected) for name in files) or METADATA_NAME in files:
        return None
    return (
        f"{show(files[0])}: all {len(files)} entries are inside the folder {show(top)}/, expected "
        f"{show(inner[0])} at the top level: zip the folder's contents, not the folder"
    )


def _stranger_problems(strangers: Sequence[str], expected: ExpectedViews) -> list[str]:
    macos = [name for name in strangers if _from_macos(name)]
    found = [_stranger_problem(name, expected) for name in strangers if not _from_macos(name)]
    if macos:
        found.append(
            f"{show(macos[0])}: {len(macos)} entries made by macOS were found, expected none; {_ZIP_HINT}"
        )
    return found


def _stranger_problem(name: str, expected: ExpectedViews) -> str:
    path = PurePosixPath(name)
    view_id = name.removesuffix(path.suffix)
    configs = sorted({config_of(view) for view in expected})
    if view_id in expected:
        reason = f"the suffix is {show(path.suffix or 'missing')}, expected one of {_SUFFIXES}"
    elif path.suffix in FORMATS and config_of(name) in configs and "/" in name:
        reason = f"the dataset has no view {show(view_id)} in the config {config_of(name)}"
    elif path.suffix in FORMATS and "/" in name:
        reason = f"the dataset has no config {show(config_of(name))}, expected one of {', '.join(configs)}"
    else:
        reason = f"expected {METADATA_NAME} or <view_id> with one of {_SUFFIXES}"
    return f"{show(name)}: unknown entry, {reason}"


def _duplicate_problems(claims: Mapping[str, Sequence[int]], names: Sequence[str]) -> list[str]:
    return [
        f"{key}: {len(at)} entries were found ({', '.join(names[index] for index in at[:4])}"
        f"{', ...' if len(at) > 4 else ''}), expected one"
        for key, at in claims.items()
        if len(at) > 1
    ]


def _missing_problems(claims: Mapping[str, Sequence[int]], expected: ExpectedViews) -> list[str]:
    found = [] if METADATA_NAME in claims else [f'{METADATA_NAME}: missing, expected {{"method": "name"}}']
    configs = {config_of(view_id) for view_id in claims if view_id != METADATA_NAME}
    if not configs:
        return [
            *found,
            f"no view was found, expected <view_id> with one of {_SUFFIXES} of at least one config",
        ]
    missing = (view for view in sorted(expected) if config_of(view) in configs and view not in claims)
    return found + [
        f"{view}: missing, expected one of {_SUFFIXES}, since other views of {config_of(view)} are there"
        for view in missing
    ]


def _from_macos(name: str) -> bool:
    return name.startswith("__MACOSX/") or PurePosixPath(name).name == ".DS_Store"
