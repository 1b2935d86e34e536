"""Masks that the user gives find their pictures, or are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_hands import CORNER, PICTURE, SIDE, made_hand
from PIL import Image
from videos import save_video

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling
from handavatar.capture.given_masks import give_masks, read_mask
from handavatar.capture.left_out import NO_MASK
from handavatar.capture.masks import HandMask
from handavatar.capture.tracking import Track

COUNT = 6


def _track(side: str = "right") -> Track:
    hands = [
        replace(made_hand(number % 3)[0], index=number, time=number / 10) for number in range(COUNT)
    ]
    if side == "left":
        hands = [hand.mirrored() for hand in hands]
    return Track(side, tuple(hands), {}, PICTURE)


def _whole(number: int) -> np.ndarray:
    """The true mask in the whole picture, 0 and 255."""
    mask = np.zeros((PICTURE[1], PICTURE[0]), dtype=np.uint8)
    x, y = (int(at) for at in CORNER)
    rows, columns = slice(max(0, y), y + SIDE), slice(max(0, x), x + SIDE)
    own = made_hand(number % 3)[1][max(0, -y) :, max(0, -x) :]
    part = mask[rows, columns]
    part[:] = 255 * own[: part.shape[0], : part.shape[1]]
    return mask


def _given(
    folder: Path, names: dict[int, str] | None = None, side: str = "right"
) -> tuple[Track, list[HandMask]]:
    return give_masks(_track(side), folder, names or {}, Sampling(), lambda image: image)


def _save(folder: Path, name: str = "{:04d}.png", first: int = 0, count: int = COUNT) -> Path:
    folder.mkdir(exist_ok=True)
    for number in range(count):
        Image.fromarray(_whole(number)).save(folder / name.format(number + first))
    return folder


def _check(masks: list[HandMask], side: str = "right") -> None:
    assert len(masks) == COUNT
    for number, mask in enumerate(masks):
        truth = made_hand(number % 3)[1]
        truth = truth[:, ::-1] if side == "left" else truth
        assert (mask.pixels != truth).mean() < 0.002 and truth.mean() > 0.05
        assert ((mask.level > 0.5) == mask.pixels).all()


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("first", [0, 1])
def test_masks_belong_to_a_video_s_frames_by_their_numbers(
    tmp_path: Path, first: int, side: str
) -> None:
    track, masks = _given(_save(tmp_path / "masks", first=first), side=side)
    assert track.skipped == {}
    _check(masks, side)


@pytest.mark.parametrize("ending", ["frame_{:02d}.png", "frame_{:02d}.jpg.png"])
def test_masks_belong_to_pictures_by_their_names(tmp_path: Path, ending: str) -> None:
    # Pictures in another order than their numbers.
    names = {number: f"frame_{number:02d}.jpg" for number in range(COUNT)}
    _check(_given(_save(tmp_path / "masks", ending), names)[1])


def test_pictures_without_a_mask_are_left_out_by_that_name(tmp_path: Path) -> None:
    names = {number: f"frame_{number:02d}.jpg" for number in range(COUNT)}
    track, masks = _given(_save(tmp_path / "masks", "frame_{:02d}.png", count=4), names)
    assert track.skipped == {4: NO_MASK, 5: NO_MASK}
    assert [hand.index for hand in track.hands] == [0, 1, 2, 3] and len(masks) == 4


def test_masks_may_be_a_video(tmp_path: Path) -> None:
    pictures = [np.repeat(_whole(number)[..., None], 3, axis=2) for number in range(COUNT)]
    video = save_video(tmp_path / "masks.mp4", pictures, fps=10)
    track, masks = give_masks(_track(), video, {}, Sampling(fps=10.0), lambda image: image)
    assert track.skipped == {}
    for number, mask in enumerate(masks):
        assert (mask.pixels != made_hand(number % 3)[1]).mean() < 0.01


def test_a_video_of_other_times_is_refused(tmp_path: Path) -> None:
    pictures = [np.repeat(_whole(number)[..., None], 3, axis=2) for number in range(COUNT)]
    video = save_video(tmp_path / "masks.mp4", pictures, fps=5)
    with pytest.raises(CaptureError, match="the same frames at the same times"):
        give_masks(_track(), video, {}, Sampling(fps=10.0), lambda image: image)


@pytest.mark.parametrize("kind", ["one", "labels", "alpha", "large"])
def test_masks_of_other_programs_are_read(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "masks"
    folder.mkdir()
    for number in range(COUNT):
        mask = _whole(number)
        if kind == "one":
            picture = Image.fromarray(mask // 255)
        elif kind == "labels":
            picture = Image.fromarray((mask > 0).astype(np.uint8) * np.uint8(3), "P")
            picture.putpalette([value for level in range(256) for value in (level, 0, 0)])
        elif kind == "alpha":
            picture = Image.new("RGB", PICTURE, (200, 150, 120))
            picture.putalpha(Image.fromarray(mask))
        else:
            picture = Image.fromarray(mask).resize((2 * PICTURE[0], 2 * PICTURE[1]))
        picture.save(folder / f"{number}.png")
    _check(_given(folder)[1])


def test_masks_that_are_wrong_are_refused(tmp_path: Path) -> None:
    folder = _save(tmp_path / "few", count=4)
    with pytest.raises(CaptureError, match="0 to 3; those of the video's frames go from 0 or 1"):
        _given(folder)
    folder = _save(tmp_path / "other", "{:03d}.png", first=100)
    with pytest.raises(CaptureError, match="numbers 100 to 105"):
        _given(folder)
    with pytest.raises(CaptureError, match="no mask for any of the 6 pictures"):
        _given(folder, {number: f"frame_{number}.jpg" for number in range(COUNT)})
    folder = _save(tmp_path / "inverted")
    for file in folder.iterdir():
        Image.fromarray(255 - np.asarray(Image.open(file))).save(file)
    with pytest.raises(CaptureError, match="lie in its masks") as caught:
        _given(folder)
    assert "white has to be the hand" in caught.value.remedy
    folder = _save(tmp_path / "shape")
    for file in folder.iterdir():
        Image.open(file).resize((400, 300)).save(file)
    with pytest.raises(CaptureError, match="masks of 400 x 300 for pictures of 400 x 400"):
        _given(folder)
    folder = _save(tmp_path / "named", "mask_{:c}.png", first=97)
    with pytest.raises(CaptureError, match="no number in its name"):
        _given(folder)
    picture = Image.fromarray(np.tile(np.arange(4, dtype=np.uint8), (400, 100)), "P")
    picture.putpalette([0] * 768)
    folder = _save(tmp_path / "several")
    picture.save(folder / "0000.png")
    with pytest.raises(CaptureError, match="labels 1, 2, 3: several objects"):
        _given(folder)


@pytest.mark.parametrize("mode", ["L", "P", "LA", "RGBA"])
def test_a_damaged_mask_is_refused_by_name(tmp_path: Path, mode: str) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64), dtype=np.uint8)
    file = tmp_path / "0.png"
    Image.fromarray(noise).convert(mode).save(file)
    file.write_bytes(file.read_bytes()[:1500])
    with pytest.raises(CaptureError, match=r"0\.png is damaged"):
        read_mask(file)
