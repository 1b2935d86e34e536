"""A capture: frames of one hand with a known camera and pose, in a folder on disk.

``transforms.json`` is a superset of nerfstudio's. On disk a camera is camera-to-world in OpenGL
axes (x right, y up, z backwards); in memory it is ``camera_from_world`` in OpenCV axes (x right,
y down, z forward). :func:`opencv_from_opengl` and its inverse are the only place where one becomes
the other. The principal point needs no conversion: nerfstudio, COLMAP and this project all count
image coordinates from the corner, so that the centre of the first pixel is (0.5, 0.5).

A left hand is stored mirrored to a right one (image, mask, camera and pose alike) with
``side: left``; whoever shows a result mirrors it back.
"""

import json
import math
import re
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from handavatar.capture.checks import (
    CaptureError,
    decoded,
    is_to_be_turned,
    load_json,
    number,
    numbers,
    open_picture,
    path_inside,
    text_field,
)
from handavatar.errors import raise_if_refused
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.geometry.cameras import Camera
from handavatar.geometry.rotations import invert_rigid
from handavatar.geometry.tensors import require_tensor, require_type
from handavatar.hand.landmarks import NUM_LANDMARKS
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.jobs.files import (
    FolderInUse,
    FolderKind,
    fill_folder,
    refuse_folder_in_use,
    restore_folder,
    write_atomically,
)
from handavatar.jobs.finite import find_not_finite

Said = TypeVar("Said")
"""What a frame may say of itself."""
SCHEMA = 1
SPLITS = ("train", "val", "test")
MAX_FRAMES = 100_000
MAX_CAPTURE_PIXELS = 1_000_000_000
"""Of all pictures of a capture: 2,000 frames of 512 x 512 have half as many. Whoever learns from
them may hold them all, five bytes each."""
_MAX_SIDE_FILE = 1 << 30
"""Bytes of a file of covariances or landmarks; 10,000 frames have 0.2 GB."""
MAX_CLIPS = 32
"""Recordings of one hand in a capture."""
FITTED_SIDE = 256
"""Pixels along a side of the pictures that hands are laid onto, learned from and judged; larger
ones are binned towards it (:meth:`Frame.binned`)."""
_UNKNOWN_GREY = 128
PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
"""Of nerfstudio's ``camera_model``: pinholes, with or without a lens that bends lines."""
_CAMERA_KEYS = (
    *("w", "h", "fl_x", "fl_y", "cx", "cy"),
    *("k1", "k2", "k3", "k4", "p1", "p2", "transform_matrix"),
)
COVARIANCES = "covariances.safetensors"
"""File of a capture: tensor ``covariance``, one matrix per frame, in the order of the frames."""
LANDMARKS = "landmarks.safetensors"
"""File of a capture: the fields of ``LandmarkSightings``, stacked in the order of the frames."""
_MAKE_AGAIN = "make the capture again, or delete this file: poses then count as less sure"


def _landmark_shapes(num_skin: int) -> dict[str, tuple[int, ...]]:
    """Of one frame's landmarks, behind which points of the skin may follow."""
    count = NUM_LANDMARKS + num_skin
    shapes: dict[str, tuple[int, ...]] = {
        "directions": (count, 2),
        "errors": (count,),
        "depths": (count,),
        "depth_errors": (count,),
        "offsets": (NUM_LANDMARKS, 3),
    }
    # Captures of a tracker that tells landmarks alone have no such tensor.
    return shapes | ({"vertices": (num_skin,)} if num_skin else {})


def _is_older_capture(folder: Path) -> bool:
    """Whether a version that left no marker has written the capture; nerfstudio writes no block."""
    try:
        block = load_json(folder / "transforms.json").get("handavatar")
    except CaptureError:
        return False
    return isinstance(block, dict) and "schema" in block


