"""What became of every picture of a video, on one sheet to look at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage

from handavatar.capture.frames import Frame

_TILE = 192
_COLUMNS = 9
_MOST_TILES = 63
_LETTERS_PER_LINE = 30


@dataclass(frozen=True, eq=False)
class Tile:
    """One picture of the sheet.

    Attributes:
        name: of the frame, and what else stands above it.
        image: sRGB, of any size.
        reason: why it was left out; empty if it was kept.
    """

    name: str
    image: UInt8[np.ndarray, "height width 3"]
    reason: str = ""


def outlined(
    frame: Frame, mesh: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture, grey where nothing is known; mask outline green, mesh outline red."""
    image = frame.shown.numpy().copy()
    mask = frame.mask.numpy()
    image[mask ^ ndimage.binary_erosion(mask)] = (0, 255, 0)
    image[mesh ^ ndimage.binary_erosion(mesh)] = (255, 40, 40)
    return image


def contact_sheet(tiles: Sequence[Tile]) -> Image.Image:
    """At most 63 of the pictures, evenly chosen; those left out are framed, with the reason."""
    step = max(1, -(-len(tiles) // _MOST_TILES))
    shown = tiles[::step]
    rows = max(1, -(-len(shown) // _COLUMNS))
    sheet = Image.new("RGB", (_COLUMNS * _TILE, rows * _TILE))
    for place, tile in enumerate(shown):
        row, column = divmod(place, _COLUMNS)
        sheet.paste(_drawn(tile), (column * _TILE, row * _TILE))
    return sheet


def _drawn(tile: Tile) -> Image.Image:
    canvas = Image.new("RGB", (_TILE, _TILE))
    picture = Image.fromarray(tile.image)
    scale = _TILE / max(picture.size)
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    canvas.paste(picture.resize(size), ((_TILE - size[0]) // 2, (_TILE - size[1]) // 2))
    draw = ImageDraw.Draw(canvas)
    draw.text((4, 3), tile.name, fill="white", stroke_width=1, stroke_fill="black")
    if tile.reason:
        lines = _lines(tile.reason)
        for number, line in enumerate(lines):
            height = _TILE - 5 - 11 * (len(lines) - number)
            draw.text((5, height), line, fill="white", stroke_width=1, stroke_fill="black")
        draw.rectangle((0, 0, _TILE - 1, _TILE - 1), outline="red", width=3)
    return canvas


def _lines(text: str) -> list[str]:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) < _LETTERS_PER_LINE:
            lines[-1] = f"{lines[-1]} {word}".strip()
        else:
            lines.append(word)
    return lines
