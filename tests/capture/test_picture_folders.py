"""Folders and patterns of pictures."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from handavatar.capture.checks import CaptureError
from handavatar.capture.decoding import Sampling, VideoFrame
from handavatar.capture.picture_folders import frames_of


def picture(level: int, size: tuple[int, int] = (160, 120)) -> Image.Image:
    """Grey of a level, its upper half red."""
    image = np.full((size[1], size[0], 3), level, dtype=np.uint8)
    image[: size[1] // 2] = (220, 30, 40)
    return Image.fromarray(image)


def read(source: Path, **sampling: float) -> tuple[list[VideoFrame], list[str]]:
    notes: list[str] = []
    return list(frames_of(source, Sampling(**sampling), notes.append)), notes  # type: ignore[arg-type]


def levels(frames: list[VideoFrame]) -> list[int]:
    return [int(frame.image[-10, 10, 0]) for frame in frames]


def test_all_pictures_are_taken_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in range(12):
        picture(10 * number).save(tmp_path / f"frame{number}.png")
    (tmp_path / "notes.txt").write_text("hi")
    (tmp_path / ".hidden.png").write_text("not a picture")
    frames, notes = read(tmp_path, fps=5.0)
    assert levels(frames) == [10 * number for number in range(12)]
    assert [frame.time for frame in frames] == pytest.approx([n / 5 for n in range(12)])
    assert notes == [
        "1 files that are no pictures were left out",
        "pictures tell no times: they are taken as 5 a second (`fps`)",
    ]


@pytest.mark.parametrize("pattern", ["a_*.jpg", "a_%03d.jpg", "a_%d.jpg", "a_00?.jpg"])
def test_a_pattern_names_some_of_them(tmp_path: Path, pattern: str) -> None:
    for number in range(4):
        picture(40 * number).save(tmp_path / f"a_{number:03d}.jpg", quality=95)
        picture(255).save(tmp_path / f"b_{number:03d}.jpg")
    found = levels(read(tmp_path / pattern)[0])
    assert np.allclose(found, [0, 40, 80, 120], atol=3)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_camera_s_rotation_is_undone(tmp_path: Path, orientation: int) -> None:
    upright = picture(90)
    back = {
        1: None,
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }[orientation]
    stored = upright if back is None else upright.transpose(back)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(tmp_path / "a.png", exif=exif)
    (frame,), _ = read(tmp_path)
    assert np.array_equal(frame.image, np.asarray(upright))


def test_profiles_depths_and_alpha_become_srgb(tmp_path: Path) -> None:
    deep = np.full((120, 160), 200 * 257, dtype=np.uint16)
    Image.fromarray(deep).save(tmp_path / "0.png")
    clear = picture(80).convert("RGBA")
    clear.putalpha(0)
    clear.save(tmp_path / "1.png")
    picture(80).quantize(16).save(tmp_path / "2.png")
    linear = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    picture(80).save(tmp_path / "3.png", icc_profile=linear.tobytes())
    picture(80).save(tmp_path / "4.png", icc_profile=b"no profile")
    frames, _ = read(tmp_path)
    assert np.allclose(levels(frames), [200, 80, 80, 80, 80], atol=2)


def test_sizes_are_made_the_same_and_other_shapes_left_out(tmp_path: Path) -> None:
    picture(10).save(tmp_path / "0.png")
    picture(20, (320, 240)).save(tmp_path / "1.png")
    picture(30, (120, 160)).save(tmp_path / "2.png")
    frames, notes = read(tmp_path)
    assert levels(frames) == [10, 20]
    assert {frame.image.shape for frame in frames} == {(240, 320, 3)}
    assert any("1 pictures were left out" in note for note in notes)
    assert any("brought to 320 x 240" in note for note in notes)
    assert read(tmp_path, max_frames=1)[1][-1].startswith("1 pictures were taken; 2 after them")


def test_what_is_not_there_or_damaged_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no pictures"):
        read(tmp_path)
    with pytest.raises(CaptureError, match="no such folder"):
        read(tmp_path / "none" / "*.png")
    with pytest.raises(CaptureError, match="no such file"):
        read(tmp_path / "none.mp4")
    (tmp_path / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    with pytest.raises(CaptureError, match=r"0\.png"):
        read(tmp_path)
    whole = tmp_path / "whole"
    whole.mkdir()
    picture(5, (640, 480)).save(whole / "1.jpg")
    content = (whole / "1.jpg").read_bytes()
    (whole / "1.jpg").write_bytes(content[: len(content) // 2])
    with pytest.raises(CaptureError, match=r"1\.jpg is damaged"):
        read(whole)
    (whole / "1.jpg").unlink()
    picture(5, (64, 48)).save(whole / "1.png")
    with pytest.raises(CaptureError, match="64 x 48 pixels"):
        read(whole)


@pytest.mark.parametrize("kind", ["tif", "deep"])
def test_turned_pictures_of_other_kinds_are_upright(tmp_path: Path, kind: str) -> None:
    """Pillow turns TIFF itself; sixteen bits a pixel lose what says that they are turned."""
    exif = Image.Exif()
    exif[0x0112] = 6
    if kind == "tif":
        upright = np.asarray(picture(90))
        picture(90).transpose(Image.Transpose.ROTATE_90).save(tmp_path / "a.tif", exif=exif)
    else:
        ramp = np.arange(160, dtype=np.uint16).repeat(120).reshape(160, 120).T
        upright = ramp[..., None].repeat(3, 2)
        stored = np.ascontiguousarray(np.rot90(257 * ramp))
        Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    (frame,), _ = read(tmp_path)
    assert np.array_equal(frame.image, upright)


def test_what_exif_says_in_a_damaged_way_is_not_obeyed(tmp_path: Path) -> None:
    picture(90).save(tmp_path / "a.png", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff\x01")
    (frame,), _ = read(tmp_path)
    assert np.array_equal(frame.image, np.asarray(picture(90)))


def test_names_may_hold_digits_that_are_no_numbers(tmp_path: Path) -> None:
    for number, name in enumerate(("10", "\u00b21", "2")):
        picture(40 * number).save(tmp_path / f"{name}.png")
    assert levels(read(tmp_path)[0]) == [80, 0, 40]
