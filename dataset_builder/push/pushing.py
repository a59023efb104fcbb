"""Publishing of a dataset folder as a dataset repository of the Hugging Face Hub.

The repository then holds the manifest and the files that it lists, and no others. Large files are uploaded first;
one commit then makes all changes visible at once, and readers stay at one commit, so that nobody loads the shards
of one version with the manifest of another. The Hub keeps uploaded content that no commit refers to yet: an
interrupted upload continues where it ended, since the Hub names the content that it lacks (git LFS), or the chunks
of it (Xet).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, DatasetCard, HfApi, constants
from huggingface_hub.constants import REPOCARD_NAME
from huggingface_hub.errors import (
    GatedRepoError,
    HFValidationError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.hf_api import RepoFile
from huggingface_hub.utils import disable_progress_bars, validate_repo_id  # type: ignore[attr-defined]
from huggingface_hub.utils.sha import git_hash

from dataset_builder.push.hub_errors import hub_errors
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import (
    DatasetError,
    InputError,
    Problem,
    escape_text,
    exception_summary,
    printable,
    problem_summary,
)
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import parse_json
from rebar_depth_bench.data.files import MANIFEST_FILE, file_problems, file_sha256, local_folder
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder

_FILES_AT_ONCE = 8
_IGNORE_NOTHING = "# Every file of the commit is uploaded.\n"
"""Rules in place of a repository's ``.gitignore``, which could leave out files of the commit."""


@dataclass(frozen=True)
class LocalFile:
    """File to be published; ``sha256`` is the hex digest that its content must have."""

    path: Path
    size: int
    sha256: str

    def equals(self, remote: RepoFile | None) -> bool:
        """Return whether a file of the Hub has the same content: by SHA-256, or by git's hash of small files."""
        if remote is None:
            return False
        if remote.lfs is not None:
            return bool(remote.lfs.sha256 == self.sha256)
        return remote.size == self.size and git_hash(self.path.read_bytes()) == remote.blob_id


@dataclass(frozen=True)
class VerifiedFolder:
    """Dataset folder that matches its manifest: the files to publish by path, its card, and files that stay local.

    The files to publish are the manifest and those that it lists, in alphabetical order.
    """

    folder: DatasetFolder
    files: Mapping[str, LocalFile]
    stray: tuple[str, ...]
    card: DatasetCard

    def lines(self) -> Iterator[str]:
        """Yield a line for each file that is published, and the totals."""
        for name, file in self.files.items():
            yield f"  {name}, {file.size:,} bytes"
        total_bytes = sum(file.size for file in self.files.values())
        yield f"{len(self.files)} files ({total_bytes:,} bytes); what the Hub has is not sent again"


def verified_folder(root: str, progress: Progress = silent) -> VerifiedFolder:
    """Compare a local dataset folder with its manifest and parse its card; return what is published of it.

    Raises ``DatasetError`` for anything but a complete local dataset folder, with all of its problems.
    ``progress`` counts files.
    """
    manifest = local_folder(root) / MANIFEST_FILE
    # Before the manifest is read: if a build replaces it in between, the file to be uploaded has another digest.
    manifest_sha256 = file_sha256(manifest) if manifest.is_file() else ""
    folder = open_folder(root)
    problems = list(file_problems(folder, progress))
    damaged = [problem for problem in problems if problem.code != "unknown"]
    if damaged:
        raise DatasetError.from_problems(root, damaged)
    digests = {**folder.files, MANIFEST_FILE: manifest_sha256}
    paths = {name: Path(root, name) for name in sorted(digests)}
    files = {name: LocalFile(path, path.stat().st_size, digests[name]) for name, path in paths.items()}
    return VerifiedFolder(
        folder, files, tuple(one.where for one in problems if one.code == "unknown"), _card(folder)
    )


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
        problem = Problem("syntax", REPOCARD_NAME, found, "one written by rebar-build")
        raise DatasetError.from_problems(folder.root, [problem]) from None
    if sorted(names) != sorted(folder.configs):
        found = f"has the configs {escape_text(', '.join(names))}"
        expected = f"those of the manifest, {', '.join(folder.configs)}"
        raise DatasetError.from_problems(folder.root, [Problem("conflict", REPOCARD_NAME, found, expected)])
    return card