CAPTURE = FolderKind(
    "capture",
    (
        "transforms.json",
        *("images/*.png", "masks/*.png", "known/*.png"),
        *("truth/*.png", "truth/*.json", "truth/*.safetensors"),
        *("overview.png", "fit.json", "skipped.json", "seen.safetensors"),
        *(COVARIANCES, LANDMARKS),
    ),
    _is_older_capture,
)
"""The folder that :class:`CaptureWriter` makes."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of the hand, decoded.

    Attributes:
        name: unique within the capture, e.g. ``000012``.
        image: sRGB, 8 bit, as stored; the background is kept.
        coverage: how much of each pixel the hand covers, 255 for all of it; the pixels of an
            outline are covered in part.
        camera: OpenCV axes, of exactly this picture.
        pose: one hand; rotations of 16 bones, translation in metres.
        confidence: how far the pose is to be trusted, in [0, 1].
        split: ``train``, ``val`` or ``test``.
        time: seconds since the start of the recording.
        known: false where nothing is known: outside the camera's picture, under a sleeve or an
            object, or where the mask is unsure. Such a pixel is neither hand nor background, and
            counts in no loss and no figure. All are known if it is left out.
        gain: of red, green and blue: the factor by which exposure and white balance make the
            stored values of this picture larger than those of the capture's average; ones if it is
            left out.
        covariance: of the pose's errors, rotations bone by bone (radians) and then translation
            (metres), as far as neither landmarks nor mask nor colours tell it; None where the
            capture does not say.
        landmarks: that a tracker saw; None where the capture does not say.
        clip: number of the recording that it belongs to, from 0: each has a light of its own.

    Raises:
        ArgumentError: if image, coverage, what is known and the camera are not of one size, or one
            of them is of another kind.
    """

    name: str
    image: UInt8[Tensor, "height width 3"]
    coverage: UInt8[Tensor, "height width"]
    camera: Camera
    pose: HandPose
    confidence: float
    split: str
    time: float
    known: Bool[Tensor, "height width"] = None  # type: ignore[assignment]
    gain: Float[Tensor, "3"] = None  # type: ignore[assignment]
    covariance: Float[Tensor, "51 51"] | None = None
    landmarks: LandmarkSightings | None = None
    clip: int = 0

    def __post_init__(self) -> None:
        """Fills in what most pictures need not say, and refuses what is no frame."""
        require_type("Frame.camera", self.camera, Camera)
        require_type("Frame.pose", self.pose, HandPose)
        size = (self.camera.height, self.camera.width)
        require_tensor("Frame.image", self.image, (*size, 3), torch.uint8)
        require_tensor("Frame.coverage", self.coverage, size, torch.uint8)
        require_tensor("Frame.pose.rotations", self.pose.rotations, (NUM_BONES, 3))
        if self.known is None:
            object.__setattr__(self, "known", torch.ones_like(self.coverage, dtype=torch.bool))
        if self.gain is None:
            object.__setattr__(self, "gain", torch.ones(3))
        require_tensor("Frame.known", self.known, size, torch.bool)
        require_tensor("Frame.gain", self.gain, (3,))

    @property
    def mask(self) -> Bool[Tensor, "height width"]:
        """True where the hand is known to cover at least half of the pixel."""
        return (self.coverage > 127) & self.known

    @property
    def alpha(self) -> Float[Tensor, "height width"]:
        """The coverage in [0, 1]."""
        return self.coverage.float() / 255

    @property
    def colors(self) -> Float[Tensor, "height width 3"]:
        """Stored values as the capture's average exposure and white balance would give them.

        In [0, 1], but where the gain is below one.
        """
        return self.image.float() / 255 / self.gain

    @property
    def shown(self) -> UInt8[Tensor, "height width 3"]:
        """The picture for people to look at: grey where nothing is known."""
        return torch.where(self.known[..., None], self.image, self.image.new_tensor(_UNKNOWN_GREY))

    def require_finite(self) -> None:
        """Refuses a frame whose numbers are not finite.

        Raises:
            CaptureError: if one is NaN or infinite; it says of which frame, and which.
        """
        numbers = {
            "pose": vars(self.pose),
            "camera": vars(self.camera),
            "gain": self.gain,
            "confidence": self.confidence,
            "time": self.time,
            "covariance": self.covariance,
            "landmarks": None if self.landmarks is None else vars(self.landmarks),
        }
        if found := find_not_finite(numbers):
            raise CaptureError(f"frame {self.name} is not finite: its {found}", "drop the frame")

    def binned(self, side: int) -> "Frame":
        """The same frame with square blocks of pixels averaged, as large ones as leave it ``side``.

        A block is known if all of it is. Both sides are multiples of the block's; a picture that
        is not twice as large, or is no multiple of any block, stays as it is.

        Args:
            side: pixels that the longer side keeps at least.
        """
        width, height = self.camera.width, self.camera.height
        largest = max(1, max(width, height) // side)
        factor = next(
            factor for factor in range(largest, 0, -1) if width % factor == height % factor == 0
        )
        if factor == 1:
            return self
        return replace(
            self,
            image=block_means(self.image, factor).round().to(torch.uint8),
            coverage=block_means(self.coverage, factor).round().to(torch.uint8),
            camera=self.camera.resized(width // factor, height // factor),
            known=block_means(self.known, factor) == 1,
        )


def block_means(values: Tensor, factor: int) -> Tensor:
    """Means over square blocks of pixels, as floats; further axes stay.

    Args:
        values: height, width, and any further axes.
        factor: pixels along a side of a block; divides height and width.
    """
    blocks = values.unflatten(0, (-1, factor)).unflatten(2, (-1, factor))
    return blocks.float().mean((1, 3))


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """What a capture says of one frame, without its pixels.

    Attributes:
        name: as in :class:`Frame`, and so are the fields not named here.
        file_path: picture, relative to the folder.
        mask_path: mask, relative to the folder.
        known_path: what is known, relative to the folder; empty if everything is.
    """

    name: str
    file_path: str
    mask_path: str
    camera: Camera
    pose: HandPose
    confidence: float
    split: str
    time: float
    known_path: str = ""
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    clip: int = 0


@dataclass(frozen=True)
class Problem:
    """Something wrong with a capture folder.

    Attributes:
        file: relative to the folder.
        frame: name of the frame; empty if the whole capture is meant.
        what: what was found and what was expected.
        remedy: what to do.
    """

    file: str
    frame: str
    what: str
    remedy: str

    def __str__(self) -> str:
        """Two lines: what and where, then the remedy."""
        where = f"{self.file}, frame {self.frame}" if self.frame else self.file
        return f"{where}: {self.what}\n  {self.remedy}"


@dataclass(frozen=True, eq=False)
class Capture:
    """A folder of frames, read and found sound as far as the headers of its files tell.

    Attributes:
        folder: where it lies.
        rig_name: the rig its poses belong to.
        rig_sha256: fingerprint of that rig.
        side: ``right``, or ``left`` if everything is stored mirrored.
        subject: whose hand.
        color_space: always ``srgb``.
        source: where the pictures come from.
        licence: under which terms.
        shape_coefficients: of that rig; zeros if they are not known.
        records: frames in the order of the file.
    """

    folder: Path
    rig_name: str
    rig_sha256: str
    side: str
    subject: str
    color_space: str
    source: str
    licence: str
    shape_coefficients: Float[Tensor, "shapes"]
    records: tuple[FrameRecord, ...]

    def frame(self, index: int) -> Frame:
        """Decodes one frame.

        Raises:
            CaptureError: if a file was damaged or changed since the capture was read.
        """
        record = self.records[index]
        size = (record.camera.width, record.camera.height)
        image = _pixels(self.folder, record.file_path, size, ("RGB",), record.name)
        mask = _pixels(self.folder, record.mask_path, size, ("L", "1"), record.name)
        known = np.ones(mask.shape, dtype=bool)
        if record.known_path:
            known = _pixels(self.folder, record.known_path, size, ("L", "1"), record.name) > 0
        return Frame(
            name=record.name,
            image=torch.from_numpy(image),
            coverage=torch.from_numpy(mask if mask.dtype != bool else mask * np.uint8(255)),
            camera=record.camera,
            pose=record.pose,
            confidence=record.confidence,
            split=record.split,
            time=record.time,
            known=torch.from_numpy(known),
            gain=torch.tensor(record.gain),
            covariance=None if self.covariances is None else self.covariances[index],
            landmarks=None if self.landmarks is None else self.landmarks[index],
            clip=record.clip,
        )

    @cached_property
    def covariances(self) -> Float[Tensor, "frames 51 51"] | None:
        """Of every frame's pose, as in :class:`Frame`; None where the capture does not say.

        Raises:
            CaptureError: if the file does not fit the frames.
        """
        found = self._frame_tensors(COVARIANCES, {"covariance": (51, 51)})
        return None if found is None else found["covariance"]

    @cached_property
    def landmarks(self) -> tuple[LandmarkSightings, ...] | None:
        """Of every frame, as in :class:`Frame`; None where the capture does not say.

        Raises:
            CaptureError: if the file does not fit the frames.
        """
        found = self._frame_tensors(LANDMARKS, _landmark_shapes(self._num_skin_points()))
        if found is None:
            return None
        if "vertices" in found:
            numbers = found["vertices"]
            if not bool((numbers >= 0).all()) or not torch.equal(numbers, numbers.round()):
                raise CaptureError(f"{LANDMARKS}: vertices are no numbers of any", _MAKE_AGAIN)
            found["vertices"] = numbers.long()
        for name in ("errors", "depth_errors"):
            if not bool((found[name] > 0).all()):
                raise CaptureError(f"{LANDMARKS}: {name} are not above zero", _MAKE_AGAIN)
        return tuple(
            LandmarkSightings(**{name: values[index] for name, values in found.items()})
            for index in range(len(self.records))
        )

    def _num_skin_points(self) -> int:
        """How many points of the skin follow the landmarks, as their file says."""
        path = self.folder / LANDMARKS
        try:
            with safe_open(path, "pt") as file:
                return int(file.get_slice("vertices").get_shape()[-1])
        except (SafetensorError, OSError):
            # Landmarks alone; or whatever else is wrong with it is said where it is read.
            return 0

    def _frame_tensors(
        self, file: str, shapes: dict[str, tuple[int, ...]]
    ) -> dict[str, Float[Tensor, "frames ..."]] | None:
        """Tensors of a file that hold one entry for each frame; None without the file.

        Args:
            file: relative to the folder.
            shapes: of one frame's entry, by the tensor's name.

        Raises:
            CaptureError: if they do not fit the frames.
        """
        path = self.folder / file
        if not path.is_file():
            return None
        if path.stat().st_size > _MAX_SIDE_FILE:
            raise CaptureError(f"{file} has more than {_MAX_SIDE_FILE >> 20} MiB", _MAKE_AGAIN)
        try:
            tensors = load_file(path)
            found = {name: tensors[name].float() for name in shapes}
        except (SafetensorError, KeyError, OSError) as error:
            raise_if_refused(error)
            raise CaptureError(f"{file} cannot be read ({error})", _MAKE_AGAIN) from error
        for name, shape in shapes.items():
            values = found[name]
            if values.shape != (len(self.records), *shape) or not bool(values.isfinite().all()):
                raise CaptureError(
                    f"{file}: {name} has shape {tuple(values.shape)} or is not finite, expected "
                    f"{(len(self.records), *shape)}",
                    _MAKE_AGAIN,
                )
        return found

    def split(self, name: str) -> tuple[int, ...]:
        """Indices of the frames of ``train``, ``val`` or ``test``; may be empty."""
        if name not in SPLITS:
            raise CaptureError(f"there is no split {name!r}", f"ask for one of {', '.join(SPLITS)}")
        return tuple(i for i, record in enumerate(self.records) if record.split == name)

    @property
    def num_clips(self) -> int:
        """How many recordings the frames come from: each has a light of its own."""
        return 1 + max(record.clip for record in self.records)

    @property
    def is_tracked(self) -> bool:
        """Whether any pose is an estimate and not known: its confidence is below one."""
        return any(record.confidence < 1 for record in self.records)

    @cached_property
    def sha256(self) -> str:
        """Fingerprint of ``transforms.json``."""
        return sha256((self.folder / "transforms.json").read_bytes()).hexdigest()


def read_capture(folder: Path) -> Capture:
    """Reads ``transforms.json`` and the headers of all pictures; decodes nothing.

    Raises:
        CaptureError: the first problem, with file, frame and remedy.
    """
    capture, problems = examine_files(Path(folder))
    if problems or capture is None:
        more = (
            f"\nand {len(problems) - 1} more: handavatar capture check {folder}"
            if len(problems) > 1
            else ""
        )
        raise CaptureError(f"{folder}\n{problems[0]}{more}")
    return capture


def common_camera(content: dict[str, Any]) -> dict[str, Any]:
    """What a transforms.json says of the cameras of all frames; the rest may be very much.

    Args:
        content: of the file.
    """
    return {name: content[name] for name in _CAMERA_KEYS if name in content}


def opencv_from_opengl(world_from_camera: np.ndarray) -> Float[Tensor, "4 4"]:
    """``camera_from_world`` in OpenCV axes of a camera-to-world matrix in OpenGL axes."""
    flipped = world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    return invert_rigid(torch.from_numpy(flipped)).float()


def opengl_from_opencv(camera_from_world: Float[Tensor, "4 4"]) -> np.ndarray:
    """Camera-to-world in OpenGL axes of ``camera_from_world`` in OpenCV axes."""
    world_from_camera = invert_rigid(camera_from_world.detach().cpu().double()).numpy()
    return world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])


