"""What stands behind the hand in a made video: pictures in linear light, made of noise."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, Float64
from scipy import ndimage

Background = Literal["plain", "cloth", "room", "skin", "wood"]
BACKGROUNDS: tuple[Background, ...] = get_args(Background)


def paint_background(
    kind: Background, height: int, width: int, random: np.random.Generator
) -> Float32[np.ndarray, "height width 3"]:
    """A background, linear light, mostly within 0.02 and 0.8.

    Args:
        kind: a wall, patterned cloth, a room out of focus, a wall in the colour of skin, or boards.
        height: pixels.
        width: pixels.
        random: draws colours and patterns.
    """
    painters = {
        "plain": _plain,
        "cloth": _cloth,
        "room": _room,
        "skin": _skin,
        "wood": _wood,
    }
    stored = painters[kind](height, width, random)
    # Lamps leave the corners darker.
    y, x = np.mgrid[0:height, 0:width] / max(height, width)
    off = np.hypot(x - random.uniform(0.2, 0.6), y - random.uniform(0.1, 0.5))
    shade = 1 - random.uniform(0.15, 0.35) * off**2
    return (shade[..., None] * stored.clip(0.02, 0.97) ** 2.2).astype(np.float32)


def _noise(
    height: int, width: int, wavelength: tuple[float, float], random: np.random.Generator
) -> Float64[np.ndarray, "height width"]:
    """Smooth noise of deviation one; wavelengths down and across, pixels."""
    field = random.standard_normal((height, width))
    smooth = ndimage.gaussian_filter(field, [length / 3 for length in wavelength], mode="wrap")
    return smooth / smooth.std()


def _flat(color: tuple[float, float, float], height: int, width: int) -> np.ndarray:
    return np.broadcast_to(np.array(color), (height, width, 3)).copy()


def _plain(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    grey = random.uniform(0.55, 0.8)
    tint = random.uniform(-0.06, 0.06, 3)
    picture = _flat((grey + tint[0], grey + tint[1], grey + tint[2]), height, width)
    picture += 0.008 * _noise(height, width, (6.0, 6.0), random)[..., None]
    return picture + 0.012 * _noise(height, width, (160.0, 160.0), random)[..., None]


def _cloth(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[0:height, 0:width].astype(float)
    fold = 9 * _noise(height, width, (170.0, 120.0), random)
    u, v = x + fold, y + np.roll(fold, 40, 1)
    base = np.array(random.uniform((0.2, 0.3, 0.4), (0.35, 0.5, 0.6)))
    stripe = np.array(random.uniform((0.5, 0.5, 0.4), (0.8, 0.8, 0.7)))
    lines = ((np.sin(2 * np.pi * u / 61) > 0.75) | (np.sin(2 * np.pi * v / 61) > 0.75)) * 0.7
    soft = ndimage.gaussian_filter(lines, 1.2)[..., None]
    weave = 0.03 * np.sin(2 * np.pi * u / 3.1) * np.sin(2 * np.pi * v / 3.1)
    crease = 0.05 * _noise(height, width, (90.0, 60.0), random)
    return base * (1 - soft) + stripe * soft + (weave + crease)[..., None]


def _room(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    picture = _flat((0.62, 0.58, 0.52), height, width)
    for _ in range(26):
        top, left = random.integers(-40, height), random.integers(-40, width)
        tall, wide = random.integers(24, height // 2), random.integers(16, width // 3)
        color = 0.35 * random.uniform(0.05, 0.95, 3) + 0.65 * random.uniform(0.1, 0.9)
        picture[max(top, 0) : top + tall, max(left, 0) : left + wide] = color
    blurred = ndimage.gaussian_filter(picture, (2.5, 2.5, 0))
    return blurred + 0.02 * _noise(height, width, (20.0, 20.0), random)[..., None]


def _skin(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    picture = _flat((0.80, 0.62, 0.51), height, width)
    picture += 0.02 * _noise(height, width, (180.0, 180.0), random)[..., None]
    return picture + 0.012 * _noise(height, width, (7.0, 7.0), random)[..., None]


def _wood(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    y = np.mgrid[0:height, 0:width][0].astype(float)
    board = np.floor(y / 118).astype(int)
    rings = y * 0.20 + 1.6 * _noise(height, width, (60.0, 420.0), random)
    grain = 0.5 + 0.5 * np.sin(rings + 2.3 * board)
    fibre = _noise(height, width, (2.0, 70.0), random)
    share = (0.55 * grain + 0.12 * fibre + 0.1 * np.array([0.3, -0.6, 0.8, -0.2, 0.5])[board % 5])[
        ..., None
    ]
    light, dark = np.array((0.68, 0.48, 0.31)), np.array((0.42, 0.26, 0.15))
    picture = light * (1 - share) + dark * share
    joint = np.abs(y % 118 - 59) > 57.8
    return picture * np.where(joint, 0.45, 1.0)[..., None]
