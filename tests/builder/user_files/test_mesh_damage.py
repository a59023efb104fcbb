"""Seeded damage of mesh files of every format: refused, or the mesh is the sound one but for changed numbers."""

from __future__ import annotations

import random
import re
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.model import Mesh
from dataset_builder.specs.file_specs import MeshFileSpec
from dataset_builder.user_files.cage_file import cage_problems, raise_problems
from dataset_builder.user_files.mesh_import import read_parts
from rebar_depth_bench.base.errors import MeshError
from rebar_depth_bench.data.bars import Bar
from tests.builder.user_files.test_mesh_file import obj_bytes
from tests.requirements import Repetitions

BODIES = [trimesh.creation.cylinder(0.01, 0.5, sections=8) for _ in range(2)]
BODIES[1].apply_translation([0.1, 0, 0])
BOTH = trimesh.util.concatenate(BODIES)
SAMPLES: dict[str, bytes] = {
    "text.ply": trimesh.exchange.ply.export_ply(BOTH, encoding="ascii"),
    "binary.ply": trimesh.exchange.ply.export_ply(BOTH),
    "text.stl": trimesh.exchange.stl.export_stl_ascii(BOTH).encode(),
    "binary.stl": trimesh.exchange.stl.export_stl(BOTH),
    "a.obj": obj_bytes(BODIES, ["a", "b"]) + b"\n",
}
NUMERIC = b"0123456789.+-eE/ \t\n\r\v\f"
"""Characters of numbers and of what separates them: replacing one by another changes a number of the file."""


def payload_start(name: str) -> int:
    """Return the offset from which the bytes of a sample are numbers, or its size for a text."""
    content = SAMPLES[name]
    match name:
        case "binary.ply":
            return content.index(b"end_header\n") + 11
        case "binary.stl":
            return 84
    return len(content)


def read(name: str, content: bytes) -> dict[int, Mesh]:
    parts = read_parts(content, MeshFileSpec(name, "", 1.0))
    bars = [CageBar(part.name, Bar.without_axis(part.bar_id, "bar"), mesh=part.mesh) for part in parts]
    raise_problems(cage_problems(bars), name)
    return {part.bar_id: part.mesh for part in parts}


def assert_refused_or_sound(name: str, content: bytes, lossless: Callable[[dict[int, Mesh]], bool]) -> None:
    try:
        parts = read(name, content)
    except MeshError as error:
        assert str(error).startswith(f"{name}: ")  # noqa: PT017
        return
    for mesh in parts.values():
        assert np.isfinite(mesh.vertices_m).all()
        assert mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices_m)
    assert is_sound(name, parts) or lossless(parts)


def is_sound(name: str, parts: dict[int, Mesh]) -> bool:
    sound = read(name, SAMPLES[name])
    return parts.keys() == sound.keys() and all(
        np.array_equal(part.vertices_m, sound[bar_id].vertices_m)
        and np.array_equal(part.faces, sound[bar_id].faces)
        for bar_id, part in parts.items()
    )


def never(parts: dict[int, Mesh]) -> bool:
    return False


def always(parts: dict[int, Mesh]) -> bool:
    return True


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.slow
def test_truncated_files_are_refused(name: str, repetitions: Repetitions) -> None:
    """An OBJ states no counts, so that its end can only be missed within a line."""
    rng = random.Random(f"truncated {name}")
    content = SAMPLES[name]
    for _ in range(repetitions(20, 500)):
        kept = content[: rng.randrange(len(content))]
        assert_refused_or_sound(name, kept, always if name == "a.obj" else never)


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.slow
def test_changed_bytes_are_refused_or_numbers(name: str, repetitions: Repetitions) -> None:
    rng = random.Random(f"bytes {name}")
    content, start = SAMPLES[name], payload_start(name)
    for _ in range(repetitions(60, 1500)):
        damaged = bytearray(content)
        # Half of the damage is in the first bytes, which hold the headers.
        position = rng.randrange(rng.choice([len(content), min(900, len(content))]))
        damaged[position] = rng.choice([rng.randrange(256), rng.choice(b"0129 -\nx#")])
        is_number = position >= start or {content[position], damaged[position]} <= set(NUMERIC)
        allowed = is_number or (name == "a.obj" and is_name(content, position))
        assert_refused_or_sound(name, bytes(damaged), always if allowed else never)


def is_name(content: bytes, position: int) -> bool:
    """Return whether a byte of an OBJ belongs to a name, or begins or ends a line: it may become another line."""
    line = content.rfind(b"\n", 0, position) + 1
    return content[position] in b"\n" or position == line or content.startswith(b"o", line)


@pytest.mark.parametrize("name", ["text.ply", "text.stl", "a.obj"])
@pytest.mark.slow
def test_missing_and_repeated_words_are_refused(name: str, repetitions: Repetitions) -> None:
    rng = random.Random(f"words {name}")
    content = SAMPLES[name]
    for _ in range(repetitions(40, 500)):
        word = rng.choice(list(re.finditer(rb"\S+", content)))
        replaced = rng.choice([b"", word[0] + b" " + word[0], b"nan", b"1e999", b"0x10", b"99999999999999999999"])
        damaged = content[: word.start()] + replaced + content[word.end() :]
        # A corner may occur twice in a polygon, and the name of an object decides on its number.
        is_valid = name == "a.obj" and (replaced.startswith(word[0] + b" ") or word[0] in (b"o", b"a", b"b"))
        assert_refused_or_sound(name, damaged, always if is_valid else never)


@pytest.mark.parametrize("name", ["text.ply", "binary.ply", "binary.stl"])
@pytest.mark.slow
def test_missing_and_repeated_pieces_are_refused(name: str, repetitions: Repetitions) -> None:
    rng = random.Random(f"pieces {name}")
    content = SAMPLES[name]
    for _ in range(repetitions(20, 500)):
        start, end = sorted(rng.sample(range(len(content)), 2))
        is_number = name == "text.ply" and set(content[start:end]) <= set(NUMERIC)
        for damaged in (content[:start] + content[end:], content[:end] + content[start:]):
            assert_refused_or_sound(name, damaged, always if is_number else never)
