"""Command-line interface of ``rebar-build``.

Modules that only one command needs are imported when it is called.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import (
    Command,
    InputFile,
    add_names,
    add_output_file,
    check_outputs,
    prints_table,
    program_parser,
    run_program,
)

BUILD = "build"
_STRAY_SHOWN = 5


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-build``; return its exit status."""
    words = with_command(sys.argv[1:] if arguments is None else arguments)
    return run_program(argument_parser(words[:1]), words)


def with_command(words: Sequence[str]) -> list[str]:
    """Return the words of a command line that begins with a command; without one, it is ``build``."""
    has_command = words and words[0] in (*COMMANDS, "-h", "--help", "--version")
    return [*words] if has_command else [BUILD, *words]


def argument_parser(words: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """Return the argument parser of ``rebar-build``, complete for the command in ``words``, or for all if None."""
    description = "Build, check and convert dataset folders of stereo views with exact depth."
    epilog = f"Without a command, the options are those of {BUILD}: rebar-build {BUILD} --help lists them."
    parser = program_parser("rebar-build", description, COMMANDS, words, epilog)
    parser.set_defaults(interrupted="interrupted; run the same command again to continue")
    return parser


def _add_build_arguments(parser: argparse.ArgumentParser) -> None:
    from dataset_builder.cli.build_command import add_arguments

    parser.description = (
        "Render a dataset folder of stereo views with exact depth, or resume an interrupted build."
    )
    add_arguments(parser)


def _build(options: argparse.Namespace) -> None:
    from dataset_builder.cli.build_command import run

    if commands := [name for name in options.config or () if name in COMMANDS]:
        raise InputError(
            f"--config is followed by the command {commands[0]}, expected names of configs; a command is the "
            f"first word: rebar-build {commands[0]} ..."
        )
    run(options)


def _add_audit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument(
        "--depth-views",
        type=int,
        default=4,
        metavar="N",
        help="number of views per config whose depth is compared with Cycles' depth pass (default: %(default)s)",
    )


def _audit(options: argparse.Namespace) -> None:
    from dataset_builder.cli.build_command import check_extra

    check_extra()
    from dataset_builder.audit import audit, print_audit

    with ProgressBars() as bars:
        report = audit(options.root, depth_views=options.depth_views, progress=bars.update)
    print_audit(report)
    if report.failures:
        raise InputError(f"{options.root}: {len(report.failures)} of {len(report.checks)} checks failed")


def _add_export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="output folder: new, or an earlier export to resume"
    )
    formats = ("plain", "ultralytics")
    parser.add_argument("--format", choices=formats, default="plain", help="files to write (default: plain)")
    add_names(parser, "--config", "configs to export (default: all)")
    parser.add_argument(
        "--split", choices=SPLITS, metavar="NAME", help="split to export: train, validation or test (default: all)"
    )
    parser.add_argument(
        "--views",
        type=int,
        metavar="N",
        help="number of views per config, or per scene of a config with splits, evenly spaced over the views of "
        "the folder (default: all)",
    )


def _export(options: argparse.Namespace) -> None:
    """Export configs of a dataset folder; print the numbers of files."""
    from dataset_builder.export import export

    with ProgressBars() as bars:
        exported = export(
            options.root,
            options.out,
            options.config,
            options.views,
            progress=bars.update,
            split=options.split,
            file_format=options.format,
        )
    for config in exported:
        print(f"{config.config}: {config.views} views, {config.written} files written, {config.kept} kept")
    print(options.out)


def _add_import_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("layout", type=Path, metavar="LAYOUT", help="TOML file that describes the data")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="ROOT", help="dataset folder: new, or one to add the config to"
    )
    parser.add_argument("--config", required=True, metavar="NAME", help="name of the config")
    parser.add_argument(
        "--overwrite",
        nargs="+",
        default=(),
        metavar="NAME",
        help="config of ROOT that may be replaced, if it was imported from other data",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="check the layout and show what it describes; nothing is written",
    )


def _import(options: argparse.Namespace) -> None:
    """Check the layout, print what is imported, and import it unless this is a dry run."""
    from dataset_builder.importing.config_import import plan_import, run_import

    source = plan_import(options.layout, options.config)
    for note in source.views.notes:
        print_notice(note)
    (height, width), views = source.views.grid, source.views.names
    print(f"{source.name}: {len(views)} views of {width} x {height}, sigma {source.layout.truth_sigma_m} m")
    if source.absent_columns:
        print(f"absent: {', '.join(source.absent_columns)}")
    if source.bars:
        print(f"surveyed bars: {len(source.bars)}")
    if not options.dry_run:
        with ProgressBars() as bars:
            findings = run_import(source, options.out, bars.update, overwrite=options.overwrite)
        for note in findings.notes:
            print_notice(note)
        for line in findings.summary:
            print(line)
        print(options.out)


