"""Commits on the Hugging Face Hub: large files are uploaded first, then one commit makes all changes visible.

The Hub keeps uploaded content that no commit refers to yet. An interrupted upload therefore continues where it
ended: the Hub names the content that it lacks (git LFS), or the chunks of it (Xet).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dataset_builder.push.errors import hub_errors
from dataset_builder.push.repository import Changes, Remote, Repository
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.progress import Progress, silent

if TYPE_CHECKING:
    from huggingface_hub import CommitOperationAdd, HfApi

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
