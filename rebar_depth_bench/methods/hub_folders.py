"""Models of the Hub as local folders, never fetched silently; the folder's name is the commit."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.errors import MethodError

HUB_ACCESS = "a connection, HF_TOKEN for a model that is not public"


def snapshot(repository: str, file: str, instead: str) -> Path:
    """Return the Hub's cached snapshot of a model's main branch, with at least ``file``; its name is the commit.

    Only where the cache has none is ``file`` fetched, and said first. ``instead`` is what to name where the model
    is in a folder of one's own (``local_copy``).

    Raises ``MethodError`` where it is not to be had.
    """
    from huggingface_hub import constants, hf_hub_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(repository, file, local_files_only=True)).parent
    except LocalEntryNotFoundError:
        pass
    announce(repository, file, constants.ENDPOINT, instead)
    try:
        return Path(hf_hub_download(repository, file)).parent
    except Exception as error:  # the Hub's client raises its own, httpx's and the system's
        raise unavailable(repository, constants.ENDPOINT, error, instead, HUB_ACCESS) from None


def complete_snapshot(repository: str, folder: Path, files: Sequence[str], instead: str) -> None:
    """Fetch what a snapshot lacks of ``files``, at its own commit, whatever the main branch is by now.

    Raises ``MethodError`` where they are not to be had.
    """
    from huggingface_hub import constants, snapshot_download

    lacking = [name for name in files if not (folder / name).is_file()]
    if not lacking:
        return
    announce(repository, " and ".join(lacking), constants.ENDPOINT, instead)
    try:
        snapshot_download(repository, revision=folder.name, allow_patterns=lacking)
    except Exception as error:
        raise unavailable(repository, constants.ENDPOINT, error, instead, HUB_ACCESS) from None
    for name in lacking:  # a file that the Hub does not list is passed over without a word
        if not (folder / name).is_file():
            raise MethodError(f"{repository}: no {name} at commit {folder.name}, expected {' and '.join(files)}")


def local_copy(prefix: str, repository: str) -> str:
    """Return how a copy of a model is made and named, for a method that takes ``PREFIX:FOLDER``."""
    return f"{prefix}:FOLDER (hf download {repository} --local-dir FOLDER)"


def announce(name: str, what: str, where: str, instead: str) -> None:
    """Say what is fetched from where. Raises ``MethodError`` where ``HF_HUB_OFFLINE`` forbids it."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        raise MethodError(
            f"{name}: {what} not on this machine, and HF_HUB_OFFLINE is set: unset it, or fetch them elsewhere "
            f"and name their folder: {instead}"
        )
    print(f"{name}: fetching {what} from {where}", file=sys.stderr, flush=True)


def unavailable(
    name: str, where: str, error: Exception, instead: str, access: str = "a connection"
) -> MethodError:
    """Return what to raise where something could not be fetched; ``access`` is what that takes."""
    first = (str(error).strip().splitlines() or [""])[0]
    return MethodError(
        f"{name}: cannot be fetched from {where}: {type(error).__name__}: {first}; expected {access}, or a local "
        f"copy: {instead}"
    )
