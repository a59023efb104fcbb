"""The ``rebar-bench push-results`` command."""

from __future__ import annotations

import argparse
import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.console import ProgressBars
from rebar_depth_bench.errors import InputError, escape_text, printable
from rebar_depth_bench.hub.commit import commit_changes
from rebar_depth_bench.hub.errors import require_online, require_token
from rebar_depth_bench.hub.repository import LocalFile, Repository, changes, check_repository_id
from rebar_depth_bench.paths import NAME_LETTERS, NAME_PATTERN
from rebar_depth_bench.reporting.eval_results_file import read_eval_results

SUMMARY = "publish .eval_results files in the repository of a model on the Hugging Face Hub"
FOLDER = ".eval_results"
"""Folder of a model's repository whose files the Hub reads as evaluation results."""
_SUFFIX = ".yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help="YAML file written by score --eval-results"
    )
    parser.add_argument("--model-id", required=True, metavar="ID", help="id of the model's repository, ORG/NAME")
    parser.add_argument(
        "--yes", action="store_true", help="publish; without it, only what would be sent is printed"
    )
    parser.add_argument("--create-pr", action="store_true", help="open a pull request in place of a commit")


def run(options: argparse.Namespace) -> None:
    """Print what is published, and publish it with ``--yes``."""
    repository = Repository(check_repository_id(options.model_id, "--model-id"), "model")
    require_online()
    if options.yes:
        require_token()
    local, lines = _checked_files(options.files)
    remote = repository.remote()
    if not remote.commit:
        raise InputError(
            f"{repository.url}: does not exist or is not visible, expected the repository of a model that exists"
        )
    difference = changes(local, remote)
    print(repository.url, *lines, *difference.lines(), sep="\n", flush=True)
    if not difference:
        print("up to date: nothing to send")
    elif not options.yes:
        print("dry run: nothing was sent; --yes publishes")
    else:
        message = f"Add evaluation results: {', '.join(sorted(name.rpartition('/')[2] for name in local))}"
        with ProgressBars() as bars:
            url = commit_changes(repository, remote, difference, message, bars.update, create_pr=options.create_pr)
        print(url)


def _checked_files(paths: Sequence[Path]) -> tuple[dict[str, LocalFile], list[str]]:
    """Return the files by their path in the repository, and a line for each result.

    Raises ``InputError`` for files with problems, and for names that are not valid or occur twice.
    """
    twice = [name for name, count in Counter(path.name for path in paths).items() if count > 1]
    if twice:
        raise InputError(f"{escape_text(twice[0])} is given twice, expected files with different names")
    local, lines = dict[str, LocalFile](), list[str]()
    for path in paths:
        if not re.fullmatch(NAME_PATTERN, path.name) or path.suffix != _SUFFIX:
            expected = f"a name ending in {_SUFFIX} that consists of {NAME_LETTERS}"
            raise InputError(f"{path}: cannot be published under this name, expected {expected}")
        content, entries = read_eval_results(path)
        local[f"{FOLDER}/{path.name}"] = LocalFile(path, len(content), hashlib.sha256(content).hexdigest())
        lines += [
            f"  {path.name}: {entry.dataset_id}, {printable(entry.task_id)}: {entry.value}" for entry in entries
        ]
    return local, lines
