"""Checks of what comes from outside: paths, JSON, numbers, pictures. Nothing is trusted.

Every check raises :class:`CaptureError` with what was found and what to do; callers add where.
"""

import json
import math
import re
from collections import Counter
from io import BytesIO
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image

from handavatar.errors import HandAvatarError

MAX_JSON_BYTES = 64 * 2**20
MAX_JSON_CONTAINERS = 4_000_000
"""Lists and objects: each takes 60 bytes and more, of three in the file. A motion of 100,000 steps
has 1.7 million, a capture of as many frames 2.5."""
MAX_JSON_VALUES = 20_000_000
"""Each takes up to 32 bytes, of two in the file. A motion of 100,000 steps has 5 million, such a
one of rotation matrices 16."""
MAX_PIXELS = 64_000_000
MAX_TEXT = 2000
PICTURE_FORMATS = {
    ".png": "PNG",
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
    ".webp": "WEBP",
    ".bmp": "BMP",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".ppm": "PPM",
}
"""Of files of pictures, by the ends of their names."""
OPTIONAL_FORMATS = {".heic": "HEIF", ".heif": "HEIF"}
"""Those that only an extra can read."""
NUMBERED = re.compile(r"%0?(\d*)d")
"""In a pattern: where a picture's number stands."""
_ORIENTATION = 0x0112
"""Tag of EXIF; 1 is upright, and so is 0, which some programs write for not knowing."""


class CaptureError(HandAvatarError):
    """A capture or motion that cannot be used: what was found, where, and what to do."""

    def __init__(self, what: str, remedy: str = "") -> None:
        """Keeps the two halves apart, so that a list of problems can be printed as a table.

        Args:
            what: was found, and what was expected.
            remedy: what to do about it.
        """
        super().__init__(what, "", remedy)


def load_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> dict[str, Any]:
    """A JSON object without NaN, infinity or duplicate keys, of bounded size.

    Raises:
        CaptureError: if the file is missing, a link, too large, or not such an object.
    """
    if path.is_symlink() or not path.is_file():
        raise CaptureError(
            f"{path.name} is missing or is not a plain file",
            "point at the folder that holds it; links are not followed",
        )
    if path.stat().st_size > max_bytes:
        raise CaptureError(
            f"{path.name} has {path.stat().st_size} bytes, at most {max_bytes} are read",
            "split the recording into several captures",
        )
    text = path.read_bytes()
    containers = text.count(b"[") + text.count(b"{")
    if containers > MAX_JSON_CONTAINERS:
        raise CaptureError(
            f"{path.name} has {containers} lists and objects, at most {MAX_JSON_CONTAINERS} are "
            "read",
            "split the recording into several captures or motions",
        )
    if (commas := text.count(b",")) > MAX_JSON_VALUES:
        raise CaptureError(
            f"{path.name} has {commas} values, at most {MAX_JSON_VALUES} are read",
            "split the recording into several captures or motions",
        )
    try:
        content = json.loads(
            text.decode("utf-8"),
            parse_constant=_refuse_constant,
            object_pairs_hook=_unique_keys,
        )
    except (ValueError, RecursionError) as error:
        raise CaptureError(
            f"{path.name} is not JSON that can be read: {str(error)[:200]}",
            "write the file again with plain numbers and each key once",
        ) from error
    if not isinstance(content, dict):
        raise CaptureError(f"{path.name} holds no JSON object", "its outermost level must be {...}")
    return content


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        (twice, _), *_rest = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:80]!r} appears twice")
    return content


def path_inside(folder: Path, text: object) -> Path:
    """A file below ``folder`` named by a relative path with forward slashes.

    Raises:
        CaptureError: if the path is absolute, climbs out, passes a link, or names no plain file.
    """
    if not isinstance(text, str) or not 0 < len(text) <= 500 or "\0" in text:
        raise CaptureError("the path is not a text", 'write a relative path, "images/000000.png"')
    parts = PurePosixPath(text).parts
    if text.startswith("/") or ".." in parts or "\\" in text or ":" in text:
        raise CaptureError(
            f"the path {text!r} leaves the capture folder",
            'keep the files inside the folder and write relative paths, "images/000000.png"',
        )
    path = folder
    for part in parts:
        path = path / part
        if path.is_symlink():
            raise CaptureError(f"{text!r} passes through a link", "copy the file into the folder")
    if not path.is_file():
        raise CaptureError(f"{text!r} is missing", "restore the file, or drop the frame")
    return path


