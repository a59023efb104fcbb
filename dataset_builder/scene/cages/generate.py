"""Generator of reinforcement cages from a seed: a design of a family, the cage as it was built, its assembly."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, ribs_per_row
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.cages.as_built import BuiltBar, build_as, lowest_steel_m
from dataset_builder.scene.cages.design import Design, InfeasibleError
from dataset_builder.scene.cages.families.beams import beam, joint
from dataset_builder.scene.cages.families.columns import column, pile_cage
from dataset_builder.scene.cages.families.mats import footing, slab
from dataset_builder.scene.cages.families.walls import wall
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.specs.config_specs import CAGES_VERSION, GeneratedCageSpec
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.data.bars import Bar

MAX_BARS = 200
"""Largest number of bars of a design, which bounds the time to generate and to render a cage."""

MAX_ATTEMPTS = 200
"""Number of designs that are drawn before a cage is given up."""

MAX_RIBS = 3000
"""Largest number of ribs in one row of all bars of a cage with ribs.

Hundreds of cages have a mesh each: this number makes about 1.2 million triangles.
"""


@dataclass(frozen=True)
class Family:
    """Family of cages: a function that draws a design of a shape, and the shapes.

    ``draw`` raises ``InfeasibleError`` for drawn parameters that do not fit.
    """

    draw: Callable[[np.random.Generator, str], Design]
    shapes: tuple[str, ...]


FAMILIES: Mapping[str, Family] = {
    "column": Family(column, ("square", "rectangular", "round-ties", "spiral")),
    "beam": Family(beam, ("straight", "hooked")),
    "wall": Family(wall, ("plain", "laps", "u-bars")),
    "slab": Family(slab, ("two-mats",)),
    "footing": Family(footing, ("bobs", "full-height")),
    "pile-cage": Family(pile_cage, ("spiral", "rings")),
    "joint": Family(joint, ("corner", "passing")),
}
"""Families by name."""


@dataclass(frozen=True, eq=False)
class GeneratedCage:
    """Cage of a family, centred above the world's origin: its bars, and a record of how it was generated.

    ``record`` holds the parameters of the design, the bars that were left out with their nominal axes, the
    deviations of its mats, the number of doubled bars, and how many designs and deviations were refused, as JSON
    values. ``mats`` has for each mat the least and the largest deviation of its cover, their tolerances, the class
    of these, and whether the mat was drawn beyond them.
    """

    family: str
    bars: tuple[BuiltBar, ...]
    record: dict[str, Any]


def drawn_family(split: str, number: int, seed: int = 0) -> str:
    """Return the family that ``generate_cage`` draws for cage ``number`` of a split, without making the cage.

    Raises ``InputError`` for an unknown split or a negative number.
    """
    return _drawn_family(_cage_rng(split, number, seed))


def generate_cage(split: str, number: int, seed: int = 0, family: str | None = None) -> GeneratedCage:
    """Return cage ``number`` of a split; the same arguments give the same cage, whatever other cages there are.

    ``family`` restricts the draw to one of ``FAMILIES``. Raises ``InputError`` for an unknown split or family, a
    negative number, and if no design can be built in ``MAX_ATTEMPTS`` attempts.
    """
    if family not in (None, *FAMILIES):
        raise InputError(f"the family of a cage is {family!r}, expected one of {', '.join(FAMILIES)}")
    rng = _cage_rng(split, number, seed)
    drawn = _drawn_family(rng)
    chosen = drawn if family is None else family
    shapes = FAMILIES[chosen].shapes
    shape = shapes[int(rng.integers(len(shapes)))]
    refused: Counter[str] = Counter()
    for _ in range(MAX_ATTEMPTS):
        try:
            design = FAMILIES[chosen].draw(rng, shape)
            if len(design.bars) > MAX_BARS:
                raise InfeasibleError("too many bars")
            built = build_as(design, rng)
        except InfeasibleError as error:
            refused[str(error)] += 1
            continue
        except ValueError as error:
            refused[f"a bar cannot be bent: {str(error).split()[0]}"] += 1
            continue
        offset_m = _offset_m(design)
        record = {
            "family": design.family,
            "parameters": design.parameters,
            "left_out": [
                {
                    "role": bar.role,
                    "diameter_m": bar.diameter_m,
                    "nominal_axis": _placed(bar.line_m, offset_m).tolist(),
                }
                for bar in built.left_out
            ],
            "mats": list(built.mats),
            "doubled": built.doubled,
            "deviations_reduced": built.deviations_reduced,
            "deviations_refused": built.deviations_refused,
            "designs_refused": dict(sorted(refused.items())),
        }
        return GeneratedCage(design.family, tuple(_moved(bar, offset_m) for bar in built.bars), record)
    reasons = ", ".join(f"{reason} ({count})" for reason, count in refused.most_common(3))
    raise InputError(
        f"no cage of the family {chosen}, shape {shape}, for {split} {number}, seed {seed}: {reasons}"
    )


def _cage_rng(split: str, number: int, seed: int) -> np.random.Generator:
    """Return the generator of a cage, whose seed is a digest of all that identifies the cage.

    NumPy joins the 32-bit words of several seeds without their lengths, so that ``[seed, split, number]`` with a
    seed past 32 bits could be those of another split.
    """
    if split not in SPLITS:
        raise InputError(f"the split of a cage is {split!r}, expected one of {', '.join(SPLITS)}")
    if number < 0:
        raise InputError(f"the number of a cage is {number}, expected 0 or more")
    name = f"cage version {CAGES_VERSION} seed {seed} split {split} number {number}"
    return np.random.default_rng(int.from_bytes(sha256(name.encode()).digest(), "little"))


def _drawn_family(rng: np.random.Generator) -> str:
    """Return the family of a cage, the first that is drawn from its generator."""
    return list(FAMILIES)[int(rng.integers(len(FAMILIES)))]


def _offset_m(design: Design) -> Float64[ndarray, " 3"]:
    """Return the displacement that centres a design above the origin and sets its lowest steel at ``ground_m``."""
    points = np.concatenate([bar.line_m for bar in design.bars])
    lowest_m = min(lowest_steel_m(bar.line_m, bar.diameter_m) for bar in design.bars)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.array([-round(float(middle[0]), 3), -round(float(middle[1]), 3), design.ground_m - lowest_m])


def _moved(bar: BuiltBar, offset_m: Float64[ndarray, " 3"]) -> BuiltBar:
    nominal_m = None if bar.nominal_m is None else _placed(bar.nominal_m, offset_m)
    return BuiltBar(bar.role, bar.diameter_m, _placed(bar.line_m, offset_m), nominal_m)


def _placed(line_m: Float64[ndarray, "n 3"], offset_m: Float64[ndarray, " 3"]) -> Float64[ndarray, "n 3"]:
    """Return a displaced line, rounded to the nanometre.

    Products of matrices and sines differ in the last bit between processors; the rounded line does not. Adding
    zero removes the sign of zeros.
    """
    return np.asarray(np.round(line_m + offset_m, 9) + 0.0)


def spec_cage(spec: GeneratedCageSpec) -> GeneratedCage:
    """Return the cage of a spec.

    Raises ``InputError`` if the spec is of another version of the generator, and as ``generate_cage``.
    """
    if spec.version != CAGES_VERSION:
        raise InputError(f"the cage is of version {spec.version} of the generator, expected {CAGES_VERSION}")
    return generate_cage(spec.split, spec.number, spec.seed, spec.family)


def cage_assembly(cage: GeneratedCage) -> Assembly:
    """Return the bars of a generated cage, numbered from 1 in the order of the generator, and their meshes."""
    bars = cage_bars(cage)
    is_ribbed = sum(map(ribs_per_row, bars)) <= MAX_RIBS
    return Assembly.from_meshes((bar.bar, _rounded(bar_mesh(replace(bar, ribs=is_ribbed)))) for bar in bars)


def _rounded(mesh: Mesh) -> Mesh:
    """Return a mesh with vertices rounded to the nanometre, which are the same on every processor."""
    return Mesh(np.round(mesh.vertices_m, 9) + 0.0, mesh.faces)


def cage_bars(cage: GeneratedCage) -> tuple[CageBar, ...]:
    """Return the bars of a generated cage as built, numbered from 1 in their order."""
    return tuple(CageBar(f"bar {number}", _bar(number, bar)) for number, bar in enumerate(cage.bars, start=1))


def _bar(number: int, bar: BuiltBar) -> Bar:
    nominal_m = () if bar.nominal_m is None else axis_of(bar.nominal_m)
    return Bar(number, bar.role, bar.diameter_m, axis_of(bar.line_m), nominal_m)