def examine_files(folder: Path) -> tuple[Capture | None, list[Problem]]:
    """The capture as far as it can be read, and all problems that show without decoding.

    Args:
        folder: of the capture.
    """
    try:
        content = load_json(folder / "transforms.json")
        header = _header(content)
        entries = content.get("frames")
        if not isinstance(entries, list) or not 0 < len(entries) <= MAX_FRAMES:
            raise CaptureError(
                f"frames is not a list of 1 to {MAX_FRAMES} frames", "list at least one frame"
            )
    except CaptureError as error:
        return None, [Problem("transforms.json", "", error.what, error.remedy)]
    common = common_camera(content)
    records: dict[str, FrameRecord] = {}
    problems: list[Problem] = []
    for index, entry in enumerate(entries):
        label = f"#{index}"
        try:
            if not isinstance(entry, dict):
                raise CaptureError("the frame is not a JSON object", "write it as {...}")
            label = Path(str(entry.get("file_path", label))[:200]).stem
            record = _record(folder, common, entry, index)
            if record.name in records:
                raise CaptureError(
                    f"two frames are named {record.name}", "give every picture its own name"
                )
            records[record.name] = record
        except CaptureError as error:
            said = entry.get("file_path") if isinstance(entry, dict) else None
            file = said[:200] if isinstance(said, str) else "transforms.json"
            problems.append(Problem(file, label, error.what, error.remedy))
    pixels = sum(record.camera.width * record.camera.height for record in records.values())
    if pixels > MAX_CAPTURE_PIXELS:
        what = (
            f"{len(records)} frames have {pixels / 1e6:,.0f} megapixels together, at most "
            f"{MAX_CAPTURE_PIXELS / 1e6:,.0f} are read"
        )
        problems.append(
            Problem("transforms.json", "", what, "make the pictures smaller, or leave frames out")
        )
    return Capture(folder=folder, records=tuple(records.values()), **header), problems


