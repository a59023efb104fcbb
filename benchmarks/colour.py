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

from benchmarks.timing import machine, print_markdown
from dataset_builder.blender.evaluated_mesh import evaluated_world_mesh
from dataset_builder.blender.render import configure_colour, render_colour
from dataset_builder.blender.scene import build_scene
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import ColourSpec
from dataset_builder.config.trajectories import poses, subset
from dataset_builder.scene.assemblies import aim_point_m, make_assembly
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import ideal_K, pixel_rays

REFERENCE = ColourSpec(samples=256, prefilter="ACCURATE")
"""Denoised: the noise left in 256 raw samples would hide what is better than it."""
RIVAL = ColourSpec(samples=16, prefilter="ACCURATE")
"""What BlenderProc renders with by default, at 16 samples."""
CANDIDATES = (
    RIVAL,
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
    K = ideal_K(rig.width, rig.height)
    assembly = make_assembly(spec.scene.assembly)
    build_scene(assembly, spec.scene)
    caster = RayCaster(evaluated_world_mesh())
    every = poses(spec.protocol, aim_point_m(assembly), rig)
    chosen = [every[index] for index in subset(len(every), int(views))]
    masks = [caster.cast(pixel_rays(K, rig.width, rig.height), pose).mask for pose in chosen]

    say = _only_own_words()

    def rendered(colour: ColourSpec, seed: int) -> tuple[list[np.ndarray], float]:
        configure_colour(colour, os.cpu_count() or 1)
        pictures, seconds = [], []
        with tempfile.TemporaryDirectory() as scratch:
            for pose in chosen:
                start = time.perf_counter()
                pictures.append(render_colour(rig_cameras(rig, pose)["left"], seed, Path(scratch)))
                seconds.append(time.perf_counter() - start)
        return pictures, float(np.median(seconds))

    say(f"{config}, {len(chosen)} left views at {rig.width} x {rig.height}; {machine()}\n")
    rendered(replace(RIVAL, samples=1), seed=0)  # the scene's first render also loads it
    results = {colour: rendered(colour, seed=1) for colour in CANDIDATES}
    reference, reference_s = rendered(REFERENCE, seed=2)
    rival_s = results[RIVAL][1]
    table = [
        (
            _name(colour),
            f"{seconds:.1f}",
            f"{seconds / rival_s:.2f}",
            f"{_psnr_db(pictures, reference, masks):.1f}",
        )
        for colour, (pictures, seconds) in results.items()
    ]
    table.append((_name(REFERENCE), f"{reference_s:.1f}", f"{reference_s / rival_s:.2f}", "reference"))
    headings = ["setting", "s a picture", "times 16 + ACCURATE", "PSNR on steel, dB"]
    print_markdown(headings, table, say)


def _only_own_words() -> Callable[[str], None]:
    """Send Blender's prints to nowhere and return what prints for us."""
    own = os.fdopen(os.dup(1), "w", buffering=1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    return lambda words: print(words, file=own)


def _name(colour: ColourSpec) -> str:
    return f"{colour.samples} samples" + (f", OIDN, {colour.prefilter} prefilter" if colour.denoise else ", raw")


def _psnr_db(pictures: list[np.ndarray], reference: list[np.ndarray], masks: list[np.ndarray]) -> float:
    """Return the peak signal-to-noise ratio over the steel pixels of all pictures, 8-bit values."""
    off = [a[mask].astype(float) - b[mask] for a, b, mask in zip(pictures, reference, masks, strict=True)]
    return float(20 * np.log10(PSNR_PEAK / np.sqrt(np.mean(np.concatenate(off) ** 2))))


if __name__ == "__main__":
    main(*sys.argv[1:])
