"""Publishing of a verified dataset folder in a repository of the Hugging Face Hub."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from huggingface_hub import DatasetCard, HfApi
from huggingface_hub.constants import REPOCARD_NAME

from dataset_builder.push.hub_errors import hub_errors
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.data.manifest import MANIFEST_FILE, DatasetFolder, open_folder
from rebar_depth_bench.data.verification import file_problems
from rebar_depth_bench.errors import (
    DatasetError,
    InputError,
    Problem,
    escape_text,
    exception_summary,
    printable,
    problem_summary,
)
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.version import software_version

if TYPE_CHECKING:
    from huggingface_hub import CommitOperationAdd
    from huggingface_hub.hf_api import RepoFile

MAIN_BRANCH = "main"


def check_repository_id(text: str, option: str) -> str:
    """Return ``text``, the value of ``option``. Raises ``InputError`` unless it is the id of a repository."""
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]

    try:
        validate_repo_id(text)
        valid = text.count("/") == 1
    except HFValidationError:
        valid = False
    if not valid:
        raise InputError(f"{option} is {escape_text(text)}, expected the id of a repository, ORG/NAME")
    return text


@dataclass(frozen=True)
class Repository:
    """Dataset repository on the Hub, and the branch of it that is read and written."""

    id: str
    branch: str = MAIN_BRANCH

    @property
    def url(self) -> str:
        """Address of the repository's page."""
        from huggingface_hub import constants

        return f"{constants.ENDPOINT}/datasets/{self.id}"

    def remote(self) -> Remote:
        """Return what the Hub has: the files of the branch, or of the main branch if there is no such branch.

        Raises ``InputError`` and ``HubError`` as ``hub_errors`` does.
        """
        from huggingface_hub import HfApi
        from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError, RevisionNotFoundError
        from huggingface_hub.hf_api import RepoFile

        api, has_branch = HfApi(), True
        with hub_errors(f"{self.id} cannot be read"):
            try:
                info = api.repo_info(self.id, repo_type="dataset", revision=self.branch)
            except GatedRepoError:
                raise
            except RepositoryNotFoundError:
                return Remote()
            except RevisionNotFoundError:
                info, has_branch = api.repo_info(self.id, repo_type="dataset"), False
            commit = str(info.sha)
            tree = api.list_repo_tree(self.id, recursive=True, revision=commit, repo_type="dataset")
            files = {str(entry.path): entry for entry in tree if isinstance(entry, RepoFile)}
            return Remote(commit, has_branch, bool(info.private), files)


@dataclass(frozen=True)
class Remote:
    """Files of a repository at a commit; the commit of a repository that does not exist is empty."""

    commit: str = ""
    has_branch: bool = False
    private: bool = False
    files: Mapping[str, RepoFile] = field(default_factory=dict)

    @property
    def visible(self) -> set[str]:
        """Paths of the files but those that are hidden at the top level, such as ``.gitattributes``."""
        return {name for name in self.files if not name.startswith(".")}


@dataclass(frozen=True)
class LocalFile:
    """File to be published; ``sha256`` is the hex digest that its content must have."""

    path: Path
    size: int
    sha256: str

    def equals(self, remote: RepoFile) -> bool:
        """Return whether a file of the Hub has the same content: by SHA-256, or by git's hash of small files."""
        from huggingface_hub.utils.sha import git_hash

        if remote.lfs is not None:
            return bool(remote.lfs.sha256 == self.sha256)
        return remote.size == self.size and git_hash(self.path.read_bytes()) == remote.blob_id


@dataclass(frozen=True)
class Changes:
    """Local files that are new, changed or unchanged in a repository, by path, and files deleted there."""

    new: Mapping[str, LocalFile]
    changed: Mapping[str, LocalFile]
    unchanged: Mapping[str, LocalFile]
    deleted: tuple[str, ...] = ()

    @property
    def sent(self) -> dict[str, LocalFile]:
        """Files that are uploaded, by path."""
        return dict(sorted({**self.new, **self.changed}.items()))

    def __bool__(self) -> bool:
        return bool(self.new or self.changed or self.deleted)

    def lines(self) -> Iterator[str]:
        """Yield a line for each file that is uploaded or deleted, and one with the totals."""
        for name, file in self.sent.items():
            yield f"  {'new' if name in self.new else 'changed':9}{name}, {file.size:,} bytes"
        for name in self.deleted:
            yield f"  {'deleted':9}{printable(name)}"
        total_bytes = sum(file.size for file in self.sent.values())
        yield (
            f"{len(self.sent)} files to upload ({total_bytes:,} bytes), {len(self.deleted)} to delete, "
            f"{len(self.unchanged)} unchanged"
        )


def changes(local: Mapping[str, LocalFile], remote: Remote, deleted: Iterable[str] = ()) -> Changes:
    """Return the changes that put the local files in a repository, and delete the files ``deleted`` there."""
    same = {name for name, file in local.items() if name in remote.files and file.equals(remote.files[name])}
    return Changes(
        new={name: file for name, file in local.items() if name not in remote.files},
        changed={name: file for name, file in local.items() if name in remote.files and name not in same},
        unchanged={name: file for name, file in local.items() if name in same},
        deleted=tuple(sorted(deleted)),
    )


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


