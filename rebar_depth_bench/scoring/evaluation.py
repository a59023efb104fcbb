"""Open submission and dataset folder, shared by scoring, extended measures and reports."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.errors import SubmissionError
from rebar_depth_bench.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.parallel import Progress, silent
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.provenance import ArchiveIdentity, Provenance
from rebar_depth_bench.submission import Declaration, SubmissionReader, open_submission
from rebar_depth_bench.submission.declaration import NOT_DECLARED


@dataclass(frozen=True)
class Evaluation:
    """Submission whose structure is valid, and the dataset folder it is evaluated against."""

    folder: DatasetFolder
    submission: SubmissionReader

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.submission.meta.method if self.submission.meta else ""

    @property
    def declared(self) -> Declaration:
        """What the submission declares about its inputs and its use of ground truth."""
        return self.submission.meta.declaration if self.submission.meta else NOT_DECLARED

    @property
    def configs(self) -> tuple[DatasetConfig, ...]:
        """Configs that the submission contains, in the order of the folder, each restricted to its split."""
        split_by_config = {config_of(view_id): split_of(view_id) for view_id in self.submission.view_ids}
        return tuple(
            config.of_split(split_by_config[name] or TEST_SPLIT) if config.has_splits else config
            for name, config in self.folder.config_by_name.items()
            if name in split_by_config
        )

    def check_entries(self, progress: Progress = silent) -> None:
        """Decode every entry. Raises ``SubmissionError`` with all problems."""
        problems = list(self.submission.problems(progress))
        if problems:
            raise SubmissionError.from_problems(self.submission.path, problems)

    def provenance(self) -> Provenance:
        """Return the provenance of an analysis of the submission."""
        archives = (ArchiveIdentity(self.method, self.submission.sha256()),)
        return Provenance(PROTOCOL, self.folder.digest, self.folder.version, archives)


@contextmanager
def open_evaluation(
    archive: str | os.PathLike[str], root: str | Path, *, expect_digest: str | None = None
) -> Iterator[Evaluation]:
    """Open an archive and a dataset folder or Hub repository, and close the archive when the block ends.

    Raises ``SubmissionError`` with all problems, also those of single entries, if the structure of the archive is
    invalid, and ``DatasetError`` if the dataset folder is, or if its digest is not ``expect_digest``.
    """
    folder = open_folder(root, expect_digest=expect_digest)
    with open_submission(archive, folder.expected_views()) as submission:
        if submission.meta is None or submission.structure_problems:
            raise SubmissionError.from_problems(archive, list(submission.problems()))
        yield Evaluation(folder, submission)
