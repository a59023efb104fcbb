"""Files and folders of a dataset folder that a build owns: their names, checks for links, and removal.

A build may continue in a folder from another machine. It writes and deletes nothing outside the folder: folders
that it changes are no links, and it deletes regular files whose names are its own, but no others.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from dataset_builder.pipeline.plan import BUILD_FOLDER, ConfigPlan
from rebar_depth_bench.atomic_io import temporary_target
from rebar_depth_bench.bar_crossings.table import CROSSINGS_FILE
from rebar_depth_bench.data.bars import BARS_FILE
from rebar_depth_bench.data.manifest import MANIFEST_FILE, open_folder
from rebar_depth_bench.errors import InputError, OutputError
from rebar_depth_bench.paths import check_no_links, remove_file, remove_folder
from rebar_depth_bench.view_ids import SPLITS

MESHES = "meshes"
PICTURES = "pictures"
CARD = "README.md"
LOCK = "lock"
SHARD_DIGEST_CHARACTERS = 12

_NAME = "[a-z0-9][a-z0-9-]{0,199}"
_OWN_NAMES = {MESHES: re.compile(rf"{_NAME}\.ply"), PICTURES: re.compile(rf"{_NAME}\.webp")}
"""Names of the files in the folders that all configs share."""
SHARD_NAME = re.compile(
    rf"(?:test|(?:{'|'.join(SPLITS)})-{_NAME})-\d{{5}}-of-\d{{5}}-[0-9a-f]{{{SHARD_DIGEST_CHARACTERS}}}\.parquet"
)
"""Names of the files in the folder of a config; those of a config of several scenes name split and scene."""


def check_folder(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Raise ``InputError`` unless ``out`` is new, empty or a dataset folder that the plans can be built in.

    Raises as ``check_target`` does. A config with colour may not be built again without.
    """
    stagings = (path for plan in plans for path in plan.all_stagings())  # Not read before ``out`` is checked.
    check_target(out, [plan.spec.name for plan in plans], stagings)
    if (out / MANIFEST_FILE).is_file():
        _check_keeps_colour(out, plans)


def check_target(out: Path, configs: Collection[str], stagings: Iterable[Path]) -> None:
    """Raise ``InputError`` unless ``out`` is new, empty or a dataset folder, where configs can be written.

    Raises ``OutputError`` if it cannot be written. No other files are ever changed. Folders that a build changes,
    its lock and the files in the staging folders may not be links.
    """
    ancestor = existing_ancestor(out)
    if not ancestor.is_dir():
        raise InputError(f"{out}: {ancestor} is a file, expected a folder")
    if not os.access(ancestor, os.W_OK | os.X_OK):
        raise OutputError(f"{out}: cannot be written: no permission to write in {ancestor}")
    check_no_links(out, f"{BUILD_FOLDER}/{LOCK}", MESHES, PICTURES, *configs)
    for staging in stagings:
        check_no_links(out, os.path.relpath(staging, out))
        for folder, folders, files in os.walk(staging):
            check_no_links(Path(folder), *folders, *files)
    is_dataset = (out / MANIFEST_FILE).is_file() or (out / BUILD_FOLDER / LOCK).is_file()
    if out.is_dir() and any(out.iterdir()) and not is_dataset:
        raise InputError(
            f"{out}: is not empty and has no {MANIFEST_FILE}, expected a new folder or a dataset folder"
        )


def existing_ancestor(path: Path) -> Path:
    """Return the longest part of a path that exists and can be reached; the path itself if it does."""
    path = path.absolute()
    for candidate in (path, *path.parents[:-1]):
        with suppress(OSError):
            if candidate.exists():
                return candidate
    return Path(path.anchor)


def _check_keeps_colour(out: Path, plans: Sequence[ConfigPlan]) -> None:
    published = open_folder(out).config_by_name
    names = [plan.spec.name for plan in plans if plan.spec.colour is None and plan.spec.name in published]
    if with_colour := [name for name in names if published[name].colour is not None]:
        raise InputError(
            f"{out}: contains {', '.join(with_colour)} with colour, which --no-colour would replace; choose "
            "another folder (--out) or other configs (--config)"
        )


def remove_unlisted_files(out: Path, listed: Collection[str]) -> None:
    """Delete the shards, meshes and pictures whose paths in ``out`` are not ``listed``."""
    for folder, own_name in _own_folders(out):
        for path in list(folder.iterdir()):
            if own_name.fullmatch(path.name) and path.relative_to(out).as_posix() not in listed:
                remove_file(path)


def remove_temporary_files(out: Path) -> None:
    """Delete the temporary files that a killed build left."""
    top_names = re.compile("|".join(map(re.escape, (MANIFEST_FILE, BARS_FILE, CROSSINGS_FILE, CARD))))
    for folder, own_name in [(out, top_names), *_own_folders(out)]:
        for path in list(folder.iterdir()):
            target = temporary_target(path.name)
            if target is not None and own_name.fullmatch(target):
                remove_file(path)


def remove_stagings(plan: ConfigPlan) -> None:
    """Delete all staging folders of a config, but for a build without colour only its own.

    The others may hold views with colour, which take hundreds of times as long.
    """
    for staging in plan.all_stagings():
        if plan.spec.colour is not None or staging == plan.staging.root:
            remove_folder(staging)


def remove_build_folder(folder: Path) -> None:
    """Delete the build folder unless it contains anything but its lock, such as unfinished configs."""
    if {path.name for path in folder.iterdir()} <= {LOCK}:
        remove_file(folder / LOCK)
        folder.rmdir()


def _own_folders(out: Path) -> Iterator[tuple[Path, re.Pattern[str]]]:
    """Yield the folders in ``out`` that are no links, with the pattern of the names that are a build's own."""
    for folder in sorted(out.iterdir()):
        if re.fullmatch(_NAME, folder.name) and folder.is_dir() and not folder.is_symlink():
            yield folder, _OWN_NAMES.get(folder.name, SHARD_NAME)
