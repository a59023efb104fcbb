"""Files and folders of a dataset folder that a build owns: names, links, removal, the lock.

A build may continue in a folder from another machine. It writes and deletes nothing outside the folder: folders
that it changes are no links, and it deletes regular files whose names are its own, but no others.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from dataset_builder.pipeline.plan import BUILD_FOLDER, STAGING_KEY, ConfigPlan
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_FILE
from rebar_depth_bench.base.errors import InputError, OutputError
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.base.reading import check_no_links, remove_file, remove_folder
from rebar_depth_bench.base.system import exclusive_lock
from rebar_depth_bench.base.writing import temporary_target, write_error
from rebar_depth_bench.data.bars import BARS_FILE
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256
from rebar_depth_bench.data.manifest import DatasetFolder

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
"""Names of the files in the folder of a config; with several scenes, they include split and scene."""


def stagings_by_label(out: Path) -> dict[str, list[Path]]:
    """Return the staging folders of ``out`` by the label of their config, including abandoned builds."""
    by_label: dict[str, list[Path]] = {}
    folder = out / BUILD_FOLDER
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        label, _, key = path.name.rpartition("-")
        if re.fullmatch(STAGING_KEY, key):
            by_label.setdefault(label, []).append(path)
    return by_label


def check_target(out: Path, configs: Collection[str]) -> None:
    """Raise ``InputError`` unless ``out`` is new, empty or a dataset folder, where configs can be written.

    Raises ``OutputError`` if it cannot be written. No other files are ever changed. Folders that a build changes,
    its lock and the files in staging folders may not be links.
    """
    ancestor = existing_ancestor(out)
    if not ancestor.is_dir():
        raise InputError(f"{out}: {ancestor} is a file, expected a folder")
    if not os.access(ancestor, os.W_OK | os.X_OK):
        raise OutputError(f"{out}: cannot be written: no permission to write in {ancestor}")
    check_no_links(out, f"{BUILD_FOLDER}/{LOCK}", f"{BUILD_FOLDER}/{BARS_FILE}", MESHES, PICTURES, *configs)
    for staging in (path for paths in stagings_by_label(out).values() for path in paths):
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


@contextmanager
def build_lock(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on the file ``lock`` in ``folder``; the lock of a killed process is released.

    Raises ``InputError`` if another process holds the lock, and ``OutputError`` if the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder.parent, error) from None
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(folder / LOCK))
        except BlockingIOError:
            raise InputError(f"{folder.parent}: another rebar-build process is using this folder") from None
        yield


def file_matches(folder: DatasetFolder, name: str) -> bool:
    """Return whether a file of a local dataset folder exists with the digest that the manifest has for it."""
    path = Path(folder.root, name)
    return path.is_file() and file_sha256(path) == folder.files.get(name)


def stored_bars_path(out: Path, folder: DatasetFolder) -> Path:
    """Return the path of the bars of all scenes that the manifest describes.

    It is that of ``bars.parquet``, or of the copy that an interrupted build has left. Raises ``InputError`` if
    neither matches its digest.
    """
    for path in (out / BARS_FILE, out / BUILD_FOLDER / BARS_FILE):
        if path.is_file() and file_sha256(path) == folder.files.get(BARS_FILE):
            return path
    raise InputError(
        f"{out}: {BARS_FILE} does not match the manifest, expected the bars of the scenes that are not built now; "
        "restore the file, or build all configs in another folder"
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


def remove_stagings(out: Path, plans: Iterable[ConfigPlan]) -> None:
    """Delete all staging folders of configs, but for a build without colour only its own.

    The others may hold views with colour, which take hundreds of times as long.
    """
    stagings = stagings_by_label(out)
    for plan in plans:
        for staging in stagings.get(plan.spec.label, ()):
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
