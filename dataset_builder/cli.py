"""Command-line interface of ``rebar-build``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from dataset_builder.build_options import add_build_arguments, add_mesh_unit, add_scene_arguments
from dataset_builder.config.cages import CAGES, CagesRequest
from dataset_builder.config.catalog import CONFIGS, LATTICE_CONFIGS, BuildRequest
from dataset_builder.config.specs import CPU, colour_spec
from dataset_builder.export import command as export_command
from dataset_builder.importing import command as import_command
from dataset_builder.push import command as push_command
from rebar_depth_bench.console import ProgressBars, Rate, require_extra, run_command
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.output_options import add_output_file, check_outputs, prints_table
from rebar_depth_bench.outputs import write_output
from rebar_depth_bench.terminal import use_plain_characters
from rebar_depth_bench.version import software_version

if TYPE_CHECKING:
    from dataset_builder.config.specs import ColourSpec
    from dataset_builder.pipeline.build import BuildSummary
    from dataset_builder.pipeline.local_renderer import Renderer

_EXTRA_MODULES = ("bpy", "cv2", "embreex", "trimesh")


CAGES_OPTIONS = ("split", "scenes", "views_per_scene")
"""Options of the scenes of ``cages``; each is None if it is not given."""
BUILD = "build"
COMMANDS = (BUILD, "audit", "export", "import", "inspect", "push")
COLOUR_OPTIONS = ("sampling", "quality", "samples", "device")
"""Options that only colour has; each is None if it is not given."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-build``; return its exit status."""
    use_plain_characters()
    options = argument_parser().parse_args(with_command(sys.argv[1:] if arguments is None else arguments))
    interrupted = "interrupted; run the same command again to continue"
    return run_command(lambda: options.run(options), interrupted=interrupted)


def with_command(words: Sequence[str]) -> list[str]:
    """Return the words of a command line that begins with a command; without one, it is ``build``."""
    has_command = words and words[0] in (*COMMANDS, "-h", "--help", "--version")
    return [*words] if has_command else [BUILD, *words]


def _check_extra() -> None:
    """Raise ``InputError`` if the build extra is not installed."""
    require_extra("build", _EXTRA_MODULES)


def _build(options: argparse.Namespace) -> None:
    if commands := [name for name in options.config or () if name in COMMANDS]:
        raise InputError(
            f"--config is followed by the command {commands[0]}, expected names of configs; a command is the "
            f"first word: rebar-build {commands[0]} ..."
        )
    if options.out is None:
        raise InputError("--out ROOT is missing, expected the dataset folder to build")
    if options.rewrite_manifest:
        names = ("config", "scene", "mesh", "views", "overwrite", "dry_run")
        if given := [f"--{name.replace('_', '-')}" for name in names if getattr(options, name)]:
            raise InputError(f"--rewrite-manifest is combined with {', '.join(given)}, expected only --out ROOT")
        from dataset_builder.pipeline.rewrite import rewrite_manifest

        rewrite_manifest(options.out)
        print(options.out)
        return
    _check_extra()
    from dataset_builder.pipeline.build import build
    from dataset_builder.pipeline.devices import Devices, find_devices

    if options.cluster is not None and options.dry_run:
        raise InputError(
            f"--dry-run is combined with --cluster {options.cluster}, expected only one of them: the estimate is "
            "measured on this machine"
        )
    if options.cluster is not None and options.workers is not None:
        raise InputError(
            f"--workers {options.workers} is combined with --cluster {options.cluster}, expected only one of "
            "them: on a cluster, the number of its workers determines how many views are rendered at once"
        )
    workers = 1 if options.workers is None else options.workers
    if workers < 1:
        raise InputError(f"--workers is {workers}, expected 1 or more")
    device = options.device or CPU
    with _cluster_context(options.cluster, device) as cluster:
        devices = Devices(device) if cluster else find_devices(device)
        request = _build_request(options, devices.type)
        threads = max(1, (os.cpu_count() or 1) // (workers * devices.count))
        if options.dry_run:
            _print_estimate(request, options.out, workers * devices.count, threads)
            return
        with ProgressBars(Rate("pictures", 2)) as bars:
            summary = build(
                request,
                options.out,
                workers=workers,
                threads=threads,
                devices=devices.count,
                cluster=cluster,
                progress=bars.update,
            )
    _print_summary(options.out, summary)


def _print_estimate(request: BuildRequest, out: Path, processes: int, threads: int) -> None:
    """Print what a build would need; raise ``InputError`` if it would be refused."""
    from dataset_builder.pipeline.build import plan_build
    from dataset_builder.pipeline.disk_space import check_space
    from dataset_builder.pipeline.estimate import estimate_build, estimate_lines
    from dataset_builder.pipeline.retained import Finished, check_retained

    plans = plan_build(request, out)
    finished = Finished(out)
    check_retained(out, finished, plans, request.overwrite)
    with ProgressBars() as bars:
        estimates = estimate_build(plans, finished, out, threads, bars.update)
    print(*map(printable, estimate_lines(estimates, out, processes)), sep="\n")
    check_space(out, [estimate.space for estimate in estimates if estimate.space])


def _build_request(options: argparse.Namespace, device: str) -> BuildRequest:
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
        colour=_colour_spec(options, device),
        seed=options.seed,
        mesh=mesh_file_spec(options.mesh, options.mesh_unit) if options.mesh else None,
        variants=tuple(options.variant or ()),
        scenes=tuple(scene_config(path) for path in options.scene or ()),
        cages=_cages_request(options),
        overwrite=tuple(options.overwrite or ()),
    )


