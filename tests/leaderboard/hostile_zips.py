"""Archives as an enemy or a broken disk makes them: a registry of kinds, each drawn from a seeded generator."""

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
class Sound:
    """A sound archive to spoil: true depth in metres by view id, and a folder that nobody may write to."""

    depths: Mapping[str, Array]
    forbidden: Path

    @property
    def names(self) -> list[str]:
        return sorted(self.depths)

    def records(self, *first: Record, meta: bytes = META) -> list[Record]:
        """Return the archive's entries, those of ``first`` in the place of as many views."""
        views = [Record(f"{name}.npy".encode(), npy(self.depths[name])) for name in self.names[len(first) :]]
        return [Record(b"submission.json", meta), *first, *views]

    def view(self, suffix: str, data: bytes, **changes: Any) -> bytes:
        """Return the archive with other bytes, under a right checksum, for its first view."""
        return build(self.records(Record(f"{self.names[0]}{suffix}".encode(), data, **changes)))

    @property
    def depth_m(self) -> Array:
        return self.depths[self.names[0]]


Kind = Callable[[np.random.Generator, Sound], bytes]


class Payload:
    """What a pickled array runs when it is loaded: it makes a file."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self._marker,)


def payload(marker: Path) -> bytes:
    """Return an ``.npy`` that makes ``marker`` when whoever loads it unpickles it."""
    return npy(np.array([Payload(marker)], dtype=object), allow_pickle=True)


def _bytes_changed(random: np.random.Generator, sound: Sound) -> bytes:
    data = bytearray(build(sound.records()))
    tail = random.random() < 0.5  # where the directory is
    for at in random.integers(len(data) - 250 if tail else 0, len(data), size=random.integers(1, 9)):
        data[at] ^= int(random.integers(1, 256))
    return bytes(data)


def _cut_off(random: np.random.Generator, sound: Sound) -> bytes:
    data = build(sound.records())
    return data[: random.integers(1, len(data))]


def _cut_out(random: np.random.Generator, sound: Sound) -> bytes:
    data = build(sound.records())
    first, second = sorted(random.integers(len(data), size=2))
    return data[:first] + data[second:]


def _spliced(random: np.random.Generator, sound: Sound) -> bytes:
    one, other = build(sound.records()), build([deflated(r.name, r.data) for r in sound.records()])
    if random.random() < 0.5:
        return one + other
    return one[: random.integers(len(one))] + other[random.integers(len(other)) :]


def _junk_around(random: np.random.Generator, sound: Sound) -> bytes:
    junk = random.bytes(int(random.integers(1, 5000)))
    return junk + build(sound.records()) if random.random() < 0.5 else build(sound.records()) + junk


def _no_zip(random: np.random.Generator, _: Sound) -> bytes:
    starts = (b"", b"PK\3\4", b"PK\5\6", b"\x1f\x8b\x08", b"\x80\4", b"{", b"<html>")
    return bytes(random.choice(np.array(starts, dtype=object))) + random.bytes(int(random.integers(0, 3000)))


def _field_forged(random: np.random.Generator, sound: Sound) -> bytes:
    name = random.choice(["size", "compressed", "crc", "offset", "local_size", "disk", "method", "flags"])
    most = 0xFFFF if name in ("disk", "method", "flags") else 0xFFFFFFFF
    forged: dict[str, Any] = {str(name): max(int(random.choice(EXTREMES)) & most, 1)}
    first, *others = sound.records()
    return build([first, *others[:-1], replace(others[-1], **forged)])


def _end_forged(random: np.random.Generator, sound: Sound) -> bytes:
    data = bytearray(build(sound.records()))
    at, width = ((4, 2), (6, 2), (8, 2), (10, 2), (12, 4), (16, 4), (20, 2))[random.integers(7)]
    start = len(data) - 22 + at
    before = int.from_bytes(data[start : start + width], "little")
    found = [value & (256**width - 1) for value in EXTREMES if value & (256**width - 1) != before]
    data[start : start + width] = int(random.choice(found)).to_bytes(width, "little")
    return bytes(data)


@cache
def _zeros(megabytes: int) -> Record:
    return deflated(b"", bytes(megabytes * 1_000_000), level=1)


def _bomb(random: np.random.Generator, sound: Sound) -> bytes:
    bomb = replace(_zeros(int(random.choice([1, 10, 50]))), name=f"{sound.names[0]}.npy".encode())
    declared = random.choice([bomb.size or 0, len(npy(sound.depth_m)), len(npy(sound.depth_m.astype(np.float64)))])
    return build(sound.records(replace(bomb, size=int(declared))))


def _bomb_in_a_format(random: np.random.Generator, sound: Sound) -> bytes:
    inside = replace(_zeros(10), name=b"z.npy")
    return (
        lambda: sound.view(
            ".png", png(np.zeros(sound.depth_m.shape, np.uint16), idat=zlib.compress(bytes(2 << 20)))
        ),
        lambda: sound.view(".npz", build([inside])),
        lambda: sound.view(".npz", build([replace(inside, size=len(npy(sound.depth_m)))])),
    )[random.integers(3)]()


def _nested(random: np.random.Generator, sound: Sound) -> bytes:
    inner, name = build(sound.records()), random.choice(["inner.zip", f"{sound.names[0]}.npz", "submission.json"])
    for _ in range(random.integers(1, 4)):
        inner = build([Record(str(name).encode(), inner)])
    return inner if random.random() < 0.5 else sound.view(".npz", inner)


def _encrypted(random: np.random.Generator, sound: Sound) -> bytes:
    return sound.view(".npy", npy(sound.depth_m), flags=int(random.choice([0x1, 0x40, 0x2000, 0x2041])))


def _odd_name(random: np.random.Generator, sound: Sound) -> bytes:
    place = sound.forbidden
    names = (
        f"{place}/absolute.npy", "/etc/absolute.npy", "../up.npy", "../" * 20 + f"{place}/climbed.npy",
        f"{sound.names[0]}/../../up.npy", "..\\up.npy", "C:\\up.npy", "a\0b.npy", "\x1b[31m.npy", "a\nb.npy",
        "\u202egnp.npy", "x" * 60_000, "", ".", "/", "//", "CON", "%2e%2e/up.npy", "<script>alert(1)</script>",
        f"{sound.names[0]}.npy\0.png", f"{sound.names[0]}.NPY", f"./{sound.names[0]}.npy", "lattice/../../../etc",
    )  # fmt: skip
    name = str(random.choice(np.array(names, dtype=object)))
    flags = int(random.choice([0, 0x800]))
    record = Record(name.encode("utf-8"), npy(sound.depth_m), flags=flags)
    return build([*sound.records(), record] if random.random() < 0.5 else sound.records(record))


def _no_file(random: np.random.Generator, sound: Sound) -> bytes:
    kinds = (stat.S_IFLNK, stat.S_IFDIR, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFIFO, stat.S_IFSOCK)
    target = str(random.choice(["/etc/passwd", "../../../leaderboard.sqlite", str(sound.forbidden)]))
    mode = int(random.choice(kinds)) | 0o777
    return sound.view(".npy", target.encode(), mode=mode)


def _twice(random: np.random.Generator, sound: Sound) -> bytes:
    records = sound.records()
    again = records[random.integers(len(records))]
    return build([*records, replace(again, data=again.data[::-1]), *[again] * random.integers(3)])


def _many(random: np.random.Generator, sound: Sound) -> bytes:
    count = int(random.choice([900, 1500, 20_000, 65_535]))
    empty = build([Record(b"%05d" % number) for number in range(min(count, 1500))])
    return empty if count <= 1500 else build(sound.records(), count=count)


def _npy_that_is_none(random: np.random.Generator, sound: Sound) -> bytes:
    depth_m, height, width = sound.depth_m, *sound.depth_m.shape
    pickled = pickle.dumps(Payload(sound.forbidden / "unpickled"))
    header = "{{'descr': '{}', 'fortran_order': {}, 'shape': {}, }}"
    bodies = (
        payload(sound.forbidden / "unpickled"),
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
    return sound.view(".npy", bodies[random.integers(len(bodies))])


def _meta_that_is_none(random: np.random.Generator, sound: Sound) -> bytes:
    bodies = (
        b"[" * 100_000, b'{"method":' * 50_000, b"", b"null", b"[]", b'"m"', b"{", b'{"method": "\xff"}',
        b"\xef\xbb\xbf{}",
        '{"method": "m"}'.encode("utf-16"), b'{"method": "m", "x": 1e999}', b'{"method": "m", "x": NaN}',
        b'{"method": "m", "x": ' + b"9" * 5000 + b"}", b'{"method": "\\ud800"}', b'{"method": "m\\u0000"}',
        b'{"method": "m", "description": "\\u0000"}', b'{"method": "m", "description": "\\udfff"}',
        b'{"method": 1, "url": 2, "description": [], "uses_intrinsics": 3, "runtime": [], "depth_scale": "x"}',
        b'{"method": "m", "url": "javascript:alert(1)"}', b'{"method": "m", "url": "http://[::1"}',
        b'{"method": "' + b"m" * 201 + b'"}', b'{"method": "m", "depth_scale": -1e-999}',
        json.dumps({"method": "m", "description": "x" * 5_000_000}).encode(),
    )  # fmt: skip
    return build(sound.records(meta=bodies[random.integers(len(bodies))]))


def _odd_method(random: np.random.Generator, sound: Sound) -> bytes:
    return sound.view(
        ".npy", npy(sound.depth_m), method=int(random.choice([1, 6, 9, 12, 14, 93, 95, 98, 99, 255]))
    )


def _damaged_image(random: np.random.Generator, sound: Sound) -> bytes:
    units = (1000 * sound.depth_m).astype(np.uint16)
    suffix, data = ((".png", png(units)), (".npz", npz(z=sound.depth_m)))[random.integers(2)]
    body = bytearray(data)
    body[random.integers(min(len(body), 60))] ^= int(random.integers(1, 256))
    return sound.view(suffix, bytes(body[: random.integers(20, len(body))]))


KINDS: Mapping[str, Kind] = {
    "bytes changed": _bytes_changed,
    "cut off": _cut_off,
    "cut out": _cut_out,
    "spliced": _spliced,
    "junk around": _junk_around,
    "no zip": _no_zip,
    "field forged": _field_forged,
    "end forged": _end_forged,
    "bomb": _bomb,
    "bomb in a format": _bomb_in_a_format,
    "nested": _nested,
    "encrypted": _encrypted,
    "odd name": _odd_name,
    "no file": _no_file,
    "twice": _twice,
    "many": _many,
    "no npy": _npy_that_is_none,
    "no metadata": _meta_that_is_none,
    "odd method": _odd_method,
    "damaged image": _damaged_image,
}
"""Kinds of archive that are refused, but for a mutation now and then that changes what nobody reads."""


def odd_and_sound(sound: Sound) -> Sequence[bytes]:
    """Return archives that look wrong and are none the less sound: each is to be accepted and scored."""
    depth_m = sound.depth_m
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {depth_m.shape}, }}"
    odd = np.full(depth_m.shape, np.nan)
    odd.flat[: 4 * odd.shape[1]] = np.tile([np.inf, -1.0, 1e308, 5e-324], odd.shape[1])
    return [
        *(sound.view(".npy", npy_header(text, version) + depth_m.tobytes()) for version in (b"\2\0", b"\3\0")),
        sound.view(".npy", npy(np.asfortranarray(depth_m))),
        sound.view(".npy", npy(depth_m.astype(">f8"))),
        build(
            [
                Record(record.name, record.data if b"json" in record.name else npy(odd))
                for record in sound.records()
            ]
        ),
        build(sound.records(meta=json.dumps({"method": "x", "description": "x" * 1_000_000}).encode())),
        build(sound.records(), comment=b"PK\5\6" * 100),
    ]


def mutated(random: np.random.Generator, sound: Sound, count: int) -> list[tuple[str, bytes]]:
    """Return ``count`` archives with their kinds, as many of each."""
    names = list(KINDS)
    return [(name, KINDS[name](random, sound)) for name in (names[at % len(names)] for at in range(count))]
