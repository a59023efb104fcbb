"""Malformed and malicious submission archives: a registry of kinds, each drawn from a seeded generator."""

from __future__ import annotations

import json
import pickle
import stat
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.submission.zips import Array, Record, build, deflated, npy, npy_header, npz, png

EXTREMES = (0, 1, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF)
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


def _changed_bytes(random: np.random.Generator, valid: ValidArchive) -> bytes:
    data = bytearray(build(valid.records()))
    in_directory = random.random() < 0.5  # The zip directory is at the end.
    for position in random.integers(len(data) - 250 if in_directory else 0, len(data), size=random.integers(1, 9)):
        data[position] ^= int(random.integers(1, 256))
    return bytes(data)


def _truncated(random: np.random.Generator, valid: ValidArchive) -> bytes:
    data = build(valid.records())
    return data[: random.integers(1, len(data))]


def _with_gap(random: np.random.Generator, valid: ValidArchive) -> bytes:
    data = build(valid.records())
    first, second = sorted(random.integers(len(data), size=2))
    return data[:first] + data[second:]


def _spliced_archives(random: np.random.Generator, valid: ValidArchive) -> bytes:
    stored, compressed = build(valid.records()), build([deflated(r.name, r.data) for r in valid.records()])
    if random.random() < 0.5:
        return stored + compressed
    return stored[: random.integers(len(stored))] + compressed[random.integers(len(compressed)) :]


def _junk_around(random: np.random.Generator, valid: ValidArchive) -> bytes:
    junk = random.bytes(int(random.integers(1, 5000)))
    return junk + build(valid.records()) if random.random() < 0.5 else build(valid.records()) + junk


def _not_a_zip(random: np.random.Generator, _: ValidArchive) -> bytes:
    prefixes = (b"", b"PK\3\4", b"PK\5\6", b"\x1f\x8b\x08", b"\x80\4", b"{", b"<html>")
    return bytes(random.choice(np.array(prefixes, dtype=object))) + random.bytes(int(random.integers(0, 3000)))


def _forged_field(random: np.random.Generator, valid: ValidArchive) -> bytes:
    name = random.choice(["size", "compressed", "crc", "offset", "local_size", "disk", "method", "flags"])
    max_value = 0xFFFF if name in ("disk", "method", "flags") else 0xFFFFFFFF
    changes: dict[str, Any] = {str(name): max(int(random.choice(EXTREMES)) & max_value, 1)}
    first, *others = valid.records()
    return build([first, *others[:-1], replace(others[-1], **changes)])


def _forged_end_record(random: np.random.Generator, valid: ValidArchive) -> bytes:
    data = bytearray(build(valid.records()))
    offset, width = ((4, 2), (6, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2))[random.integers(7)]
    start = len(data) - 22 + offset
    original = int.from_bytes(data[start : start + width], "little")
    values = [value & (256**width - 1) for value in EXTREMES if value & (256**width - 1) != original]
    data[start : start + width] = int(random.choice(values)).to_bytes(width, "little")
    return bytes(data)


@cache
def _zeros(megabytes: int) -> Record:
    return deflated(b"", bytes(megabytes * 1_000_000), level=1)


def _bomb(random: np.random.Generator, valid: ValidArchive) -> bytes:
    bomb = replace(_zeros(int(random.choice([1, 10, 50]))), name=f"{valid.names[0]}.npy".encode())
    declared = random.choice([bomb.size or 0, len(npy(valid.depth_m)), len(npy(valid.depth_m.astype(np.float64)))])
    return build(valid.records(replace(bomb, size=int(declared))))


def _bomb_in_a_format(random: np.random.Generator, valid: ValidArchive) -> bytes:
    inside = replace(_zeros(10), name=b"z.npy")
    return (
        lambda: valid.view(
            ".png", png(np.zeros(valid.depth_m.shape, np.uint16), idat=zlib.compress(bytes(2 << 20)))
        ),
        lambda: valid.view(".npz", build([inside])),
        lambda: valid.view(".npz", build([replace(inside, size=len(npy(valid.depth_m)))])),
    )[random.integers(3)]()


def _nested(random: np.random.Generator, valid: ValidArchive) -> bytes:
    inner, name = build(valid.records()), random.choice(["inner.zip", f"{valid.names[0]}.npz", "submission.json"])
    for _ in range(random.integers(1, 4)):
        inner = build([Record(str(name).encode(), inner)])
    return inner if random.random() < 0.5 else valid.view(".npz", inner)


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
    count = int(random.choice([900, 1500, 20_000, 65_535]))
    empty = build([Record(b"%05d" % number) for number in range(min(count, 1500))])
    return empty if count <= 1500 else build(valid.records(), count=count)


