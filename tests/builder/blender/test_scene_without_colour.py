"""Scenes built without colour: the same mesh, byte for byte, and neither materials nor lights nor images.

Blender runs in a separate process, ``python -m tests.builder.blender.test_scene_without_colour FOLDER``.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.specs.config_specs import SceneSpec
from dataset_builder.user_files.make_assembly import make_assembly
from tests.builder.blender.probe import RunProbe

REQUESTS = [
    BuildRequest(("lattice", "pile", "pier")),
    BuildRequest(("lattice", "pier"), variants=("rusted", "dusk", "clutter")),
    BuildRequest(("lattice",), variants=("tie-wire",)),
]


def scenes() -> list[SceneSpec]:
    return [spec.scene for request in REQUESTS for spec in request.config_specs()]


def probe(folder: Path) -> None:
    """Build every scene with and without colour; write the digests of its mesh (runs in the Blender process)."""
    import bpy

    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    facts: dict[str, Any] = {}
    for scene in scenes():
        assembly = make_assembly(scene.assembly)
        for colour in (True, False):
            build_scene(assembly, scene, colour=colour)
            mesh = evaluated_world_mesh()
            arrays = (mesh.vertices_m, mesh.faces, mesh.face_bar_id)
            digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
            kinds = (bpy.data.materials, bpy.data.lights, bpy.data.images, bpy.data.worlds)
            facts.setdefault(scene.name, []).append([digest, [len(kind) for kind in kinds]])
    (folder / "facts.json").write_text(json.dumps(facts))


def test_meshes_are_equal_and_nothing_else_is_made(tmp_path: Path, run_probe: RunProbe) -> None:
    folder = run_probe("tests.builder.blender.test_scene_without_colour", tmp_path)
    facts = json.loads((folder / "facts.json").read_text())
    assert list(facts) == [scene.name for scene in scenes()]
    for (with_colour, made), (without, nothing) in facts.values():
        assert with_colour == without
        assert made[0] > 1 <= made[1]
        assert nothing == [0, 0, 0, 0]


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