def _header(content: dict[str, Any]) -> dict[str, Any]:
    """The capture's own fields, as keyword arguments of :class:`Capture`."""
    ours = content.get("handavatar")
    if not isinstance(ours, dict):
        raise CaptureError(
            "there is no handavatar block: a nerfstudio capture does not know the hand's pose",
            "make a capture of a video of it: handavatar capture video FILE",
        )
    if ours.get("schema") != SCHEMA:
        raise CaptureError(
            f"schema is {str(ours.get('schema'))[:20]}, this program reads {SCHEMA}",
            "update handavatar, or make the capture again",
        )
    rig = ours.get("rig")
    if not isinstance(rig, dict):
        raise CaptureError("rig is missing", 'write rig: {"name": ..., "sha256": ...}')
    coefficients = ours.get("shape_coefficients", [0.0] * 10)
    if not isinstance(coefficients, list) or len(coefficients) > 1000:
        raise CaptureError("shape_coefficients is not a short list", "leave it out if unknown")
    model = content.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise CaptureError(f"camera_model is {str(model)[:40]!r}", "undistort to a pinhole camera")
    return {
        "rig_name": text_field(rig, "name"),
        "rig_sha256": text_field(rig, "sha256"),
        "side": text_field(ours, "side", ("left", "right")),
        "subject": text_field(ours, "subject"),
        "color_space": text_field(ours, "color_space", ("srgb",)),
        "source": text_field(ours, "source"),
        "licence": text_field(ours, "licence"),
        "shape_coefficients": torch.from_numpy(
            numbers(coefficients, (len(coefficients),), "shape_coefficients")
        ).float(),
    }


