"""Wavefront OBJ: positions, faces and the objects that they belong to.

An own reader, because trimesh's reverses the order of objects and skips lines that it does not understand.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from dataset_builder.mesh_tools import checked_mesh, split_by_label
from dataset_builder.model import Mesh
from rebar_depth_bench.errors import MeshError

_MAX_INDEX = int(np.iinfo(np.int32).max)


@dataclass
class _Naming:
    """The faces' owners by one kind of line, ``o`` or ``g``: names in the order of their first lines."""

    number_of: dict[str, int] = field(default_factory=lambda: {"": 0})
    current: int = 0
    face_owner: array[int] = field(default_factory=lambda: array("i"))

    def begin(self, name: str) -> None:
        self.current = self.number_of.setdefault(name, len(self.number_of))


@dataclass
class _Obj:
    """What has been read so far; ``array`` holds a number in 4 or 8 bytes where a list takes 32."""

    coordinates: array[float] = field(default_factory=lambda: array("d"))
    corners: array[int] = field(default_factory=lambda: array("i"))
    objects: _Naming = field(default_factory=_Naming)
    groups: _Naming = field(default_factory=_Naming)

    def add_position(self, words: list[str]) -> None:
        x, y, z = words[:3]
        self.coordinates.extend((float(x), float(y), float(z)))

    def add_face(self, words: list[str]) -> None:
        count = len(self.coordinates) // 3
        if len(words) < 3:
            raise ValueError(f"{len(words)} corners, expected at least 3")
        first, *others = [_vertex_index(word, count) for word in words]
        for second, third in pairwise(others):
            self.corners.extend((first, second, third))
            self.objects.face_owner.append(self.objects.current)
            self.groups.face_owner.append(self.groups.current)


def read_obj(content: bytes, where: str) -> list[Mesh]:
    """Return one mesh per object, in the order of the objects' lines, in file units.

    Objects are what ``o`` lines name; in a file without any, what ``g`` lines name; two lines with one
    name are one object. Polygons become fans of triangles. Raises ``MeshError`` naming the line.
    """
    obj = _Obj()
    actions: dict[str, Callable[[list[str]], None]] = {
        "v": obj.add_position,
        "f": obj.add_face,
        "o": lambda words: obj.objects.begin(" ".join(words)),
        "g": lambda words: obj.groups.begin(" ".join(words)),
    }
    _run(content, where, actions)
    if not obj.corners:
        return []
    naming = obj.objects if len(obj.objects.number_of) > 1 else obj.groups
    mesh = checked_mesh(obj.coordinates, obj.corners, where)
    return list(split_by_label(mesh, np.array(naming.face_owner)).values())


def _run(content: bytes, where: str, actions: dict[str, Callable[[list[str]], None]]) -> None:
    """Do each line's action; names may be in any encoding, as nothing but their equality matters."""
    text = content.decode("utf-8", errors="surrogateescape").replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.split("\n"), start=1):
        key, *words = line.partition("#")[0].split() or [""]
        action = actions.get(key)
        if action is None:
            continue
        try:
            action(words)
        except ValueError as error:
            raise MeshError(f"{where}, line {number}: {line.strip()[:60]!r}: {error}") from error


def _vertex_index(word: str, count: int) -> int:
    """Return the position index, from 0, of a corner ``v``, ``v/vt`` or ``v/vt/vn``; negative counts back."""
    number = int(word.partition("/")[0])
    index = number - 1 if number > 0 else count + number
    # Vertices may follow their faces: whether a positive index exists is known at the end only.
    if number == 0 or not 0 <= index <= _MAX_INDEX:
        raise ValueError(f"vertex {number}, expected 1 and up, or -1 to -{count}")
    return index
