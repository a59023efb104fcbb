"""Seeded generators that damage the content of a file at the level of bytes, tokens and values; special files.

Each generator takes the content of a sound file and a random generator, and returns other content. Special files
(pipes, devices, folders, links, and empty, huge or missing files) take the place of an input.
"""

from __future__ import annotations

import copy
import json
import os
import re
import shutil
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from tests.fuzz import hostile

Damage = Callable[[bytes, np.random.Generator], bytes]
_HEAD_BYTES = 256
_TOKEN = re.compile(rb'"[^"\n]*"|\'[^\'\n]*\'|[-+]?\d[\w.+-]*|[A-Za-z_][\w.-]*|[^\s\w]')
_PLACEHOLDER = "b4d9b0a1-placeholder"


def damage_content(name: str, content: bytes, rng: np.random.Generator) -> tuple[bytes, str]:
    """Return the damaged content of the file ``name`` and the level of the damage."""
    levels = {"bytes": damage_bytes, **_LEVELS.get(PurePath(name).suffix, {})}
    level = str(rng.choice(list(levels)))
    try:
        return levels[level](content, rng), level
    except (ValueError, RecursionError):  # An earlier damage has made the file unreadable.
        return damage_bytes(content, rng), "bytes"


def damage_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Change, insert, delete, repeat or clear a few bytes, or a block, anywhere or near one of the ends."""
    if not content:
        return bytes(rng.integers(0, 256, 16, dtype=np.uint8))
    data = bytearray(content)
    start, length = _position(len(data), rng), int(rng.choice((1, 2, 4, 16, 256, 4096)))
    noise = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
    block = bytes(data[start : start + length])
    kind = rng.integers(9)
    if kind == 0:
        for at in {start, *(_position(len(data), rng) for _ in range(rng.integers(3)))}:
            data[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        data[start : start + 1] = noise[:1]
    elif kind == 2:
        data[start:start] = noise
    elif kind == 3:
        del data[start : start + length]
    elif kind == 4:
        del data[start:]
    elif kind == 5:
        data[start:start] = block * int(rng.choice((1, 2, 1000)))
    elif kind == 6:
        data[start : start + length] = bytes(len(block))
    elif kind == 7:
        number = int(rng.choice((0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40)))
        width = int(rng.choice((2, 4, 8)))
        data[start : start + width] = (number & ((1 << 8 * width) - 1)).to_bytes(
            width,
            str(rng.choice(("little", "big"))),  # type: ignore[arg-type]
        )
    else:
        other = _position(len(data), rng)
        data[start : start + length] = data[other : other + length]
    return bytes(data)


def _position(size: int, rng: np.random.Generator) -> int:
    """Return a position, in half of the cases near one of the ends, where formats keep their structure."""
    low, high = [(0, size), (0, size), (0, _HEAD_BYTES), (size - _HEAD_BYTES, size)][rng.integers(4)]
    return int(rng.integers(max(low, 0), min(high, size)))


def damage_tokens(content: bytes, rng: np.random.Generator) -> bytes:
    """Delete, repeat, swap or replace tokens or lines of a text, or insert a long run of one token."""
    if rng.random() < 0.3:
        return _damage_lines(content, rng)
    tokens = list(_TOKEN.finditer(content))
    if not tokens:
        return damage_bytes(content, rng)
    first, second = sorted((tokens[rng.integers(len(tokens))] for _ in range(2)), key=lambda match: match.start())
    before, old, after = content[: first.start()], first[0], content[first.end() :]
    kind = rng.integers(7)
    if kind == 0:
        return before + after
    if kind == 1:
        return before + (old + b" ") * int(rng.choice((2, 3, 10_000))) + after
    if kind == 2 and first.start() != second.start():
        between = content[first.end() : second.start()]
        return before + second[0] + between + old + content[second.end() :]
    if kind == 3:
        return before + _choose(hostile.SPAM, rng) + content[first.start() :]
    return before + _other_token(old, rng) + after


def _other_token(token: bytes, rng: np.random.Generator) -> bytes:
    if token[:1] in b"'\"":
        return token[:1] + _choose((*hostile.TEXTS, *hostile.PATHS), rng) + token[:1]
    if re.fullmatch(rb"[-+]?[\d.][\w.+-]*", token) and rng.random() < 0.7:
        return _choose(hostile.NUMBERS, rng)
    return _choose((*hostile.TEXTS, *hostile.PATHS, *hostile.NUMBERS), rng)


def _damage_lines(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.splitlines(keepends=True) or [b"\n"]
    first, second = (int(rng.integers(len(lines))) for _ in range(2))
    kind = rng.integers(4)
    if kind == 0:
        del lines[first]
    elif kind == 1:
        lines.insert(second, lines[first])
    elif kind == 2:
        lines[first], lines[second] = lines[second], lines[first]
    else:
        del lines[first:]
    return b"".join(lines)


def damage_json(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace, delete, repeat, rename or move one value of a JSON text."""
    return _damage_value(json.loads(content), rng, lambda value: json.dumps(value).encode())


