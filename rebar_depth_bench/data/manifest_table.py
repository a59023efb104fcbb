"""Base class of the objects of a manifest."""

from __future__ import annotations

from pydantic import ConfigDict

from rebar_depth_bench.validation import StrictModel


class ManifestTable(StrictModel):
    """Base class of the objects that may contain further keys, which are ignored."""

    model_config = ConfigDict(extra="ignore")
