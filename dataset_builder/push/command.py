"""The ``rebar-build push`` command."""

from __future__ import annotations

import argparse
import re
import sys

from rebar_depth_bench.console import ProgressBars, print_notice
from rebar_depth_bench.errors import InputError, escape_text
from rebar_depth_bench.paths import PATH_PATTERN

SUMMARY = "publish a dataset folder as a dataset repository of the Hugging Face Hub"
_STRAY_SHOWN = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("root", metavar="ROOT", help="dataset folder")
    parser.add_argument("--hub-id", required=True, metavar="ID", help="id of the repository, ORG/NAME")
    parser.add_argument(
        "--yes", action="store_true", help="publish; without it, only what would be sent is printed"
    )
    parser.add_argument("--private", action="store_true", help="make a new repository private")
    parser.add_argument(
        "--revision",
        default="main",
        metavar="BRANCH",
        help="branch to publish on, created from the main branch if it does not exist (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> None:
    """Print what a push changes, and publish it with ``--yes``."""
    from dataset_builder.push.hub_errors import require_online, require_token
    from dataset_builder.push.pushing import (
        Repository,
        check_repository_id,
        plan_push,
        send_push,
        verified_folder,
    )

    repository = Repository(check_repository_id(options.hub_id, "--hub-id"), options.revision)
    if not re.fullmatch(PATH_PATTERN, options.revision):
        raise InputError(f"--revision is {escape_text(options.revision)}, expected the name of a branch")
    require_online()
    if options.yes:
        require_token()
    with ProgressBars() as bars:
        source = verified_folder(options.root, bars.update)
    if source.stray:
        more = f" and {len(source.stray) - _STRAY_SHOWN} more" if len(source.stray) > _STRAY_SHOWN else ""
        print_notice(f"not in the manifest, stays local: {', '.join(source.stray[:_STRAY_SHOWN])}{more}")
    push = plan_push(source, repository, private=options.private)
    print(*push.lines(), sep="\n")
    sys.stdout.flush()
    if not push.is_needed:
        print("up to date: nothing to send")
    elif not options.yes:
        print("dry run: nothing was sent; --yes publishes")
    else:
        with ProgressBars() as bars:
            print(send_push(push, bars.update))
