"""Files of a dataset in a local folder or a Hub repository at one commit: access, digests and verification."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from pydantic import ConfigDict

from rebar_depth_bench.base.errors import DatasetError, InputError, Problem, escape_text
from rebar_depth_bench.base.names import PATH_PATTERN
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import FileSource, open_regular, path_below
from rebar_depth_bench.base.validation import StrictModel

if TYPE_CHECKING:
    from rebar_depth_bench.data.manifest import DatasetFolder
    from rebar_depth_bench.data.schema import ViewRecord


MANIFEST_FILE = "manifest.json"
CROISSANT_FILE = "croissant.json"
"""Description of a folder that ``rebar-build croissant`` prints: it names the digests of all files."""
_HUB_NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,95}"
_HUB_ROOT_PATTERN = re.compile(rf"(?P<repository>{_HUB_NAME}/{_HUB_NAME})(@(?P<revision>{PATH_PATTERN}))?")


class Located(StrictModel):
    """Dataset, or part of one.

    ``root`` is a folder path, or the id of a Hub repository with an optional ``@REVISION`` (branch, tag or
    commit); ``commit`` is the revision of the Hub that files are read from, empty for a local folder.
    """

    model_config = ConfigDict(extra="ignore")

    root: str
    commit: str = ""

    @property
    def local(self) -> Path | None:
        """Path of a local dataset folder, or None for a Hub repository."""
        path = Path(self.root)
        return path if path.is_dir() else None

    def file(self, name: str) -> Path:
        """Return the local path of a file of the dataset, downloaded first if the dataset is a Hub repository.

        Without a commit, the root may be a mistyped folder: the Hub is asked once, and not at all if a local
        folder has the name of the repository's owner. Raises ``DatasetError`` if the root is neither a folder nor
        a repository, and if the file is missing, not a regular file, or cannot be downloaded.
        """
        folder = Path(self.root)
        if folder.exists() and not folder.is_dir():
            raise DatasetError(f"{self.root}: is a file, no such folder")
        path = path_below(folder, name) if folder.is_dir() else _download(self.root, name, self.commit)
        try:
            open_regular(path).close()
        except FileNotFoundError:
            raise DatasetError(
                f"{self.root}: has no {name}, expected a complete dataset folder written by rebar-build"
            ) from None
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from None
        return path

    def open(self, name: str) -> BinaryIO:
        """Open a file of the dataset for reading; a file of the Hub that is not cached is read in ranges.

        Raises ``DatasetError`` if the file is missing, not a regular file, or cannot be read from the Hub.
        """
        if self.local is not None:
            return open_regular(self.file(name))
        from huggingface_hub import HfFileSystem, try_to_load_from_cache

        repository, _ = _hub_root(self.root)
        cached = try_to_load_from_cache(repository, name, repo_type="dataset", revision=self.commit)
        if isinstance(cached, str):
            return open_regular(Path(cached))
        try:
            return cast(BinaryIO, HfFileSystem().open(f"datasets/{repository}@{self.commit}/{name}"))
        except Exception as error:  # The errors of the HTTP client have no base class in the Hub's package.
            raise _download_error(self.root, name, error) from None


def _hub_root(root: str) -> tuple[str, str | None]:
    """Return the repository and the revision (None: the main branch) of a Hub root.

    Raises ``DatasetError`` if the root cannot be a repository.
    """
    match = _HUB_ROOT_PATTERN.fullmatch(root)
    if match is None:
        raise DatasetError(
            f"{escape_text(root)}: no such folder, expected a dataset folder or a Hub repository id, ORG/NAME or "
            "ORG/NAME@REVISION"
        )
    return match["repository"], match["revision"]


def local_folder(root: str | Path) -> Path:
    """Return the path of a dataset folder on this machine. Raises ``DatasetError`` if ``root`` is no folder."""
    if not Path(root).is_dir():
        raise DatasetError(
            f"{root}: no such folder, expected a dataset folder on this machine; download a Hub repository first"
        )
    return Path(root)


def _download(root: str, name: str, commit: str) -> Path:
    # Imported on use: it takes a fifth of a second, which local folders do not need.
    from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url
    from huggingface_hub.errors import HfHubHTTPError

    repository, revision = _hub_root(root)
    folder = Path(repository).parent
    if not commit and folder.is_dir():
        raise DatasetError(
            f"{root}: no such folder, expected a dataset folder; it is not read as the id of a Hub repository, "
            f"since the folder {folder} exists here"
        )
    download = partial(hf_hub_download, repository, name, repo_type="dataset", revision=commit or revision)
    try:
        if not commit:  # Without an answer, the download would try five times more.
            get_hf_file_metadata(hf_hub_url(repository, name, repo_type="dataset", revision=revision))
        return Path(download())
    except Exception as error:  # The errors of the HTTP client have no base class in the Hub's package.
        if not isinstance(error, HfHubHTTPError) or error.response.status_code >= 500:  # The Hub cannot be asked.
            with suppress(Exception):
                return Path(download(local_files_only=True))
        raise _download_error(root, name, error) from None


def _download_error(root: str, name: str, error: Exception) -> InputError:
    return DatasetError(f"{root}: not a local folder, and its {name} cannot be downloaded from the Hub: {error}")


def file_sha256(path: Path) -> str:
    """Return the hex SHA-256 of a regular file. Raises ``OSError`` if it is missing or not a regular file."""
    return FileSource(path).sha256()


def views_digest(views: Iterable[ViewRecord]) -> str:
    """Return the ground-truth digest, ``sha256:...``, over the ids and eye digests of the views, sorted by id."""
    lines = sorted(f"{view.view_id} {view.left} {view.right}\n" for view in views)
    return "sha256:" + hashlib.sha256("".join(lines).encode()).hexdigest()


def parameters_digest(parameters: object) -> str:
    """Return the hex SHA-256 of the canonical JSON of ``parameters`` (sorted keys, no whitespace, no NaN)."""
    canonical = json.dumps(parameters, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def planes_digest(scenes: Iterable[Mapping[str, Any]]) -> str:
    """Return the digest, ``sha256:...``, of the planes of formwork of scenes, given their manifest entries."""
    return "sha256:" + parameters_digest({scene["name"]: scene.get("planes", []) for scene in scenes})


def file_problems(folder: DatasetFolder, progress: Progress = silent) -> Iterator[Problem]:
    """Yield a problem for each file of the manifest that is missing or differs, and for each further file.

    Files of a Hub repository are downloaded first; further files of a repository are not searched for.
    """
    for done, (name, sha256) in enumerate(folder.files.items(), start=1):
        if problem := _file_problem(folder, name, sha256):
            yield problem
        progress("files", done, len(folder.files))
    used = {name for config in folder.config_by_name.values() for name in config.files}
    for name in sorted(used - set(folder.files)):
        yield Problem("missing", name, "has no SHA-256 in the manifest, which names it", "one for each file")
    if folder.local is not None:
        for name in sorted(
            _existing_files(folder.local) - set(folder.files) - used - {MANIFEST_FILE, CROISSANT_FILE}
        ):
            yield Problem("unknown", escape_text(name), "is not in the manifest")


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
