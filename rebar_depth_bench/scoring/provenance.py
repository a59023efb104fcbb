"""Provenance of written results: dataset, protocol, archives and software version."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rebar_depth_bench.version import software_version


@dataclass(frozen=True)
class ArchiveIdentity:
    """Method name of an archive and the hex SHA-256 of its file."""

    method: str
    sha256: str


@dataclass(frozen=True)
class Provenance:
    """Provenance of the numbers of a comparison, or of an analysis of archives.

    ``protocol`` names the definitions of the numbers; changed definitions have a new name. ``dataset_digest`` and
    ``dataset_version`` are None if the reference is not a dataset folder.
    """

    protocol: str
    dataset_digest: str | None
    dataset_version: str | None
    archives: Sequence[ArchiveIdentity]

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance entries of a JSON object."""
        dataset = {"digest": self.dataset_digest, "version": self.dataset_version}
        return {
            "protocol": self.protocol,
            "dataset": dataset if self.dataset_digest is not None else None,
            "submissions": [{"method": archive.method, "sha256": archive.sha256} for archive in self.archives],
            "software": {"version": software_version()},
        }
