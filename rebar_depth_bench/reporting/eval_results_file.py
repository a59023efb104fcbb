"""Reader of ``.eval_results`` files: parsed by ``huggingface_hub`` and checked before they are published."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.errors import InputError, Problem, escape_text, exception_summary
from rebar_depth_bench.hub.repository import check_repository_id
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import read_file

if TYPE_CHECKING:
    from huggingface_hub import EvalResultEntry


def read_eval_results(path: Path) -> tuple[bytes, list[EvalResultEntry]]:
    """Return the content of an ``.eval_results`` file and its entries.

    Raises ``InputError`` with all problems if it is not YAML, is not read by the Hub's own parser, or has an entry
    without a valid dataset, task or finite number.
    """
    content = read_file(path, TOML_BYTES, "a YAML file written by rebar-bench score --eval-results", InputError)
    items, problems = _parse_yaml(content)
    entries = _parse_entries(items, problems)
    if not problems:
        problems += _entry_problems(entries)
    if problems:
        raise InputError.from_problems(path, problems)
    return content, entries


def _parse_yaml(content: bytes) -> tuple[list[Any], list[Problem]]:
    """Return the list in a YAML text, and the problems of the text."""
    import yaml

    try:
        items = yaml.safe_load(content.decode())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        found = f"not valid YAML: {escape_text(exception_summary(error))}"
        return [], [Problem("syntax", "", found, "a YAML file")]
    if not isinstance(items, list) or not items:
        return [], [Problem("invalid", "", f"got {_shown(items)}", "a list of one or more results")]
    return items, []


def _parse_entries(items: Sequence[Any], problems: list[Problem]) -> list[EvalResultEntry]:
    """Return the entries as the Hub's parser reads them one by one, and append the problems of the others."""
    from huggingface_hub import parse_eval_result_entries

    entries = []
    for position, item in enumerate(items, start=1):
        try:
            [entry] = parse_eval_result_entries([item])  # It leaves out what the Hub has marked as an error.
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            found = f"cannot be read: {escape_text(exception_summary(error))}"
            problems.append(Problem("invalid", f"result {position}", found, "dataset.id, dataset.task_id, value"))
        else:
            entries.append(entry)
    return entries


def _entry_problems(entries: Sequence[EvalResultEntry]) -> Iterator[Problem]:
    for position, entry in enumerate(entries, start=1):
        where = f"result {position}"
        if not _is_repository_id(entry.dataset_id):
            found = f"got {_shown(entry.dataset_id)}"
            yield Problem("invalid", f"{where}: dataset.id", found, "the id of a repository, ORG/NAME")
        if not isinstance(entry.task_id, str) or not entry.task_id:
            yield Problem("invalid", f"{where}: dataset.task_id", f"got {_shown(entry.task_id)}", "text")
        is_number = isinstance(entry.value, int | float) and not isinstance(entry.value, bool)
        if not is_number or not abs(entry.value) <= sys.float_info.max:  # NaN is in no range.
            yield Problem("invalid", f"{where}: value", f"got {_shown(entry.value)}", "a finite number")
    tasks = Counter((_shown(entry.dataset_id), _shown(entry.task_id)) for entry in entries)
    for (dataset, task), count in tasks.items():
        if count > 1:
            yield Problem("duplicate", f"{dataset} {task}", f"has {count} results", "one for each task")


def _is_repository_id(value: object) -> bool:
    try:
        return isinstance(value, str) and bool(check_repository_id(value, "dataset.id"))
    except InputError:
        return False


def _shown(value: object) -> str:
    """Return a value for a message; a list or table only by its type, since aliases can make it very long."""
    return escape_text(str(value)) if isinstance(value, str | float | bool) else type(value).__name__
