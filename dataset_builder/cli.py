"""Command-line interface of ``rebar-build``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from dataset_builder.config.catalog import CONFIGS, LATTICE_CONFIGS, SWEEPS, BuildRequest
from dataset_builder.config.quality import DEFAULT_QUALITY, QUALITIES, SAMPLINGS, colour_spec
from dataset_builder.scene.variants import VARIANTS
from rebar_depth_bench.console import ProgressBars, replace_renamed_options, run_command
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.version import software_version

if TYPE_CHECKING:
    from dataset_builder.config.specs import ColourSpec
    from dataset_builder.pipeline.build import BuildSummary
    from dataset_builder.pipeline.local_renderer import Renderer

_EXTRA_MODULES = ("bpy", "cv2", "embreex", "trimesh")


COLOUR_OPTIONS = ("sampling", "quality", "samples")
"""Options that only colour has; each is None if it is not given."""
RENAMED_OPTIONS = {"--to": "--out"}
"""Old option strings that are still accepted, and their new names."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-build``; return its exit status."""
    options = argument_parser().parse_args(replace_renamed_options(arguments, RENAMED_OPTIONS))
    interrupted = "interrupted; run the same command again to continue"
    return run_command(lambda: options.run(options), interrupted=interrupted)


def _check_extra() -> None:
    """Raise ``InputError`` if the build extra is not installed.

    Modules that need the extra are imported only after this check.
    """
    missing = [name for name in _EXTRA_MODULES if find_spec(name) is None]
    if missing:
        raise InputError(
            f"not installed: {', '.join(missing)}; expected the build extra: "
            "pip install 'rebar-depth-bench[build]'"
        )


