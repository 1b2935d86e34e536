"""From the colours with which a frame of a video is tagged to sRGB, as a player shows them.

Numbers are code points of ITU-T H.273. Transfer: BT.709 and its kin are shown as sRGB, as players
do; PQ (SMPTE ST 2084) and HLG (ARIB STD-B67, system gamma 1.2) become light of a display of 1,000
cd/m2, of which 203 are white (ITU-R BT.2408), and what is brighter is compressed into the top of
the range.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, UInt8, UInt16

from handavatar.geometry.colors import eight_bits, linear_from_srgb, srgb_from_linear

UNSPECIFIED = 2
_RGB, _BT709, _FCC, _BT470BG, _SMPTE170M = 0, 1, 4, 5, 6
_SMPTE240M, _YCGCO, _BT2020, _BT2020_CL, _DERIVED = 7, 8, 9, 10, 12
_FULL_RANGE = 2
# Shares of red and blue in luma.
_LUMA = {
    _BT709: (0.2126, 0.0722),
    _FCC: (0.30, 0.11),
    _BT470BG: (0.299, 0.114),
    _SMPTE170M: (0.299, 0.114),
    _SMPTE240M: (0.212, 0.087),
    _BT2020: (0.2627, 0.0593),
    _BT2020_CL: (0.2627, 0.0593),
}
_D65, _WHITE_C, _WHITE_E, _WHITE_DCI = (
    (0.3127, 0.329),
    (0.31, 0.316),
    (1 / 3, 1 / 3),
    (0.314, 0.351),
)
# x and y of red, green, blue and white.
_PRIMARIES = {
    _BT709: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), _D65),
    4: ((0.67, 0.33), (0.21, 0.71), (0.14, 0.08), _WHITE_C),
    5: ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06), _D65),
    6: ((0.63, 0.34), (0.31, 0.595), (0.155, 0.07), _D65),
    7: ((0.63, 0.34), (0.31, 0.595), (0.155, 0.07), _D65),
    8: ((0.681, 0.319), (0.243, 0.692), (0.145, 0.049), _WHITE_C),
    9: ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046), _D65),
    10: ((1.0, 0.0), (0.0, 1.0), (0.0, 0.0), _WHITE_E),
    11: ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), _WHITE_DCI),
    12: ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), _D65),
    22: ((0.63, 0.34), (0.295, 0.605), (0.155, 0.077), _D65),
}
_GAMMA22, _GAMMA28, _LINEAR, _PQ, _DCI, _HLG = 4, 5, 8, 16, 17, 18
_SHOWN_AS_SRGB = {1, UNSPECIFIED, 6, 7, 11, 12, 13, 14, 15}
_KNOWN_TRANSFERS = _SHOWN_AS_SRGB | {_GAMMA22, _GAMMA28, _LINEAR, _PQ, _DCI, _HLG}
_NAMES = {_PQ: "PQ", _HLG: "HLG", _LINEAR: "linear light", _DCI: "DCI gamma"}
_PRIMARY_NAMES = {9: "BT.2020", 10: "XYZ", 11: "DCI P3", 12: "Display P3"}
_WHITE_NITS, _PEAK_NITS, _HLG_GAMMA = 203.0, 1000.0, 1.2
# Up to here, in units of white, nothing is compressed.
_KNEE = 0.75
_STEPS_IN, _STEPS_OUT = 4095, 16384


@dataclass(frozen=True)
class ColorTags:
    """What the numbers of a frame mean.

    Attributes:
        matrix: from RGB to the planes.
        is_full: whether all numbers are used, or 16 to 235 of 255.
        primaries: of the RGB.
        transfer: from light to its numbers.
    """

    matrix: int
    is_full: bool
    primaries: int
    transfer: int

    @classmethod
    def of_planes(
        cls,
        matrix: int,
        color_range: int,
        primaries: int,
        transfer: int,
        size: tuple[int, int],
        is_full_format: bool = False,
    ) -> "ColorTags":
        """The tags of planes of luma and colour; what is not said is guessed as players do.

        Args:
            matrix: code point.
            color_range: 2 if all numbers are used.
            primaries: code point.
            transfer: code point.
            size: width and height: large pictures without tags are BT.709, small ones BT.601.
            is_full_format: whether the format of the pixels says that all numbers are used.
        """
        if matrix in (UNSPECIFIED, _RGB):
            is_large = size[0] >= 1280 or size[1] > 576
            matrix = _BT2020 if primaries == 9 else _BT709 if is_large else _SMPTE170M
        is_full = color_range == _FULL_RANGE or is_full_format
        return cls(matrix, is_full, primaries, transfer)

    @property
    def is_high_dynamic_range(self) -> bool:
        """Whether there may be light that is brighter than white."""
        return self.transfer in (_PQ, _HLG)

    @property
    def needs_light(self) -> bool:
        """Whether colours are other than those of sRGB, so that light has to be computed."""
        is_other = self.transfer in _KNOWN_TRANSFERS - _SHOWN_AS_SRGB
        return is_other or self.primaries not in (_BT709, UNSPECIFIED)

    def notes(self) -> list[str]:
        """What a person should know about the colours; nothing where they are as usual."""
        said = []
        names = [
            table[code]
            for table, code in ((_NAMES, self.transfer), (_PRIMARY_NAMES, self.primaries))
            if code in table
        ]
        if names:
            toned = ", light beyond white is compressed" if self.is_high_dynamic_range else ""
            said.append(f"colours: {' in '.join(names)}, shown as sRGB{toned}")
        unknown = [
            f"{what} {code}"
            for what, code, known in (
                ("matrix", self.matrix, {*_LUMA, _YCGCO, _DERIVED}),
                ("primaries", self.primaries, {*_PRIMARIES, UNSPECIFIED}),
                ("transfer", self.transfer, _KNOWN_TRANSFERS),
            )
            if code not in known
        ]
        if unknown:
            said.append(f"colours: {' and '.join(unknown)} of H.273 unknown, taken as BT.709")
        return said


def srgb_from_planes(
    planes: UInt16[np.ndarray, "height width 3"], bits: int, tags: ColorTags
) -> UInt8[np.ndarray, "height width 3"]:
    """The sRGB picture of planes of luma and colour.

    Args:
        planes: Y, Cb and Cr, of ``bits`` bits in the top of 16.
        bits: of a number.
        tags: what they mean.
    """
    unit = float(1 << 8)
    full = _full_scale(bits)
    offset, gain, chroma_gain = (
        (0.0, full, full) if tags.is_full else (16 * unit, 219 * unit, 224 * unit)
    )
    rgb_from_ycc = _rgb_from_planes(tags.matrix, tags.primaries)
    scaled = rgb_from_ycc / np.array([gain, chroma_gain, chroma_gain])
    shift = scaled @ np.array([offset, 128 * unit, 128 * unit])
    rgb = planes.reshape(-1, 3).astype(np.float32) @ scaled.T.astype(np.float32)
    rgb -= shift.astype(np.float32)
    return _srgb_from_signal(rgb, tags).reshape(planes.shape)


def srgb_from_rgb(
    rgb: UInt16[np.ndarray, "height width 3"], bits: int, tags: ColorTags
) -> UInt8[np.ndarray, "height width 3"]:
    """The sRGB picture of an RGB picture of all numbers, of ``bits`` bits in the top of 16."""
    signal = rgb.reshape(-1, 3).astype(np.float32) * np.float32(1 / _full_scale(bits))
    return _srgb_from_signal(signal, tags).reshape(rgb.shape)


def _full_scale(bits: int) -> float:
    return float(((1 << bits) - 1) << (16 - bits))


def _srgb_from_signal(
    signal: Float[np.ndarray, "pixels 3"], tags: ColorTags
) -> UInt8[np.ndarray, "pixels 3"]:
    np.clip(signal, 0, 1, out=signal)
    if not tags.needs_light:
        signal *= 255
        signal += 0.5
        return signal.astype(np.uint8)
    steps = (signal * _STEPS_IN + np.float32(0.5)).astype(np.int32)
    light = _light_of_steps(tags.transfer)[steps]
    if tags.transfer == _HLG:
        luminance = light @ np.array([0.2627, 0.678, 0.0593], dtype=np.float32)
        light *= np.maximum(luminance, 1e-6)[:, None] ** np.float32(_HLG_GAMMA - 1)
        light *= np.float32(_PEAK_NITS / _WHITE_NITS)
    light = light @ _srgb_from_primaries(tags.primaries).T
    np.maximum(light, 0, out=light)
    if tags.is_high_dynamic_range:
        light *= _compression(light.max(-1))[:, None]
    np.minimum(light, 1, out=light)
    return _srgb_of_steps()[(light * _STEPS_OUT + np.float32(0.5)).astype(np.int32)]


def _compression(brightest: Float[np.ndarray, "pixels"]) -> Float[np.ndarray, "pixels"]:
    """Factors that bring light of up to the peak below white, and leave what is below the knee."""
    room = np.float32(1 - _KNEE)
    peak = np.float32((_PEAK_NITS / _WHITE_NITS - _KNEE) / room)
    above = np.maximum(brightest - np.float32(_KNEE), 0) / room
    # Slope 1 at the knee; white at the peak.
    kept = above * (1 + above / peak**2) / (1 + above)
    mapped = np.minimum(brightest, np.float32(_KNEE)) + room * np.minimum(kept, 1)
    return mapped / np.maximum(brightest, np.float32(1e-6))


@lru_cache(maxsize=8)
def _light_of_steps(transfer: int) -> Float[np.ndarray, "steps"]:
    """Light of all numbers: relative to white, or of the scene for HLG."""
    signal = np.linspace(0, 1, _STEPS_IN + 1)
    if transfer == _PQ:
        m1, m2 = 2610 / 16384, 2523 / 4096 * 128
        c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
        root = signal ** (1 / m2)
        light = (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) * 10000 / _WHITE_NITS
    elif transfer == _HLG:
        a = 0.17883277
        b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    elif transfer in (_GAMMA22, _GAMMA28):
        light = signal ** (2.2 if transfer == _GAMMA22 else 2.8)
    elif transfer == _LINEAR:
        light = signal
    elif transfer == _DCI:
        light = 52.37 / 48 * signal**2.6
    else:
        light = linear_from_srgb(torch.from_numpy(signal)).numpy()
    return light.astype(np.float32)


@lru_cache(maxsize=1)
def _srgb_of_steps() -> UInt8[np.ndarray, "steps"]:
    light = torch.from_numpy(np.linspace(0, 1, _STEPS_OUT + 1))
    return eight_bits(srgb_from_linear(light)).numpy()


def _rgb_from_planes(matrix: int, primaries: int) -> Float[np.ndarray, "3 3"]:
    """From luma in [0, 1] and colour in [-0.5, 0.5]."""
    if matrix == _YCGCO:
        return np.array([[1.0, -1, 1], [1, 1, 0], [1, -1, -1]])
    if matrix == _DERIVED:
        luminance = _xyz_from_primaries(primaries)[1]
        red, blue = float(luminance[0]), float(luminance[2])
    else:
        red, blue = _LUMA.get(matrix, _LUMA[_BT709])
    green = 1 - red - blue
    to_red, to_blue = 2 * (1 - red), 2 * (1 - blue)
    return np.array(
        [[1, 0, to_red], [1, -to_blue * blue / green, -to_red * red / green], [1, to_blue, 0]]
    )


@lru_cache(maxsize=8)
def _srgb_from_primaries(primaries: int) -> Float[np.ndarray, "3 3"]:
    """Linear light of other primaries in those of sRGB; white stays white (Bradford)."""
    bradford = np.array(
        [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
    )
    xyz = _xyz_from_primaries(primaries)
    srgb = _xyz_from_primaries(_BT709)
    cones = (bradford @ srgb.sum(1)) / (bradford @ xyz.sum(1))
    adapted = np.linalg.solve(bradford, cones[:, None] * (bradford @ xyz))
    return np.linalg.solve(srgb, adapted).astype(np.float32)


def _xyz_from_primaries(primaries: int) -> Float[np.ndarray, "3 3"]:
    *corners, white = _PRIMARIES.get(primaries, _PRIMARIES[_BT709])
    places = np.array([[x, y, 1 - x - y] for x, y in corners]).T
    x, y = white
    scale = np.linalg.solve(places, np.array([x / y, 1, (1 - x - y) / y]))
    return places * scale
