"""Files of the Hub as a local folder, never fetched silently: for models that are not of ``transformers``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.errors import MethodError


def hub_folder(repository: str, files: Sequence[str], instead: str) -> Path:
    """Return the folder of the Hub's cache that holds a model's files, fetched if it does not.

    ``instead`` is what to name where they are in a folder of one's own, ``unidepth:FOLDER`` say.

    Raises ``MethodError`` where they are not to be had.
    """
    from huggingface_hub import constants, snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        folder = Path(snapshot_download(repository, allow_patterns=list(files), local_files_only=True))
        if all((folder / name).is_file() for name in files):
            return folder
    except LocalEntryNotFoundError:
        pass
    announce(repository, " and ".join(files), constants.ENDPOINT, instead)
    try:
        return Path(snapshot_download(repository, allow_patterns=list(files)))
    except Exception as error:  # the Hub's client raises its own, httpx's and the system's
        raise unavailable(repository, constants.ENDPOINT, error, instead) from None


def announce(name: str, what: str, where: str, instead: str) -> None:
    """Say what is fetched from where. Raises ``MethodError`` where ``HF_HUB_OFFLINE`` forbids it."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        raise MethodError(
            f"{name}: {what} not on this machine, and HF_HUB_OFFLINE is set: unset it, or fetch them elsewhere "
            f"and name their folder: {instead}"
        )
    print(f"{name}: fetching {what} from {where}", file=sys.stderr, flush=True)


def unavailable(name: str, where: str, error: Exception, instead: str) -> MethodError:
    """Return what to raise where something could not be fetched."""
    first = (str(error).strip().splitlines() or [""])[0]
    return MethodError(
        f"{name}: cannot be fetched from {where}: {type(error).__name__}: {first}; expected a connection, or a "
        f"local copy: {instead}"
    )
