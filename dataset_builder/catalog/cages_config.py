"""Scenes of the config ``cages``: surroundings, appearance and stereo camera of each generated cage, from a seed.

Every scene has its own random numbers, so that it does not depend on which other scenes are built.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dataset_builder.scene.environments.surroundings import FORMWORK_FAMILIES, LIFE_SIZE_ENVIRONMENTS, SURROUNDINGS
from dataset_builder.scene.variants.registry import EXCLUSIVE_SLOTS, SENSOR, SHADOWS, VARIANTS
from dataset_builder.specs.config_specs import (
    STEREO_CAMERAS,
    AppearanceSpec,
    ColourSpec,
    GeneratedCageSpec,
    RandomViewsSpec,
    SceneConfigSpec,
    SceneSpec,
)
from rebar_depth_bench.base.names import SPLITS, TEST_SPLIT

CAGES = "cages"
"""Name of the config; it is built only if it is named."""

MAX_SCENES = 10_000
MAX_VIEWS_PER_SCENE = 1000

_STREAM = 1
"""First number of the seed of a scene's random numbers; those of the cage itself begin with the version."""

_DEFAULT_SHARE = 0.3
"""Probabilities of the default light, and of the default steel; the variants share the rest equally."""
_IN_GROUND = ("footing", "pile-cage")
"""Families that are cast in the ground, and so are not on a deck."""
FORMWORK = "formwork"
_PROPS: Mapping[str, float] = {"clutter": 0.25, FORMWORK: 0.25, "spacers": 0.3, "tie-wire": 0.5}
"""Probability of each variant of props on and round the steel."""
_SENSOR_SHARE = 0.3
"""Probability of the variant of the camera's sensor."""
_CAMERAS = (
    *("Stereolabs ZED", "Luxonis OAK-D"),
    *("Intel RealSense D415", "Intel RealSense D435", "Intel RealSense D455"),
)
"""Names of the stereo cameras that are drawn; others would change the scenes of a seed."""


@dataclass(frozen=True)
class CagesRequest:
    """Request for scenes of one split: the first ``scenes`` of it, with ``views_per_scene`` views each."""

    split: str = TEST_SPLIT
    scenes: int = 40
    views_per_scene: int = 8


def cage_scenes(
    request: CagesRequest, seed: int, width: int, height: int, colour: ColourSpec | None
) -> list[SceneConfigSpec]:
    """Return the scenes of a request, without the stations of their cameras (``pipeline.plan.place_cameras``).

    ``seed`` is that of cages, surroundings and cameras.
    """
    scenes = (_scene(request, number, seed) for number in range(request.scenes))
    return [replace(scene, rig=replace(scene.rig, width=width, height=height), colour=colour) for scene in scenes]


def _scene(request: CagesRequest, number: int, seed: int) -> SceneConfigSpec:
    from dataset_builder.scene.cages.generate import drawn_family  # Only builds of ``cages`` need the generator.

    rng = np.random.default_rng([_STREAM, seed, SPLITS.index(request.split), number])
    family = drawn_family(request.split, number, seed)
    suitable = [name for name in LIFE_SIZE_ENVIRONMENTS if name != "deck" or family not in _IN_GROUND]
    environment = str(rng.choice(suitable))
    variants = _variants(rng, environment, family)
    surface_seed, views_seed = (int(rng.integers(2**31)) for _ in range(2))
    scene = SceneSpec(
        name=f"{family}-{request.split}{number:04d}",
        assembly=GeneratedCageSpec(request.split, number, seed),
        board=None,
        environment=environment,
        appearance=AppearanceSpec(variants),
        seed=surface_seed,
    )
    return SceneConfigSpec(
        name=CAGES,
        scene=scene,
        protocol=RandomViewsSpec(request.views_per_scene, seed=views_seed),
        rig=STEREO_CAMERAS[_CAMERAS[int(rng.integers(len(_CAMERAS)))]],
        split=request.split,
    )


def _variants(rng: np.random.Generator, environment: str, family: str) -> tuple[str, ...]:
    """Return the names of drawn variants that suit the environment and the family of the cage, in their order."""
    drawn = {name for name, share in _PROPS.items() if rng.random() < share}
    if family not in FORMWORK_FAMILIES:
        drawn.discard(FORMWORK)
    if family == "slab":  # Its mats lie on blocks and chairs.
        drawn.discard("spacers")
    if rng.random() < _SENSOR_SHARE:
        drawn.add(SENSOR)
    for slot in EXCLUSIVE_SLOTS:
        choices = [name for name in SURROUNDINGS[environment].variants(slot) if name != SHADOWS]
        choice = choices[int(rng.integers(len(choices)))]
        if rng.random() >= _DEFAULT_SHARE:
            drawn.add(choice)
    return tuple(name for name in VARIANTS if name in drawn)
