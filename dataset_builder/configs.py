"""The configs this builder knows, by name, and how a request changes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from dataset_builder.specs import (
    BoardSpec,
    ColourSpec,
    ConfigSpec,
    DomeSpec,
    LatticeSpec,
    MeshFileSpec,
    RigSpec,
    RingSpec,
    SceneSpec,
)
from rebar_depth_bench.errors import InputError

LATTICE_DOME = DomeSpec(
    radii_m=(0.22, 0.30, 0.35, 0.38, 0.40, 0.42, 0.43),
    elevations_deg=(15.0, 27.0, 39.0, 51.0, 63.0, 75.0),
    azimuths=12,
)
"""The paper's 504 views at 0.22-0.43 m; far shells lie closer, so that steel covers 4.5-7.2 % of the frame."""
LATTICE_RING = RingSpec(radius_m=0.325, elevation_deg=35.0, azimuths=100)


def _lattice_scene() -> SceneSpec:
    return SceneSpec(name="lattice", assembly=LatticeSpec(), board=BoardSpec(markers=6))


CONFIGS: Mapping[str, Callable[[], ConfigSpec]] = {
    "lattice": lambda: ConfigSpec("lattice", _lattice_scene(), LATTICE_DOME),
    "lattice-orbit": lambda: ConfigSpec("lattice-orbit", _lattice_scene(), LATTICE_RING),
}


@dataclass(frozen=True)
class BuildRequest:
    """What a user asks of ``rebar-build``: which configs, how many views, at which size and quality."""

    configs: tuple[str, ...] = tuple(CONFIGS)
    views: int | None = None
    width: int = RigSpec.width
    height: int = RigSpec.height
    samples: int = ColourSpec.samples
    seed: int = 0
    mesh: MeshFileSpec | None = None

    def config_specs(self) -> list[ConfigSpec]:
        """Return the specs of the requested configs; raise ``InputError`` for an unknown one."""
        return [self._config_spec(name) for name in dict.fromkeys(self.configs)]

    def _config_spec(self, name: str) -> ConfigSpec:
        if name not in CONFIGS:
            raise InputError(f"no config {name!r}, expected one of {', '.join(CONFIGS)}")
        spec = CONFIGS[name]()
        scene = replace(spec.scene, seed=self.seed, assembly=self.mesh or spec.scene.assembly)
        return replace(
            spec,
            scene=scene,
            rig=replace(spec.rig, width=self.width, height=self.height),
            colour=replace(spec.colour, samples=self.samples),
        )


def view_id(config: str, index: int) -> str:
    """Return the id of a view: its config and its index in the full protocol."""
    return f"{config}/{index:04d}"


def check_request(request: BuildRequest) -> None:
    """Raise ``InputError`` naming every value of a request that cannot be built."""
    limits: Sequence[tuple[str, int | None, int, int]] = (
        ("--views", request.views, 1, 1_000_000),
        ("--width", request.width, 16, 8192),
        ("--height", request.height, 16, 8192),
        ("--samples", request.samples, 1, 65_536),
        ("--seed", request.seed, 0, 2**31 - 1),
    )
    wrong = [
        f"{name} is {value}, expected {low} to {high}"
        for name, value, low, high in limits
        if value is not None and not low <= value <= high
    ]
    if wrong:
        raise InputError("; ".join(wrong))
    request.config_specs()
