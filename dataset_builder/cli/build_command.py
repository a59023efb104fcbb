"""The ``rebar-build build`` command: its options, the request that they make, and what it prints."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dataset_builder.catalog.cages_config import CAGES, CagesRequest
from dataset_builder.catalog.named_configs import CONFIGS, LATTICE_CONFIGS, SWEEPS, ZED_CONFIGS, BuildRequest
from dataset_builder.scene.variants.registry import VARIANTS
from dataset_builder.specs.config_specs import (
    CPU,
    DEFAULT_QUALITY,
    GPU_TYPES,
    QUALITIES,
    SAMPLINGS,
    ColourSpec,
    colour_spec,
)
from rebar_depth_bench.base.errors import InputError, printable, require_extra
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.cli.console import add_names

if TYPE_CHECKING:
    from dataset_builder.pipeline.blender_process import Submit
    from dataset_builder.pipeline.build import BuildSummary

CAGES_OPTIONS = ("split", "scenes", "views_per_scene")
"""Options of the scenes of ``cages``; each is None if it is not given."""
COLOUR_OPTIONS = ("sampling", "quality", "samples", "device")
"""Options that only colour has; each is None if it is not given."""
_EXTRA_MODULES = ("bpy", "cv2", "embreex", "trimesh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a build."""
    parser.add_argument("--out", type=Path, metavar="ROOT", help="dataset folder to build or resume")
    add_names(
        parser,
        "--config",
        f"configs to build: {', '.join(CONFIGS)} (default: all of these), or {', '.join((*SWEEPS, CAGES))}",
    )
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="number of views per config, evenly spaced over the trajectory (default: all)",
    )
    parser.add_argument(
        "--rig",
        metavar="NAME|FILE",
        help="camera, calibration file, or TOML file with the keys of [rig], in place of the rig of the configs",
    )
    parser.add_argument(
        "--width", type=int, help="image width in pixels (default: that of the rig, or from --height)"
    )
    parser.add_argument(
        "--height", type=int, help="image height in pixels (default: that of the rig, or from --width)"
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help=f"random seed of surfaces and noise, and of all of {CAGES} (default: %(default)s)",
    )
    add_names(
        parser,
        "--overwrite",
        "finished configs of ROOT that may be replaced; to others, only views and scenes can be added",
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
        "--device",
        choices=(CPU, *GPU_TYPES, "auto"),
        help="type of device that renders colour, on all devices of the type; auto: the best type of this machine "
        f"(default: {CPU})",
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
        "--dry-run",
        action="store_true",
        help="print the number of views, the disk space and the memory that the build needs, and build nothing",
    )
    parser.add_argument("--mesh", metavar="FILE", help="STL, PLY or OBJ file that replaces the lattice's rods")
    add_mesh_unit(parser)
    add_names(
        parser,
        "--scene",
        "scene files to build: TOML or IFC; only these are built unless --config is given",
        "FILE",
    )
    add_names(parser, "--variant", f"appearance variants, appended to the config name: {', '.join(VARIANTS)}")
    cages = parser.add_argument_group(f"scenes of the config {CAGES}")
    cages.add_argument(
        "--split",
        metavar="NAME",
        help=f"split of the scenes: {', '.join(SPLITS)} (default: {CagesRequest.split})",
    )
    cages.add_argument(
        "--scenes", type=int, metavar="N", help=f"number of scenes of the split (default: {CagesRequest.scenes})"
    )
    cages.add_argument(
        "--views-per-scene",
        type=int,
        metavar="N",
        help=f"number of views of each scene (default: {CagesRequest.views_per_scene})",
    )


def add_mesh_unit(parser: argparse.ArgumentParser) -> None:
    """Add the option for the unit of a mesh file."""
    parser.add_argument(
        "--mesh-unit",
        default="m",
        metavar="UNIT",
        help="unit of the mesh file: m, cm, mm, in or ft (default: m)",
    )


