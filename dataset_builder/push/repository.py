"""Dataset repositories of the Hugging Face Hub: ids, files at a commit, and changes that publish local files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from dataset_builder.push.errors import hub_errors
from rebar_depth_bench.errors import InputError, escape_text, printable

if TYPE_CHECKING:
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
