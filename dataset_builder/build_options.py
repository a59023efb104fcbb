"""Options of a build with ``rebar-build``."""

from __future__ import annotations

import argparse
from pathlib import Path

from dataset_builder.config.cages import CAGES, CagesRequest
from dataset_builder.config.catalog import CONFIGS, SWEEPS, BuildRequest
from dataset_builder.config.specs import CPU, DEFAULT_QUALITY, GPU_TYPES, QUALITIES, SAMPLINGS
from dataset_builder.scene.variants.registry import VARIANTS
from rebar_depth_bench.view_ids import SPLITS


def add_build_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options for configs, images, samples, devices and processes."""
    parser.add_argument("--out", type=Path, metavar="ROOT", help="dataset folder to build or resume")
    parser.add_argument(
        "--config",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"configs to build: {', '.join(CONFIGS)} (default: all of these), or {', '.join((*SWEEPS, CAGES))}",
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
        "--device",
        choices=(CPU, *GPU_TYPES, "auto"),
        help=f"type of device that renders colour; auto: the best one of this machine (default: {CPU})",
    )
    parser.add_argument(
        "--no-colour",
        action="store_true",
        help="build depth, masks, ids and poses only; the columns left_rgb and right_rgb are null in every row",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="print views, disk space, memory and duration of the build, measured with small pictures, and build "
        "nothing",
    )
    parser.add_argument(
        "--overwrite",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="finished configs of ROOT that may be replaced; to others, only views and scenes can be added",
    )
    parser.add_argument(
        "--rewrite-manifest",
        action="store_true",
        help="only convert the manifest of ROOT, which an earlier version wrote, to the present format",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="number of parallel render processes per device (default: 1)"
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="address of a dask scheduler whose workers render the views, such as tcp://host:8786",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help=f"random seed of surfaces and noise, and of all of {CAGES} (default: %(default)s)",
    )
    _add_cages_arguments(parser)


def _add_cages_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options for the scenes of the config ``cages``."""
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


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options for user's meshes and scenes, and for variants."""
    parser.add_argument("--mesh", metavar="FILE", help="STL, PLY or OBJ file that replaces the lattice's rods")
    add_mesh_unit(parser)
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


def add_mesh_unit(parser: argparse.ArgumentParser) -> None:
    """Add the option for the unit of a mesh file."""
    parser.add_argument(
        "--mesh-unit",
        default="m",
        metavar="UNIT",
        help="unit of the mesh file: m, cm, mm, in or ft (default: m)",
    )