_FILES_AT_ONCE = 8
_IGNORE_NOTHING = "# Every file of the commit is uploaded.\n"
"""Rules in place of a repository's ``.gitignore``, which could leave out files of the commit."""


def commit_changes(
    repository: Repository,
    remote: Remote,
    changes: Changes,
    message: str,
    progress: Progress = silent,
) -> str:
    """Upload files and make one commit; return its URL. ``progress`` counts files.

    The commit is refused if the branch is no longer at ``remote.commit``. Raises ``InputError`` if a file does not
    have its expected SHA-256 any more, and as ``hub_errors`` does.
    """
    from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi
    from huggingface_hub.utils import disable_progress_bars  # type: ignore[attr-defined]

    disable_progress_bars()  # ``progress`` takes their place.
    api = HfApi()
    with hub_errors(f"{repository.id} cannot be written"):
        additions = [CommitOperationAdd(name, file.path) for name, file in changes.sent.items()]
        deletions = [CommitOperationDelete(name, is_folder=False) for name in changes.deleted]
        _upload(api, repository, additions, progress)
        for addition, file in zip(additions, changes.sent.values(), strict=True):
            if addition.upload_info.sha256.hex() != file.sha256:
                raise InputError(f"{file.path}: was changed while it was uploaded; nothing is published")
        commit = api.create_commit(
            repository.id,
            [*additions, *deletions],
            commit_message=message,
            repo_type="dataset",
            revision=repository.branch,
            parent_commit=remote.commit,
        )
        return str(commit.commit_url)


def _upload(
    api: HfApi,
    repository: Repository,
    additions: list[CommitOperationAdd],
    progress: Progress,
) -> None:
    """Upload the content of large files; small ones are part of the commit."""
    for first in range(0, len(additions), _FILES_AT_ONCE):
        group = additions[first : first + _FILES_AT_ONCE]
        api.preupload_lfs_files(
            repository.id,
            group,
            repo_type="dataset",
            revision=repository.branch,
            num_threads=_FILES_AT_ONCE,
            free_memory=False,
            gitignore_content=_IGNORE_NOTHING,
        )
        progress("files uploaded", first + len(group), len(additions))


@dataclass(frozen=True)
class Push:
    """Changes that publish a folder in a repository; ``private`` is the visibility of a new one."""

    source: VerifiedFolder
    repository: Repository
    remote: Remote
    changes: Changes
    private: bool

    @property
    def is_needed(self) -> bool:
        """Whether the branch does not exist or differs from the folder."""
        return bool(self.changes) or not self.remote.has_branch

    def lines(self) -> Iterator[str]:
        """Yield the repository, a line for each file that is uploaded or deleted, and the totals."""
        state = ""
        if not self.remote.commit:
            state = f": does not exist or is not visible, will be created{' (private)' if self.private else ''}"
        elif not self.remote.has_branch:
            state = ": will be created from the main branch"
        yield f"{self.repository.url}, branch {self.repository.branch}{state}"
        yield from self.changes.lines()


def plan_push(source: VerifiedFolder, repository: Repository, *, private: bool) -> Push:
    """Compare a folder with a repository; nothing is written.

    Raises ``InputError`` if the repository holds anything but a dataset folder, or is public and should be
    private, and as ``hub_errors`` does.
    """
    remote = repository.remote()
    if remote.visible - {REPOCARD_NAME} and MANIFEST_FILE not in remote.files:
        raise InputError(
            f"{repository.url}: has {len(remote.visible)} files and no {MANIFEST_FILE}, expected an empty "
            "repository or one that holds a dataset folder: all its other files would be deleted"
        )
    if private and remote.commit and not remote.private:
        raise InputError(f"{repository.url}: exists and is public, expected a private or new one with --private")
    difference = changes(source.files, remote, remote.visible - set(source.files))
    return Push(source, repository, remote, difference, private)


def send_push(push: Push, progress: Progress = silent) -> str:
    """Publish a folder; return the URL of the commit, or of the branch if it needs no commit.

    The card is checked by the Hub first. ``progress`` counts files. Raises errors as ``plan_push`` and
    ``commit_changes`` do.
    """
    repository, api = push.repository, HfApi()
    _validate_card(push.source.card, push.source.folder.root)
    if not push.remote.commit:
        with hub_errors(f"{repository.id} cannot be created"):
            api.create_repo(repository.id, repo_type="dataset", private=push.private or None, exist_ok=True)
        push = plan_push(push.source, repository, private=push.private)
    if not push.remote.has_branch:
        with hub_errors(f"branch {repository.branch} of {repository.id} cannot be created"):
            api.create_branch(
                repository.id, branch=repository.branch, revision=push.remote.commit, repo_type="dataset"
            )
    if not push.changes:
        return f"{repository.url}/tree/{repository.branch}"
    message = f"Publish dataset {push.source.folder.digest} with {software_version()}"
    return commit_changes(repository, push.remote, push.changes, message, progress)


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
