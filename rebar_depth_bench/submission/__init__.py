"""Submission archives: writing, validation and reading of predictions."""

from rebar_depth_bench.base.errors import EntryError
from rebar_depth_bench.submission.declaration import INPUTS, Declaration, SubmissionMeta
from rebar_depth_bench.submission.entries import CaptureViews, ExpectedViews
from rebar_depth_bench.submission.reader import SubmissionReader
from rebar_depth_bench.submission.writer import SubmissionWriter

__all__ = [
    "INPUTS",
    "CaptureViews",
    "Declaration",
    "EntryError",
    "ExpectedViews",
    "SubmissionMeta",
    "SubmissionReader",
    "SubmissionWriter",
]
