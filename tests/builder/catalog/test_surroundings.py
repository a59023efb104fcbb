"""Surroundings by environment: variants that suit them, and scene files that name the hall or the deck."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.catalog.scene_file import scene_config
from dataset_builder.scene.cages.generate import FAMILIES
from dataset_builder.scene.environments.surroundings import (
    FORMWORK_FAMILIES,
    LIFE_SIZE_ENVIRONMENTS,
    SURROUNDINGS,
    check_suitable,
)
from dataset_builder.scene.variants.registry import LIGHT_SLOT, PROPS_SLOT, VARIANTS
from dataset_builder.specs.config_specs import DomeSpec, SurveySpec
from rebar_depth_bench.base.errors import InputError
from tests.builder.catalog.scene_files import BAR, MM, write_scene

SMALL_SURVEY = '[cameras]\nkind = "survey"\ndistances = [1000]\nviews_per_distance = 4\n'


def test_tables_name_environments_and_families() -> None:
    assert set(LIFE_SIZE_ENVIRONMENTS) < set(SURROUNDINGS)
    assert set(FORMWORK_FAMILIES) < set(FAMILIES)
    for name in LIFE_SIZE_ENVIRONMENTS:
        surroundings = SURROUNDINGS[name]
        assert surroundings.steel_radius_m > 3, "cages have diagonals of 5 m"
        assert set(surroundings.variants(PROPS_SLOT)) == {
            variant.name for variant in VARIANTS.values() if variant.slot == PROPS_SLOT
        }


@pytest.mark.parametrize("place", ["hall", "deck"])
def test_shadows_suit_only_places_with_room_for_the_screen(place: str, tmp_path: Path) -> None:
    assert "shadows" not in SURROUNDINGS[place].variants(LIGHT_SLOT)
    assert "dusk" in SURROUNDINGS[place].variants(LIGHT_SLOT)
    with pytest.raises(InputError) as raised:
        check_suitable(place, ("dusk", "shadows"))
    assert [(problem.code, problem.where) for problem in raised.value.problems] == [("conflict", "'shadows'")]
    config = scene_config(write_scene(tmp_path, f'environment = "{place}"\n' + MM + BAR))
    BuildRequest(configs=(), variants=("dusk",), scenes=(config,)).config_specs()
    with pytest.raises(InputError, match="laboratory, outdoors"):
        BuildRequest(configs=(), variants=("shadows",), scenes=(config,)).config_specs()


@pytest.mark.parametrize(("place", "limit_m"), [("hall", 10.4), ("deck", 8.3)])
def test_scene_file_names_hall_or_deck(place: str, limit_m: float, tmp_path: Path) -> None:
    head = f'environment = "{place}"\n' + MM
    config = scene_config(write_scene(tmp_path, head + BAR))
    assert isinstance(config.protocol, DomeSpec)
    assert (config.scene.environment, config.scene.board) == (place, None)
    ring = f'[cameras]\nkind = "ring"\nradius = {1000 * limit_m + 200:g}\nelevation_deg = 5\nazimuths = 4\n'
    with pytest.raises(
        InputError, match=rf"cameras are .* m from the world's origin, expected at most {limit_m} m in .* {place}"
    ):
        scene_config(write_scene(tmp_path, head + BAR + ring))
    high = '[cameras]\nkind = "ring"\nradius = 9000\nelevation_deg = 80\nazimuths = 4\n'
    with pytest.raises(InputError, match=r"cameras are .* m high, expected at most"):
        scene_config(write_scene(tmp_path, head + BAR + high))
    with pytest.raises(
        InputError, match=rf"the steel extends 6 m from the world's origin, expected at most 5 m in .* {place}"
    ):
        scene_config(write_scene(tmp_path, head + BAR.replace("100", "6000") + SMALL_SURVEY))


@pytest.mark.slow
def test_survey_in_the_hall_stays_below_its_ceiling(tmp_path: Path) -> None:
    """Survey a bar whose dome does not fit; half of the views above it would be above the ceiling."""
    bar = "[[bar]]\ndiameter = 32\npoints = [[0, 0, 50], [0, 0, 6000]]\n"
    survey = '[cameras]\nkind = "survey"\ndistances = [1000, 4000]\nviews_per_distance = 12\n'
    config = scene_config(write_scene(tmp_path, 'environment = "hall"\n' + MM + bar + survey))
    assert isinstance(config.protocol, SurveySpec)
    heights_m = np.array([centre_m[2] for centre_m, _ in config.protocol.stations])
    assert len(heights_m) == 24
    assert heights_m.max() <= SURROUNDINGS["hall"].cameras.ceiling_m