def _record(folder: Path, common: dict[str, Any], entry: dict[str, Any], index: int) -> FrameRecord:
    file_path = path_inside(folder, entry.get("file_path"))
    mask_path = path_inside(folder, entry.get("mask_path"))
    size = _size_of_picture(file_path, ("RGB",))
    mask_size = _size_of_picture(mask_path, ("L", "1"))
    if mask_size != size:
        raise CaptureError(
            f"the mask {entry['mask_path']} is {mask_size[0]} x {mask_size[1]}, "
            f"the picture {size[0]} x {size[1]}",
            "make both the same size",
        )
    camera = _camera({**common, **entry}, size)
    known_path = entry.get("known_path")
    if known_path is not None:
        known_path = path_inside(folder, known_path)
        known_size = _size_of_picture(known_path, ("L", "1"))
        if known_size != size:
            raise CaptureError(
                f"{entry['known_path']} is {known_size[0]} x {known_size[1]}, "
                f"the picture {size[0]} x {size[1]}",
                "make both the same size",
            )
    gain = numbers(entry.get("gain", [1.0, 1.0, 1.0]), (3,), "gain")
    if not (gain.min() >= 0.01 and gain.max() <= 100):
        raise CaptureError(
            f"gain is {gain.round(3).tolist()}, expected 0.01 to 100 for each channel",
            "leave it out if exposure and white balance are steady",
        )
    hand = entry.get("hand")
    if not isinstance(hand, dict):
        raise CaptureError("the frame has no hand pose", 'write hand: {"rotations": ...}')
    rotations = numbers(hand.get("rotations"), (NUM_BONES, 3), "rotations")
    largest = float(np.linalg.norm(rotations, axis=-1).max())
    if largest > 2 * math.pi + 1e-3:
        raise CaptureError(
            f"a joint turns by {largest:.1f} radians, at most 6.28 make sense",
            "write rotations as axis times angle in radians, not in degrees",
        )
    translation = numbers(hand.get("translation"), (3,), "translation")
    transform = camera.camera_from_world.double().numpy()
    depth = float(transform[2, :3] @ translation + transform[2, 3])
    far = float(np.linalg.norm(translation))
    if not 0 < depth < 100:
        raise CaptureError(
            f"the wrist lies {depth:.3g} m in front of the camera, expected 0 to 100"
            + (", and the hand's translation looks like millimetres" if far > 3 else ""),
            "write metres, and transform_matrix as camera-to-world in OpenGL axes",
        )
    return FrameRecord(
        name=file_path.stem,
        file_path=file_path.relative_to(folder).as_posix(),
        mask_path=mask_path.relative_to(folder).as_posix(),
        camera=camera,
        pose=HandPose(torch.from_numpy(rotations).float(), torch.from_numpy(translation).float()),
        confidence=number(hand.get("confidence", 1.0), "confidence", 0.0, 1.0),
        split=text_field(entry, "split", SPLITS),
        time=number(entry.get("time", float(index)), "time"),
        known_path="" if known_path is None else known_path.relative_to(folder).as_posix(),
        gain=(float(gain[0]), float(gain[1]), float(gain[2])),
        clip=_clip(entry),
    )


