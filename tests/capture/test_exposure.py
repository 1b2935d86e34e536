"""Exposure and white balance are read from the background, in light and not in stored values."""

import numpy as np
import pytest
from made_hands import PICTURE, made_hand

from handavatar.capture.exposure import exposure_gains
from handavatar.capture.tracking import Glance, TrackedHand

HANDS = [made_hand(number)[0] for number in range(6)]
LIGHT_GAINS = np.array(
    [
        [1.0, 1.0, 1.0],
        [1.2, 1.1, 1.0],
        [0.8, 0.8, 0.85],
        [1.0, 0.9, 1.1],
        [1.1, 1.2, 1.1],
        [1, 1, 1],
    ]
)


def _stored(light: np.ndarray) -> np.ndarray:
    light = light.clip(0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def _glances(gains: np.ndarray, noise: float = 0.0, shown: slice = slice(None)) -> list[Glance]:
    """A wall of many greys; only ``shown`` of its columns is not black."""
    generator = np.random.default_rng(0)
    wall = generator.uniform(0.05, 0.5, (80, 80, 3))
    glances = []
    for number, gain in enumerate(gains):
        light = wall * gain
        if noise:
            light = generator.uniform(0.05, 0.5, (80, 80, 3)) * noise + light * (1 - noise)
        picture = np.zeros_like(light)
        picture[:, shown] = light[:, shown]
        # Where the hand is: bright, and brighter in every picture.
        (left, top), (right, bottom) = (
            (edge * 80 / PICTURE[0]).astype(int)
            for edge in (HANDS[number].landmarks.min(0), HANDS[number].landmarks.max(0))
        )
        picture[top:bottom, left:right] = 0.1 + 0.1 * number
        image = (255 * _stored(picture)).round().astype(np.uint8)
        glances.append(Glance(number, number / 10, image))
    return glances


def _expected(gains: np.ndarray) -> np.ndarray:
    logarithms = np.log(gains)
    return np.exp((logarithms - logarithms.mean(0)) / 2.2)


def test_gains_of_a_made_camera_are_found_again() -> None:
    found = exposure_gains(_glances(LIGHT_GAINS), HANDS, PICTURE)
    assert np.abs(found / _expected(LIGHT_GAINS) - 1).max() < 0.01
    assert np.exp(np.log(found).mean(0)) == pytest.approx(np.ones(3))
    # What the factor means: stored values of the average picture times it are those of the picture.
    light = np.array([0.1, 0.2, 0.4])
    assert np.abs(_stored(1.2 * light) / _stored(light) / 1.2 ** (1 / 2.2) - 1).max() < 0.02


def test_hardly_any_background_says_hardly_anything() -> None:
    few = exposure_gains(_glances(LIGHT_GAINS, shown=slice(0, 1)), HANDS, PICTURE)
    all_of_it = exposure_gains(_glances(LIGHT_GAINS), HANDS, PICTURE)
    assert np.abs(np.log(few)).max() < np.abs(np.log(all_of_it)).max()
    none = exposure_gains(_glances(LIGHT_GAINS, shown=slice(0, 0)), HANDS, PICTURE)
    assert (none == 1).all()


def test_a_background_that_changes_by_itself_is_believed_less() -> None:
    moving = exposure_gains(_glances(np.ones((6, 3)), noise=0.9), HANDS, PICTURE)
    assert np.abs(np.log(moving)).max() < 0.03


@pytest.mark.parametrize("hands", [[], HANDS])
def test_without_pictures_all_gains_are_one(hands: list[TrackedHand]) -> None:
    assert (exposure_gains([], hands, PICTURE) == np.ones((len(hands), 3))).all()