def damage_toml(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace, delete, repeat, rename or move one value of a TOML text."""
    return _damage_value(tomllib.loads(content.decode()), rng, _toml)


def _damage_value(document: Any, rng: np.random.Generator, write: Callable[[Any], bytes]) -> bytes:
    places = _places(document)
    if not places:
        return _choose(hostile.LITERALS, rng)
    container, key = places[rng.integers(len(places))]
    literal, kind = _choose(hostile.LITERALS, rng), rng.integers(8)
    old = container[key]
    if kind == 0:
        del container[key]
    elif kind == 1:
        other_container, other_key = places[rng.integers(len(places))]
        container[key] = copy.deepcopy(other_container[other_key])
    elif kind == 2 and isinstance(container, dict):
        container[_choose((*hostile.PATHS, *hostile.TEXTS), rng).decode("latin-1")] = container.pop(key)
    elif kind == 3 and isinstance(container, dict):  # The key twice.
        container[key], literal = _PLACEHOLDER, literal + b', "' + str(key).encode() + b'": ' + literal
    elif kind == 4 and isinstance(old, list):
        container[key] = old * int(rng.choice((2, 1000)))
    elif kind == 5 and isinstance(old, int | float):
        container[key] = (
            old * float(rng.choice((-1, 0, 0.5, 1.001, 10, 1000, 1e9))) if rng.random() < 0.5 else old + 1
        )
    elif kind == 5 and isinstance(old, str):
        container[key] = _choose((*hostile.PATHS, *hostile.TEXTS), rng).decode("latin-1")
    else:
        container[key] = _PLACEHOLDER
    return write(document).replace(json.dumps(_PLACEHOLDER).encode(), literal)


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Return container and key of every value inside ``value``."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [place for key in keys for place in ((value, key), *_places(value[key]))]


def _toml(value: Any) -> bytes:
    """Return a TOML text of one line for each key."""
    return b"".join(f"{json.dumps(key)} = {_toml_value(item)}\n".encode() for key, item in value.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    return json.dumps(value, default=str)


def _choose(values: tuple[bytes, ...], rng: np.random.Generator) -> bytes:
    return values[rng.integers(len(values))]


def _damage_archive(content: bytes, rng: np.random.Generator) -> bytes:
    return hostile.damage_zip(content, rng, damage_content)


def _damage_table(content: bytes, rng: np.random.Generator) -> bytes:
    return hostile.damage_parquet(content, rng, damage_bytes)


_TEXT: Mapping[str, Damage] = {"tokens": damage_tokens}
_JSON: Mapping[str, Damage] = {**_TEXT, "values": damage_json}
_ARCHIVE: Mapping[str, Damage] = {"entries": _damage_archive}
_IMAGE: Mapping[str, Damage] = {"size": hostile.damage_image_size}
_LEVELS: Mapping[str, Mapping[str, Damage]] = {
    ".conf": _TEXT,
    ".csv": _TEXT,
    ".exr": _TEXT,
    ".ifc": _TEXT,
    ".json": _JSON,
    ".md": _TEXT,
    ".npy": _TEXT,
    ".npz": _ARCHIVE,
    ".obj": _TEXT,
    ".parquet": {"cells": _damage_table},
    ".pfm": _TEXT,
    ".ply": _TEXT,
    ".png": _IMAGE,
    ".stl": _TEXT,
    ".tif": _IMAGE,
    ".toml": {**_TEXT, "values": damage_toml},
    ".token": _TEXT,
    ".txt": _TEXT,
    ".webp": _IMAGE,
    ".xml": _TEXT,
    ".yaml": _TEXT,
    ".yml": _TEXT,
    ".zip": _ARCHIVE,
}
"""Generators beyond ``damage_bytes`` by the suffix of a file."""


HUGE_BYTES = 1 << 30


def replace_by_special_file(path: Path, kind: str, elsewhere: Path) -> None:
    """Replace a file by a special one of ``kind``; ``elsewhere`` is a folder for the file and targets of links."""
    elsewhere.mkdir(exist_ok=True)
    shutil.move(path, elsewhere / path.name)
    SPECIAL_FILES[kind](path, elsewhere)


def _link_to_pipe(path: Path, elsewhere: Path) -> None:
    os.mkfifo(elsewhere / "pipe")
    path.symlink_to(elsewhere / "pipe")


def _huge_file(path: Path, elsewhere: Path) -> None:
    shutil.copy(elsewhere / path.name, path)
    os.truncate(path, path.stat().st_size + HUGE_BYTES)


SPECIAL_FILES: Mapping[str, Callable[[Path, Path], object]] = {
    "missing": lambda *_: None,
    "empty": lambda path, _: path.touch(),
    "folder": lambda path, _: path.mkdir(),
    "pipe": lambda path, _: os.mkfifo(path),
    "link to a pipe": _link_to_pipe,
    "link to /dev/zero": lambda path, _: path.symlink_to("/dev/zero"),
    "link to itself": lambda path, _: path.symlink_to(path.name),
    "link to nothing": lambda path, elsewhere: path.symlink_to(elsewhere / "nothing"),
    "link to a folder": lambda path, elsewhere: path.symlink_to(elsewhere),
    "link to the file": lambda path, elsewhere: path.symlink_to(elsewhere / path.name),
    "huge": _huge_file,
}
"""Functions that make a special file, by its kind."""
