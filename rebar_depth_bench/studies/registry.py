"""Registry of the studies: the subcommands of ``rebar-bench study`` by name."""

from __future__ import annotations

from collections.abc import Mapping

from rebar_depth_bench.console import Command
from rebar_depth_bench.studies.distance import command as distance
from rebar_depth_bench.studies.kitti import command as kitti
from rebar_depth_bench.studies.pseudo_reference import command as pseudo_reference
from rebar_depth_bench.studies.scale_anchor import command as anchor

STUDIES: Mapping[str, Command] = {
    "anchor": anchor,
    "distance": distance,
    "pseudo-reference": pseudo_reference,
    "kitti": kitti,
}
