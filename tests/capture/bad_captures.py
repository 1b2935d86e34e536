"""Captures that are wrong in one way each, made of a good one; and in which words it must be said.

The source is every fifth frame of the capture that ships, whose poses are exact.
"""

import json
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

Pixels = np.ndarray
Change = Callable[["Scene"], None]

ALL, HALF, ONE = "all", "half", "one"


@dataclass(frozen=True)
class Scene:
    """A copy of a capture, to be spoilt.

    Attributes:
        folder: of the copy.
        content: of its ``transforms.json``.
    """

    folder: Path
    content: dict

    @property
    def frames(self) -> list[dict]:
        """Entries of the frames."""
        return self.content["frames"]

    def pixels(self, number: int, kind: str) -> Pixels:
        """Of a frame's picture (``file_path``) or mask (``mask_path``)."""
        with Image.open(self.folder / self.frames[number][kind]) as picture:
            return np.array(picture)

    def write(self, number: int, kind: str, pixels: Pixels, **options: object) -> None:
        """Gives the copy other pixels."""
        path = self.folder / self.frames[number][kind]
        Image.fromarray(np.ascontiguousarray(pixels)).save(path, **options)


def copied(source: Path, folder: Path, stride: int = 1) -> Scene:
    """A copy of a capture's pictures, masks and poses."""
    content = json.loads((source / "transforms.json").read_text())
    content["frames"] = content["frames"][::stride]
    for entry in content["frames"]:
        for kind in ("file_path", "mask_path"):
            path = folder / entry[kind]
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / entry[kind], path)
    return Scene(folder, content)


