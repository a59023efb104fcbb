"""Export target folder: new, empty, or an earlier export of the same data that is resumed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import check_no_links, parse_json, read_file, remove_file
from rebar_depth_bench.base.system import exclusive_lock
from rebar_depth_bench.base.validation import StrictModel, one_of, validate_table
from rebar_depth_bench.base.writing import temporary_target, write_error, write_text
from rebar_depth_bench.data.manifest import DatasetFolder

MARKER = "export.json"
"""File in the target folder that identifies an export."""

FORMAT = "rebar-depth-export-1"
"""Format version of ``MARKER``."""


class ExportedPart(StrictModel):
    """What is exported into one folder, a config or a scene: the key of its build and the ids of its views."""

    key: str
    views: list[str]


class _Marker(StrictModel):
    """Content of ``MARKER``."""

    format: Annotated[str, one_of(FORMAT)]
    dataset: str
    configs: dict[str, ExportedPart]


@contextmanager
def export_target(
    to: Path, folder: DatasetFolder, parts: Mapping[str, ExportedPart], subfolders: Sequence[str]
) -> Iterator[None]:
    """Prepare and lock ``to`` for an export of ``parts``, by folder below ``to``, into ``subfolders`` of each.

    Context manager; the lock is held until it exits. ``export.json`` in the folder records the dataset and, for
    each config, its build and its views. Temporary files left by a killed export are removed. Raises
    ``InputError`` if the folder contains anything else, another dataset or build, or views that are not
    wanted now, a link in place of a folder that the export writes to, or if another export holds the lock.
    """
    _check_target(to, folder)
    folders = [f"{name}/{subfolder}" for name in parts for subfolder in subfolders]
    check_no_links(to, *folders)
    try:
        to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(to, error) from None
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(to))  # Locking the folder itself leaves no file behind.
        except BlockingIOError:
            raise InputError(f"{to}: another export is using this folder") from None
        earlier = _read_marker(to / MARKER, folder) if (to / MARKER).is_file() else {}
        for name in earlier.keys() & parts.keys():
            _check_same_build(to, name, earlier[name], parts[name])
        for path in (to, *(to / name for name in folders)):
            _remove_temporary_files(path, MARKER if path == to else None)
        marker = _Marker(format=FORMAT, dataset=folder.digest, configs={**earlier, **parts})
        write_text(to / MARKER, json.dumps(marker.model_dump()) + "\n")
        yield


def _remove_temporary_files(folder: Path, only_of: str | None) -> None:
    """Delete the temporary files in a folder, which need not exist: all, or those of the file ``only_of``."""
    for path in list(folder.iterdir()) if folder.is_dir() else ():
        target = temporary_target(path.name)
        if target is not None and only_of in (None, target):
            remove_file(path)


def _check_target(to: Path, folder: DatasetFolder) -> None:
    """Raise ``InputError`` if ``to`` is a file, is in the dataset folder or contains anything but an export."""
    if to.exists() and not to.is_dir():
        raise InputError(f"{to}: is a file, expected a folder")
    root = Path(folder.root).resolve()
    if to.resolve().is_relative_to(root):
        raise InputError(f"{to}: is inside the dataset folder {folder.root}, expected a folder outside it")
    if to.is_dir() and not (to / MARKER).is_file():
        foreign = sorted(path.name for path in to.iterdir() if temporary_target(path.name) != MARKER)
        if foreign:
            raise InputError(
                f"{to}: is not empty (it contains {foreign[0]}) and has no {MARKER}, "
                "expected a new or an empty folder"
            )


def _read_marker(path: Path, folder: DatasetFolder) -> dict[str, ExportedPart]:
    """Return the configs of an earlier export from its ``export.json``.

    Raises ``InputError`` if the file is invalid, has another format or names another dataset.
    """
    values, problems = parse_json(read_file(path, JSON_BYTES, "the record of an export", InputError))
    marker = None if problems else validate_table(_Marker, values, problems)
    if marker is None:
        raise InputError.from_problems(path, problems)
    if marker.dataset != folder.digest:
        raise InputError(
            f"{path.parent}: contains an export of dataset {marker.dataset}, expected {folder.digest} "
            f"as in {folder.root}; choose another folder"
        )
    return marker.configs


def _check_same_build(to: Path, name: str, earlier: ExportedPart, wanted: ExportedPart) -> None:
    """Raise ``InputError`` if a config was exported from another build or has unselected views."""
    if earlier.key != wanted.key:
        raise InputError(
            f"{to}: contains config {name} of another build (key {earlier.key[:16]}, now {wanted.key[:16]}): "
            "the ground truth is the same, but the images may differ; choose another folder"
        )
    dropped = set(earlier.views) - set(wanted.views)
    if dropped:
        raise InputError(
            f"{to}: contains {len(earlier.views)} views of {name}, {len(dropped)} of which are not among the "
            f"{len(wanted.views)} requested, such as {min(dropped)}; request more views or choose another folder"
        )