def _clip(entry: dict[str, Any]) -> int:
    clip = number(entry.get("clip", 0), "clip", 0.0, float(MAX_CLIPS - 1))
    if clip != int(clip):
        raise CaptureError(f"clip is {clip:g}, expected a whole number", "number the clips from 0")
    return int(clip)


def _camera(entry: dict[str, Any], size: tuple[int, int]) -> Camera:
    """The pinhole camera of one frame; a frame's own intrinsics go before the common ones."""
    for name in ("k1", "k2", "k3", "k4", "p1", "p2"):
        if number(entry.get(name, 0.0), name) != 0:
            raise CaptureError(f"the lens distortion {name} is not zero", "undistort the pictures")
    for name, length in (("w", size[0]), ("h", size[1])):
        if number(entry.get(name, length), name) != length:
            raise CaptureError(
                f"{name} is {str(entry[name])[:20]}, the picture has {length}", f"correct {name}"
            )
    matrix = read_transform(entry.get("transform_matrix"), "transform_matrix")
    return Camera(
        focal=(
            number(entry.get("fl_x"), "fl_x", 1e-3, 1e6),
            number(entry.get("fl_y", entry.get("fl_x")), "fl_y", 1e-3, 1e6),
        ),
        center=(
            number(entry.get("cx"), "cx", -1e6, 1e6),
            number(entry.get("cy"), "cy", -1e6, 1e6),
        ),
        width=size[0],
        height=size[1],
        camera_from_world=opencv_from_opengl(matrix),
    )


