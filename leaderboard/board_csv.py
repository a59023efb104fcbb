"""A board as CSV, with the columns of the command line's."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from leaderboard.board import BoardRow
from rebar_depth_bench.table import csv_cell, number_cells, number_heads


def board_csv(rows: Sequence[BoardRow]) -> str:
    """Return the rows as CSV: rank, who and what, then the table's numbers; undefined ones are empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["rank", "id", "method", "submitter", "config", *number_heads()])
    for row in rows:
        cells = [row.rank, row.submission_id, row.method, row.submitter, row.config, *number_cells(row.table)]
        writer.writerow([csv_cell(cell) for cell in cells])
    return out.getvalue()
