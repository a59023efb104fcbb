"""Verification of a dataset's files and ground truth against the digests of its manifest."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import MANIFEST_FILE, DatasetConfig, DatasetFolder
from rebar_depth_bench.data.rows import iterate_rows, truth_columns, truth_from_row
from rebar_depth_bench.errors import DatasetError, Problem, escape_text
from rebar_depth_bench.parallel import Progress, silent
from rebar_depth_bench.reading import path_below


def file_problems(folder: DatasetFolder, progress: Progress = silent) -> Iterator[Problem]:
    """Yield a problem for each file of the manifest that is missing or has another SHA-256, and for further files.

    Files of a Hub repository are downloaded first; its further files are not looked for.
    """
    for done, (name, sha256) in enumerate(folder.files.items(), start=1):
        if problem := _file_problem(folder, name, sha256):
            yield problem
        progress("files", done, len(folder.files))
    used = {name for config in folder.config_by_name.values() for name in config.files}
    for name in sorted(used - set(folder.files)):
        yield Problem("missing", name, "has no SHA-256 in the manifest, which names it", "one for each file")
    if folder.local is not None:
        for name in sorted(_existing_files(folder.local) - set(folder.files) - used - {MANIFEST_FILE}):
            yield Problem("unknown", escape_text(name), "is not in the manifest")


def truth_problems(config: DatasetConfig, progress: Progress = silent) -> Iterator[Problem]:
    """Yield a problem for each view whose cameras or ground truth differ from the digests of the manifest.

    Raises ``DatasetError`` for damaged shards and rows that are not the views of the manifest.
    """
    records = {record.view_id: record for record in config.views}
    columns = ("view_id", "scene", *(name for eye in config.truth_eyes for name in truth_columns(eye)))
    for done, row in enumerate(iterate_rows(config, columns), start=1):
        record = records[row["view_id"]]
        for eye in config.truth_eyes:
            digest, expected = truth_from_row(row, eye).digest(), getattr(record, eye)
            if digest != expected:
                found = f"the {eye} ground truth has the digest {digest[:16]}"
                yield Problem("conflict", record.view_id, found, f"{expected[:16]} as in the manifest")
        progress(f"ground truth of {config.name}", done, len(records))


def _file_problem(folder: DatasetFolder, name: str, sha256: str) -> Problem | None:
    try:
        actual_sha256 = file_sha256(folder.file(name) if folder.local is None else path_below(folder.local, name))
    except FileNotFoundError:
        return Problem("missing", name, "is missing")
    except OSError as error:
        return Problem("unreadable", name, f"cannot be read: {error.strerror or error}")
    except DatasetError as error:  # The file cannot be downloaded.
        return Problem("unreadable", name, escape_text(str(error)))
    if actual_sha256 == sha256:
        return None
    return Problem("conflict", name, f"SHA-256 is {actual_sha256[:16]}", sha256[:16])


def _existing_files(root: Path) -> set[str]:
    """Return the relative POSIX paths of all files in a folder that are not hidden at its top level."""
    names = set()
    for folder, subfolders, files in os.walk(root):
        links = [name for name in subfolders if Path(folder, name).is_symlink()]
        names |= {Path(folder, name).relative_to(root).as_posix() for name in (*files, *links)}
    return {name for name in names if not name.startswith(".")}