def read_transform(value: object, label: str) -> np.ndarray:
    """A rigid matrix of 4 x 4.

    Args:
        value: nested lists, as JSON has them.
        label: what it is, for the message.

    Raises:
        CaptureError: it is none.
    """
    matrix = numbers(value, (4, 4), label)
    rotation = matrix[:3, :3]
    is_rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    if not is_rigid or np.linalg.det(rotation) < 0 or list(matrix[3]) != [0, 0, 0, 1]:
        raise CaptureError(
            f"{label} is not a rotation and a translation",
            "its upper left 3 x 3 must be orthonormal, its last row 0 0 0 1",
        )
    return matrix


def _size_of_picture(path: Path, modes: tuple[str, ...]) -> tuple[int, int]:
    """Width and height by the header alone."""
    with open_picture(path) as picture:
        if picture.mode not in modes:
            raise CaptureError(
                f"{path.name} has channels {picture.mode}, expected {' or '.join(modes)}",
                "save pictures as 8-bit RGB without alpha, masks as 8-bit grey",
            )
        if is_to_be_turned(picture):
            raise CaptureError(
                f"{path.name} says that it is to be turned or mirrored before it is shown (EXIF)",
                "turn its pixels as mask, camera and pose have them, and save it without that tag",
            )
        return picture.size


def _pixels(
    folder: Path, relative: str, size: tuple[int, int], modes: tuple[str, ...], frame: str
) -> np.ndarray:
    try:
        path = path_inside(folder, relative)
        if _size_of_picture(path, modes) != size:
            raise CaptureError("the picture changed since it was checked", "read the capture again")
        return decoded(open_picture(path), relative)
    except CaptureError as error:
        raise CaptureError(f"frame {frame}: {error.what}", error.remedy) from error


