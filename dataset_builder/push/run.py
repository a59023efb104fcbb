"""Plan of a push, and its execution: new repository, new branch, uploads, one commit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from huggingface_hub import DatasetCard, HfApi
from huggingface_hub.constants import REPOCARD_NAME

from dataset_builder.push.commit import commit_changes
from dataset_builder.push.errors import hub_errors
from dataset_builder.push.repository import Changes, Remote, Repository, changes
from dataset_builder.push.verified import VerifiedFolder
from rebar_depth_bench.data.manifest import MANIFEST_FILE
from rebar_depth_bench.errors import InputError, escape_text, problem_summary
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.version import software_version


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
