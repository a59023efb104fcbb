"""Benchmark of depth and colour codecs: size and time on rendered views.

python -m benchmarks.codecs ROOT     (the rows of imagecodecs and pcodec need: pip install imagecodecs pcodec)
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

import rebar_depth_bench as rdb
from benchmarks.timing import machine_description, median_seconds, print_markdown

Codec = tuple[Callable[[Any], Any], Callable[[Any], Any]]
REPEATS = 5


def exr(compression: Any) -> Codec:
    def encode(depth_m: Any) -> bytes:
        stream = io.BytesIO()
        header = {"compression": compression, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": depth_m}, num_threads=0).write(stream)
        return stream.getvalue()

    def decode(content: bytes) -> Any:
        with OpenEXR.File(io.BytesIO(content), separate_channels=True, num_threads=0) as image:
            return image.channels()["Y"].pixels

    return encode, decode


def pillow(kind: str, **options: Any) -> Codec:
    def encode(picture: Any) -> bytes:
        stream = io.BytesIO()
        Image.fromarray(picture).save(stream, kind, **options)
        return stream.getvalue()

    return encode, lambda content: np.asarray(Image.open(io.BytesIO(content)))


def depth_codecs(shape: tuple[int, int]) -> Mapping[str, Codec]:
    tags = {317: 3, 278: shape[0]}  # TIFF tags: floating-point predictor, all rows in one strip
    codecs = {
        "EXR ZIP": exr(OpenEXR.ZIP_COMPRESSION),
        "EXR ZSTD": exr(OpenEXR.ZSTD_COMPRESSION),
        "EXR HTJ2K": exr(OpenEXR.HTJ2K256_COMPRESSION),
        "EXR PIZ": exr(OpenEXR.PIZ_COMPRESSION),
        "TIFF deflate + predictor 3, Pillow": pillow("TIFF", compression="tiff_adobe_deflate", tiffinfo=tags),
        "TIFF zstd + predictor 3, Pillow": pillow("TIFF", compression="zstd", tiffinfo=tags),
    }
    try:
        import imagecodecs
    except ImportError:
        pass
    else:
        for name, compression in (("deflate", 8), ("zstd", 50000)):
            encode = partial(imagecodecs.tiff_encode, compression=compression, predictor=3)
            codecs[f"TIFF {name} + predictor 3, imagecodecs"] = (encode, imagecodecs.tiff_decode)
    try:
        from pcodec import ChunkConfig, standalone
    except ImportError:
        pass
    else:
        codecs["pcodec"] = (
            lambda depth_m: standalone.simple_compress(depth_m.ravel(), ChunkConfig()),
            lambda content: standalone.simple_decompress(content).reshape(shape),
        )
    return codecs


def colour_codecs() -> Mapping[str, Codec]:
    codecs = {
        "PNG level 1": pillow("PNG", compress_level=1),
        "PNG level 6": pillow("PNG"),
        "PNG level 9": pillow("PNG", compress_level=9),
        "WebP lossless m0": pillow("WEBP", lossless=True, method=0),
        "WebP lossless m4": pillow("WEBP", lossless=True, method=4),
    }
    try:
        import imagecodecs
    except ImportError:
        return codecs
    codecs["QOI"] = (imagecodecs.qoi_encode, imagecodecs.qoi_decode)
    codecs["JPEG XL lossless e1"] = (
        lambda picture: imagecodecs.jpegxl_encode(picture, lossless=True, effort=1),
        imagecodecs.jpegxl_decode,
    )
    return codecs


def measure(name: str, codec: Codec, images: list[Any]) -> list[object]:
    encode, decode = codec
    coded = [encode(image) for image in images]
    exact = all(np.array_equal(decode(content), image) for content, image in zip(coded, images, strict=True))
    encode_s = median_seconds(lambda: [encode(image) for image in images], REPEATS) / len(images)
    decode_s = median_seconds(lambda: [decode(content) for content in coded], REPEATS) / len(images)
    megabytes = sum(map(len, coded)) / len(coded) / 1e6
    return [name, f"{1e3 * encode_s:.1f}", f"{1e3 * decode_s:.1f}", f"{megabytes:.2f}", "yes" if exact else "NO"]


def main(root: str) -> None:
    rows = list(rdb.load(root, "lattice", columns=["left_rgb", "left_depth"]))
    shape = rows[0]["left_depth"].shape
    print(f"{len(rows)} rendered views, medians of {REPEATS}, ms and MB per image; {machine_description()}\n")
    for title, column, codecs in (
        ("depth", "left_depth", depth_codecs(shape)),
        ("colour", "left_rgb", colour_codecs()),
    ):
        images = [row[column] for row in rows]
        table = [measure(name, codec, images) for name, codec in codecs.items()]
        print_markdown([title, "encode ms", "decode ms", "MB", "lossless"], table)
        print()


if __name__ == "__main__":
    main(sys.argv[1])
