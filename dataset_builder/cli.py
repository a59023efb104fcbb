"""The ``rebar-build`` command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from dataset_builder.configs import CONFIGS, BuildRequest
from rebar_depth_bench.console import ProgressBars, run_command
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.version import software_version

if TYPE_CHECKING:
    from dataset_builder.build import BuildSummary

_EXTRA = ("bpy", "cv2", "embreex", "trimesh")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-build``; return its exit status."""
    options = argument_parser().parse_args(arguments)
    command = _audit if options.command == "audit" else _build
    return run_command(lambda: command(options), interrupted="interrupted; run the same command again to go on")


def _check_extra() -> None:
    """Raise ``InputError`` where the build extra is not installed; what needs it is imported only after this."""
    missing = [name for name in _EXTRA if find_spec(name) is None]
    if missing:
        raise InputError(
            f"not installed: {', '.join(missing)}; expected the build extra: "
            "pip install 'rebar-depth-bench[build]'"
        )


def _build(options: argparse.Namespace) -> None:
    _check_extra()
    from dataset_builder.build import build
    from dataset_builder.mesh_door import mesh_file_spec

    if options.out is None:
        raise InputError("--out ROOT is missing: the dataset folder to build")
    if options.workers < 1:
        raise InputError(f"--workers is {options.workers}, expected 1 or more")
    request = BuildRequest(
        configs=tuple(options.config or CONFIGS),
        views=options.views,
        width=options.width,
        height=options.height,
        samples=options.samples,
        seed=options.seed,
        mesh=mesh_file_spec(options.mesh, options.mesh_unit) if options.mesh else None,
    )
    threads = max(1, (os.cpu_count() or 1) // options.workers)
    with ProgressBars() as bars:
        summary = build(request, options.out, workers=options.workers, threads=threads, progress=bars.update)
    _print_summary(options.out, summary)


def _print_summary(out: Path, summary: BuildSummary) -> None:
    if summary.up_to_date:
        print(f"up to date: {', '.join(summary.up_to_date)}")
    if summary.built:
        print(f"built: {', '.join(summary.built)}")
        longest_first = sorted(summary.seconds.items(), key=lambda item: -item[1])
        stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in longest_first)
        print(f"seconds in render processes: {stages}", file=sys.stderr)
    print(out)


def _audit(options: argparse.Namespace) -> None:
    _check_extra()
    from dataset_builder.audit import audit, print_audit

    with ProgressBars() as bars:
        report = audit(options.root, depth_views=options.depth_views, progress=bars.update)
    print_audit(report)
    if report.failures:
        raise InputError(f"{options.root}: {len(report.failures)} of {len(report.checks)} checks failed")


def argument_parser() -> argparse.ArgumentParser:
    """Return the command's argument parser."""
    parser = argparse.ArgumentParser(
        prog="rebar-build",
        description="Render a dataset folder of stereo views with exact depth, or continue one.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    parser.add_argument("--out", type=Path, metavar="ROOT", help="the dataset folder to build or continue")
    parser.add_argument(
        "--config",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"which configs (default: all): {', '.join(CONFIGS)}",
    )
    parser.add_argument("--views", type=int, metavar="N", help="N views spread evenly over each full protocol")
    parser.add_argument("--width", type=int, default=BuildRequest.width, help="pixels (default: %(default)s)")
    parser.add_argument("--height", type=int, default=BuildRequest.height, help="pixels (default: %(default)s)")
    parser.add_argument(
        "--samples",
        type=int,
        default=BuildRequest.samples,
        help="Cycles samples per pixel (default: %(default)s)",
    )
    parser.add_argument("--workers", type=int, default=1, help="render processes at once (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of surfaces and noise (default: %(default)s)")
    parser.add_argument(
        "--mesh", metavar="FILE", help="STL, PLY, OBJ or glTF file that replaces the lattice's rods"
    )
    parser.add_argument(
        "--mesh-unit",
        default="m",
        metavar="UNIT",
        help="unit of the mesh file: m, cm, mm, in or ft (default: m)",
    )
    commands = parser.add_subparsers(dest="command", metavar="audit")
    checking = commands.add_parser("audit", help="check a dataset folder and its ground truth")
    checking.add_argument("root", metavar="ROOT", help="the dataset folder")
    checking.add_argument(
        "--depth-views",
        type=int,
        default=4,
        metavar="N",
        help="views per config whose depth is compared with Cycles' own (default: %(default)s)",
    )
    return parser
