"""Frames that lie as pictures in a folder, as programs and cameras write them."""

import io
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageCms

from handavatar.capture.checks import (
    NUMBERED,
    OPTIONAL_FORMATS,
    PICTURE_FORMATS,
    CaptureError,
    decoded,
    is_pattern,
    picture_in,
)
from handavatar.capture.decoding import (
    MAX_PIXELS,
    Sampling,
    Tell,
    VideoFrame,
    check_size,
    have_same_shape,
    say_other_shapes,
    video_frames,
    working_size,
)

_TURNS: dict[object, Image.Transpose] = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What brings pictures upright, by what EXIF says."""


def frames_of(source: Path, sampling: Sampling, tell: Tell) -> Iterator[VideoFrame]:
    """The pictures of a video file, of a folder, or of a pattern such as frames/%04d.png.

    Args:
        source: which.
        sampling: how many, and from when to when.
        tell: called with what was guessed, changed or left out.

    Raises:
        CaptureError: there are no pictures, or some cannot be read.
    """
    if is_picture_source(source):
        return picture_frames(source, sampling, tell)
    return video_frames(source, sampling, tell)


def picture_frames(source: Path, sampling: Sampling, tell: Tell) -> Iterator[VideoFrame]:
    """The pictures of a folder or of a pattern, in the order of the numbers in their names.

    Pictures have no times: they count as ``sampling.fps`` a second, so that all of them are taken.
    EXIF rotation is applied and colours with a profile become sRGB.

    Args:
        source: folder, ``folder/*.png``, or ``folder/frame_%04d.png``.
        sampling: how many, and from when to when.
        tell: called with what was guessed, changed or left out.

    Raises:
        CaptureError: there are no pictures, or one cannot be read.
    """
    files = picture_files(source, tell)
    tell(f"pictures tell no times: they are taken as {sampling.fps:g} a second (`fps`)")
    sizes = [_upright_size(file) for file in files]
    width, height = working_size(sizes)
    is_same = [have_same_shape(size, (width, height)) for size in sizes]
    say_other_shapes(is_same.count(False), tell)
    if len(set(sizes)) > 1:
        tell(f"pictures have {len(set(sizes))} sizes: all are brought to {width} x {height}")
    taken = 0
    for number, (file, is_kept) in enumerate(zip(files, is_same, strict=True)):
        time = number / sampling.fps
        if not is_kept or time < sampling.start - 1e-6 or sampling.is_over(time):
            continue
        if taken == sampling.max_frames:
            tell(
                f"{taken} pictures were taken; {len(files) - number} after them were not looked at "
                "(`max_frames`)"
            )
            break
        yield VideoFrame(number, time, _read(file, (width, height)), file.name)
        taken += 1


def is_picture_source(source: Path) -> bool:
    """Whether a folder or a pattern is meant, and not a video."""
    return source.is_dir() or (not source.is_file() and is_pattern(source.name))


def picture_files(source: Path, tell: Tell) -> list[Path]:
    """The files of a folder's or a pattern's pictures, in the order of the numbers in their names.

    Args:
        source: folder, ``folder/*.png``, or ``folder/frame_%04d.png``.
        tell: called where files are no pictures.

    Raises:
        CaptureError: there are no pictures.
    """
    if source.is_dir():
        folder, found = source, sorted(source.iterdir())
    elif NUMBERED.search(source.name):
        folder = source.parent
        before, after = NUMBERED.split(source.name, maxsplit=1)[::2]
        name = re.compile(re.escape(before) + r"\d+" + re.escape(after))
        found = [file for file in _entries(folder) if name.fullmatch(file.name)]
    else:
        folder = source.parent
        found = [file for file in _entries(folder) if file.match(source.name)]
    found = [file for file in found if file.is_file() and not file.name.startswith(".")]
    known = PICTURE_FORMATS | OPTIONAL_FORMATS
    files = [file for file in found if file.suffix.lower() in known]
    if not files:
        raise CaptureError(
            f"{source}: no pictures ({len(found)} other files)",
            f"give a video, or a folder of {', '.join(sorted(known))}",
        )
    if len(files) < len(found):
        tell(f"{len(found) - len(files)} files that are no pictures were left out")
    return sorted(files, key=lambda file: _natural_order(file.name))


def _entries(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder", "give a folder of pictures, or a video")
    return sorted(folder.iterdir())


def _natural_order(name: str) -> list[tuple[int, str]]:
    """So that 2 comes before 10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


def open_picture_file(file: Path) -> Image.Image:
    """A picture of any kind that is read here; no pixel is decoded yet.

    Raises:
        CaptureError: it is damaged or too large, or needs a package that is not installed.
    """
    suffix = file.suffix.lower()
    if suffix in OPTIONAL_FORMATS:
        try:
            from pillow_heif import register_heif_opener
        except ImportError as error:
            raise CaptureError(
                f"{file}: HEIC pictures need a package that is not installed",
                "pip install 'handavatar[heic]', or save them as JPEG",
            ) from error
        register_heif_opener()
    # A file may be of another kind than its name says.
    kinds = tuple(sorted({*PICTURE_FORMATS.values(), (PICTURE_FORMATS | OPTIONAL_FORMATS)[suffix]}))
    return picture_in(file, str(file), kinds, MAX_PIXELS)


def _upright_size(file: Path) -> tuple[int, int]:
    with open_picture_file(file) as picture:
        width, height = picture.size
        check_size(file, width, height)
        is_turned = _orientation(picture) in (5, 6, 7, 8)
    return (height, width) if is_turned else (width, height)


def _orientation(picture: Image.Image) -> object:
    """How EXIF says that it is still to be turned; what cannot be read asks for nothing."""
    if picture.format == "TIFF":
        # Pillow turns these itself, and their size is that of the upright picture.
        return None
    try:
        return picture.getexif().get(0x0112)
    except Exception:  # Of whatever kind: as in :func:`is_to_be_turned`.
        return None


def _read(file: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "height width 3"]:
    picture = opened = open_picture_file(file)
    try:
        picture.load()
        profile = picture.info.get("icc_profile")
        if picture.mode.startswith(("I", "F")):
            # Sixteen bits a pixel.
            levels = np.array(picture, dtype=np.float32)
            levels /= 257
            np.clip(levels.round(out=levels), 0, 255, out=levels)
            picture = Image.fromarray(levels.astype(np.uint8))
        turn = _TURNS.get(_orientation(opened))
        colored = _srgb(picture if turn is None else picture.transpose(turn), profile)
    except MemoryError:
        raise
    except Exception as error:  # Of whatever kind: decoders stumble over damage in many ways.
        raise CaptureError(
            f"{file} is damaged: {str(error)[:120]}", "restore the file, or leave it out"
        ) from error
    if colored.size != size:
        colored = colored.resize(size, Image.Resampling.BICUBIC)
    return decoded(colored, str(file), "RGB")


def _srgb(picture: Image.Image, profile: bytes | None) -> Image.Image:
    if profile is None or picture.mode not in ("RGB", "RGBA", "CMYK"):
        return picture.convert("RGB")
    try:
        found = ImageCms.profileToProfile(
            picture,
            ImageCms.ImageCmsProfile(io.BytesIO(profile)),
            ImageCms.createProfile("sRGB"),
            outputMode="RGB",
        )
    except (ImageCms.PyCMSError, OSError):
        # A profile that cannot be read says nothing.
        return picture.convert("RGB")
    assert found is not None
    return found