def _invalid_npy(random: np.random.Generator, valid: ValidArchive) -> bytes:
    depth_m, height, width = valid.depth_m, *valid.depth_m.shape
    pickled = pickle.dumps(Payload(valid.forbidden / "unpickled"))
    header = "{{'descr': '{}', 'fortran_order': {}, 'shape': {}, }}"
    bodies = (
        pickle_payload_npy(valid.forbidden / "unpickled"),
        pickled,
        npy_header(header.format("|O", False, (height, width))) + pickled,
        *(npy(depth_m.astype(kind)) for kind in ("i4", "u1", "c8", "?", "M8[s]", "S3")),
        *(npy(array) for array in (depth_m.T, depth_m[None], depth_m[:-1], depth_m.ravel(), depth_m[:0])),
        npy_header(header.format("<f4", False, (400_000, 400_000))),
        npy_header(header.format("<f4", False, (-height, -width))) + depth_m.tobytes(),
        npy_header(header.format("<f4", False, "__import__('os').abort()")) + depth_m.tobytes(),
        npy_header("(" * 3000), npy_header("x" * 60_000), npy_header("x" * 200_000, b"\2\0"),
        b"\x93NUMPY\3\0\xff\xff\xff\x7f", b"\x93NUMPY\x09\0\x10\0", npy(depth_m)[: random.integers(200)],
    )  # fmt: skip
    return valid.view(".npy", bodies[random.integers(len(bodies))])


def _invalid_metadata(random: np.random.Generator, valid: ValidArchive) -> bytes:
    bodies = (
        b"[" * 100_000, b'{"method":' * 50_000, b"", b"null", b"[]", b'"m"', b"{", b'{"method": "\xff"}',
        b"\xef\xbb\xbf{}",
        '{"method": "m"}'.encode("utf-16"), b'{"method": "m", "x": 1e999}', b'{"method": "m", "x": NaN}',
        b'{"method": "m", "x": ' + b"9" * 5000 + b"}", b'{"method": "\\ud800"}', b'{"method": "m\\u0000"}',
        b'{"method": "m", "description": "\\u0000"}', b'{"method": "m", "description": "\\udfff"}',
        b'{"method": 1, "url": 2, "description": [], "uses_ground_truth": 3, "runtime": [], "depth_scale": "x"}',
        b'{"method": "m", "url": "javascript:alert(1)"}', b'{"method": "m", "url": "http://[::1"}',
        b'{"method": "' + b"m" * 201 + b'"}', b'{"method": "m", "depth_scale": -1e-999}',
        json.dumps({"method": "m", "description": "x" * 5_000_000}).encode(),
    )  # fmt: skip
    return build(valid.records(meta=bodies[random.integers(len(bodies))]))


def _unsupported_compression(random: np.random.Generator, valid: ValidArchive) -> bytes:
    return valid.view(
        ".npy", npy(valid.depth_m), method=int(random.choice([1, 6, 9, 12, 14, 93, 95, 98, 99, 255]))
    )


def _damaged_image(random: np.random.Generator, valid: ValidArchive) -> bytes:
    units = (1000 * valid.depth_m).astype(np.uint16)
    suffix, data = ((".png", png(units)), (".npz", npz(z=valid.depth_m)))[random.integers(2)]
    body = bytearray(data)
    body[random.integers(min(len(body), 60))] ^= int(random.integers(1, 256))
    return valid.view(suffix, bytes(body[: random.integers(20, len(body))]))


KINDS: Mapping[str, ArchiveGenerator] = {
    "bytes changed": _changed_bytes,
    "cut off": _truncated,
    "cut out": _with_gap,
    "spliced": _spliced_archives,
    "junk around": _junk_around,
    "no zip": _not_a_zip,
    "field forged": _forged_field,
    "end forged": _forged_end_record,
    "bomb": _bomb,
    "bomb in a format": _bomb_in_a_format,
    "nested": _nested,
    "encrypted": _encrypted,
    "odd name": _unusual_name,
    "no file": _special_file,
    "twice": _duplicate_entries,
    "many": _many_entries,
    "no npy": _invalid_npy,
    "no metadata": _invalid_metadata,
    "odd method": _unsupported_compression,
    "damaged image": _damaged_image,
}
"""Generators of archives by kind; nearly all are rejected (a mutation may by chance change only unread bytes)."""


def unusual_valid_archives(valid: ValidArchive) -> Sequence[bytes]:
    """Return unusual but valid archives: each must be accepted and scored."""
    depth_m = valid.depth_m
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {depth_m.shape}, }}"
    unusual_depth_m = np.full(depth_m.shape, np.nan)
    unusual_depth_m.flat[: 4 * unusual_depth_m.shape[1]] = np.tile(
        [np.inf, -1.0, 1e308, 5e-324], unusual_depth_m.shape[1]
    )
    return [
        *(valid.view(".npy", npy_header(text, version) + depth_m.tobytes()) for version in (b"\2\0", b"\3\0")),
        valid.view(".npy", npy(np.asfortranarray(depth_m))),
        valid.view(".npy", npy(depth_m.astype(">f8"))),
        build(
            [
                Record(record.name, record.data if b"json" in record.name else npy(unusual_depth_m))
                for record in valid.records()
            ]
        ),
        build(valid.records(meta=json.dumps({"method": "x", "description": "x" * 1_000_000}).encode())),
        build(valid.records(), comment=b"PK\5\6" * 100),
    ]


def malformed_archives(random: np.random.Generator, valid: ValidArchive, count: int) -> list[tuple[str, bytes]]:
    """Return ``count`` pairs of kind and archive, the same number of each kind."""
    names = list(KINDS)
    return [(name, KINDS[name](random, valid)) for name in (names[index % len(names)] for index in range(count))]
