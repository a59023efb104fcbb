"""Numbers of the network of ``examples/finetune.py`` beside a constant and SGBM, for the benchmark card.

    python -m benchmarks.own_network ROOT OUT

ROOT and OUT are the dataset folder and the ``--out`` folder of the commands at the head of
``examples/finetune.py``, which trains the network and writes an archive ``OUT/METHOD-CONFIG-SPLIT.zip`` for each
row of its table. This command scores the archives of the split ``test`` and writes
``cards/reference/own-network.json``, from which ``make cards`` writes the card.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import torch

from cards.learned import OWN_NETWORK
from cards.reference import results_file
from rebar_depth_bench import score
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.base.writing import write_text
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.scoring.columns import rounded

METHODS = ("finetuned", "constant", "sgbm")
PLACES = {
    "rank_error": "rank_error",
    "native": "native.abs_rel",
    "scaled": "scaled.abs_rel",
    "scaled_constant": "reference.scaled_constant.abs_rel",
    "within_5_mm": "within_mm.5",
    "coverage": "coverage",
}
"""Places of the stored numbers in the JSON of a result."""


def main(root: Path, out: Path) -> int:
    """Score the archives, write their numbers, and return the exit status."""
    folder = open_folder(root)
    checkpoint = torch.load(out / "checkpoint.pt", weights_only=True)
    plan = checkpoint["plan"]
    training = {
        **{name: plan[name] for name in ("seed", "epochs", "batch", "crop", "torch")},
        "views": len(plan["views"]),
        "scenes": len(folder.config("cages").of_split("train").scenes),
        "parameters": sum(
            value.numel() for name, value in checkpoint["net"].items() if name.endswith(("weight", "bias"))
        ),
    }
    configs = {
        name: config_numbers(config.of_split(TEST_SPLIT), root, out)
        for name, config in folder.config_by_name.items()
        if TEST_SPLIT in config.splits
    }
    document = {
        "command": "python -m benchmarks.own_network ROOT OUT",
        "dataset": folder.digest,
        "training": training,
        "configs": configs,
    }
    write_text(results_file(OWN_NETWORK), json.dumps(document, indent=1, allow_nan=False) + "\n")
    return 0


def config_numbers(config: DatasetConfig, root: Path, out: Path) -> dict[str, Any]:
    """Return the numbers of a config: of its views, and of each method."""
    tables = {
        method: score(out / f"{method}-{config.name}-{TEST_SPLIT}.zip", root).tables[config.name]
        for method in METHODS
    }
    return {
        "views": len(config.view_ids),
        "width": config.grid[1],
        "height": config.grid[0],
        "methods": {
            method: {name: rounded(table[place]) for name, place in PLACES.items()}
            for method, table in tables.items()
        },
    }


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m benchmarks.own_network ROOT OUT")
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
