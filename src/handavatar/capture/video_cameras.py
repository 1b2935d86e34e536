"""The camera of a video where somebody knows it: intrinsics, lens distortion, and its way.

Read from nerfstudio's ``transforms.json``, from the text model of COLMAP, or given as a focal
length. Pictures of a lens that bends lines are brought to those of a pinhole before anything else
looks at them, so that all that follows knows pinholes alone.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from handavatar.capture.checks import CaptureError, load_json, number, text_field
from handavatar.capture.decoding import Tell, have_same_shape
from handavatar.capture.frames import (
    MAX_FRAMES,
    PINHOLE_MODELS,
    common_camera,
    opencv_from_opengl,
    read_transform,
)
from handavatar.capture.masks import load_opencv
from handavatar.geometry.rotations import matrix_from_quaternion, rigid_transform

_MAX_BYTES = 256 << 20
_SAME = 1e-6
# Pixels by which a lens may bend lines before pictures are brought to a pinhole.
_STRAIGHT = 0.1
_MOST_ZOOM = 1.5
_LONGEST_SIDE = 100_000
_COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
_UNDISTORT = "undistort the pictures to a pinhole first (colmap image_undistorter)"


@dataclass(frozen=True)
class Lens:
    """A pinhole behind a lens, in the pictures' own pixels.

    Attributes:
        size: width and height of the pictures, pixels.
        focal: lengths along x and y, pixels.
        center: principal point, pixels from the corner of the first pixel.
        radial: k1 and k2 of OpenCV.
        tangential: p1 and p2 of OpenCV.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, float] = (0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    def resized(self, size: tuple[int, int]) -> "Lens":
        """The same of larger or smaller pictures."""
        across, down = size[0] / self.size[0], size[1] / self.size[1]
        return replace(
            self,
            size=size,
            focal=(self.focal[0] * across, self.focal[1] * down),
            center=(self.center[0] * across, self.center[1] * down),
        )

    def project(self, directions: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of directions (x and y over z)."""
        x, y = directions[..., 0], directions[..., 1]
        squared = x * x + y * y
        swollen = 1 + squared * (self.radial[0] + squared * self.radial[1])
        p1, p2 = self.tangential
        bent = np.stack(
            [
                x * swollen + 2 * p1 * x * y + p2 * (squared + 2 * x * x),
                y * swollen + p1 * (squared + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )
        return bent * np.array(self.focal) + np.array(self.center)


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """What is known of the camera of one video.

    Attributes:
        lens: of its pictures.
        source: where it was read, to name it.
        camera_from_world: by the name of the picture without its folder; OpenCV axes, in units of
            the source. Empty where the camera stands still, or nobody knows where it was.
    """

    lens: Lens
    source: str
    camera_from_world: dict[str, Float[Tensor, "4 4"]] = field(default_factory=dict)


def read_camera(path: Path) -> KnownCamera:
    """Reads nerfstudio's ``transforms.json``, or the folder of a text model of COLMAP.

    Args:
        path: the file, or a folder that holds it, or ``cameras.txt`` (and ``images.txt``).

    Raises:
        CaptureError: what is wrong with it; a fisheye, or more than one camera.
    """
    if (path / "cameras.txt").is_file():
        return _from_colmap(path)
    if (path / "cameras.bin").is_file():
        raise CaptureError(
            f"{path}: a binary model of COLMAP",
            f"colmap model_converter --input_path {path} --output_path {path} --output_type TXT",
        )
    file = path / "transforms.json" if path.is_dir() else path
    if not file.is_file():
        raise CaptureError(
            f"{path}: no transforms.json and no cameras.txt",
            "give nerfstudio's transforms.json, or the folder of a text model of COLMAP",
        )
    try:
        return _from_transforms(file)
    except CaptureError as error:
        raise CaptureError(f"{file}: {error.what}", error.remedy) from error


def _from_transforms(file: Path) -> KnownCamera:
    content = load_json(file)
    model = content.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise CaptureError(f"camera_model is {str(model)[:40]!r}", _UNDISTORT)
    entries = content.get("frames", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise CaptureError("frames is not a list of objects", "write it as nerfstudio does")
    if len(entries) > MAX_FRAMES:
        raise CaptureError(
            f"{len(entries)} frames, at most {MAX_FRAMES} are read", "leave some out"
        )
    common = common_camera(content)
    lenses = {_lens_of({**common, **entry}) for entry in entries} or {_lens_of(common)}
    if len(lenses) > 1:
        raise CaptureError(
            f"{len(lenses)} different cameras", "one video has one camera: give each its own file"
        )
    views: dict[str, Float[Tensor, "4 4"]] = {}
    for index, entry in enumerate(entries):
        if "transform_matrix" not in entry:
            continue
        name = Path(text_field(entry, "file_path")).name
        label = f"transform_matrix of frame #{index} ({name})"
        matrix = read_transform(entry["transform_matrix"], label)
        _add_view(views, name, opencv_from_opengl(matrix))
    return KnownCamera(lenses.pop(), file.name, views)


def _lens_of(content: dict[str, Any]) -> Lens:
    """Of nerfstudio's keys."""
    for name in ("k3", "k4"):
        if number(content.get(name, 0.0), name) != 0:
            raise CaptureError(f"the lens distortion {name} is not zero", _UNDISTORT)
    side = float(_LONGEST_SIDE)
    width, height = (int(number(content.get(name), name, 1.0, side)) for name in ("w", "h"))
    focal = number(content.get("fl_x"), "fl_x", 1.0, 1e6)
    return Lens(
        (width, height),
        (focal, number(content.get("fl_y", focal), "fl_y", 1.0, 1e6)),
        (
            number(content.get("cx", width / 2), "cx", 0.0, float(width)),
            number(content.get("cy", height / 2), "cy", 0.0, float(height)),
        ),
        (number(content.get("k1", 0.0), "k1"), number(content.get("k2", 0.0), "k2")),
        (number(content.get("p1", 0.0), "p1"), number(content.get("p2", 0.0), "p2")),
    )


def _add_view(views: dict[str, Float[Tensor, "4 4"]], name: str, view: Tensor) -> None:
    if name in views:
        raise CaptureError(f"two cameras are those of {name}", "give every picture one camera")
    views[name] = view


def _from_colmap(folder: Path) -> KnownCamera:
    cameras = list(_colmap_lines(folder / "cameras.txt", 13))
    lenses = {}
    for line, words in cameras:
        where = f"{folder / 'cameras.txt'}, line {line}"
        if len(words) < 4 or words[1] not in _COLMAP_PARAMETERS:
            model = words[1][:40] if len(words) > 1 else "nothing"
            known = ", ".join(_COLMAP_PARAMETERS)
            raise CaptureError(f"{where}: {model} is none of {known}", _UNDISTORT)
        names = _COLMAP_PARAMETERS[words[1]]
        values = _floats(words[2:], 2 + len(names), where)
        given = dict(zip(names, values[2:], strict=True))
        side = float(_LONGEST_SIDE)
        width, height = (int(number(value, where, 1.0, side)) for value in values[:2])
        focal = given.get("f", given.get("fx", 0.0))
        lenses[words[0]] = Lens(
            (width, height),
            (number(focal, where, 1.0, 1e6), number(given.get("fy", focal), where, 1.0, 1e6)),
            (given["cx"], given["cy"]),
            (given.get("k1", 0.0), given.get("k2", 0.0)),
            (given.get("p1", 0.0), given.get("p2", 0.0)),
        )
    views: dict[str, Float[Tensor, "4 4"]] = {}
    used = set()
    if (folder / "images.txt").is_file():
        # Every other line lists the picture's points, and may be empty.
        lines = _colmap_lines(folder / "images.txt", 10, keeps_empty=True)
        for line, words in islice(lines, 0, None, 2):
            where = f"{folder / 'images.txt'}, line {line}"
            if len(words) < 10:
                raise CaptureError(f"{where}: {len(words)} words, expected 10", "write it again")
            turn = torch.tensor(_floats(words[1:5], 4, where), dtype=torch.float64)
            if abs(float(turn.norm()) - 1) > 1e-3:
                raise CaptureError(f"{where}: the quaternion has not length 1", "write it again")
            shift = torch.tensor(_floats(words[5:8], 3, where), dtype=torch.float64)
            used.add(words[8])
            _add_view(
                views,
                Path(words[9]).name,
                rigid_transform(matrix_from_quaternion(turn), shift).float(),
            )
    chosen = {lenses.get(name) for name in used} if used else set(lenses.values())
    if len(chosen) != 1 or None in chosen:
        raise CaptureError(
            f"{folder}: {len(chosen)} different cameras",
            "one video has one camera: run COLMAP with --ImageReader.single_camera 1",
        )
    lens = chosen.pop()
    assert lens is not None
    return KnownCamera(lens, folder.name, views)


def _colmap_lines(
    file: Path, most_words: int, keeps_empty: bool = False
) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines that are no comments; the last word is all that is left."""
    if file.stat().st_size > _MAX_BYTES:
        raise CaptureError(
            f"{file}: more than {_MAX_BYTES >> 20} MiB", "leave out the points of images.txt"
        )
    started = False
    with file.open(encoding="utf-8", errors="replace") as lines:
        for line, text in enumerate(lines, 1):
            if text.startswith("#") or (not text.strip() and not (keeps_empty and started)):
                continue
            started = True
            # A picture's name may hold blanks, and its points be very many.
            yield line, text.strip().split(maxsplit=most_words - 1)


def _floats(words: list[str], count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise CaptureError(
            f"{where}: {' '.join(words)[:60]!r} are not {count} finite numbers", "write it again"
        )
    return values


@dataclass(frozen=True, eq=False)
class Pinhole:
    """How a video's pictures are seen once they are a pinhole's.

    Attributes:
        focal: length, pixels of the pictures as they are looked at.
        principal_point: pixels of the same.
        straighten: makes a pinhole's picture of one of the lens.
    """

    focal: float
    principal_point: tuple[float, float]
    straighten: Callable[[UInt8[np.ndarray, "height width 3"]], UInt8[np.ndarray, "_ _ 3"]]


def pinhole_of(lens: Lens, size: tuple[int, int], where: str, tell: Tell) -> Pinhole:
    """The pinhole of pictures of another size than those that the lens was measured on.

    Args:
        lens: as it was measured.
        size: width and height of the pictures, upright, as they are looked at.
        where: what told the lens.
        tell: called where pictures have to be resampled.

    Raises:
        CaptureError: the pictures have another shape, or lines are bent too much.
    """
    if not have_same_shape(lens.size, size):
        raise CaptureError(
            f"{where}: the camera's pictures are {lens.size[0]} x {lens.size[1]}, those of the "
            f"video, upright, {size[0]} x {size[1]}",
            "give the camera of exactly these pictures",
        )
    lens = lens.resized(size)
    focal = math.sqrt(lens.focal[0] * lens.focal[1])
    if _bend(lens, focal) < _STRAIGHT:
        return Pinhole(focal, lens.center, lambda image: image)
    zoom = _least_zoom(lens, focal, where)
    tell(
        f"pictures were resampled to those of a pinhole (lens of {where}), "
        f"{100 * (zoom - 1):.1f} % enlarged"
    )
    opencv = load_opencv()
    across, down = _source_pixels(lens, focal * zoom, _pixel_centers(size)).astype(np.float32).T
    # OpenCV counts from the middle of the first pixel.
    maps = np.ascontiguousarray(across.T) - 0.5, np.ascontiguousarray(down.T) - 0.5

    def straighten(image: UInt8[np.ndarray, "_ _ 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
        return opencv.remap(image, *maps, opencv.INTER_CUBIC, borderMode=opencv.BORDER_REPLICATE)

    return Pinhole(focal * zoom, lens.center, straighten)


def _pixel_centers(size: tuple[int, int]) -> Float[np.ndarray, "height width 2"]:
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return np.stack([x, y], axis=-1)


def _border(size: tuple[int, int]) -> Float[np.ndarray, "points 2"]:
    """Centres of the outermost pixels."""
    centers = _pixel_centers(size)
    return np.concatenate([centers[0], centers[-1], centers[:, 0], centers[:, -1]])


def _source_pixels(
    lens: Lens, focal: float, pixels: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n 2"]:
    """Where the lens shows what a pinhole with the same principal point shows at pixels."""
    return lens.project((pixels - np.array(lens.center)) / focal)


def _bend(lens: Lens, focal: float) -> float:
    """Pixels by which the lens differs from a pinhole, at most; lenses bend most at the border."""
    border = _border(lens.size)
    return float(np.abs(_source_pixels(lens, focal, border) - border).max())


def _least_zoom(lens: Lens, focal: float, where: str) -> float:
    """By how much a pinhole's picture has to be enlarged so that the lens has seen all of it."""
    border, size = _border(lens.size), np.array(lens.size)
    for zoom in np.arange(1.0, _MOST_ZOOM, 0.001):
        found = _source_pixels(lens, focal * zoom, border)
        if ((found > 0.4) & (found < size - 0.4)).all():
            return float(zoom)
    raise CaptureError(f"{where}: the lens bends lines too much for a pinhole", _UNDISTORT)
