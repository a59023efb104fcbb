"""Surfaces of IFC objects, from ifcopenshell's geometry kernel in a process of its own.

The kernel may run for ever or crash on a damaged shape; the process then ends by a signal, and whose turn it was
is known. ``python -m dataset_builder.scene.assemblies.ifc.tessellation`` reads one pickle (content, where, ids)
from standard input and writes one a shape: vertices and triangles, or the words of an error.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO

import numpy as np

from dataset_builder.scene.assemblies.ifc.model import open_model, world_meshes
from dataset_builder.scene.model import Mesh

SECONDS_PER_SHAPE = 60
COMMAND = (sys.executable, "-m", "dataset_builder.scene.assemblies.ifc.tessellation")


def meshes_of(content: bytes, where: str, ids: list[int]) -> list[Mesh | str]:
    """Return each object's surface (world, metres), or why it has none, for the first ``ids`` that were reached.

    The list ends with the object that brought the process down, if one did.
    """
    finished = subprocess.run(COMMAND, input=pickle.dumps((content, where, ids)), capture_output=True, check=False)
    found = list(_unpickled(finished.stdout))
    if len(found) < len(ids):
        status = finished.returncode
        slow = status == -signal.SIGALRM
        found.append(
            f"took over {SECONDS_PER_SHAPE} s" if slow else f"brought the geometry kernel down (status {status})"
        )
    return found


def _unpickled(content: bytes) -> Iterator[Mesh | str]:
    stream = BytesIO(content)
    while stream.tell() < len(content):
        try:
            yield pickle.load(stream)
        except (EOFError, pickle.UnpicklingError):  # it died in the middle of a word
            return


def main() -> None:
    """Answer one request; what native code prints does not get among the answers."""
    content, where, ids = pickle.load(sys.stdin.buffer)
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)
        model = open_model(content, where)  # the parent has opened this very content
        for number in ids:
            signal.alarm(SECONDS_PER_SHAPE)
            pickle.dump(_mesh(model, number), answers)
            answers.flush()


def _mesh(model: object, number: int) -> Mesh | str:
    try:
        [(vertices, faces)] = world_meshes(model, [number])
    except RuntimeError as error:
        return str(error) or "the geometry kernel gave up"
    if not len(faces):
        return "has no surface"
    return Mesh(np.array(vertices).reshape(-1, 3), np.array(faces, dtype=np.int32).reshape(-1, 3))


if __name__ == "__main__":
    main()
