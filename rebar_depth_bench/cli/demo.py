"""The ``rebar-bench demo`` command: predict, score and report a few views, rendered or bundled.

``dataset_builder`` depends on this package and not vice versa, so the demo renders by running ``rebar-build`` in a
subprocess.
"""

from __future__ import annotations

import argparse
import lzma
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from rebar_depth_bench.base.errors import BuildError, InputError, require_extra
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.cli.console import EXIT_INPUT
from rebar_depth_bench.evaluator import evaluate
from rebar_depth_bench.methods import METHODS
from rebar_depth_bench.methods.controls import CONSTANT_DEPTH_M, NOISY_TRUTH_FACTOR
from rebar_depth_bench.reporting.tables import make_grid, plain_text, print_line, print_unwrapped
from rebar_depth_bench.scoring.formatting import (
    note_text,
    row_name,
    row_notes,
    summary,
)
from rebar_depth_bench.scoring.result import Result

SAMPLE = Path(__file__).parents[1] / "sample"
"""Dataset folder in the package: ten small views of the lattice, the pile and a mat; its meshes are packed."""
DEMO_CONFIG = "lattice"
DEMO_METHODS = ("sgbm", "sgbm-filled", "constant", "noisy-truth")
DEMO_SAMPLES = 8
"""Samples per pixel: half the default of a build, which halves the demo's run time; the denoiser compensates."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    folder = Path("demo-output")
    parser.add_argument("--out", type=Path, default=folder, help="working folder (default: %(default)s)")
    views = parser.add_mutually_exclusive_group()
    views.add_argument("--views", type=int, default=6, help="stereo views to render (default: %(default)s)")
    sample = "use the ten views of three scenes in the package, without Blender; written to sample in --out"
    views.add_argument("--sample", action="store_true", help=sample)


def run(options: argparse.Namespace) -> None:
    """Copy the sample or render lattice views, run four methods, write a report of each, and print one table.

    An interrupted build is resumed. Raises ``InputError`` if the extra ``methods``, or ``build`` for rendering, is
    not installed.
    """
    out = options.out / "sample" if options.sample else options.out
    data = out / "dataset"
    if options.sample:
        require_extra("methods", ["cv2"])
        copy_sample(SAMPLE, data)
    else:
        require_extra("build", ["dataset_builder", "bpy"])
        print_notice(f"rendering {options.views} stereo views of the lattice at 1280 x 720 into {data}")
        build = ("-P", "-m", "dataset_builder", "--out", str(data), "--config", DEMO_CONFIG)
        limits = ("--views", str(options.views), "--samples", str(DEMO_SAMPLES))
        finished = subprocess.run([sys.executable, *build, *limits], stdout=sys.stderr, check=False)
        if finished.returncode == EXIT_INPUT:
            raise InputError("the demo dataset cannot be built, see the error above")
        if finished.returncode:
            raise BuildError(f"rebar-build ended with exit status {finished.returncode}, expected 0")
    results = []
    for name in DEMO_METHODS:
        print_notice(f"predicting with {name}: {METHODS[name].info.summary}")
        result = evaluate(name, data, config=None if options.sample else DEMO_CONFIG, archive=out / f"{name}.zip")
        result.to_html(out / f"{name}.html")
        write_bytes(out / f"{name}.json", result.to_json())
        results.append(result)
    console = Console()
    _print_results(results, console)
    if options.sample:
        print_line(
            console,
            "The lattice is near: on its steel, disparities reach a third of the image width, and the two views "
            "disagree on more than a third of the pixels. What sgbm-filled fills in there makes it worse than a "
            "plane.",
        )
    print("Reports, for a browser:")
    for name in DEMO_METHODS:
        print(f"  {(out / name).resolve()}.html")


def copy_sample(sample: Path, root: Path) -> None:
    """Write the dataset folder ``sample`` to the folder ``root``, its packed meshes unpacked."""
    for source in filter(Path.is_file, sample.rglob("*")):
        target, content = root / source.relative_to(sample), source.read_bytes()
        if target.suffix == ".xz":
            target, content = target.with_suffix(""), lzma.decompress(content)
        write_bytes(target, content)


def _print_results(results: Sequence[Result], console: Console) -> None:
    """Print one row per config and result, what the rows show, and the meaning of their marks."""
    shown = [summary(result) for result in results]
    grid = make_grid("method", shown[0].heads[1:])
    for n, config in enumerate(results[0].tables):
        grid.add_row(plain_text(config))
        for result, one in zip(results, shown, strict=True):
            name = f" {row_name(result, result.tables[config])}"
            grid.add_row(*map(plain_text, [name, *one.rows[n][1:]]))
        grid.add_section()
    print_unwrapped(console, grid)
    console.print()
    print_line(
        console,
        "AbsRel is the mean relative error of depth on steel; scaled, that of depth times the best factor of each "
        f"view. A plane, such as constant with {CONSTANT_DEPTH_M:g} m everywhere, has the scaled AbsRel in the "
        "column constant; margin is the share by which a method is below it. noisy-truth, exact depth times "
        f"{NOISY_TRUTH_FACTOR:g} with noise, has a wrong scale and almost the exact shape: AbsRel shows the one, "
        "scaled AbsRel the other.",
    )
    for note in row_notes(results, ()):
        print_line(console, note_text(*note))
