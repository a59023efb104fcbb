"""The HTML report of a result."""

from rebar_depth_bench.report.browser import VIEWS_SHOWN
from rebar_depth_bench.report.from_archive import write_report

__all__ = ["VIEWS_SHOWN", "write_report"]
