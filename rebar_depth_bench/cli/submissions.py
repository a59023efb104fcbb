"""The ``rebar-bench submissions`` command."""

from __future__ import annotations

import argparse

from rebar_depth_bench.cli.submit import add_leaderboard, read_token
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.leaderboard_answers import OwnSubmission
from rebar_depth_bench.leaderboard_client import LeaderboardClient
from rebar_depth_bench.submission.metadata import MethodDetails

SUMMARY = "list, publish, withdraw, edit and delete your submissions on a leaderboard"
_ACTIONS = {
    "list": "list the submissions of the token, newest first: id, status, visibility, date, method",
    "publish": "show a submission on the leaderboard",
    "withdraw": "take a submission off the leaderboard",
    "edit": "change what the leaderboard says about the method",
    "delete": "delete a submission with its archive and results; the quota is not restored",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the actions with their arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    for name, summary in _ACTIONS.items():
        action = actions.add_parser(name, help=summary, description=summary)
        if name != "list":
            action.add_argument("id", metavar="ID", help="id of the submission, the last part of its URL")
        if name == "edit":
            action.add_argument(
                "--set",
                action="append",
                required=True,
                metavar="KEY=VALUE",
                help=f"new value of a key, empty to remove it: {', '.join(MethodDetails.model_fields)}",
            )
        add_leaderboard(action)


def run(options: argparse.Namespace) -> None:
    """Perform an action and print the submissions that it lists or changes."""
    values = _values(options)
    with LeaderboardClient(options.url, read_token(options.token_file)) as leaderboard:
        if options.action == "list":
            for submission in leaderboard.submissions():
                print(_line(submission))
        elif options.action == "delete":
            leaderboard.delete(options.id)
        else:
            print(_line(leaderboard.change(options.id, values)))


def _values(options: argparse.Namespace) -> dict[str, object]:
    """Return the values to change. Raises ``InputError`` if a ``--set`` is not ``KEY=VALUE`` with a known key."""
    if options.action != "edit":
        return {"public": options.action == "publish"}
    values: dict[str, object] = {}
    for text in options.set:
        key, separator, value = text.partition("=")
        if not separator or key not in MethodDetails.model_fields:
            known = ", ".join(MethodDetails.model_fields)
            raise InputError(f"--set {printable(text)}: expected KEY=VALUE with one of the keys {known}")
        values[key] = value or None
    return values


def _line(submission: OwnSubmission) -> str:
    visibility = "public" if submission.public else "private"
    date = printable(submission.created_at[:10])
    return f"{submission.id}  {submission.status:<7}  {visibility:<7}  {date}  {printable(submission.method)}"
