"""Tessellation of IFC objects by ifcopenshell's geometry kernel, in a separate process.

The kernel may hang or crash on a damaged shape; the process then ends by a signal, and the number of results
identifies the shape. ``python -m dataset_builder.scene.assemblies.ifc.tessellation`` reads one pickle
(content, where, ids) from standard input and writes one pickle per shape: a ``Mesh``, or an error message.
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

from dataset_builder.scene.assemblies.ifc.model import open_model, world_mesh
from dataset_builder.scene.model import Mesh

SECONDS_PER_SHAPE = 60
"""Time limit per shape; SIGALRM ends the process after it."""

COMMAND = (sys.executable, "-m", "dataset_builder.scene.assemblies.ifc.tessellation")


def tessellate(content: bytes, where: str, ids: list[int]) -> list[Mesh | str]:
    """Return each object's surface (world, metres) or an error message, in the order of ``ids``.

    The list is shorter than ``ids`` if an object ended the process; its error message is then the last item.
    """
    finished = subprocess.run(COMMAND, input=pickle.dumps((content, where, ids)), capture_output=True, check=False)
    results = list(_iter_pickles(finished.stdout))
    if len(results) < len(ids):
        status = finished.returncode
        slow = status == -signal.SIGALRM
        results.append(
            f"took more than {SECONDS_PER_SHAPE} s" if slow else f"the geometry kernel crashed (status {status})"
        )
    return results


def _iter_pickles(content: bytes) -> Iterator[Mesh | str]:
    """Yield the complete pickles in ``content``."""
    stream = BytesIO(content)
    while stream.tell() < len(content):
        try:
            yield pickle.load(stream)
        except (EOFError, pickle.UnpicklingError):  # The process ended while it wrote a pickle.
            return


def main() -> None:
    """Read one request and write its results; output of native code is redirected to standard error."""
    content, where, ids = pickle.load(sys.stdin.buffer)
    with os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)
        model = open_model(content, where)  # This cannot fail: the parent process has opened the same content.
        for number in ids:
            signal.alarm(SECONDS_PER_SHAPE)
            pickle.dump(_tessellate_instance(model, number), answers)
            answers.flush()


def _tessellate_instance(model: object, number: int) -> Mesh | str:
    """Return the surface of one instance (world, metres), or an error message."""
    try:
        vertices, faces = world_mesh(model, number)
    except RuntimeError as error:
        return str(error) or "the geometry kernel failed"
    if not len(faces):
        return "has no surface"
    return Mesh(np.array(vertices).reshape(-1, 3), np.array(faces, dtype=np.int32).reshape(-1, 3))


if __name__ == "__main__":
    main()
