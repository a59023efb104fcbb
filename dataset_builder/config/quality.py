"""Quality presets of colour, and the samples that the options of ``rebar-build`` select."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from dataset_builder.config.specs import ColourSpec

QUALITIES: Mapping[str, ColourSpec] = {
    "preview": ColourSpec(samples=2, steel_samples=8),
    "standard": ColourSpec(),
    "high": ColourSpec(samples=6, steel_samples=64),
}
"""Presets by name, chosen by measurement (``python -m benchmarks.colour``)."""

DEFAULT_QUALITY = "standard"

STEEL_FIRST, UNIFORM = "steel-first", "uniform"
SAMPLINGS = (STEEL_FIRST, UNIFORM)


def colour_spec(sampling: str | None = None, quality: str | None = None, samples: int | None = None) -> ColourSpec:
    """Return the colour settings that the options select; None is an option that is not given.

    ``samples`` are those of steel pixels, by default those of ``quality``. With uniform sampling, which is the
    default if ``samples`` are given, all other pixels have as many.
    """
    preset = QUALITIES[quality or DEFAULT_QUALITY]
    steel_samples = preset.steel_samples if samples is None else samples
    is_uniform = (sampling or (STEEL_FIRST if samples is None else UNIFORM)) == UNIFORM
    return replace(
        preset,
        samples=steel_samples if is_uniform else min(preset.samples, steel_samples),
        steel_samples=steel_samples,
    )
