"""Registry of the entry formats: size bound and decoder for each file suffix."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from rebar_depth_bench.submission.image_formats import decode_exr, decode_png, max_exr_bytes, max_png_bytes
from rebar_depth_bench.submission.numpy_formats import Depth, decode_npy, decode_npz, max_npy_bytes, max_npz_bytes


@dataclass(frozen=True, slots=True)
class Format:
    """Decoder and size bound of one entry format.

    ``decode(name, data, (H, W), depth_scale)`` returns the depth in metres and raises ``EntryError``;
    ``max_bytes((H, W))`` is the largest acceptable length of ``data`` in bytes.
    """

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
