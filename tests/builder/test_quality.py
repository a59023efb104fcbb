"""Quality presets and sampling options: the samples they select, and combinations that are refused."""

from __future__ import annotations

import pytest

from dataset_builder.specs.config_specs import DEFAULT_QUALITY, QUALITIES, SAMPLINGS, ColourSpec, colour_spec


def test_default_is_the_standard_preset() -> None:
    assert colour_spec() == QUALITIES[DEFAULT_QUALITY] == ColourSpec()


@pytest.mark.parametrize("quality", QUALITIES)
def test_presets_sample_steel_more_often(quality: str) -> None:
    spec = colour_spec(quality=quality)
    assert spec == colour_spec("steel-first", quality)
    assert spec.samples < spec.steel_samples
    uniform = colour_spec("uniform", quality)
    assert uniform.samples == uniform.steel_samples == spec.steel_samples


def test_presets_get_better_in_order() -> None:
    specs = [colour_spec(quality=quality) for quality in ("preview", "standard", "high")]
    assert specs == sorted(specs, key=lambda spec: (spec.steel_samples, spec.samples))


def test_samples_are_uniform_unless_steel_comes_first() -> None:
    assert colour_spec(samples=50) == colour_spec("uniform", samples=50) == ColourSpec(50, 50)
    assert colour_spec("steel-first", samples=50) == ColourSpec(ColourSpec.samples, 50)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_no_pixel_has_more_samples_than_steel(sampling: str) -> None:
    assert colour_spec(sampling, samples=1) == ColourSpec(1, 1)