def chosen(count: int, share: str) -> list[int]:
    """Numbers of the frames that are spoilt."""
    return {ALL: list(range(count)), HALF: list(range(1, count, 2)), ONE: [count // 2]}[share]


@dataclass(frozen=True)
class BadCapture:
    """One way to be wrong.

    Attributes:
        name: of the case.
        change: spoils a scene.
        says: what one of the problems must say, a pattern.
        share: which frames are spoilt; the problem names one of them. Empty where the capture as a
            whole is wrong.
    """

    name: str
    change: Change
    says: str
    share: str = ALL

    def spoil(self, scene: Scene) -> set[str]:
        """Spoils it, and tells the names of the frames that are wrong; none for the whole."""
        self.change(scene)
        (scene.folder / "transforms.json").write_text(json.dumps(scene.content))
        numbers = chosen(len(scene.frames), self.share) if self.share else []
        return {Path(scene.frames[number]["file_path"]).stem for number in numbers}


# --- pixels ---------------------------------------------------------------------------------------


def _on_pixels(kind: str, share: str, change: Callable[[Pixels], Pixels]) -> Change:
    def apply(scene: Scene) -> None:
        for number in chosen(len(scene.frames), share):
            scene.write(number, kind, change(scene.pixels(number, kind)))

    return apply


def _on_both(share: str, change: Callable[[Pixels], Pixels]) -> Change:
    def apply(scene: Scene) -> None:
        for kind in ("file_path", "mask_path"):
            _on_pixels(kind, share, change)(scene)

    return apply


def _exchanged(kinds: Sequence[str], share: str, by: int) -> Change:
    """Files of the chosen frames go round among themselves."""

    def apply(scene: Scene) -> None:
        numbers = chosen(len(scene.frames), share)
        for kind in kinds:
            before = {number: scene.pixels(number, kind) for number in numbers}
            for place, number in enumerate(numbers):
                other = numbers[(place + by) % len(numbers)]
                scene.write(number, kind, before[other])

    return apply


def _repeated(kinds: Sequence[str], share: str) -> Change:
    def apply(scene: Scene) -> None:
        for kind in kinds:
            first = scene.pixels(0, kind)
            for number in chosen(len(scene.frames), share):
                if number:
                    scene.write(number, kind, first)

    return apply


def _shifted(right: int, down: int) -> Callable[[Pixels], Pixels]:
    def shift(pixels: Pixels) -> Pixels:
        moved = np.zeros_like(pixels)
        height, width = pixels.shape[:2]
        moved[max(down, 0) : height + min(down, 0), max(right, 0) : width + min(right, 0)] = pixels[
            max(-down, 0) : height - max(down, 0), max(-right, 0) : width - max(right, 0)
        ]
        return moved

    return shift


def _filled(value: int) -> Callable[[Pixels], Pixels]:
    return lambda pixels: np.full_like(pixels, value)


def _noise(pixels: Pixels) -> Pixels:
    return np.random.default_rng(0).integers(0, 256, pixels.shape, dtype=np.uint8)


def _boxed(mask: Pixels) -> Pixels:
    rows, columns = (mask > 127).nonzero()
    box = np.zeros_like(mask)
    box[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = 255
    return box


def _ellipse(mask: Pixels) -> Pixels:
    height, width = mask.shape
    y, x = np.mgrid[:height, :width]
    inside = ((x / width - 0.5) / 0.3) ** 2 + ((y / height - 0.5) / 0.4) ** 2 < 1
    return inside.astype(np.uint8) * 255


def _grown(by: int) -> Callable[[Pixels], Pixels]:
    def grow(mask: Pixels) -> Pixels:
        change = binary_dilation if by > 0 else binary_erosion
        return change(mask > 127, iterations=abs(by)).astype(np.uint8) * 255

    return grow


def _halved(mask: Pixels) -> Pixels:
    columns = (mask > 127).nonzero()[1]
    half = mask.copy()
    half[:, : int(np.median(columns))] = 0
    return half


def _with_forearm(mask: Pixels) -> Pixels:
    longer = mask.copy()
    rows, columns = (mask > 127).nonzero()
    wrist = columns[rows < rows.min() + 12]
    longer[: rows.min() + 12, wrist.min() : wrist.max() + 1] = 255
    return longer


def _oriented(scene: Scene) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    for number in range(len(scene.frames)):
        scene.write(number, "file_path", scene.pixels(number, "file_path"), exif=exif)


# --- cameras and poses ----------------------------------------------------------------------------


def _on_entries(share: str, change: Callable[[dict], None]) -> Change:
    def apply(scene: Scene) -> None:
        for number in chosen(len(scene.frames), share):
            change(scene.frames[number])

    return apply


def _moved_center(right: float, down: float) -> Callable[[dict], None]:
    def move(entry: dict) -> None:
        entry.update(cx=entry["cx"] + right, cy=entry["cy"] + down)

    return move


def _scaled_focal(x: float, y: float) -> Callable[[dict], None]:
    def scale(entry: dict) -> None:
        entry.update(fl_x=entry["fl_x"] * x, fl_y=entry["fl_y"] * y)

    return scale


def _scaled_translation(factor: float) -> Callable[[dict], None]:
    def scale(entry: dict) -> None:
        entry["hand"]["translation"] = [factor * v for v in entry["hand"]["translation"]]

    return scale


def _moved_hand(*by: float) -> Callable[[dict], None]:
    def move(entry: dict) -> None:
        hand = entry["hand"]
        hand["translation"] = [a + b for a, b in zip(hand["translation"], by, strict=True)]

    return move


def _other_rotations(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict], None]:
    def apply(entry: dict) -> None:
        entry["hand"]["rotations"] = change(np.array(entry["hand"]["rotations"])).tolist()

    return apply


def _camera(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict], None]:
    def apply(entry: dict) -> None:
        entry["transform_matrix"] = change(np.array(entry["transform_matrix"])).tolist()

    return apply


def _thumb_first(rotations: np.ndarray) -> np.ndarray:
    return rotations[[0, 13, 14, 15, 1, 2, 3, 4, 5, 6, 10, 11, 12, 7, 8, 9]]


def _without_wrist(rotations: np.ndarray) -> np.ndarray:
    return np.vstack([np.zeros((1, 3)), rotations[1:]])


def _rolled(degrees: float) -> Callable[[np.ndarray], np.ndarray]:
    turn = np.eye(4)
    angle = math.radians(degrees)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return lambda matrix: matrix @ turn


def _poses_exchanged(share: str, by: int) -> Change:
    def apply(scene: Scene) -> None:
        numbers = chosen(len(scene.frames), share)
        hands = [scene.frames[number]["hand"] for number in numbers]
        for place, number in enumerate(numbers):
            scene.frames[number]["hand"] = hands[(place + by) % len(numbers)]

    return apply


def _swapped(kinds: Sequence[str], first: int, second: int) -> Change:
    """Two frames' files or poses change places."""

    def apply(scene: Scene) -> None:
        one, two = scene.frames[first], scene.frames[second]
        for kind in kinds:
            if kind == "hand":
                one[kind], two[kind] = two[kind], one[kind]
            else:
                pixels = scene.pixels(first, kind), scene.pixels(second, kind)
                scene.write(first, kind, pixels[1])
                scene.write(second, kind, pixels[0])

    return apply


def _header(**values: object) -> Change:
    return lambda scene: scene.content["handavatar"].update(values)


def _all_splits(split: str) -> Change:
    return _on_entries(ALL, lambda entry: entry.update(split=split))


def _nothing_known(scene: Scene) -> None:
    for entry in scene.frames:
        entry["known_path"] = f"known/{Path(entry['file_path']).name}"
        path = scene.folder / entry["known_path"]
        path.parent.mkdir(exist_ok=True)
        Image.new("L", (entry["w"], entry["h"])).save(path)


MASK, PICTURE = "mask_path", "file_path"
BOTH = (PICTURE, MASK)
_FOREIGN = "mask belongs to another frame|share"
_POSE = "share|belong to another pose|hand's|picture and mask|not in the picture|times as large"


def _spread(
    name: str, make: Callable[[str], Change], says: str, shares: Sequence[str] = (ALL, HALF, ONE)
) -> list[BadCapture]:
    return [BadCapture(f"{name}, {share}", make(share), says, share) for share in shares]


def _masks(name: str, change: Callable[[Pixels], Pixels], says: str, *shares: str):
    make = lambda share: _on_pixels(MASK, share, change)  # noqa: E731
    return _spread(name, make, says, shares or (ALL, HALF, ONE))


def _pictures(name: str, change: Callable[[Pixels], Pixels], says: str, *shares: str):
    make = lambda share: _on_pixels(PICTURE, share, change)  # noqa: E731
    return _spread(name, make, says, shares or (ALL, HALF, ONE))


def _entries(name: str, change: Callable[[dict], None], says: str, *shares: str):
    return _spread(name, lambda share: _on_entries(share, change), says, shares or (ALL,))


BAD_CAPTURES: list[BadCapture] = [
    *_masks("inverted masks", lambda mask: 255 - mask, "inverted"),
    *_masks("white masks", _filled(255), "white"),
    *_masks("black masks", _filled(0), "empty"),
    *_masks("masks of 0 and 1", lambda mask: mask // 255, "largest value is 1"),
    *_masks("masks of 0 and 100", lambda mask: mask // 255 * 100, "largest value is 100", ALL),
    *_masks("shifted masks", _shifted(24, 0), "mask lies 2. pixels right"),
    *_masks(
        "masks shifted far", _shifted(-60, 30), "mask lies .* left and .* below|share", ALL, ONE
    ),
    *_masks("masks shifted a little", _shifted(0, 10), "masks? lies? .*below", ALL),
    *_spread("foreign masks", lambda share: _exchanged((MASK,), share, 5), _FOREIGN, (ALL, HALF)),
    *_masks("mirrored masks", lambda mask: mask[:, ::-1], "mirrored left to right"),
    *_masks("masks upside down", lambda mask: mask[::-1], "upside down", ALL, ONE),
    *_masks("turned masks", np.rot90, "turned by 90 degrees counterclockwise", ALL, ONE),
    *_masks("masks turned by half", lambda mask: mask[::-1, ::-1], "by 180 degrees", HALF),
    *_masks("boxes for masks", _boxed, "share", ALL, ONE),
    *_masks("ellipses for masks", _ellipse, "share|times as large", ALL),
    *_masks("noise for masks", lambda mask: _noise(mask) // 128 * 255, "share|inverted", ALL, ONE),
    *_masks("thick masks", _grown(14), "share|times as large", ALL, ONE),
    *_masks("thin masks", _grown(-9), "share|times as large", ALL, ONE),
    *_masks("halved masks", _halved, "share|lies?", ALL, ONE),
    *_masks("masks with a forearm", _with_forearm, "share|lies? ", ALL),
    BadCapture("one picture", _repeated((PICTURE,), ALL), "all frames have the same picture", ""),
    BadCapture("one picture, half", _repeated((PICTURE,), HALF), "same, pixel by pixel", HALF),
    BadCapture("one picture and mask", _repeated(BOTH, ALL), "same picture", ""),
    *_pictures("mirrored pictures", lambda p: p[:, ::-1], "picture is mirrored left to right"),
    *_pictures("turned pictures", np.rot90, "picture is turned by 90 degrees counter", ALL, ONE),
    *_pictures("pictures turned by half", lambda p: p[::-1, ::-1], "by 180 degrees", ALL),
    *_pictures("pictures upside down", lambda p: p[::-1], "picture is upside down", HALF),
    *_pictures("shifted pictures", _shifted(20, 0), "picture shows the hand .* right", ALL),
    *_pictures(
        "pictures shifted far", _shifted(0, 40), "picture shows the hand .* below", HALF, ONE
    ),
    *_spread(
        "foreign pictures",
        lambda share: _exchanged((PICTURE,), share, 5),
        "picture belongs to another mask|picture shows|follows no edge|picture is",
        (ALL, HALF),
    ),
    *_pictures("black pictures", _filled(0), "blank", ALL, ONE),
    *_pictures("white pictures", _filled(255), "blank", HALF),
    *_pictures("noise for pictures", _noise, "follows no edge|picture is the same", ALL, ONE),
    BadCapture("orientation tags", _oriented, "turned or mirrored before it is shown"),
    *_spread(
        "wrong side",
        lambda share: _on_both(share, lambda p: p[:, ::-1]),
        "picture and mask are mirrored",
    ),
    *_spread(
        "turned picture and mask", lambda share: _on_both(share, np.rot90), "turned by 90", (ALL,)
    ),
    *_spread(
        "picture and mask upside down",
        lambda share: _on_both(share, lambda p: p[::-1, ::-1]),
        "turned by 180",
        (ALL, ONE),
    ),
    *_entries("millimetres", _scaled_translation(1e3), "millimetres", ALL, ONE),
    *_entries("centimetres", _scaled_translation(1e2), "in centimetres|wrist lies"),
    *_entries("hand moved", _moved_hand(0.03, 0, 0), "pixels (above|below)|pixels (left|right)"),
    *_entries("principal point off", _moved_center(40, 0), "left of where", ALL, ONE),
    *_entries("principal point a little off", _moved_center(0, -10), "below .*where", ALL),
    *_entries("principal point at 0", lambda e: e.update(cx=0.0, cy=0.0), "where pose|not in"),
    *_entries(
        "principal point in the middle", lambda e: e.update(cx=128.0, cy=128.0), "where pose"
    ),
    *_entries("cx for cy", lambda e: e.update(cx=e["cy"], cy=e["cx"]), "where pose|not in the"),
    *_entries("focal length doubled", _scaled_focal(2, 2), "times as large|share"),
    *_entries("focal length halved", _scaled_focal(0.5, 0.5), "0.5. times as large"),
    *_entries("focal length a quarter off", _scaled_focal(1.25, 1.25), "1.2. times as large"),
    *_entries("focal length a fifth off", _scaled_focal(0.8, 0.8), "times as large", ALL, ONE),
    *_entries(
        "focal length in millimetres", lambda e: e.update(fl_x=35.0, fl_y=35.0), "pixels long"
    ),
    *_entries("one focal length off", _scaled_focal(1.0, 1.5), _POSE),
    *_entries("world to camera", _camera(np.linalg.inv), _POSE + "|wrist lies"),
    *_entries(
        "OpenCV axes", _camera(lambda m: m @ np.diag([1.0, -1, -1, 1])), "wrist lies|" + _POSE
    ),
    *_entries("rolled camera", _camera(_rolled(180)), "turned by 180|not in the picture"),
    *_entries("camera rolled a little", _camera(_rolled(20)), _POSE),
    *_entries("degrees", _other_rotations(np.rad2deg), "radians"),
    *_entries("thumb first", _other_rotations(_thumb_first), _POSE),
    *_entries("flat hands", _other_rotations(np.zeros_like), _POSE),
    *_entries("no wrist", _other_rotations(_without_wrist), _POSE),
    *_entries("rotations of a left hand", _other_rotations(lambda r: r * [1, -1, -1]), _POSE),
    *_entries("inverse rotations", _other_rotations(np.negative), _POSE),
    *_entries("15 joints", _other_rotations(lambda r: r[1:]), "16 entries"),
    BadCapture("poses late", _poses_exchanged(ALL, 5), "belong to another pose|share"),
    BadCapture("poses late, half", _poses_exchanged(HALF, 3), _POSE, HALF),
    BadCapture("swapped poses", _swapped(("hand",), 3, -4), _POSE, ""),
    BadCapture("swapped frames", _swapped(BOTH, 5, -3), "belong to another pose", ""),
    BadCapture("swapped masks", _swapped((MASK,), 5, -3), _FOREIGN, ""),
    BadCapture("swapped pictures", _swapped((PICTURE,), 5, -3), "picture belongs to another", ""),
    BadCapture("another rig", _header(rig={"name": "x", "sha256": "f" * 64}), "unknown", ""),
    BadCapture("9 shape coefficients", _header(shape_coefficients=[0.0] * 9), "9 numbers", ""),
    BadCapture("absurd shape", _header(shape_coefficients=[40.0] * 10), "standard deviations", ""),
    BadCapture("nothing known", _nothing_known, "known"),
    BadCapture("no test frames", _all_splits("train"), "no frame of split 'test'", ""),
    BadCapture("no training frames", _all_splits("test"), "no frame of split 'train'", ""),
    BadCapture(
        "a clip left out", _on_entries(HALF, lambda e: e.update(clip=2)), "clip 1 has no frame", ""
    ),
]
