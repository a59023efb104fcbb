"""Rank errors in the ``.eval_results`` format of the Hugging Face Hub, and the YAML of its benchmark files.

Source: https://huggingface.co/docs/hub/eval-results. A file ``.eval_results/*.yaml`` in a model's repository holds
one entry per task of a benchmark, whose dataset repository lists them in its ``eval.yaml``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.hub.repository import check_repository_id
from rebar_depth_bench.reporting.formatting import declaration_text, short_digest, unranked_reason
from rebar_depth_bench.scoring.result import Result, Table
from rebar_depth_bench.scoring.rounding import rounded
from rebar_depth_bench.view_ids import TEST_SPLIT

if TYPE_CHECKING:
    from huggingface_hub import EvalResultEntry

EVALUATION_FRAMEWORK = "rebar-depth-bench"
"""Identifier of this software in ``eval.yaml``."""

_PLAIN = re.compile(r"[A-Za-z][A-Za-z_]+([-/][A-Za-z_]+)*")
"""Texts that every version of YAML reads as text without quotes, other than the words that PyYAML quotes."""


def task_id(config: str) -> str:
    """Return the id of a config's task in ``eval.yaml``."""
    return config


def check_hub_id(hub_id: str | None) -> str:
    """Return the id of a dataset repository, ORG/NAME. Raises ``InputError`` if it is missing or invalid."""
    if hub_id is None:
        raise InputError("--eval-results needs --hub-id ORG/NAME, the dataset's repository on the Hub")
    return check_repository_id(hub_id, "--hub-id")


def eval_results(result: Result, folder: DatasetFolder, hub_id: str) -> tuple[str, list[str]]:
    """Return the content of an ``.eval_results`` file, and a note on each config that is left out of it.

    The file has one entry per ranked config, without a date; a config with splits needs the split ``test``, which
    its task names. The entries name the dataset's commit if the dataset was read from the repository ``hub_id``.
    Raises ``InputError`` if there is no entry.
    """
    from huggingface_hub import eval_result_entries_to_yaml

    reasons = {name: _omission_reason(table) for name, table in result.tables.items()}
    notes = [
        f"{printable(name)} is left out of --eval-results, because {reason}"
        for name, reason in reasons.items()
        if reason
    ]
    entries = _entries(result, folder, hub_id, [name for name, reason in reasons.items() if not reason])
    if not entries:
        raise InputError("\n".join(["--eval-results has no ranked config to write", *notes]))
    return yaml_text(eval_result_entries_to_yaml(entries)), notes


def _omission_reason(table: Table) -> str:
    if table.split not in (None, TEST_SPLIT):
        return f"it covers the split {table.split}, expected {TEST_SPLIT}"
    reason = unranked_reason(table)
    return f"it is not ranked: {reason}" if reason else ""


def _entries(result: Result, folder: DatasetFolder, hub_id: str, configs: Sequence[str]) -> list[EvalResultEntry]:
    from huggingface_hub import EvalResultEntry

    notes = (
        f"{result.method}: rank error of protocol {result.protocol}, lower is better; "
        f"software {EVALUATION_FRAMEWORK} {result.software_version}, "
        f"dataset {result.dataset_version} ({short_digest(result.dataset_digest)}), "
        f"archive {short_digest(result.submission_sha256)}, "
        f"{declaration_text(result.declared)}"
    )
    return [
        EvalResultEntry(
            dataset_id=hub_id,
            task_id=task_id(config),
            value=rounded(result.tables[config].rank_error),
            dataset_revision=folder.commit if folder.repository == hub_id else None,
            notes=notes,
        )
        for config in configs
    ]


def yaml_text(content: Any) -> str:
    """Return content as YAML that version 1.1 and 1.2 parsers read alike.

    The Hub reads YAML 1.2, where texts such as ``1e3`` that PyYAML would not quote are numbers; these are quoted.
    """
    import yaml

    class Dumper(yaml.SafeDumper):  # type: ignore[misc]
        pass

    def represent_text(dumper: Any, text: str) -> Any:
        return dumper.represent_scalar(
            "tag:yaml.org,2002:str", text, style=None if _PLAIN.fullmatch(text) else '"'
        )

    Dumper.add_representer(str, represent_text)
    return str(yaml.dump(content, Dumper=Dumper, sort_keys=False, allow_unicode=True, width=10_000))
