"""Colour quality per CPU second: presets and uniform sampling against 256 samples, on steel and beside it.

python -m benchmarks.colour OUT [WIDTH HEIGHT [CONFIG ...]]

Writes the reference pictures to OUT and uses those that are there: they take most of the time. Also writes each
picture, and its differences from the reference eight times as strong, for people to look at.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray
from PIL import Image

from benchmarks.timing import machine_description, print_markdown
from dataset_builder.blender.colour import configure_colour, render_colour
from dataset_builder.blender.scene import build_scene, evaluated_world_mesh
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, poses, subset
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.specs.config_specs import QUALITIES, UNIFORM, ColourSpec, ConfigSpec, colour_spec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.geometry.cameras import Camera

SCENES = ("lattice", "pile", "pier")
PICTURES = 4
"""Left pictures per config, evenly spread over its views."""

BASELINE = "16 samples, ACCURATE"
SETTINGS: Mapping[str, ColourSpec] = {
    BASELINE: ColourSpec(16, 16, "ACCURATE"),
    "16 samples, FAST": ColourSpec(16, 16),
    "--sampling uniform": colour_spec(UNIFORM),
    **{f"--quality {name}": spec for name, spec in QUALITIES.items()},
}
"""Settings that are compared; the first has the default settings of BlenderProc's denoiser."""

REFERENCE = ColourSpec(256, 256, "ACCURATE")
"""Reference; denoised, since the noise of 256 raw samples would exceed the error of good settings."""
REFERENCE_SEED, SEED = 2, 1
PSNR_PEAK = 255.0
AMPLIFICATION = 8


@dataclass(frozen=True, eq=False)
class Subject:
    """Picture to render: its name, camera and mask of steel."""

    name: str
    camera: Camera
    steel: Bool[ndarray, "h w"]


def main(out: str, width: str = "1280", height: str = "720", *configs: str) -> None:
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_line = _redirect_blender_output()
    write_line(f"{PICTURES} left pictures per config at {width} x {height}; {machine_description()}\n")
    request = BuildRequest(configs or SCENES, width=int(width), height=int(height))
    rows = [row for spec in request.config_specs() for row in _rows(spec, folder)]
    headings = ["config", "setting", "samples", "CPU s a picture", "times", "PSNR on steel, dB", "elsewhere, dB"]
    print_markdown(headings, rows, write_line)


def _rows(spec: ConfigSpec, folder: Path) -> list[tuple[str, ...]]:
    """Return a table row for each setting on one config."""
    subjects = _open_scene(spec)
    references = [_reference(subject, folder) for subject in subjects]
    _render(subjects[0], ColourSpec(1, 1), SEED)  # The first render also loads the scene.
    rows, baseline_s = [], np.nan
    for name, colour in SETTINGS.items():
        start = time.process_time()  # It includes all threads.
        pictures = [_render(subject, colour, SEED) for subject in subjects]
        seconds = (time.process_time() - start) / len(subjects)
        baseline_s = seconds if name == BASELINE else baseline_s
        for subject, picture, reference in zip(subjects, pictures, references, strict=True):
            stem = f"{subject.name} {name.removeprefix('--')}"
            _save(picture, folder / f"{stem}.png")
            difference = AMPLIFICATION * (picture.astype(int) - reference) + 128
            _save(difference.clip(0, 255).astype(np.uint8), folder / f"{stem} difference.png")
        quality = [
            _psnr_db(pictures, references, [subject.steel == on_steel for subject in subjects])
            for on_steel in (True, False)
        ]
        numbers = (f"{seconds:.1f}", f"{seconds / baseline_s:.2f}", *(f"{psnr_db:.1f}" for psnr_db in quality))
        rows.append((spec.name, name, f"{colour.samples} / {colour.steel_samples}", *numbers))
    return rows


def _open_scene(spec: ConfigSpec) -> list[Subject]:
    assembly = make_assembly(spec.scene.assembly)
    build_scene(assembly, spec.scene)
    configure_colour(os.cpu_count() or 1)
    caster = RayCaster(evaluated_world_mesh())
    left_poses = poses(spec.protocol, aim_point_m(assembly), spec.rig, assembly.bars)
    subjects = []
    for index in subset(len(left_poses), PICTURES):
        camera = rig_cameras(spec.rig, left_poses[index])["left"]
        name = f"{spec.name}-{spec.rig.width}-{index:04d}"
        subjects.append(Subject(name, camera, caster.cast(camera).mask))
    return subjects


def _reference(subject: Subject, folder: Path) -> UInt8[ndarray, "h w 3"]:
    path = folder / f"{subject.name}.png"
    if not path.is_file():
        _save(_render(subject, REFERENCE, REFERENCE_SEED), path)
    with Image.open(path) as image:
        return np.array(image, dtype=np.uint8)


def _render(subject: Subject, colour: ColourSpec, seed: int) -> UInt8[ndarray, "h w 3"]:
    with tempfile.TemporaryDirectory() as scratch:
        return render_colour(subject.camera, subject.steel, colour, seed, Path(scratch))


def _save(picture: UInt8[ndarray, "h w 3"], path: Path) -> None:
    partial = path.with_suffix(".partial")
    Image.fromarray(picture).save(partial, format="PNG")
    partial.replace(path)


def _redirect_blender_output() -> Callable[[str], None]:
    """Redirect standard output, to which Blender writes, to the null device; return a working print function."""
    terminal = os.fdopen(os.dup(1), "w", buffering=1)
    null_device = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null_device, 1)
    return lambda text: print(text, file=terminal)


def _psnr_db(
    pictures: list[UInt8[ndarray, "h w 3"]],
    references: list[UInt8[ndarray, "h w 3"]],
    masks: list[Bool[ndarray, "h w"]],
) -> float:
    """Return the peak signal-to-noise ratio in dB over the chosen pixels of all 8-bit pictures."""
    differences = [a[mask].astype(float) - b[mask] for a, b, mask in zip(pictures, references, masks, strict=True)]
    return float(20 * np.log10(PSNR_PEAK / np.sqrt(np.mean(np.concatenate(differences) ** 2))))


if __name__ == "__main__":
    main(*sys.argv[1:])
