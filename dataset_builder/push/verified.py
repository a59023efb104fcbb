"""Dataset folders that match their manifest, and the files of them that are published."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from huggingface_hub import DatasetCard
from huggingface_hub.constants import REPOCARD_NAME

from dataset_builder.push.repository import LocalFile
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.data.manifest import MANIFEST_FILE, DatasetFolder, open_folder
from rebar_depth_bench.data.verification import file_problems
from rebar_depth_bench.errors import DatasetError, Problem, escape_text, exception_summary
from rebar_depth_bench.progress import Progress, silent


@dataclass(frozen=True)
class VerifiedFolder:
    """Dataset folder without problems: the files to publish by path, and the paths of files that stay local."""

    folder: DatasetFolder
    files: Mapping[str, LocalFile]
    stray: tuple[str, ...]
    card: DatasetCard


def verified_folder(root: str, progress: Progress = silent) -> VerifiedFolder:
    """Compare a local dataset folder with its manifest and parse its card; return what is published of it.

    Files that are not in the manifest are not published. Raises ``DatasetError`` for anything but a complete local
    dataset folder, with all of its problems. ``progress`` counts files.
    """
    if not Path(root).is_dir():
        raise DatasetError(f"{root}: no such folder, expected a dataset folder")
    manifest = Path(root, MANIFEST_FILE)
    # Before the manifest is read: if a build replaces it in between, the file to be uploaded has another digest.
    manifest_sha256 = file_sha256(manifest) if manifest.is_file() else ""
    folder = open_folder(root)
    problems = list(file_problems(folder, progress))
    damaged = [problem for problem in problems if problem.code != "unknown"]
    if damaged:
        raise DatasetError.from_problems(root, damaged)
    digests = {**folder.files, MANIFEST_FILE: manifest_sha256}
    return VerifiedFolder(
        folder=folder,
        files={name: _local_file(Path(root, name), digests[name]) for name in sorted(digests)},
        stray=tuple(problem.where for problem in problems if problem.code == "unknown"),
        card=_card(folder),
    )


def _local_file(path: Path, sha256: str) -> LocalFile:
    return LocalFile(path, path.stat().st_size, sha256)


def _card(folder: DatasetFolder) -> DatasetCard:
    """Return the dataset card, as the Hub's own parser reads it.

    Raises ``DatasetError`` if it cannot be parsed or has other configs than the manifest.
    """
    try:
        card: DatasetCard = DatasetCard.load(folder.verified_file(REPOCARD_NAME))
        names = [str(entry["config_name"]) for entry in card.data["configs"]]
    except DatasetError:
        raise
    except Exception as error:  # The parsers of YAML and of the card's fields raise many types.
        found = f"is no dataset card: {escape_text(exception_summary(error))}"
        raise _card_error(folder, Problem("syntax", REPOCARD_NAME, found, "one written by rebar-build")) from None
    if sorted(names) != sorted(folder.configs):
        found = f"has the configs {escape_text(', '.join(names))}"
        expected = f"those of the manifest, {', '.join(folder.configs)}"
        raise _card_error(folder, Problem("conflict", REPOCARD_NAME, found, expected))
    return card


def _card_error(folder: DatasetFolder, problem: Problem) -> DatasetError:
    return DatasetError.from_problems(folder.root, [problem])