def number(value: object, label: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number within bounds, or :class:`CaptureError`."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # A JSON integer may be too large for a float; comparing is safe where converting is not.
    if is_number and not -1e300 < value < 1e300:  # type: ignore[operator]
        is_number = False
    if not is_number or not low <= float(value) <= high:  # type: ignore[arg-type]
        raise CaptureError(
            f"{label} is {str(value)[:60]}, expected a number from {low:g} to {high:g}",
            f"correct {label}",
        )
    return float(value)  # type: ignore[arg-type]


def numbers(value: object, shape: tuple[int, ...], label: str) -> np.ndarray:
    """Nested lists of finite numbers of a given shape, as float64, or :class:`CaptureError`."""

    items = [value]
    for size in shape:
        for item in items:
            if not isinstance(item, list) or len(item) != size:
                found = f"a list of {len(item)}" if isinstance(item, list) else str(item)[:60]
                raise CaptureError(
                    f"{label} has {found} where {size} entries were expected",
                    f"{label} must be nested lists of shape {list(shape)}",
                )
        items = list(chain.from_iterable(items))  # type: ignore[arg-type]
    checked = [number(item, label) for item in items]
    return np.array(checked, dtype=np.float64).reshape(shape)


def text_field(content: dict[str, Any], key: str, choices: tuple[str, ...] = ()) -> str:
    """A short text, one of ``choices`` if there are any, or :class:`CaptureError`."""
    value = content.get(key)
    if not isinstance(value, str) or len(value) > MAX_TEXT or (choices and value not in choices):
        expected = " or ".join(choices) if choices else f"a text of at most {MAX_TEXT} characters"
        raise CaptureError(f"{key} is {str(value)[:60]!r}, expected {expected}", f"set {key}")
    return value


def open_picture(path: Path) -> Image.Image:
    """A PNG or JPEG whose header is sound; no pixel is decoded yet.

    Raises:
        CaptureError: if it is another kind of file or has more than 64 megapixels.
    """
    return picture_in(path, path.name, ("PNG", "JPEG"), MAX_PIXELS)


def picture_in(
    source: Path | BytesIO, name: str, formats: tuple[str, ...], most_pixels: int
) -> Image.Image:
    """A picture whose header is sound; no pixel is decoded yet.

    Args:
        source: file, or its bytes.
        name: of the picture, for messages.
        formats: kinds of file, as Pillow names them.
        most_pixels: width times height, at most.

    Raises:
        CaptureError: if it is another kind of file, or larger.
    """
    megapixels = most_pixels // 10**6
    try:
        picture = Image.open(source, formats=formats)
    except Image.DecompressionBombError as error:
        raise CaptureError(
            f"{name} claims more than {megapixels} megapixels", "make it smaller"
        ) from error
    except MemoryError:
        raise
    except Exception as error:  # Of whatever kind, as in :func:`decoded`.
        kinds = " or ".join(formats)
        raise CaptureError(
            f"{name} is not a {kinds} that can be read", f"save it again as {formats[0]}"
        ) from error
    width, height = picture.size
    if width * height > most_pixels:
        picture.close()
        raise CaptureError(
            f"{name} is {width} x {height}, more than {megapixels} megapixels", "make it smaller"
        )
    return picture


def is_pattern(name: str) -> bool:
    """Whether a file's name stands for several: ``*.png``, ``frame_%04d.png``.

    Args:
        name: without its folder.
    """
    return any(sign in name for sign in "*?[") or NUMBERED.search(name) is not None


def is_to_be_turned(picture: Image.Image) -> bool:
    """Whether the header of an opened picture asks for another orientation than its pixels have.

    Args:
        picture: as :func:`open_picture` gives it; no pixel is decoded.
    """
    stored = picture.info.get("exif")
    if not isinstance(stored, bytes):
        return False
    exif = Image.Exif()
    try:
        exif.load(stored)
        return exif.get(_ORIENTATION, 1) not in (0, 1)
    except Exception:  # Of whatever kind: what cannot be read asks for nothing.
        return False


def decoded(picture: Image.Image, name: str, mode: str = "") -> np.ndarray:
    """All pixels of an opened picture; closes it.

    Args:
        picture: as :func:`open_picture` gives it.
        name: for the message.
        mode: to convert it to, as Pillow names it; by default as it is stored.

    Raises:
        CaptureError: if the file ends early or is damaged.
    """
    try:
        with picture:
            return np.array(picture.convert(mode) if mode else picture)
    except MemoryError:
        raise
    except Exception as error:  # Of whatever kind: decoders stumble over damage in many ways.
        raise CaptureError(
            f"{name} is damaged: {str(error)[:120]}", "restore the file, or drop the frame"
        ) from error
