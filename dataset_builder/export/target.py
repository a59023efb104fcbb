"""The folder an export goes to: new, empty, or an earlier export of the very same data that goes on."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from rebar_depth_bench.atomic_io import write_text
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.errors import InputError

MARKER = "export.json"
FORMAT = "rebar-depth-export-1"
_TEMPORARY = ".*.tmp"
_HALF_MARKER = f".{MARKER}.*.tmp"


@dataclass(frozen=True)
class _Part:
    """What the folder holds of a config: the key of its build and the ids of its views."""

    key: str
    views: tuple[str, ...]


@contextmanager
def export_target(to: Path, folder: DatasetFolder, wanted: Mapping[str, Sequence[str]]) -> Iterator[None]:
    """Prepare ``to`` for the wanted view ids of each config and hold it until the export is done.

    ``export.json`` there names the dataset, and for each config its build and its views; what a killed export left
    half written is removed. Raises ``InputError`` for a folder that holds anything else, another dataset, another
    build, or views that are not wanted now; or at which another export is at work.
    """
    _check_place(to, folder)
    try:
        to.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{to}: cannot be made: {error.strerror}") from None
    with _only_one(to):
        parts = _continued(to, folder, wanted)
        for temporary in to.rglob(_TEMPORARY):
            temporary.unlink()
        configs = {name: asdict(part) for name, part in parts.items()}
        marker = {"format": FORMAT, "dataset": folder.digest, "configs": configs}
        write_text(to / MARKER, json.dumps(marker) + "\n")
        yield


def _check_place(to: Path, folder: DatasetFolder) -> None:
    if to.exists() and not to.is_dir():
        raise InputError(f"{to}: is a file, expected a folder")
    root = Path(folder.root).resolve()
    if to.resolve().is_relative_to(root):
        raise InputError(f"{to}: lies in the dataset folder {folder.root}, expected a folder outside of it")
    if to.is_dir() and not (to / MARKER).is_file():
        foreign = sorted(path.name for path in to.iterdir() if not path.match(_HALF_MARKER))
        if foreign:
            raise InputError(
                f"{to}: is not empty (it holds {foreign[0]}) and has no {MARKER}, "
                "expected a new or an empty folder"
            )


def _continued(to: Path, folder: DatasetFolder, wanted: Mapping[str, Sequence[str]]) -> dict[str, _Part]:
    """Return what ``to`` will hold: earlier configs stay, the wanted ones join or grow."""
    parts = {name: _Part(str(folder.config(name)["key"]), tuple(views)) for name, views in wanted.items()}
    earlier = _earlier_parts(to / MARKER, folder) if (to / MARKER).is_file() else {}
    for name in earlier.keys() & parts.keys():
        _check_part(to, name, earlier[name], parts[name])
    return {**earlier, **parts}


def _earlier_parts(path: Path, folder: DatasetFolder) -> dict[str, _Part]:
    try:
        marker = json.loads(path.read_bytes())
        found, dataset = marker["format"], marker["dataset"]
        parts = {name: _Part(str(one["key"]), tuple(one["views"])) for name, one in marker["configs"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read as the record of an export: {error!r}") from None
    if found != FORMAT:
        raise InputError(f"{path}: format is {found!r}, expected {FORMAT!r}")
    if dataset != folder.digest:
        raise InputError(
            f"{path.parent}: holds an export of dataset {dataset}, but {folder.root} is {folder.digest}; "
            "choose another folder"
        )
    return parts


def _check_part(to: Path, name: str, earlier: _Part, now: _Part) -> None:
    if earlier.key != now.key:
        raise InputError(
            f"{to}: holds config {name} of another build (key {earlier.key[:16]}, now {now.key[:16]}): "
            "the same ground truth under other pictures; choose another folder"
        )
    dropped = set(earlier.views) - set(now.views)
    if dropped:
        raise InputError(
            f"{to}: holds {len(earlier.views)} views of {name}, {len(dropped)} of which are not among the "
            f"{len(now.views)} asked for, such as {min(dropped)}; ask for more views or choose another folder"
        )


@contextmanager
def _only_one(to: Path) -> Iterator[None]:
    """Lock the folder itself, which leaves no file behind; a killed holder lets go of it."""
    descriptor = os.open(to, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{to}: another export is at work there") from None
        yield
    finally:
        os.close(descriptor)
