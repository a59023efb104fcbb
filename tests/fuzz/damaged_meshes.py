"""1,200 randomly damaged meshes: ``python -m tests.fuzz.damaged_meshes``.

Each is read, or refused with a message, within 20 s. A recorded list says which of them a strict reader refused,
the one of commit dbbf09ef; of these at most six may be read, since a damaged file must not become another mesh.
``--record`` prints such a list. With PYTHONPATH set to another checkout, it is that of the reader there.
"""

from __future__ import annotations

import argparse
import hashlib
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.user_files.cage_file import load_cage, mesh_file_spec
from rebar_depth_bench.base.errors import MeshError
from tests.fuzz.damage import damage_content

CASES, SEED = 1200, 0
MAX_SECONDS, MAX_READ = 20.0, 6
CASES_SHA256 = "5b4d320a1217a0107c3e6e166ccda6d149562aa133c241e1d768417606d208f6"
"""SHA-256 of all cases, to which the list belongs."""
REFUSED = (
    "ffddefe9fffbbfff7bedebdfee3bff5fdf3efbd7fffdfeffd7fff9fffbfbfefdeffffefffc7ffbffafb7f9ffdfe59fde3fce"
    "bbffb7dfdf7bddefafeaffff6e7adfff3cf6feffe73f83eeebfdfdeefbfcefbfeebbfffffffbfaf677fcff2ffff6fbf7bfff"
    "7fffff7f7fff7cfffffffdfd77fbff7bfbeffbcfeeffffadfffbd9bf7efeff3ffff3de76f7b7bbfefdbcffdbfef3beff2fd7"
)
"""Which cases were refused: a hexadecimal number, in which the first case is the lowest bit."""

_SIDES = 12
_PLY = (
    "ply\nformat {order} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)


def rods() -> tuple[Float64[ndarray, "v 3"], list[list[int]]]:
    """Return the vertices of three rods of 0.5 m, and their polygons: quadrilaterals, triangles at the ends."""
    vertices, polygons = list[list[float]](), list[list[int]]()
    for radius_m, y_m in ((0.008, 0.0), (0.005, 0.1), (0.010, 0.2)):
        first = len(vertices)
        for x_m in (0.0, 0.5):
            for angle in np.arange(_SIDES) * 2 * np.pi / _SIDES:
                across_m = np.round([radius_m * np.cos(angle), radius_m * np.sin(angle)], 6)
                vertices.append([x_m, y_m + float(across_m[0]), 0.1 + float(across_m[1])])
        vertices += [[0.0, y_m, 0.1], [0.5, y_m, 0.1]]
        for side in range(_SIDES):
            here, following = first + side, first + (side + 1) % _SIDES
            polygons.append([here, following, following + _SIDES, here + _SIDES])
            polygons.append([first + 2 * _SIDES, following, here])
            polygons.append([first + 2 * _SIDES + 1, here + _SIDES, following + _SIDES])
    return np.round(vertices, 6), polygons


def sound_files() -> dict[str, bytes]:
    """Return the rods in each format, by file name."""
    vertices, polygons = rods()
    triangles = [[p[0], a, b] for p in polygons for a, b in pairwise(p[1:])]
    points = [" ".join(map(str, point)) for point in vertices.tolist()]
    solid = "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {points[n]}\n" for n in t) + "endloop\nendfacet\n"
        for t in triangles
    )
    files = {
        "text.stl": f"solid rods\n{solid}endsolid rods\n".encode(),
        "binary.stl": bytes(80)
        + struct.pack("<I", len(triangles))
        + b"".join(struct.pack("<12fH", 0, 0, 0, *vertices[t].ravel().tolist(), 0) for t in triangles),
        "one.obj": obj_text(points, polygons),
        "objects.obj": obj_text(points, triangles, objects=3),
    }
    for name, faces in (("triangles", triangles), ("mixed", polygons)):
        for order, sign in (("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")):
            header = _PLY.format(order=order, vertices=len(vertices), faces=len(faces)).encode()
            if sign:
                body = vertices.astype(f"{sign}f4").tobytes()
                body += b"".join(struct.pack(f"{sign}B{len(face)}i", len(face), *face) for face in faces)
            else:
                rows = [*points, *(" ".join(map(str, (len(face), *face))) for face in faces)]
                body = "".join(f"{row}\n" for row in rows).encode()
            files[f"{name}-{order}.ply"] = header + body
    return files


def obj_text(points: Sequence[str], faces: Sequence[Sequence[int]], objects: int = 1) -> bytes:
    """Return an OBJ file; with several objects, the faces have relative numbers."""
    lines = [f"v {point}" for point in points]
    for number in range(objects):
        lines.append(f"o bar {number}")
        for face in faces[number * len(faces) // objects : (number + 1) * len(faces) // objects]:
            shift = -len(points) if objects > 1 else 1
            lines.append("f " + " ".join(f"{corner + shift}//1" for corner in face))
    return "\n".join([*lines, ""]).encode()


def damaged_files() -> list[tuple[str, bytes]]:
    """Return the name and content of each case."""
    files, cases = sorted(sound_files().items()), []
    for number in range(CASES):
        rng = np.random.default_rng([SEED, number])
        name, content = files[number % len(files)]
        damaged, _ = damage_content(name, content, rng)
        cases.append((name, damaged))
    return cases


def main() -> int:
    """Read all cases; return 1 if a property is violated."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.damaged_meshes", description=main.__doc__)
    parser.add_argument("--record", action="store_true", help="print the list of the refused cases")
    options = parser.parse_args()
    cases, refused, failures, read = damaged_files(), 0, list[str](), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        for name, content in sound_files().items():
            (Path(folder) / name).write_bytes(content)
            assert len(load_cage(mesh_file_spec(Path(folder) / name, "m")).bars) == 3, name
        for number, (name, content) in enumerate(cases):
            path = Path(folder) / name
            path.write_bytes(content)
            start_s = time.process_time()
            try:
                load_cage(mesh_file_spec(path, "m"))
                if int(REFUSED, 16) >> number & 1:
                    read.append(f"case {number}, {name}")
            except MeshError:
                refused |= 1 << number
            except Exception:
                failures.append(f"case {number}, {name}: {traceback.format_exc(limit=-3)}")
            seconds = time.process_time() - start_s
            if seconds > MAX_SECONDS:
                failures.append(f"case {number}, {name}: {seconds:.1f} s")
    digest = hashlib.sha256(b"".join(content for _, content in cases)).hexdigest()
    if options.record:
        print(digest, f"{refused:x}", sep="\n")
    elif digest != CASES_SHA256:
        failures.append(f"the cases have the SHA-256 {digest}, expected {CASES_SHA256}: record the list again")
    print(f"{CASES} cases: {refused.bit_count()} refused, {len(failures)} failures", file=sys.stderr)
    print(
        f"read, although the list refuses them: {len(read)}, at most {MAX_READ}", *read, sep="\n", file=sys.stderr
    )
    print(*failures, sep="\n", file=sys.stderr)
    return 1 if failures or len(read) > MAX_READ else 0


if __name__ == "__main__":
    raise SystemExit(main())
