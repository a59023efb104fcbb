"""Malformed and malicious submission archives: a registry of kinds, each drawn from a seeded generator.

Every reader of archives has tests and fuzz cases of its own; these few kinds show what a server does with them.
"""

from __future__ import annotations

import json
import pickle
import stat
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.submission.zips import Array, Record, build, deflated, npy, npy_header

META = b'{"method": "hostile", "depth_scale": 0.001}'


@dataclass(frozen=True)
class ValidArchive:
    """Valid archive to be damaged: true depth in metres by view id, and a folder that must stay empty."""

    depths: Mapping[str, Array]
    forbidden: Path

    @property
    def names(self) -> list[str]:
        return sorted(self.depths)

    def records(self, *first: Record, meta: bytes = META) -> list[Record]:
        """Return the entries of the archive; the entries ``first`` replace the same number of views."""
        views = [Record(f"{name}.npy".encode(), npy(self.depths[name])) for name in self.names[len(first) :]]
        return [Record(b"submission.json", meta), *first, *views]

    def view(self, suffix: str, data: bytes, **changes: Any) -> bytes:
        """Return the archive with other bytes, with a correct checksum, for its first view."""
        return build(self.records(Record(f"{self.names[0]}{suffix}".encode(), data, **changes)))

    @property
    def depth_m(self) -> Array:
        return self.depths[self.names[0]]


ArchiveGenerator = Callable[[np.random.Generator, ValidArchive], bytes]


