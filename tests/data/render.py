"""Rendering of the dataset in ``tests/data/tiny``: ``python -m tests.data.render`` replaces it."""

from __future__ import annotations

import lzma
import shutil
import tempfile
from pathlib import Path

from tests.building import TINY, TINY_VIEWS, run_build

FOLDER = Path(__file__).parent / "tiny"


def render(root: Path) -> None:
    """Render both configs of the tiny dataset into the folder ``root``; fail if a build fails."""
    for config, views in (("lattice", TINY_VIEWS), ("lattice-orbit", 2)):
        finished = run_build("--out", root, "--config", config, "--views", str(views), *TINY)
        assert finished.returncode == 0, finished.stderr


def main() -> None:
    """Render the dataset, pack its mesh, and put it in the place of the one in the tree."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        render(root)
        for mesh in (root / "meshes").glob("*.ply"):
            mesh.with_name(f"{mesh.name}.xz").write_bytes(lzma.compress(mesh.read_bytes(), preset=9))
            mesh.unlink()
        shutil.rmtree(FOLDER, ignore_errors=True)
        shutil.copytree(root, FOLDER)


if __name__ == "__main__":
    main()
