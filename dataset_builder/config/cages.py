"""Scenes of the config ``cages``: surroundings, appearance and stereo camera of each generated cage, from a seed.

Every scene has its own random numbers, so that it does not depend on which other scenes are built.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dataset_builder.config.specs import (
    AppearanceSpec,
    ColourSpec,
    GeneratedCageSpec,
    RandomViewsSpec,
    RigSpec,
    SceneConfigSpec,
    SceneSpec,
)
from dataset_builder.config.stereo_cameras import STEREO_CAMERAS
from dataset_builder.scene.cages.generate import drawn_family
from dataset_builder.scene.variants import SENSOR, VARIANTS
from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.view_ids import SPLITS, TEST_SPLIT

CAGES = "cages"
"""Name of the config; it is built only if it is named."""

MAX_SCENES = 10_000
MAX_VIEWS_PER_SCENE = 1000

_STREAM = 1
"""First number of the seed of a scene's random numbers; those of the cage itself begin with the version."""

_LIGHTS: Mapping[str, Sequence[str | None]] = {
    "outdoors": (None, None, None, "dusk", "backlight", "city", "courtyard", "forest", "sunrise", "sunset"),
}
"""Light variants that are drawn in each environment; None is its default light."""

_STEEL: Sequence[str | None] = (None, None, "mill-scale", "rusted", "wet")
_PROPS: Mapping[str, float] = {"clutter": 0.25, "formwork": 0.25, "spacers": 0.3, "tie-wire": 0.5}
"""Probability of each variant of things on and round the steel."""
_SENSOR_SHARE = 0.3
"""Probability of the variant of the camera's sensor."""


@dataclass(frozen=True)
class CagesRequest:
    """Request for scenes of one split: the first ``scenes`` of it, with ``views_per_scene`` views each."""

    split: str = TEST_SPLIT
    scenes: int = 40
    views_per_scene: int = 8

    def check(self) -> None:
        """Raise ``InputError`` that names every value out of range."""
        problems = []
        if self.split not in SPLITS:
            problems.append(Problem("unknown", "--split", f"got {self.split!r}", f"one of {', '.join(SPLITS)}"))
        for name, value, high in (
            ("--scenes", self.scenes, MAX_SCENES),
            ("--views-per-scene", self.views_per_scene, MAX_VIEWS_PER_SCENE),
        ):
            if not 1 <= value <= high:
                problems.append(Problem("invalid", name, f"got {value}", f"1 to {high}"))
        if problems:
            raise InputError.from_problems("build request", problems)


def cage_scenes(
    request: CagesRequest, seed: int, width: int, height: int, colour: ColourSpec | None
) -> list[SceneConfigSpec]:
    """Return the scenes of a request, without the stations of their cameras (``pipeline.place_cameras``).

    ``seed`` is that of cages, surroundings and cameras. Raises ``InputError`` for values out of range.
    """
    request.check()
    scenes = (_scene(request, number, seed) for number in range(request.scenes))
    return [replace(scene, rig=replace(scene.rig, width=width, height=height), colour=colour) for scene in scenes]


def _scene(request: CagesRequest, number: int, seed: int) -> SceneConfigSpec:
    rng = np.random.default_rng([_STREAM, seed, SPLITS.index(request.split), number])
    environment = str(rng.choice(list(_LIGHTS)))
    light, steel = (_one_of(rng, choices) for choices in (_LIGHTS[environment], _STEEL))
    drawn = {light, steel, *(name for name, share in _PROPS.items() if rng.random() < share)}
    if rng.random() < _SENSOR_SHARE:
        drawn.add(SENSOR)
    surface_seed, views_seed = (int(rng.integers(2**31)) for _ in range(2))
    scene = SceneSpec(
        name=f"{drawn_family(request.split, number, seed)}-{request.split}{number:04d}",
        assembly=GeneratedCageSpec(request.split, number, seed),
        board=None,
        environment=environment,
        appearance=AppearanceSpec(tuple(name for name in VARIANTS if name in drawn)),
        seed=surface_seed,
    )
    return SceneConfigSpec(
        name=CAGES,
        scene=scene,
        protocol=RandomViewsSpec(request.views_per_scene, seed=views_seed),
        rig=_rig(rng),
        split=request.split,
    )


def _one_of(rng: np.random.Generator, choices: Sequence[str | None]) -> str | None:
    return choices[int(rng.integers(len(choices)))]


def _rig(rng: np.random.Generator) -> RigSpec:
    return list(STEREO_CAMERAS.values())[int(rng.integers(len(STEREO_CAMERAS)))].rig()
