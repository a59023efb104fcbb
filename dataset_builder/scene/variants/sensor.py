"""Sensor model of the variant ``sensor``: vignetting, shot and read noise, Bayer mosaic and JPEG compression.

The model works on the 8-bit picture of the renderer, as if a noise-free camera had encoded it with the sRGB curve:
decoding this curve gives the signal, which saturates at white. This is an approximation. The renderer's view
transform (AgX) compresses highlights more than the sRGB curve does, so that highlights get a smaller signal, and
relatively more noise, than in a camera that is exposed for them.

The noise is that of the linear camera model of EMVA 1288 (release 3.1, section 2; also Foi et al., "Practical
Poissonian-Gaussian noise modeling and fitting for single-image raw-data", IEEE TIP 17(10), 2008). The variance of
a raw value is ``K * signal + (K * read noise)^2 + 1/12``, all in digital numbers, with the system gain K.

There is no denoising, sharpening, colour matrix or fixed pattern. The vignetting is centred on the picture,
wherever the principal point is.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8, UInt16
from numpy import ndarray
from PIL import Image

from dataset_builder.scene.variants.registry import SENSOR
from dataset_builder.specs.config_specs import SceneSpec


@dataclass(frozen=True)
class SensorSpec:
    """Parameters of the sensor model; the values are those of an industrial camera in a dim room.

    ``saturation_e`` and ``read_noise_e`` (electrons, at 0 dB) follow from what the manual of the mvBlueFOX3-2051
    states for the Sony IMX250 (12 bits, 3.45 um pixels), measured after EMVA 1288: a largest signal-to-noise ratio
    of 40.3 dB, whose square is the saturation capacity, and a dynamic range of 71.2 dB, hence a threshold of 2.95
    electrons, which is ``sqrt(noise^2 + quantisation^2 + 1/4) + 1/2``. ``gain_db`` is an assumption, for short
    exposures indoors; cameras with such sensors go up to 48 dB (FLIR Blackfly S). ``black_level_dn``
    is that of the raw files of the Sony IMX477 in the Raspberry Pi HQ camera.

    ``corner_illumination`` is the illumination of the corners relative to the centre, an assumption: the cos^4 law
    gives 0.23 at the field angle of the ideal rig, and lenses of such angles are built to lose less.
    ``demosaicing`` is OpenCV's conversion by edges. ``jpeg_quality`` is the default of ROS'
    ``compressed_image_transport``, ``jpeg_subsampling`` that of libjpeg.
    """

    saturation_e: float = 10_700.0
    read_noise_e: float = 2.3
    gain_db: float = 18.0
    adc_bits: int = 12
    black_level_dn: int = 256
    demosaicing: str = "COLOR_BayerRGGB2RGB_EA"
    corner_illumination: float = 0.6
    jpeg_quality: int = 80
    jpeg_subsampling: str = "4:2:0"

    @property
    def white_dn(self) -> int:
        """Largest raw value, at which the signal saturates."""
        return int(2**self.adc_bits - 1)

    @property
    def white_e(self) -> float:
        """Electrons at which the signal saturates, at the gain."""
        return float(self.saturation_e / 10 ** (self.gain_db / 20))

    @property
    def dn_per_e(self) -> float:
        """System gain K, digital numbers per electron."""
        return (self.white_dn - self.black_level_dn) / self.white_e


def sensor_spec(scene: SceneSpec) -> SensorSpec | None:
    """Return the sensor of a scene, None without the variant ``sensor``."""
    return SensorSpec() if SENSOR in scene.appearance.variants else None


def recorded(rgb: UInt8[ndarray, "h w 3"], scene: SceneSpec, seed: int) -> UInt8[ndarray, "h w 3"]:
    """Return the picture as the sensor of the scene records it; without a sensor it is unchanged."""
    spec = sensor_spec(scene)
    return rgb if spec is None else apply_sensor(rgb, spec, seed)


def apply_sensor(rgb: UInt8[ndarray, "h w 3"], spec: SensorSpec, seed: int) -> UInt8[ndarray, "h w 3"]:
    """Return the 8-bit sRGB picture as the sensor records it; ``seed`` determines its noise."""
    height, width = rgb.shape[:2]
    signal = linear_from_srgb(rgb) * illumination(height, width, spec)[..., None]
    raw_dn = expose(bayer_mosaic(signal), spec, np.random.default_rng(seed))
    return _jpeg(_srgb_from_linear(demosaic(raw_dn, spec)), spec)


def linear_from_srgb(rgb: UInt8[ndarray, "h w 3"]) -> Float64[ndarray, "h w 3"]:
    """Return the linear signal of 8-bit sRGB values, white is 1."""
    encoded = np.arange(256) / 255
    table = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.asarray(table[rgb])


def _srgb_from_linear(signal: Float64[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    bounded = np.clip(signal, 0.0, 1.0)
    encoded = np.where(bounded <= 0.0031308, 12.92 * bounded, 1.055 * bounded ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * encoded), dtype=np.uint8)


def illumination(height: int, width: int, spec: SensorSpec) -> Float64[ndarray, "h w"]:
    """Return the illumination of each pixel relative to the centre of the picture.

    It is cos^4 of the field angle of an ideal lens whose corner pixels get ``spec.corner_illumination``.
    """
    v, u = np.ogrid[:height, :width]
    v, u = v - (height - 1) / 2, u - (width - 1) / 2
    share = (u * u + v * v) / (((height - 1) ** 2 + (width - 1) ** 2) / 4)
    squared_tangent = spec.corner_illumination**-0.5 - 1
    return np.asarray((1 + share * squared_tangent) ** -2.0)


def bayer_mosaic(signal: Float64[ndarray, "h w 3"]) -> Float64[ndarray, "h w"]:
    """Return the channel of each pixel behind an RGGB filter, whose first pixel is red."""
    mosaic = signal[..., 1].copy()
    mosaic[0::2, 0::2] = signal[0::2, 0::2, 0]
    mosaic[1::2, 1::2] = signal[1::2, 1::2, 2]
    return mosaic


def expose(
    signal: Float64[ndarray, "h w"], spec: SensorSpec, random: np.random.Generator
) -> UInt16[ndarray, "h w"]:
    """Return the raw values of a signal, 1 saturates: Poisson electrons, normal read noise, quantisation."""
    electrons = random.poisson(signal * spec.white_e) + random.normal(0.0, spec.read_noise_e, signal.shape)
    raw_dn = np.rint(spec.black_level_dn + spec.dn_per_e * electrons)
    return np.asarray(np.clip(raw_dn, 0, spec.white_dn), dtype=np.uint16)


def demosaic(raw_dn: UInt16[ndarray, "h w"], spec: SensorSpec) -> Float64[ndarray, "h w 3"]:
    """Return the linear signal of all channels, interpolated by ``spec.demosaicing``; black is 0.

    A mirrored border keeps the filter's pattern and replaces OpenCV's copies of the second rows and columns.
    """
    # Plans of builds and imports, which read the specs, run without the extra ``build``.
    import cv2

    border, unused_bits = 2, 16 - spec.adc_bits
    mirrored = np.pad(raw_dn << unused_bits, border, mode="reflect")
    rgb = cv2.demosaicing(mirrored, getattr(cv2, spec.demosaicing))[border:-border, border:-border]
    return np.asarray((rgb / 2.0**unused_bits - spec.black_level_dn) / (spec.white_dn - spec.black_level_dn))


def _jpeg(rgb: UInt8[ndarray, "h w 3"], spec: SensorSpec) -> UInt8[ndarray, "h w 3"]:
    """Return the picture after JPEG compression."""
    stream = io.BytesIO()
    Image.fromarray(rgb).save(stream, "JPEG", quality=spec.jpeg_quality, subsampling=spec.jpeg_subsampling)
    return np.array(Image.open(stream), dtype=np.uint8)