def _cages_request(options: argparse.Namespace) -> CagesRequest | None:
    """Return the request for scenes of ``cages``, or None if that is not among the configs.

    Raises ``InputError`` if options of its scenes are given without it.
    """
    given = {name: value for name in CAGES_OPTIONS if (value := getattr(options, name)) is not None}
    if CAGES in (options.config or ()):
        return CagesRequest(**given)
    if given:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise InputError(f"{names}: only {CAGES} has such scenes, expected --config {CAGES}")
    return None


def _colour_spec(options: argparse.Namespace, device: str) -> ColourSpec | None:
    """Return the colour settings of the options, or None for ``--no-colour``.

    Raises ``InputError`` if ``--no-colour`` is combined with options of colour.
    """
    if not options.no_colour:
        return replace(colour_spec(options.sampling, options.quality, options.samples), device=device)
    given = [f"--{name} {value}" for name in COLOUR_OPTIONS if (value := getattr(options, name)) is not None]
    if given:
        raise InputError(
            f"--no-colour is combined with {', '.join(given)}, expected only one of them: without colour, "
            "nothing is sampled"
        )
    return None


@contextmanager
def _cluster_context(address: str | None, device: str) -> Iterator[Renderer | None]:
    """Connect to the cluster at ``address``, whose workers must have ``device``; yield None without an address.

    Raises ``InputError`` if ``distributed`` is not installed or a worker has no such device.
    """
    if address is None:
        yield None
        return
    if find_spec("distributed") is None:
        raise InputError(
            "not installed: distributed; --cluster needs it: pip install 'rebar-depth-bench[cluster]'"
        )
    from dataset_builder.pipeline.dask_renderer import connect_to_cluster

    with connect_to_cluster(address) as cluster:
        cluster.check_device(device)
        yield cluster


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


def _inspect(options: argparse.Namespace) -> None:
    _check_extra()
    from dataset_builder.config.scene_file import files_of_scene, scene_cage
    from dataset_builder.inspection.picture import inspection_picture
    from dataset_builder.inspection.report import inspection_json, print_inspection
    from dataset_builder.inspection.summary import inspect_cage
    from dataset_builder.pipeline.notes import print_notes
    from dataset_builder.scene.assemblies.cage_checks import raise_problems

    check_outputs({**vars(options), "scene_files": files_of_scene(options.scene_file)})
    cage = scene_cage(options.scene_file, options.mesh_unit)
    inspection = inspect_cage(cage, Path(options.scene_file).name)
    if options.json is not None:
        write_output(options.json, inspection_json(inspection))
    if options.picture is not None:
        write_output(options.picture, inspection_picture(inspection))
    if prints_table(options):
        print_inspection(inspection)
    print_notes(cage.notes)
    raise_problems(cage.problems, options.scene_file)


def argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser of ``rebar-build``."""
    parser = argparse.ArgumentParser(
        prog="rebar-build",
        description="Build, check and convert dataset folders of stereo views with exact depth.",
        epilog=f"Without a command, the options are those of {BUILD}: rebar-build {BUILD} --help lists them.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    commands = parser.add_subparsers(metavar=f"{{{','.join(COMMANDS)}}}")
    building = commands.add_parser(
        BUILD,
        help="render a dataset folder",
        description="Render a dataset folder of stereo views with exact depth, or resume an interrupted build.",
    )
    add_build_arguments(building)
    add_scene_arguments(building)
    building.set_defaults(run=_build)
    auditing = commands.add_parser("audit", help="check a dataset folder and its ground truth")
    _add_audit_arguments(auditing)
    auditing.set_defaults(run=_audit)
    inspecting = commands.add_parser("inspect", help="show the bars of a scene file without rendering")
    _add_inspect_arguments(inspecting)
    inspecting.set_defaults(run=_inspect)
    for name, command in (("export", export_command), ("import", import_command), ("push", push_command)):
        subparser = commands.add_parser(name, help=command.SUMMARY)
        command.add_arguments(subparser)
        subparser.set_defaults(run=command.run)
    return parser


def _add_audit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument(
        "--depth-views",
        type=int,
        default=4,
        metavar="N",
        help="number of views per config whose depth is compared with Cycles' depth pass (default: %(default)s)",
    )


def _add_inspect_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene_file", metavar="SCENE", help="scene TOML, IFC model, or mesh file (STL, PLY, OBJ)")
    add_mesh_unit(parser)
    add_output_file(parser, "--json", "write the bars, what is left out, and the placement as JSON")
    add_output_file(parser, "--picture", "write a PNG of the cage from four sides")
