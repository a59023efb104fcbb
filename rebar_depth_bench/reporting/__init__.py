"""The HTML report of a result."""

from rebar_depth_bench.reporting.html.page import write_report
from rebar_depth_bench.reporting.html.view_browser import VIEWS_SHOWN

__all__ = ["VIEWS_SHOWN", "write_report"]