def check_repository_id(text: str) -> None:
    """Raise ``InputError`` unless ``text``, the value of ``--hub-id``, is the id of a repository."""
    try:
        validate_repo_id(text)
        valid = text.count("/") == 1
    except HFValidationError:
        valid = False
    if not valid:
        raise InputError(f"--hub-id is {escape_text(text)}, expected the id of a repository, ORG/NAME")


@dataclass(frozen=True)
class Repository:
    """Dataset repository on the Hub, the branch of it that is published on, and the files at a commit of it.

    The commit is that of the main branch if the branch does not exist, and empty if the repository does not.
    """

    id: str
    branch: str
    commit: str = ""
    has_branch: bool = False
    private: bool = False
    files: Mapping[str, RepoFile] = field(default_factory=dict)

    @property
    def url(self) -> str:
        """Address of the repository's page."""
        return f"{constants.ENDPOINT}/datasets/{self.id}"

    @property
    def visible(self) -> set[str]:
        """Paths of the files but those that are hidden at the top level, such as ``.gitattributes``."""
        return {name for name in self.files if not name.startswith(".")}


def _read(repository_id: str, branch: str) -> Repository:
    """Return what the Hub has of a repository and a branch of it.

    Raises ``InputError`` and ``HubError`` as ``hub_errors`` does.
    """
    api, has_branch = HfApi(), True
    with hub_errors(f"{repository_id} cannot be read"):
        try:
            info = api.repo_info(repository_id, repo_type="dataset", revision=branch)
        except GatedRepoError:
            raise
        except RepositoryNotFoundError:
            return Repository(repository_id, branch)
        except RevisionNotFoundError:
            info, has_branch = api.repo_info(repository_id, repo_type="dataset"), False
        commit = str(info.sha)
        tree = api.list_repo_tree(repository_id, recursive=True, revision=commit, repo_type="dataset")
        files = {str(entry.path): entry for entry in tree if isinstance(entry, RepoFile)}
        return Repository(repository_id, branch, commit, has_branch, bool(info.private), files)


@dataclass(frozen=True)
class Push:
    """Folder and the repository that publishes it; ``private`` is the visibility of a new one.

    ``sent`` are the local files that are new or changed, by path, ``deleted`` the paths of files of the repository
    that the folder does not have.
    """

    source: VerifiedFolder
    repository: Repository
    private: bool
    sent: Mapping[str, LocalFile]
    deleted: tuple[str, ...]

    @property
    def is_needed(self) -> bool:
        """Whether the branch does not exist or differs from the folder."""
        return bool(self.sent or self.deleted) or not self.repository.has_branch

    def lines(self) -> Iterator[str]:
        """Yield the repository, a line for each file that is uploaded or deleted, and the totals."""
        state = ""
        if not self.repository.commit:
            state = f": does not exist or is not visible, will be created{' (private)' if self.private else ''}"
        elif not self.repository.has_branch:
            state = ": will be created from the main branch"
        yield f"{self.repository.url}, branch {self.repository.branch}{state}"
        for name, file in self.sent.items():
            yield f"  {'changed' if name in self.repository.files else 'new':9}{name}, {file.size:,} bytes"
        for name in self.deleted:
            yield f"  {'deleted':9}{printable(name)}"
        total_bytes = sum(file.size for file in self.sent.values())
        yield (
            f"{len(self.sent)} files to upload ({total_bytes:,} bytes), {len(self.deleted)} to delete, "
            f"{len(self.source.files) - len(self.sent)} unchanged"
        )


