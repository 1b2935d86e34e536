"""The truth beside a made video: ``NAME.json`` and ``NAME.safetensors`` next to ``NAME.mp4``."""

import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from handavatar.capture.checks import (
    MAX_PIXELS,
    CaptureError,
    decoded,
    load_json,
    number,
    numbers,
    picture_in,
    text_field,
)
from handavatar.errors import raise_if_refused
from handavatar.geometry.cameras import Camera
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rig import PosedHand, Rig, ShapedHand
from handavatar.hand.rigs import find_rig
from handavatar.jobs.finite import find_not_finite

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class FilmTruth:
    """Everything about a made video, frame by frame.

    Attributes:
        name: of the film.
        rig: the hand's; its vertices are those of ``rest_vertices``.
        camera: of all frames; the world is the camera's axes.
        fps: frames per second.
        rotations: axis-angle, radians, in the middle of the exposure.
        translations: metres.
        shape_coefficients: standard deviations; joints follow from them.
        rest_vertices: the subject's skin in the zero pose, metres: that of the coefficients and a
            displacement that no coefficient can express.
        gains: factor of red, green and blue in linear light.
        inside: share of the hand's vertices that project into the picture.
        options: with which the film was made, as JSON.
        mask_bytes: PNG files of the masks, one after the other.
        mask_ends: where each of them ends.
    """

    name: str
    rig: Rig
    camera: Camera
    fps: float
    rotations: Float[Tensor, "frames bones 3"]
    translations: Float[Tensor, "frames 3"]
    shape_coefficients: Float[Tensor, "shapes"]
    rest_vertices: Float[Tensor, "vertices 3"]
    gains: Float[Tensor, "frames 3"]
    inside: Float[Tensor, "frames"]
    options: dict[str, object]
    mask_bytes: UInt8[Tensor, "bytes"]
    mask_ends: Int[Tensor, "frames"]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.rotations)

    def pose(self, frame: int) -> HandPose:
        """The pose in camera axes."""
        return HandPose(self.rotations[frame], self.translations[frame])

    @property
    def rest_hand(self) -> ShapedHand:
        """In the zero pose, metres; the joints are those of the shape coefficients."""
        shaped = self.rig.shaped(self.shape_coefficients)
        return replace(shaped, rest_vertices=self.rest_vertices)

    def posed(self, frame: int) -> PosedHand:
        """The true hand in a frame: its skin in camera axes, metres, and its bones."""
        return self.rest_hand.posed(self.pose(frame))

    def mask(self, frame: int) -> Float[Tensor, "height width"]:
        """How much of each pixel shows the hand, without the forearm, in [0, 1].

        It is that of the middle of the exposure: where the picture is blurred by motion, the mask
        is not.
        """
        start = int(self.mask_ends[frame - 1]) if frame else 0
        encoded = self.mask_bytes[start : int(self.mask_ends[frame])].numpy().tobytes()
        name = f"{self.name}: the mask of frame {frame}"
        grey = decoded(picture_in(io.BytesIO(encoded), name, ("PNG",), MAX_PIXELS), name)
        if grey.shape != (self.camera.height, self.camera.width):
            raise CaptureError(
                f"{self.name}: the mask of frame {frame} has shape {grey.shape}",
                "make the film again",
            )
        return torch.from_numpy(grey).float() / 255


def read_film_truth(path: Path) -> FilmTruth:
    """Reads the truth of a made video.

    Args:
        path: of the video, or of its ``.json``.

    Raises:
        CaptureError: a file is missing or damaged.
    """
    path = Path(path)
    content = load_json(path.with_suffix(".json"))
    if content.get("schema") != SCHEMA:
        raise CaptureError(
            f"{path}: schema is {str(content.get('schema'))[:20]}, this program reads {SCHEMA}",
            "make the film again",
        )
    try:
        arrays = load_file(path.with_suffix(".safetensors"))
        found = {name: arrays[name] for name in _ARRAYS}
    except (OSError, SafetensorError, KeyError) as error:
        raise_if_refused(error)
        raise CaptureError(
            f"{path}: the truth cannot be read ({error})", "make it again"
        ) from error
    rig = find_rig(text_field(content, "rig_sha256"), text_field(content, "rig_name"))
    _check_arrays(found, rig, path)
    size = numbers(content.get("size"), (2,), "size")
    if not (size.min() >= 1 and size.prod() <= MAX_PIXELS):
        raise CaptureError(f"{path}: size is {size.tolist()}", "make the film again")
    focal = number(content.get("focal"), "focal", 1.0, 1e6)
    center = numbers(content.get("center"), (2,), "center")
    options = content.get("options")
    camera = Camera(
        (focal, focal),
        (float(center[0]), float(center[1])),
        int(size[0]),
        int(size[1]),
        torch.eye(4),
    )
    return FilmTruth(
        name=path.stem,
        rig=rig,
        camera=camera,
        fps=number(content.get("fps"), "fps", 0.01, 1000.0),
        options=options if isinstance(options, dict) else {},
        **found,
    )


def _check_arrays(found: dict[str, Tensor], rig: Rig, path: Path) -> None:
    """Refuses arrays that do not fit together, or to the rig."""
    frames = len(found["rotations"]) if found["rotations"].ndim else 0
    shapes = {
        "rotations": (frames, NUM_BONES, 3),
        "translations": (frames, 3),
        "shape_coefficients": (rig.shape_directions.shape[-1],),
        "rest_vertices": (rig.num_vertices, 3),
        "gains": (frames, 3),
        "inside": (frames,),
        "mask_ends": (frames,),
        "mask_bytes": (found["mask_bytes"].numel(),),
    }
    for name, shape in shapes.items():
        is_of_kind = found[name].is_floating_point() != name.startswith("mask_")
        if tuple(found[name].shape) != shape or not is_of_kind:
            raise CaptureError(
                f"{path}: {name} has shape {tuple(found[name].shape)} and type "
                f"{found[name].dtype}, expected {shape}",
                "make the film again",
            )
    if problem := find_not_finite(found):
        raise CaptureError(f"{path}: {problem}", "make the film again")


_ARRAYS = (
    "rotations",
    "translations",
    "shape_coefficients",
    "rest_vertices",
    "gains",
    "inside",
    "mask_bytes",
    "mask_ends",
)


def encoded_masks(
    masks: list[UInt8[np.ndarray, "height width"]],
) -> tuple[UInt8[Tensor, "bytes"], Int[Tensor, "frames"]]:
    """Masks as PNG files, one after the other, and where each ends."""
    parts = []
    for mask in masks:
        stream = io.BytesIO()
        Image.fromarray(mask).save(stream, "PNG")
        parts.append(np.frombuffer(stream.getvalue(), np.uint8))
    ends = torch.tensor([len(part) for part in parts]).cumsum(0)
    return torch.from_numpy(np.concatenate(parts)), ends
