"""Submission archive and dataset folder that are open together, and the provenance of what is computed of them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError, SubmissionError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND
from rebar_depth_bench.scoring.result import DatasetIdentity, SubmissionIdentity
from rebar_depth_bench.submission import SubmissionMeta, SubmissionReader


@dataclass(frozen=True)
class Provenance:
    """Provenance of the numbers of a comparison, or of an analysis of archives.

    ``protocol`` names the definitions of the numbers; changed definitions have a new name. ``dataset`` is None if
    the reference is not a dataset folder.
    """

    protocol: str
    dataset: DatasetIdentity | None
    archives: Sequence[SubmissionIdentity]

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance entries of a JSON object."""
        return {
            "protocol": self.protocol,
            "dataset": None if self.dataset is None else asdict(self.dataset),
            "submissions": [{"method": archive.method, "sha256": archive.sha256} for archive in self.archives],
            "software": {"version": software_version()},
        }


@dataclass(frozen=True)
class Evaluation:
    """Submission whose structure is valid, and the dataset folder it is evaluated against."""

    folder: DatasetFolder
    submission: SubmissionReader

    @property
    def meta(self) -> SubmissionMeta:
        """Content of ``submission.json``."""
        assert self.submission.meta is not None
        return self.submission.meta

    @property
    def configs(self) -> tuple[DatasetConfig, ...]:
        """Configs that the submission contains, in the order of the folder, each restricted to its split."""
        split_by_config = {config_of(view_id): split_of(view_id) for view_id in self.submission.view_ids}
        return tuple(
            config.of_split(split_by_config[name] or TEST_SPLIT) if config.has_splits else config
            for name, config in self.folder.config_by_name.items()
            if name in split_by_config
        )

    def require_metric(self, use: str) -> None:
        """Raise ``SubmissionError`` unless the predictions are metric, which ``use`` requires."""
        if problems := self.meta.kind_problems(use):
            raise SubmissionError.from_problems(self.submission.path, problems)

    def scored_kind(self, align: str | None) -> str:
        """Return the kind that the predictions are scored as: their own, or ``align`` if they are metric.

        Raises ``InputError`` if ``align`` is no kind, and ``SubmissionError`` for predictions that are neither
        metric nor of that kind.
        """
        if align is not None and align not in ALIGNMENT_BY_KIND:
            expected = f"{', '.join(ALIGNMENT_BY_KIND)}, or None, which scores metric predictions as metric"
            raise InputError(f"align is {escape_text(str(align))}, expected one of {expected}")
        kind = align or self.meta.prediction
        if kind != self.meta.prediction:
            self.require_metric(f"only they can be scored as {kind}")
        return kind

    def provenance(self) -> Provenance:
        """Return the provenance of an analysis of the submission."""
        archive = SubmissionIdentity(self.meta.method, self.submission.sha256())
        return Provenance(PROTOCOL, DatasetIdentity(self.folder.digest, self.folder.version), [archive])


@contextmanager
def open_evaluation(
    archive: str | os.PathLike[str], root: str | Path | DatasetFolder, *, expect_digest: str | None = None
) -> Iterator[Evaluation]:
    """Open an archive and a dataset folder or Hub repository, and close the archive when the block ends.

    A folder that is open already may be restricted to some configs and views, which the archive then has.

    Raises ``SubmissionError`` with all problems, also those of single entries, if the structure of the archive is
    invalid, and ``DatasetError`` if the dataset folder is, or if its digest is not ``expect_digest``.
    """
    folder = root if isinstance(root, DatasetFolder) else open_folder(root, expect_digest=expect_digest)
    with SubmissionReader(archive, folder.expected_views()) as submission:
        if submission.structure_problems:
            raise SubmissionError.from_problems(archive, list(submission.problems()))
        yield Evaluation(folder, submission)