class CaptureWriter:
    """Writes a capture aside and puts it in place only when it is whole.

    Used in a ``with`` block: frames go into a temporary folder beside the target; leaving the
    block reads the result back and renames it, leaving it by an exception removes it.
    """

    def __init__(
        self,
        folder: Path,
        *,
        rig_name: str,
        rig_sha256: str,
        subject: str,
        source: str,
        licence: str,
        side: str = "right",
        shape_coefficients: Float[Tensor, "shapes"] | None = None,
        overwrite: bool = False,
        inputs: Iterable[Path] = (),
    ) -> None:
        """Refuses a folder that is in use before any work is done.

        Args:
            folder: where the capture is to be.
            rig_name: the rig the poses belong to.
            rig_sha256: its fingerprint.
            subject: whose hand.
            source: where the pictures come from.
            licence: under which terms.
            side: ``left`` if what is written was mirrored.
            shape_coefficients: of the rig, or None if they are not known.
            overwrite: replace a capture that is already there; never any other folder, nor one
                that holds files which the program has not written.
            inputs: files and folders that the capture is made from; ``folder`` may not hold them.

        Raises:
            CaptureError: if ``folder`` holds something that may not be replaced.
        """
        self.folder = Path(folder).absolute()
        self._overwrite = overwrite
        self._header = {
            "schema": SCHEMA,
            "rig": {"name": rig_name, "sha256": rig_sha256},
            "side": side,
            "subject": subject,
            "color_space": "srgb",
            "source": source,
            "licence": licence,
        }
        if shape_coefficients is not None:
            self._header["shape_coefficients"] = shape_coefficients.double().tolist()
        self._entries: list[dict[str, Any]] = []
        self._covariances: list[Tensor | None] = []
        self._landmarks: list[LandmarkSightings | None] = []
        self._inputs = tuple(inputs)
        with _folder_errors():
            restore_folder(self.folder)
            refuse_folder_in_use(self.folder, CAPTURE, overwrite, self._inputs)

    def __enter__(self) -> "CaptureWriter":
        """Makes the folder that takes the capture's place when it is whole."""
        with ExitStack() as whole:
            whole.enter_context(_folder_errors())
            filled = fill_folder(self.folder, CAPTURE, self._overwrite, self._inputs)
            self._aside = whole.enter_context(filled)
            whole.push(self._finish)
            self._whole = whole.pop_all()
        return self

    def file(self, relative: str) -> Path:
        """Where to write a further file of the capture, such as ``truth/albedo/000000.png``."""
        path = self._aside / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def add(self, frame: Frame) -> None:
        """Writes one frame's picture and mask.

        Raises:
            CaptureError: if a number is not finite or its name is no plain file name.
        """
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,100}", frame.name):
            raise CaptureError(f"{frame.name!r} is no name for a frame", "use letters and digits")
        image_path, mask_path = f"images/{frame.name}.png", f"masks/{frame.name}.png"
        if any(entry["file_path"] == image_path for entry in self._entries):
            raise CaptureError(f"two frames are named {frame.name}", "number the frames")
        pose = {
            "rotations": frame.pose.rotations.detach().cpu().double(),
            "translation": frame.pose.translation.detach().cpu().double(),
        }
        frame.require_finite()
        Image.fromarray(frame.image.cpu().numpy()).save(self.file(image_path))
        Image.fromarray(frame.coverage.cpu().numpy()).save(self.file(mask_path))
        said: dict[str, Any] = {}
        if not bool(frame.known.all()):
            said["known_path"] = f"known/{frame.name}.png"
            known = frame.known.byte().cpu().numpy() * np.uint8(255)
            Image.fromarray(known).save(self.file(said["known_path"]))
        if frame.clip:
            said["clip"] = frame.clip
        if not bool((frame.gain == 1).all()):
            said["gain"] = frame.gain.double().tolist()
        self._covariances.append(frame.covariance)
        self._landmarks.append(frame.landmarks)
        camera = frame.camera
        self._entries.append(
            {
                "file_path": image_path,
                "mask_path": mask_path,
                **said,
                "fl_x": camera.focal[0],
                "fl_y": camera.focal[1],
                "cx": camera.center[0],
                "cy": camera.center[1],
                "w": camera.width,
                "h": camera.height,
                "transform_matrix": opengl_from_opencv(camera.camera_from_world).tolist(),
                "split": frame.split,
                "time": frame.time,
                "hand": {
                    **{name: value.tolist() for name, value in pose.items()},
                    "confidence": frame.confidence,
                },
            }
        )

    def __exit__(self, *raised: Any) -> None:
        """Puts the whole capture in place, or removes what there is of it."""
        self._whole.__exit__(*raised)

    def _finish(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            return
        content = {
            "camera_model": "OPENCV",
            "handavatar": self._header,
            "frames": self._entries,
        }
        try:
            text = json.dumps(content, allow_nan=False)
        except ValueError as error:
            raise CaptureError("a camera or time is not finite", "drop the frame") from error
        covariances = self._of_all_frames(self._covariances, "a covariance")
        if covariances:
            self._write_tensors(COVARIANCES, {"covariance": _stacked(covariances)})
        landmarks = self._of_all_frames(self._landmarks, "landmarks")
        if landmarks:
            tensors = {
                name: _stacked([getattr(seen, name) for seen in landmarks])
                for name in _landmark_shapes(len(landmarks[0].vertices))
            }
            self._write_tensors(LANDMARKS, tensors)
        write_atomically({self.file("transforms.json"): text.encode()}, is_durable=False)
        read_capture(self._aside)

    def _write_tensors(self, name: str, tensors: dict[str, Tensor]) -> None:
        write_atomically({self.file(name): save(tensors)}, is_durable=False)

    def _of_all_frames(self, values: list[Said | None], what: str) -> list[Said]:
        """What the frames say; either all of them say it or none."""
        found = [value for value in values if value is not None]
        if found and len(found) != len(self._entries):
            raise CaptureError(
                f"{len(found)} of {len(self._entries)} frames have {what}",
                f"give all frames {what}, or none",
            )
        return found


@contextmanager
def _folder_errors() -> Iterator[None]:
    """A place that cannot be written is an error of captures, too."""
    try:
        yield
    except FolderInUse as error:
        raise CaptureError(error.found, error.remedy) from error


def _stacked(values: list[Tensor]) -> Tensor:
    return torch.stack(values).detach().cpu().float().contiguous()


def write_capture(folder: Path, frames: Iterable[Frame], **header: Any) -> Capture:
    """Writes a whole capture; ``header`` as the keyword arguments of :class:`CaptureWriter`."""
    with CaptureWriter(folder, **header) as writer:
        for frame in frames:
            writer.add(frame)
    return read_capture(folder)
