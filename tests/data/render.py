"""Rendering of the sample data of the package and of the tests: ``python -m tests.data.render`` replaces them."""

from __future__ import annotations

import lzma
import shutil
import tempfile
from pathlib import Path

import pyarrow.parquet as pq

from rebar_depth_bench.cli.demo import SAMPLE
from tests.building import TINY, TINY_DATASET, TINY_VIEWS, run_build
from tests.data import orbit

MAT = Path(__file__).parents[2] / "examples" / "mat.toml"
SAMPLE_SIZE = ("--width", "480", "--height", "270", "--quality", "high")


def render_sample(root: Path) -> None:
    """Render the views of the package's sample into the folder ``root``; fail if a build fails."""
    for scene, views in (("--config", "lattice"), 3), (("--config", "pile"), 3), (("--scene", MAT), 4):
        finished = run_build("--out", root, *scene, "--views", str(views), *SAMPLE_SIZE)
        assert finished.returncode == 0, finished.stderr


def render_tiny(root: Path) -> None:
    """Render both configs of the tiny dataset into the folder ``root``; fail if a build fails."""
    for config, views in (("lattice", TINY_VIEWS), ("lattice-orbit", 2)):
        finished = run_build("--out", root, "--config", config, "--views", str(views), *TINY)
        assert finished.returncode == 0, finished.stderr


def render_orbit(root: Path) -> dict[str, bytes]:
    """Render the views of the orbit into the folder ``root`` and return the left images by file name."""
    size = ("--width", str(orbit.REQUEST.width), "--height", str(orbit.REQUEST.height))
    options = ("--views", str(orbit.REQUEST.views), *size, "--samples", str(orbit.SAMPLES))
    finished = run_build("--out", root, "--config", *orbit.REQUEST.configs, *options)
    assert finished.returncode == 0, finished.stderr
    rows = pq.read_table(root / "lattice-orbit", columns=["view_id", "left_rgb"]).to_pylist()
    return {f"{row['view_id'].rpartition('/')[2]}.webp": row["left_rgb"]["bytes"] for row in rows}


def main() -> None:
    """Render the sample data, pack their meshes, and replace all in the tree."""
    with tempfile.TemporaryDirectory() as folder:
        for stored, render in ((SAMPLE, render_sample), (TINY_DATASET, render_tiny)):
            root = Path(folder) / stored.name
            render(root)
            for mesh in (root / "meshes").iterdir():
                mesh.with_suffix(".ply.xz").write_bytes(lzma.compress(mesh.read_bytes(), preset=9))
                mesh.unlink()
            shutil.rmtree(stored, ignore_errors=True)
            shutil.copytree(root, stored)
        shutil.rmtree(orbit.IMAGES, ignore_errors=True)
        orbit.IMAGES.mkdir()
        for name, content in render_orbit(Path(folder) / "orbit").items():
            (orbit.IMAGES / name).write_bytes(content)


if __name__ == "__main__":
    main()
