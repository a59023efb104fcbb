"""The ``rebar-bench demo`` command: render, predict, score and report a few views.

``dataset_builder`` depends on this package and not vice versa, so the demo renders by running ``rebar-build`` in a
subprocess.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from rich.console import Console

from rebar_depth_bench.base.errors import BuildError, InputError, require_extra
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.cli.console import EXIT_INPUT
from rebar_depth_bench.methods import METHODS
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.reporting.html.page import write_report
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.evaluation import open_evaluation, score_evaluation

DEMO_CONFIG = "lattice"
DEMO_METHODS = ("sgbm", "sgbm-filled", "constant")
DEMO_SAMPLES = 8
"""Samples per pixel: half the default of a build, which halves the demo's run time; the denoiser compensates."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    folder = Path("demo-output")
    parser.add_argument("--out", type=Path, default=folder, help="working folder (default: %(default)s)")
    parser.add_argument("--views", type=int, default=6, help="stereo views to render (default: %(default)s)")


def run(options: argparse.Namespace) -> None:
    """Build lattice views in a folder, run three methods, score and report each.

    An interrupted demo is resumed. Raises ``InputError`` if the ``build`` extra is not installed.
    """
    data = options.out / "dataset"
    require_extra("build", ["dataset_builder", "bpy"])
    print_notice(f"rendering {options.views} stereo views of the lattice at 1280 x 720 into {data}")
    _build_dataset(data, options.views)
    reports = []
    for name in DEMO_METHODS:
        method = METHODS[name]
        archive = options.out / f"{name}.zip"
        print_notice(f"predicting with {name}: {method.info.summary}")
        with ProgressBars() as bars:
            predict(method, data, archive, configs=[DEMO_CONFIG], progress=bars.update)
            with open_evaluation(archive, data) as evaluation:
                result = score_evaluation(evaluation, progress=bars.update)
                reports.append(options.out / f"{name}.html")
                write_report(result, evaluation, reports[-1])
        write_bytes(options.out / f"{name}.json", result.to_json())
        print_table(result, Console())
    print("open the reports in a browser:")
    for report in reports:
        print(f"  {report.resolve()}")


def _build_dataset(data: Path, views: int) -> None:
    command = ["-P", "-m", "dataset_builder", "--out", str(data), "--config", DEMO_CONFIG, "--views", str(views)]
    command += ["--samples", str(DEMO_SAMPLES)]
    finished = subprocess.run([sys.executable, *command], stdout=sys.stderr, check=False)
    if finished.returncode == EXIT_INPUT:
        raise InputError("the demo dataset cannot be built, see the error above")
    if finished.returncode:
        raise BuildError(f"rebar-build ended with exit status {finished.returncode}, expected 0")