def _build(options: argparse.Namespace) -> None:
    _check_extra()
    from dataset_builder.pipeline.build import build

    if options.out is None:
        raise InputError("--out ROOT is missing, expected the dataset folder to build")
    if options.cluster is not None and options.workers is not None:
        raise InputError(
            f"--workers {options.workers} is combined with --cluster {options.cluster}, expected only one of "
            "them: on a cluster, the number of its workers determines how many views are rendered at once"
        )
    workers = 1 if options.workers is None else options.workers
    if workers < 1:
        raise InputError(f"--workers is {workers}, expected 1 or more")
    request = _build_request(options)
    threads = max(1, (os.cpu_count() or 1) // workers)
    with _cluster_context(options.cluster) as cluster, ProgressBars() as bars:
        summary = build(
            request, options.out, workers=workers, threads=threads, cluster=cluster, progress=bars.update
        )
    _print_summary(options.out, summary)


def _build_request(options: argparse.Namespace) -> BuildRequest:
    """Return the build request of the options.

    With ``--scene`` and without ``--config``, only the given scene files are built. With ``--mesh``, the default
    configs are those of the lattice.
    """
    from dataset_builder.config.scene_file import scene_config
    from dataset_builder.scene.assemblies.mesh_file import mesh_file_spec

    default = () if options.scene else LATTICE_CONFIGS if options.mesh else CONFIGS
    return BuildRequest(
        configs=tuple(options.config or default),
        views=options.views,
        width=options.width,
        height=options.height,
        colour=_colour_spec(options),
        seed=options.seed,
        mesh=mesh_file_spec(options.mesh, options.mesh_unit) if options.mesh else None,
        variants=tuple(options.variant or ()),
        scenes=tuple(scene_config(path) for path in options.scene or ()),
    )


def _colour_spec(options: argparse.Namespace) -> ColourSpec | None:
    """Return the colour settings of the options, or None for ``--no-colour``.

    Raises ``InputError`` if ``--no-colour`` is combined with options of colour.
    """
    if not options.no_colour:
        return colour_spec(options.sampling, options.quality, options.samples)
    given = [f"--{name} {value}" for name in COLOUR_OPTIONS if (value := getattr(options, name)) is not None]
    if given:
        raise InputError(
            f"--no-colour is combined with {', '.join(given)}, expected only one of them: without colour, "
            "nothing is sampled"
        )
    return None


def _cluster_context(address: str | None) -> AbstractContextManager[Renderer | None]:
    """Return a context manager that connects to the cluster at ``address``, or yields None without an address.

    Raises ``InputError`` if ``distributed`` is not installed.
    """
    if address is None:
        return nullcontext()
    if find_spec("distributed") is None:
        raise InputError(
            "not installed: distributed; --cluster needs it: pip install 'rebar-depth-bench[cluster]'"
        )
    from dataset_builder.pipeline.dask_renderer import connect_to_cluster

    return connect_to_cluster(address)


def _print_summary(out: Path, summary: BuildSummary) -> None:
    """Print the configs built and up to date, and the seconds per stage to standard error."""
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


def _export(options: argparse.Namespace) -> None:
    from dataset_builder.export import export

    with ProgressBars() as bars:
        summary = export(options.root, options.out, options.config, options.views, progress=bars.update)
    for config in summary.configs:
        print(f"{config.config}: {config.views} views, {config.written} files written, {config.kept} kept")
    print(options.out)


def argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser of ``rebar-build``."""
    parser = argparse.ArgumentParser(
        prog="rebar-build",
        description="Render a dataset folder of stereo views with exact depth, or resume an interrupted build.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    _add_build_arguments(parser)
    _add_scene_arguments(parser)
    parser.set_defaults(run=_build)
    commands = parser.add_subparsers(metavar="{audit,export}")
    auditing = commands.add_parser("audit", help="check a dataset folder and its ground truth")
    _add_audit_arguments(auditing)
    auditing.set_defaults(run=_audit)
    exporting = commands.add_parser(
        "export", help="export a dataset folder as PNG, OpenEXR, COLMAP and nerfstudio files"
    )
    _add_export_arguments(exporting)
    exporting.set_defaults(run=_export)
    return parser


def _add_build_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, metavar="ROOT", help="dataset folder to build or resume")
    parser.add_argument(
        "--config",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"configs to build: {', '.join(CONFIGS)} (default: all of these), or {', '.join(SWEEPS)}",
    )
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="number of views per config, evenly spaced over the full protocol (default: all)",
    )
    parser.add_argument(
        "--width", type=int, default=BuildRequest.width, help="image width in pixels (default: %(default)s)"
    )
    parser.add_argument(
        "--height", type=int, default=BuildRequest.height, help="image height in pixels (default: %(default)s)"
    )
    parser.add_argument(
        "--sampling",
        choices=SAMPLINGS,
        help="more samples around the steel than elsewhere, or as many everywhere (default: steel-first)",
    )
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument(
        "--quality", choices=QUALITIES, help=f"preset of samples and denoising (default: {DEFAULT_QUALITY})"
    )
    amount.add_argument(
        "--samples",
        type=int,
        metavar="SPP",
        help="Cycles samples per pixel instead of a preset, uniform unless --sampling steel-first is given",
    )
    parser.add_argument(
        "--no-colour",
        action="store_true",
        help="build depth, masks, ids and poses only; the columns left_rgb and right_rgb are null in every row",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="number of parallel render processes (default: 1)"
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="address of a dask scheduler whose workers render the views, such as tcp://host:8786",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="random seed of surfaces and noise (default: %(default)s)"
    )


def _add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--mesh", metavar="FILE", help="STL, PLY, OBJ or glTF file that replaces the lattice's rods"
    )
    parser.add_argument(
        "--mesh-unit",
        default="m",
        metavar="UNIT",
        help="unit of the mesh file: m, cm, mm, in or ft (default: m)",
    )
    parser.add_argument(
        "--scene",
        nargs="+",
        action="extend",
        metavar="FILE",
        help="scene files to build: TOML or IFC; only these are built unless --config is given",
    )
    parser.add_argument(
        "--variant",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"appearance variants, appended to the config name: {', '.join(VARIANTS)}",
    )


def _add_audit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument(
        "--depth-views",
        type=int,
        default=4,
        metavar="N",
        help="number of views per config whose depth is compared with Cycles' depth pass (default: %(default)s)",
    )


def _add_export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="output folder: new, or an earlier export to resume"
    )
    parser.add_argument(
        "--config", nargs="+", action="extend", metavar="NAME", help="configs to export (default: all)"
    )
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="number of views per config, evenly spaced over the views of the folder (default: all)",
    )