def _add_inspect_arguments(parser: argparse.ArgumentParser) -> None:
    from dataset_builder.cli.build_command import add_mesh_unit

    scene_file = "scene TOML, IFC model, or mesh file (STL, PLY, OBJ)"
    parser.add_argument("scene_file", metavar="SCENE", help=scene_file)
    add_mesh_unit(parser)
    add_output_file(parser, "--json", "write the bars, what is left out, and the placement as JSON")
    add_output_file(parser, "--picture", "write a PNG of the cage from four sides")


def _inspect(options: argparse.Namespace) -> None:
    from dataset_builder.cli.build_command import check_extra

    check_extra()
    from dataset_builder.catalog.scene_file import files_of_scene, scene_cage
    from dataset_builder.inspection.picture import inspection_picture
    from dataset_builder.inspection.report import inspection_json, print_inspection
    from dataset_builder.inspection.summary import inspect_cage
    from dataset_builder.pipeline.plan import print_notes
    from dataset_builder.user_files.cage_file import raise_problems

    files = [InputFile(path) for path in files_of_scene(options.scene_file)]
    check_outputs({**vars(options), "scene_files": files})
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


def _add_push_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument("--hub-id", required=True, metavar="ID", help="id of the repository, ORG/NAME")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--yes", action="store_true", help="publish; without it, only what would be sent is printed")
    mode.add_argument("--dry-run", action="store_true", help="print the files without connecting to the Hub")
    parser.add_argument("--private", action="store_true", help="make a new repository private")
    parser.add_argument(
        "--revision",
        default="main",
        metavar="BRANCH",
        help="branch to publish on, created from the main branch if it does not exist (default: %(default)s)",
    )


def _push(options: argparse.Namespace) -> None:
    """Print what a push changes, and publish it with ``--yes``."""
    from dataset_builder.push.pushing import check_request, push, verified_folder

    check_request(options.hub_id, options.revision, connects=not options.dry_run, publishes=options.yes)
    with ProgressBars() as bars:
        source = verified_folder(options.root, bars.update)
    if source.stray:
        more = f" and {len(source.stray) - _STRAY_SHOWN} more" if len(source.stray) > _STRAY_SHOWN else ""
        print_notice(f"not in the manifest, stays local: {', '.join(source.stray[:_STRAY_SHOWN])}{more}")
    if not options.dry_run:
        push(source, options.hub_id, options.revision, private=options.private, publish=options.yes)
        return
    print(f"{options.hub_id}, branch {options.revision}{', private' if options.private else ''}")
    sizes = {name: (source.root / name).stat().st_size for name in source.files}
    for name, size in sizes.items():
        print(f"  {name}, {size:,} bytes")
    print(f"{len(sizes)} files ({sum(sizes.values()):,} bytes); what the Hub has is not sent again")
    print("dry run: not compared with the Hub, nothing was sent")


def _add_croissant_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="dataset folder or Hub repository id")
    parser.add_argument("--hub-id", metavar="ID", help="repository id, ORG/NAME (default: ROOT, or paths in it)")


def _croissant(options: argparse.Namespace) -> None:
    from cards.croissant import croissant
    from dataset_builder.push.pushing import check_request
    from rebar_depth_bench.data.manifest import open_folder

    if options.hub_id is not None:
        check_request(options.hub_id, "main", connects=False, publishes=False)
    folder = open_folder(options.root)
    hub_id = options.hub_id or (None if folder.local else folder.root.partition("@")[0])
    print(croissant(folder, hub_id), end="")


COMMANDS: Mapping[str, Command] = {
    BUILD: Command("render a dataset folder", _add_build_arguments, _build),
    "audit": Command("check a dataset folder and its ground truth", _add_audit_arguments, _audit),
    "croissant": Command(
        "describe a dataset folder in the Croissant format", _add_croissant_arguments, _croissant
    ),
    "export": Command(
        "export a dataset folder as plain files, with COLMAP's and nerfstudio's cameras, or for Ultralytics",
        _add_export_arguments,
        _export,
    ),
    "import": Command(
        "import images with depth from other programs as a config of a dataset folder",
        _add_import_arguments,
        _import,
    ),
    "inspect": Command("show the bars of a scene file without rendering", _add_inspect_arguments, _inspect),
    "push": Command(
        "publish a dataset folder as a dataset repository of the Hugging Face Hub", _add_push_arguments, _push
    ),
}
"""Commands by name."""
