"""Ground truth of a config as it is scored."""

from __future__ import annotations

from pathlib import Path

from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.scoring.table import Truth
from rebar_depth_bench.scoring.truth import config_truth


def truth_of(root: Path, config: str, split: str | None = None) -> Truth:
    """Return the ground truth of a config of a dataset folder, or of one of its splits."""
    folder = open_folder(root)
    chosen = folder.config(config)
    return config_truth(folder, chosen if split is None else chosen.of_split(split))