def check_extra() -> None:
    """Raise ``InputError`` if the build extra is not installed."""
    require_extra("build", _EXTRA_MODULES)


def run(options: argparse.Namespace) -> None:
    """Build or estimate the dataset folder of the options."""
    if options.out is None:
        raise InputError("--out ROOT is missing, expected the dataset folder to build")
    check_extra()
    from dataset_builder.pipeline.blender_process import find_device
    from dataset_builder.pipeline.build import build

    if options.cluster is not None and options.workers is not None:
        raise InputError(
            f"--workers {options.workers} is combined with --cluster {options.cluster}, expected only one of "
            "them: on a cluster, the number of its workers determines how many views are rendered at once"
        )
    workers = 1 if options.workers is None else options.workers
    if workers < 1:
        raise InputError(f"--workers is {workers}, expected 1 or more")
    device = options.device or CPU
    with _cluster_context(options.cluster, device) as submit:
        request = _build_request(options, device if submit else find_device(device))
        if options.dry_run:
            _print_estimate(request, options.out)
            return
        threads = max(1, (os.cpu_count() or 1) // workers)
        with ProgressBars(pictures_per_step=2) as bars:
            summary = build(
                request, options.out, workers=workers, threads=threads, submit=submit, progress=bars.update
            )
    _print_summary(options.out, summary)


def _print_estimate(request: BuildRequest, out: Path) -> None:
    """Print what a build would need; raise ``InputError`` if it would be refused."""
    from dataset_builder.pipeline.build import plan_build
    from dataset_builder.pipeline.disk_space import check_space, estimate_lines, spaces_by_config

    plans, finished = plan_build(request, out)
    print(*map(printable, estimate_lines(out, plans, finished)), sep="\n")
    check_space(out, spaces_by_config([plan for plan in plans if not finished.has(plan)]).values())


def _build_request(options: argparse.Namespace, device: str) -> BuildRequest:
    """Return the build request of the options.

    With ``--scene`` and without ``--config``, only the given scene files are built. With ``--mesh``, the default
    configs are the lattice configs; with ``--rig``, those without a calibration of their own.
    """
    default = () if options.scene else LATTICE_CONFIGS if options.mesh else CONFIGS
    request = BuildRequest(
        configs=tuple(
            options.config or (name for name in default if options.rig is None or name not in ZED_CONFIGS)
        ),
        views=options.views,
        width=options.width,
        height=options.height,
        colour=_colour_spec(options, device),
        seed=options.seed,
        variants=tuple(options.variant or ()),
        cages=_cages_request(options),
        overwrite=tuple(options.overwrite or ()),
    )
    if options.rig is not None:
        from dataset_builder.catalog.scene_file import scene_name_of
        from dataset_builder.user_files.rig_file import read_rig

        rig = read_rig(options.rig, options.width, options.height)
        request = replace(request, rig=rig, rig_name=scene_name_of(Path(options.rig)))
    if options.mesh:
        from dataset_builder.user_files.cage_file import mesh_file_spec

        request = replace(request, mesh=mesh_file_spec(options.mesh, options.mesh_unit))
    if options.scene:
        from dataset_builder.catalog.scene_file import read_scene

        scenes = [read_scene(path) for path in options.scene]
        cages_read = {scene.config.scene.assembly: scene.cage for scene in scenes}
        request = replace(request, scenes=tuple(scene.config for scene in scenes), cages_read=cages_read)
    return request


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
def _cluster_context(address: str | None, device: str) -> Iterator[Submit | None]:
    """Connect to the cluster at ``address``, whose workers must have ``device``; yield None without an address.

    Raises ``InputError`` if ``distributed`` is not installed or a worker has no such device.
    """
    if address is None:
        yield None
        return
    require_extra("cluster", ["distributed"])
    from dataset_builder.pipeline.dask_renderer import connect_to_cluster

    with connect_to_cluster(address) as cluster:
        cluster.check_device(device)
        yield cluster.submit


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
