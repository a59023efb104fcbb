"""The ``rebar-bench demo`` command: render, predict, score and report a few views.

``dataset_builder`` depends on this package and not vice versa, so the demo renders by running ``rebar-build`` in a
subprocess.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from rebar_depth_bench.atomic_io import write_bytes
from rebar_depth_bench.console import EXIT_INPUT, ProgressBars
from rebar_depth_bench.errors import BuildError, InputError
from rebar_depth_bench.methods import METHODS
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.reporting.html.page import write_report
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.evaluation import open_evaluation, score_evaluation

DEMO_FOLDER = "demo-output"
DEMO_VIEWS = 6
DEMO_SAMPLES = 8
"""Samples per pixel: half the default of a build, which halves the demo's run time; the denoiser compensates."""
DEMO_CONFIG = "lattice"
DEMO_METHODS = ("sgbm", "sgbm-filled", "constant")


def run_demo(out: Path, views: int) -> None:
    """Build ``views`` lattice views in ``out``, run three methods, score and report each.

    An interrupted demo is resumed. Raises ``InputError`` if the ``build`` extra is not installed.
    """
    data = out / "dataset"
    _print_step(f"rendering {views} stereo views of the lattice at 1280 x 720 into {data}")
    _build_dataset(data, views)
    reports = []
    for name in DEMO_METHODS:
        method = METHODS[name]
        archive = out / f"{name}.zip"
        _print_step(f"predicting with {name}: {method.info.summary}")
        with ProgressBars() as bars:
            predict(method, data, archive, configs=[DEMO_CONFIG], progress=bars.update)
            with open_evaluation(archive, data) as evaluation:
                result = score_evaluation(evaluation, progress=bars.update)
                reports.append(out / f"{name}.html")
                write_report(result, evaluation, reports[-1])
        write_bytes(out / f"{name}.json", result.to_json())
        print_table(result, Console())
    print("open the reports in a browser:")
    for report in reports:
        print(f"  {report.resolve()}")


def _build_dataset(data: Path, views: int) -> None:
    if find_spec("dataset_builder") is None or find_spec("bpy") is None:
        raise InputError("the demo renders with Blender: pip install 'rebar-depth-bench[build]'")
    command = ["-P", "-m", "dataset_builder", "--out", str(data), "--config", DEMO_CONFIG, "--views", str(views)]
    command += ["--samples", str(DEMO_SAMPLES)]
    finished = subprocess.run([sys.executable, *command], stdout=sys.stderr, check=False)
    if finished.returncode == EXIT_INPUT:
        raise InputError("the demo dataset cannot be built, see the error above")
    if finished.returncode:
        raise BuildError(f"rebar-build ended with exit status {finished.returncode}, expected 0")


def _print_step(step: str) -> None:
    print(step, file=sys.stderr, flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--out", type=Path, default=Path(DEMO_FOLDER), help="working folder (default: %(default)s)"
    )
    parser.add_argument(
        "--views", type=int, default=DEMO_VIEWS, help="stereo views to render (default: %(default)s)"
    )


def run(options: argparse.Namespace) -> None:
    """Run the demo with the command's options."""
    run_demo(options.out, options.views)
