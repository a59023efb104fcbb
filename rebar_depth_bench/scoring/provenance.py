"""The stamp on everything that is written: from which data, by which rules, with which software."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.version import software_version


@dataclass(frozen=True)
class ArchiveStamp:
    """An archive's method and the hex SHA-256 of its file."""

    method: str
    sha256: str


@dataclass(frozen=True)
class Stamp:
    """What a study's numbers come from. ``protocol`` names the definitions; a changed one changes its name.

    ``dataset_digest`` and ``dataset_version`` are None where a study's reference is not a dataset folder.
    """

    protocol: str
    dataset_digest: str | None
    dataset_version: str | None
    archives: Sequence[ArchiveStamp]

    def to_dict(self) -> dict[str, Any]:
        """Return the stamp's part of a JSON object."""
        dataset = {"digest": self.dataset_digest, "version": self.dataset_version}
        return {
            "protocol": self.protocol,
            "dataset": dataset if self.dataset_digest is not None else None,
            "submissions": [{"method": one.method, "sha256": one.sha256} for one in self.archives],
            "software": {"version": software_version()},
        }

    def csv_cells(self) -> dict[str, str | None]:
        """Return the stamp of a study of one archive as the cells that end each of its CSV rows."""
        return {
            "dataset_digest": self.dataset_digest,
            "dataset_version": self.dataset_version,
            "submission_sha256": self.archives[0].sha256,
            "software_version": software_version(),
        }

    def lines(self) -> list[tuple[str, str]]:
        """Return the stamp as (what, value) in words, safe to print."""
        dataset = []
        if self.dataset_digest is not None:
            dataset = [("Dataset", f"{self.dataset_version} ({self.dataset_digest})")]
        archives = [(f"Archive of {one.method}", f"sha256:{one.sha256}") for one in self.archives]
        software = [("Software", f"rebar-depth-bench {software_version()}")]
        lines = [("Protocol", self.protocol), *dataset, *archives, *software]
        return [(formatting.printable(what), formatting.printable(value)) for what, value in lines]