def plan_push(source: VerifiedFolder, repository_id: str, branch: str, *, private: bool) -> Push:
    """Compare a folder with a repository; nothing is written.

    Raises ``InputError`` if the repository holds anything but a dataset folder, or is public and should be
    private, and as ``hub_errors`` does.
    """
    repository = _read(repository_id, branch)
    if repository.visible - {REPOCARD_NAME} and MANIFEST_FILE not in repository.files:
        raise InputError(
            f"{repository.url}: has {len(repository.visible)} files and no {MANIFEST_FILE}, expected an empty "
            "repository or one that holds a dataset folder: all its other files would be deleted"
        )
    if private and repository.commit and not repository.private:
        raise InputError(f"{repository.url}: exists and is public, expected a private or new one with --private")
    sent = {name: file for name, file in source.files.items() if not file.equals(repository.files.get(name))}
    return Push(source, repository, private, sent, tuple(sorted(repository.visible - source.files.keys())))


def send_push(push: Push, progress: Progress = silent) -> str:
    """Publish a folder: new repository, new branch, uploads, one commit.

    Returns the URL of the commit, or of the branch if it needs no commit. The card is checked by the Hub first.
    ``progress`` counts files. The commit is refused if the branch has changed since the folder was compared with
    it. Raises ``InputError`` if a file does not have its expected SHA-256 any more, and as ``plan_push`` does.
    """
    api, repository = HfApi(), push.repository
    _validate_card(push.source.card, push.source.folder.root)
    if not repository.commit:
        with hub_errors(f"{repository.id} cannot be created"):
            api.create_repo(repository.id, repo_type="dataset", private=push.private or None, exist_ok=True)
        push = plan_push(push.source, repository.id, repository.branch, private=push.private)
        repository = push.repository
    if not repository.has_branch:
        with hub_errors(f"branch {repository.branch} of {repository.id} cannot be created"):
            api.create_branch(
                repository.id, branch=repository.branch, revision=repository.commit, repo_type="dataset"
            )
    if not push.sent and not push.deleted:
        return f"{repository.url}/tree/{repository.branch}"
    with hub_errors(f"{repository.id} cannot be written"):
        additions = _upload(api, push, progress)
        commit = api.create_commit(
            repository.id,
            [*additions, *(CommitOperationDelete(name, is_folder=False) for name in push.deleted)],
            commit_message=f"Publish dataset {push.source.folder.digest} with {software_version()}",
            repo_type="dataset",
            revision=repository.branch,
            parent_commit=repository.commit,
        )
        return str(commit.commit_url)


def _validate_card(card: DatasetCard, root: str) -> None:
    """Let the Hub check the dataset card; raise ``InputError`` with its reasons if it is not valid there."""
    with hub_errors("the dataset card cannot be checked"):
        try:
            card.validate(repo_type="dataset")
        except ValueError as error:
            reasons = _reasons(str(error))
            raise InputError(f"{root}: the Hub refuses {REPOCARD_NAME}: {problem_summary(reasons)}") from None


def _reasons(answer: str) -> list[str]:
    """Return the messages of the Hub's answer, JSON with a list ``errors``, or the answer itself."""
    content: Any = parse_json(answer.encode())[0]
    errors = content.get("errors") if isinstance(content, dict) else None
    entries = errors if isinstance(errors, list) and errors else [answer]
    return [escape_text(str(entry.get("message") if isinstance(entry, dict) else entry)) for entry in entries]


def _upload(api: HfApi, push: Push, progress: Progress) -> list[CommitOperationAdd]:
    """Upload the content of large files; return the files of the commit, of which small ones are part.

    Raises ``InputError`` if a file was changed since it was verified.
    """
    disable_progress_bars()  # ``progress`` takes their place.
    additions = [CommitOperationAdd(name, file.path) for name, file in push.sent.items()]
    for first in range(0, len(additions), _FILES_AT_ONCE):
        group = additions[first : first + _FILES_AT_ONCE]
        api.preupload_lfs_files(
            push.repository.id,
            group,
            repo_type="dataset",
            revision=push.repository.branch,
            num_threads=_FILES_AT_ONCE,
            free_memory=False,
            gitignore_content=_IGNORE_NOTHING,
        )
        progress("files uploaded", first + len(group), len(additions))
    for addition, file in zip(additions, push.sent.values(), strict=True):
        if addition.upload_info.sha256.hex() != file.sha256:
            raise InputError(f"{file.path}: was changed while it was uploaded; nothing is published")
    return additions