class Payload:
    """Pickle payload that creates a file when it is loaded."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self._marker,)


def pickle_payload_npy(marker: Path) -> bytes:
    """Return an ``.npy`` file that creates the file ``marker`` when it is unpickled."""
    return npy(np.array([Payload(marker)], dtype=object), allow_pickle=True)


def _damaged(random: np.random.Generator, valid: ValidArchive) -> bytes:
    """Change bytes, cut the end off, or cut a part out."""
    data = bytearray(build(valid.records()))
    kind = random.integers(3)
    if kind == 0:
        in_directory = random.random() < 0.5  # The zip directory is at the end.
        first = len(data) - 250 if in_directory else 0
        for position in random.integers(first, len(data), size=random.integers(1, 9)):
            data[position] ^= int(random.integers(1, 256))
        return bytes(data)
    first, second = sorted(random.integers(1, len(data), size=2))
    return bytes(data[:first] + data[second:]) if kind == 1 else bytes(data[:first])


def _not_a_zip(random: np.random.Generator, _: ValidArchive) -> bytes:
    prefixes = (b"", b"PK\3\4", b"PK\5\6", b"\x1f\x8b\x08", b"\x80\4", b"{", b"<html>")
    return bytes(random.choice(np.array(prefixes, dtype=object))) + random.bytes(int(random.integers(0, 3000)))


def _forged_field(random: np.random.Generator, valid: ValidArchive) -> bytes:
    name = random.choice(["size", "compressed", "crc", "offset", "local_size"])
    changes: dict[str, Any] = {str(name): int(random.choice([1, 0x7FFF, 0x7FFFFFFF, 0xFFFFFFFE]))}
    first, *others = valid.records()
    return build([first, *others[:-1], replace(others[-1], **changes)])


@cache
def _zeros(megabytes: int) -> Record:
    return deflated(b"", bytes(megabytes * 1_000_000), level=1)


def _bomb(random: np.random.Generator, valid: ValidArchive) -> bytes:
    bomb = replace(_zeros(int(random.choice([1, 10, 50]))), name=f"{valid.names[0]}.npy".encode())
    declared = random.choice([bomb.size or 0, len(npy(valid.depth_m)), len(npy(valid.depth_m.astype(np.float64)))])
    return build(valid.records(replace(bomb, size=int(declared))))


def _nested(random: np.random.Generator, valid: ValidArchive) -> bytes:
    inside = replace(_zeros(10), name=b"z.npy")
    return valid.view(".npz", build([inside]) if random.random() < 0.5 else build(valid.records()))


def _encrypted(random: np.random.Generator, valid: ValidArchive) -> bytes:
    return valid.view(".npy", npy(valid.depth_m), flags=int(random.choice([0x1, 0x40, 0x2000, 0x2041])))


def _unusual_name(random: np.random.Generator, valid: ValidArchive) -> bytes:
    forbidden = valid.forbidden
    names = (
        f"{forbidden}/absolute.npy", "/etc/absolute.npy", "../up.npy", "../" * 20 + f"{forbidden}/climbed.npy",
        f"{valid.names[0]}/../../up.npy", "..\\up.npy", "C:\\up.npy", "a\0b.npy", "\x1b[31m.npy", "a\nb.npy",
        "\u202egnp.npy", "x" * 60_000, "", ".", "/", "//", "CON", "%2e%2e/up.npy", "<script>alert(1)</script>",
        f"{valid.names[0]}.npy\0.png", f"{valid.names[0]}.NPY", f"./{valid.names[0]}.npy", "lattice/../../../etc",
    )  # fmt: skip
    name = str(random.choice(np.array(names, dtype=object)))
    flags = int(random.choice([0, 0x800]))
    record = Record(name.encode("utf-8"), npy(valid.depth_m), flags=flags)
    return build([*valid.records(), record] if random.random() < 0.5 else valid.records(record))


def _special_file(random: np.random.Generator, valid: ValidArchive) -> bytes:
    kinds = (stat.S_IFLNK, stat.S_IFDIR, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFIFO, stat.S_IFSOCK)
    target = str(random.choice(["/etc/passwd", "../../../leaderboard.sqlite", str(valid.forbidden)]))
    mode = int(random.choice(kinds)) | 0o777
    return valid.view(".npy", target.encode(), mode=mode)


def _duplicate_entries(random: np.random.Generator, valid: ValidArchive) -> bytes:
    records = valid.records()
    duplicate = records[random.integers(len(records))]
    return build([*records, replace(duplicate, data=duplicate.data[::-1]), *[duplicate] * random.integers(3)])


def _many_entries(random: np.random.Generator, valid: ValidArchive) -> bytes:
    empty = build([Record(b"%05d" % number) for number in range(1500)])
    return empty if random.random() < 0.5 else build(valid.records(), count=65_535)


def _invalid_npy(random: np.random.Generator, valid: ValidArchive) -> bytes:
    depth_m, (height, width) = valid.depth_m, valid.depth_m.shape
    header = "{{'descr': '{}', 'fortran_order': False, 'shape': {}, }}"
    pickled = pickle.dumps(Payload(valid.forbidden / "unpickled"))
    bodies = (
        pickle_payload_npy(valid.forbidden / "unpickled"),
        pickled,
        npy_header(header.format("|O", (height, width))) + pickled,
        *(npy(array) for array in (depth_m.astype("i4"), depth_m.T, depth_m[:-1])),
        npy_header(header.format("<f4", (400_000, 400_000))),
        npy_header(header.format("<f4", "__import__('os').abort()")) + depth_m.tobytes(),
        npy_header("(" * 3000),
    )
    return valid.view(".npy", bodies[random.integers(len(bodies))])


def _invalid_metadata(random: np.random.Generator, valid: ValidArchive) -> bytes:
    bodies = (
        *(b"[" * 100_000, b"", b"null", b'{"method": "\xff"}', b'{"method": "\\ud800"}'),
        *(b'{"method": "m", "x": ' + b"9" * 5000 + b"}", b'{"method": "m\\u0000"}'),
        b'{"method": "m", "url": "javascript:alert(1)"}',
        json.dumps({"method": "m", "description": "x" * 5_000_000}).encode(),
    )
    return build(valid.records(meta=bodies[random.integers(len(bodies))]))


KINDS: Mapping[str, ArchiveGenerator] = {
    "damaged": _damaged,
    "no zip": _not_a_zip,
    "field forged": _forged_field,
    "bomb": _bomb,
    "nested": _nested,
    "encrypted": _encrypted,
    "odd name": _unusual_name,
    "no file": _special_file,
    "twice": _duplicate_entries,
    "many": _many_entries,
    "no npy": _invalid_npy,
    "no metadata": _invalid_metadata,
}
"""Generators of archives by kind; nearly all are rejected (a mutation may by chance change only unread bytes)."""


def unusual_valid_archives(valid: ValidArchive) -> Sequence[bytes]:
    """Return unusual but valid archives: each must be accepted and scored."""
    unusual_m = np.full(valid.depth_m.shape, np.nan)
    unusual_m.flat[:4] = [np.inf, -1.0, 1e308, 5e-324]
    records = valid.records()
    return [
        valid.view(".npy", npy(np.asfortranarray(valid.depth_m))),
        valid.view(".npy", npy(valid.depth_m.astype(">f8"))),
        build([records[0], *(replace(record, data=npy(unusual_m)) for record in records[1:])]),
        build(valid.records(meta=json.dumps({"method": "x", "description": "x" * 1_000_000}).encode())),
        build(valid.records(), comment=b"PK\5\6" * 100),
    ]


def malformed_archives(random: np.random.Generator, valid: ValidArchive, count: int) -> list[tuple[str, bytes]]:
    """Return ``count`` pairs of kind and archive, the same number of each kind."""
    names = list(KINDS)
    return [(name, KINDS[name](random, valid)) for name in (names[index % len(names)] for index in range(count))]
