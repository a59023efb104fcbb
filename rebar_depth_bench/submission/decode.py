"""The formats of a view's entry, by suffix: how large one may be, and how it becomes depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from rebar_depth_bench.submission.exr import decode_exr, max_exr_bytes
from rebar_depth_bench.submission.npy import Depth, decode_npy, max_npy_bytes
from rebar_depth_bench.submission.npz import decode_npz, max_npz_bytes
from rebar_depth_bench.submission.png import decode_png, max_png_bytes


@dataclass(frozen=True, slots=True)
class Format:
    """``decode(name, data, (H, W), depth_scale)``, which raises ``EntryError``, and the bound on its data."""

    decode: Callable[[str, memoryview, tuple[int, int], float], Depth]
    max_bytes: Callable[[tuple[int, int]], int]


__all__ = ["FORMATS", "Depth", "Format"]

FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        ".npy": Format(decode_npy, max_npy_bytes),
        ".npz": Format(decode_npz, max_npz_bytes),
        ".exr": Format(decode_exr, max_exr_bytes),
        ".png": Format(decode_png, max_png_bytes),
    }
)
