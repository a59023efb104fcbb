"""Publishing of a dataset folder as a dataset repository of the Hugging Face Hub.

The repository then holds the manifest, the files that it lists, and the Croissant description that it had. Large
files are uploaded first, and the Hub keeps them, so that an interrupted upload continues where it ended. One
commit makes all changes visible at once, so that nobody loads shards of one version with the manifest of another.
"""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, DatasetCard, HfApi, constants, get_token
from huggingface_hub.constants import REPOCARD_NAME
from huggingface_hub.errors import (
    HfHubHTTPError,
    HFValidationError,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.hf_api import RepoFile
from huggingface_hub.utils import disable_progress_bars, validate_repo_id  # type: ignore[attr-defined]
from huggingface_hub.utils.sha import git_hash

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import (
    DatasetError,
    HubError,
    InputError,
    RebarDepthError,
    escape_text,
    library_message,
    printable,
)
from rebar_depth_bench.base.names import PATH_PATTERN
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.data.files import CROISSANT_FILE, MANIFEST_FILE, file_problems, file_sha256, local_folder
from rebar_depth_bench.data.manifest import open_folder


def check_request(repository_id: str, branch: str, *, connects: bool, publishes: bool) -> None:
    """Raise ``InputError`` for an id, a branch or an environment with which a push cannot succeed."""
    try:
        validate_repo_id(repository_id)
        is_id = repository_id.count("/") == 1
    except HFValidationError:
        is_id = False
    if not is_id:
        raise InputError(f"--hub-id is {escape_text(repository_id)}, expected the id of a repository, ORG/NAME")
    if not re.fullmatch(PATH_PATTERN, branch):
        raise InputError(f"--revision is {escape_text(branch)}, expected the name of a branch")
    if connects and constants.HF_HUB_OFFLINE:
        raise InputError("HF_HUB_OFFLINE is set, expected a connection to the Hugging Face Hub: unset it")
    if publishes and not get_token():
        raise InputError("no token for the Hugging Face Hub, expected one: hf auth login, or HF_TOKEN")


@dataclass(frozen=True)
class VerifiedFolder:
    """Dataset folder that matches its manifest, and the digest of its ground truth.

    ``files`` are the hex SHA-256 of the manifest and the files that it lists, by path; ``stray`` are the paths of
    files that stay local.
    """

    root: Path
    digest: str
    files: Mapping[str, str]
    stray: tuple[str, ...]


def verified_folder(root: str, progress: Progress = silent) -> VerifiedFolder:
    """Compare a local dataset folder with its manifest.

    Raises ``DatasetError`` for anything but a complete local dataset folder, with all of its problems.
    ``progress`` counts files.
    """
    manifest = local_folder(root) / MANIFEST_FILE
    # Before the manifest is read: if a build replaces it in between, the file to be uploaded has another digest.
    manifest_sha256 = file_sha256(manifest) if manifest.is_file() else ""
    folder = open_folder(root)
    problems = list(file_problems(folder, progress))
    if damaged := [problem for problem in problems if problem.code != "unknown"]:
        raise DatasetError.from_problems(root, damaged)
    files = dict(sorted({**folder.files, MANIFEST_FILE: manifest_sha256}.items()))
    return VerifiedFolder(Path(root), folder.digest, files, tuple(problem.where for problem in problems))


def push(source: VerifiedFolder, repository_id: str, branch: str, *, private: bool, publish: bool) -> None:
    """Compare a folder with a repository, print what differs and, if ``publish`` is set, make them equal.

    A missing repository is created, ``private`` if so requested, and a missing branch is created from the main
    one. The commit is refused if the branch has changed since it was compared.

    Raises ``InputError`` if the repository holds anything but a dataset folder or is public and should be private,
    if the Hub refuses the card, and if a file has changed since it was verified; otherwise as ``_hub_errors``.
    """
    api, url = HfApi(), f"{constants.ENDPOINT}/datasets/{repository_id}"
    info, has_branch, remote = None, True, dict[str, RepoFile]()
    with _hub_errors(url):
        try:
            info = api.repo_info(repository_id, repo_type="dataset", revision=branch)
        except RepositoryNotFoundError:
            has_branch = branch == constants.DEFAULT_REVISION
        except RevisionNotFoundError:
            info, has_branch = api.repo_info(repository_id, repo_type="dataset"), False
        if info is not None:
            tree = api.list_repo_tree(repository_id, recursive=True, revision=info.sha, repo_type="dataset")
            remote = {str(entry.path): entry for entry in tree if isinstance(entry, RepoFile)}
    # The Hub itself makes .gitattributes, and maintainers upload the Croissant description.
    visible = {name for name in remote if not name.startswith(".") and name != CROISSANT_FILE}
    if visible - {REPOCARD_NAME} and MANIFEST_FILE not in visible:
        raise InputError(
            f"{url}: has {len(visible)} files and no {MANIFEST_FILE}, expected an empty repository or one that "
            "holds a dataset folder: all its other files would be deleted"
        )
    if private and info is not None and not info.private:
        raise InputError(f"{url}: exists and is public, expected a private or new one with --private")

    sizes = {name: (source.root / name).stat().st_size for name in source.files}
    sent = [name for name in source.files if not _is_equal(source, name, remote.get(name))]
    deleted = sorted(visible - source.files.keys())
    state = "" if has_branch else ": will be created from the main branch"
    if info is None:
        state = f": does not exist or is not visible, will be created{' (private)' if private else ''}"
    print(f"{url}, branch {branch}{state}")
    for name in sent:
        print(f"  {'changed' if name in remote else 'new':9}{name}, {sizes[name]:,} bytes")
    for name in deleted:
        print(f"  {'deleted':9}{printable(name)}")
    total = f"{len(sent)} files to upload ({sum(sizes[name] for name in sent):,} bytes)"
    print(f"{total}, {len(deleted)} to delete, {len(sizes) - len(sent)} unchanged", flush=True)
    if has_branch and not sent and not deleted:
        print("up to date: nothing to send")
        return
    if not publish:
        print("nothing was sent; --yes publishes")
        return

    with _hub_errors(url):
        try:
            DatasetCard.load(source.root / REPOCARD_NAME).validate(repo_type="dataset")
        except (ValueError, yaml.YAMLError) as error:
            found = library_message(error)
            raise InputError(f"{source.root / REPOCARD_NAME}: the Hub accepts no such card: {found}") from None
        if info is None:
            api.create_repo(repository_id, repo_type="dataset", private=private or None)
            info = api.repo_info(repository_id, repo_type="dataset")
        if not has_branch:
            api.create_branch(repository_id, branch=branch, revision=info.sha, repo_type="dataset")
        if not sys.stderr.isatty():
            disable_progress_bars()
        additions = [CommitOperationAdd(name, source.root / name) for name in sent]
        api.preupload_lfs_files(
            repository_id,
            additions,
            repo_type="dataset",
            revision=branch,
            free_memory=False,
            gitignore_content="# Nothing is left out.\n",  # In place of the repository's rules.
        )
        for addition in additions:
            name = addition.path_in_repo
            if addition.upload_info.sha256.hex() != source.files[name]:
                raise InputError(f"{source.root / name}: was changed while it was uploaded; nothing is published")
        commit = api.create_commit(
            repository_id,
            [*additions, *(CommitOperationDelete(name, is_folder=False) for name in deleted)],
            commit_message=f"Publish dataset {source.digest} with {software_version()}",
            repo_type="dataset",
            revision=branch,
            parent_commit=str(info.sha),
        )
    print(commit.commit_url)


def _is_equal(source: VerifiedFolder, name: str, remote: RepoFile | None) -> bool:
    """Return whether a file of the Hub has the same content: by SHA-256, or by git's hash of small files."""
    if remote is None:
        return False
    if remote.lfs is not None:
        return bool(remote.lfs.sha256 == source.files[name])
    path = source.root / name
    return remote.size == path.stat().st_size and git_hash(path.read_bytes()) == remote.blob_id


@contextmanager
def _hub_errors(url: str) -> Iterator[None]:
    """Convert the errors of ``huggingface_hub`` and its HTTP client, with their messages; print its warnings.

    Raises ``InputError`` if the Hub refuses the user's id, token or files, ``HubError`` for anything else.
    """
    token = get_token() or "no token"  # A server knows the token, and could repeat it.
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        warnings.simplefilter("ignore", DeprecationWarning)  # The client's calls are not the user's.
        try:
            yield
        except RebarDepthError:
            raise
        except Exception as error:  # The HTTP client's errors have no base class in the Hub's package.
            is_wrapper = not isinstance(error, HfHubHTTPError) and isinstance(error.__cause__, Exception)
            cause = error.__cause__ if is_wrapper else error
            status, message = 0, str(cause) or type(cause).__name__
            if isinstance(cause, HfHubHTTPError):
                status = cause.response.status_code
                message = f"status {status}: {cause.server_message or message}"
            words = f"{url}: {library_message(RuntimeError(message.replace(token, '[token]')))}"
            if 400 <= status < 500 and status not in (409, 412, 429):  # Those may be answered differently later.
                raise InputError(f"{words}; check --hub-id, and the token: hf auth login, or HF_TOKEN") from None
            raise HubError(f"{words}; run the same command again later") from None
    for warning in caught:
        print_notice(str(warning.message).replace(token, "[token]"))
