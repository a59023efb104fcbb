"""Colour quality per second: samples, denoiser and prefilter against a 256-sample reference, on steel.

python -m benchmarks.colour [CONFIG] [VIEWS]
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.timing import machine_description, print_markdown
from dataset_builder.blender.evaluated_mesh import evaluated_world_mesh
from dataset_builder.blender.render import configure_colour, render_colour
from dataset_builder.blender.scene import build_scene
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import ColourSpec
from dataset_builder.config.trajectories import poses, subset
from dataset_builder.scene.assemblies import aim_point_m, make_assembly
from dataset_builder.scene.raycast import RayCaster

REFERENCE = ColourSpec(samples=256, prefilter="ACCURATE")
"""Reference setting; denoised, since the noise of 256 raw samples would exceed the error of good candidates."""

BLENDERPROC_DEFAULT = ColourSpec(samples=16, prefilter="ACCURATE")
"""Default denoiser settings of BlenderProc, at 16 samples."""

CANDIDATES = (
    BLENDERPROC_DEFAULT,
    ColourSpec(samples=16, denoise=False),
    ColourSpec(samples=8),
    ColourSpec(samples=8, prefilter="ACCURATE"),
    ColourSpec(samples=12),
    ColourSpec(samples=16),
    ColourSpec(samples=24),
    ColourSpec(samples=32),
)
PSNR_PEAK = 255.0


def main(config: str = "lattice", views: str = "1") -> None:
    [spec] = BuildRequest(configs=(config,)).config_specs()
    rig = spec.rig
    assembly = make_assembly(spec.scene.assembly)
    build_scene(assembly, spec.scene)
    caster = RayCaster(evaluated_world_mesh())
    all_poses = poses(spec.protocol, aim_point_m(assembly), rig, assembly.bars)
    selected = [rig_cameras(rig, all_poses[index])["left"] for index in subset(len(all_poses), int(views))]
    masks = [caster.cast(camera).mask for camera in selected]

    write_line = _redirect_blender_output()

    def render_views(colour: ColourSpec, seed: int) -> tuple[list[np.ndarray], float]:
        configure_colour(colour, os.cpu_count() or 1)
        pictures, seconds = [], []
        with tempfile.TemporaryDirectory() as scratch:
            for camera in selected:
                start = time.perf_counter()
                pictures.append(render_colour(camera, seed, Path(scratch)))
                seconds.append(time.perf_counter() - start)
        return pictures, float(np.median(seconds))

    write_line(f"{config}, {len(selected)} left views at {rig.width} x {rig.height}; {machine_description()}\n")
    # The first render of a scene also loads it into the renderer and is therefore not timed.
    render_views(replace(BLENDERPROC_DEFAULT, samples=1), seed=0)
    results = {colour: render_views(colour, seed=1) for colour in CANDIDATES}
    reference, reference_s = render_views(REFERENCE, seed=2)
    baseline_s = results[BLENDERPROC_DEFAULT][1]
    table = [
        (
            _name(colour),
            f"{seconds:.1f}",
            f"{seconds / baseline_s:.2f}",
            f"{_psnr_db(pictures, reference, masks):.1f}",
        )
        for colour, (pictures, seconds) in results.items()
    ]
    table.append((_name(REFERENCE), f"{reference_s:.1f}", f"{reference_s / baseline_s:.2f}", "reference"))
    headings = ["setting", "s a picture", "times 16 + ACCURATE", "PSNR on steel, dB"]
    print_markdown(headings, table, write_line)


def _redirect_blender_output() -> Callable[[str], None]:
    """Redirect standard output, to which Blender writes, to the null device; return a working print function."""
    terminal = os.fdopen(os.dup(1), "w", buffering=1)
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)
    return lambda text: print(text, file=terminal)


def _name(colour: ColourSpec) -> str:
    return f"{colour.samples} samples" + (f", OIDN, {colour.prefilter} prefilter" if colour.denoise else ", raw")


def _psnr_db(pictures: list[np.ndarray], reference: list[np.ndarray], masks: list[np.ndarray]) -> float:
    """Return the peak signal-to-noise ratio in dB over the steel pixels of all 8-bit images."""
    differences = [a[mask].astype(float) - b[mask] for a, b, mask in zip(pictures, reference, masks, strict=True)]
    return float(20 * np.log10(PSNR_PEAK / np.sqrt(np.mean(np.concatenate(differences) ** 2))))


if __name__ == "__main__":
    main(*sys.argv[1:])
