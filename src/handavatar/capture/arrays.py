"""Captures of arrays: pictures, masks, cameras and poses that another program holds in memory."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from handavatar.capture.frames import Capture, CaptureWriter, Frame, read_capture
from handavatar.errors import ArgumentError
from handavatar.geometry.cameras import Camera
from handavatar.geometry.tensors import require_tensor
from handavatar.hand.pose import NUM_BONES, HandPose
from handavatar.hand.rigs import load_rig

Array = np.ndarray | Tensor
"""NumPy's or torch's, on any device, with or without gradient."""


def capture_from_arrays(
    folder: Path | str,
    images: Array | Sequence[Array],
    masks: Array | Sequence[Array],
    intrinsics: Array,
    rotations: Array,
    translations: Array,
    camera_from_world: Array | None = None,
    *,
    splits: Sequence[str] | None = None,
    times: Array | Sequence[float] | None = None,
    known: Array | Sequence[Array] | None = None,
    shape_coefficients: Array | None = None,
    rig: str = "open-hand",
    side: str = "right",
    confidence: float = 1.0,
    subject: str = "unnamed",
    source: str = "arrays",
    licence: str = "not said",
    overwrite: bool = False,
) -> Capture:
    """Writes a capture that ``train`` and ``evaluate`` take, from arrays of one length.

    Args:
        folder: where the capture is to be.
        images: frames height width 3, sRGB; levels of 8 bits, or floats in [0, 1].
        masks: frames height width, what of each pixel the hand covers; booleans, floats in [0, 1]
            or levels of 8 bits.
        intrinsics: 3 3, or one for each frame: pixels, the first pixel's centre at (0.5, 0.5).
        rotations: frames 16 3, axis-angle, radians, of the bones of the rig against their parents
            (``hand.pose.BONE_NAMES``).
        translations: frames 3, metres, world.
        camera_from_world: 4 4, or one for each frame: metres, OpenCV camera axes (x right, y down,
            z forward). The camera's axes are the world's if it is left out.
        splits: ``train``, ``val`` or ``test`` of each frame; if left out every fifth is ``test``.
        times: seconds of each frame; thirty frames a second if left out.
        known: frames height width; false where neither hand nor background can be told.
        shape_coefficients: of the rig; not known if left out.
        rig: to which the poses belong.
        side: ``left`` if pictures and poses were mirrored to those of a right hand.
        confidence: in the poses; with less than 1 training corrects them.
        subject: whose hand.
        source: where the pictures come from.
        licence: under which terms.
        overwrite: replace a capture that is already there.

    Raises:
        ArgumentError: an array is of another kind, length or size, or out of its range; the error
            names it.
        CaptureError: the folder holds something that may not be replaced.
        RigError: there is no such rig.
    """
    count = len(images)
    if count < 1:
        raise ArgumentError("images", "none", "at least one")
    lens = _one_each("intrinsics", intrinsics, count, (3, 3))
    views = torch.eye(4) if camera_from_world is None else camera_from_world
    views = _one_each("camera_from_world", views, count, (4, 4))
    turns = _floats("rotations", rotations, (count, NUM_BONES, 3))
    places = _floats("translations", translations, (count, 3))
    if splits is None:
        splits = ["test" if number % 5 == 4 else "train" for number in range(count)]
    seconds = [number / 30 for number in range(count)] if times is None else list(times)
    lists = {"masks": masks, "splits": splits, "times": seconds, "known": known}
    for name, values in lists.items():
        if values is not None and len(values) != count:
            raise ArgumentError(name, str(len(values)), f"as many as images, {count}")
    wanted = load_rig(rig)
    with CaptureWriter(
        Path(folder),
        rig_name=wanted.name,
        rig_sha256=wanted.sha256,
        subject=subject,
        source=source,
        licence=licence,
        side=side,
        shape_coefficients=(
            None
            if shape_coefficients is None
            else _floats(
                "shape_coefficients", shape_coefficients, (wanted.shape_directions.shape[-1],)
            )
        ),
        overwrite=overwrite,
    ) as writer:
        for number in range(count):
            image = image_from_array(f"images[{number}]", images[number])
            height, width = image.shape[:2]
            is_known = torch.ones(height, width, dtype=torch.bool)
            if known is not None:
                is_known = _booleans(f"known[{number}]", known[number])
            writer.add(
                Frame(
                    name=f"{number:06d}",
                    image=image,
                    coverage=coverage_from_array(f"masks[{number}]", masks[number]),
                    camera=camera_from_matrices(lens[number], views[number], width, height),
                    pose=HandPose(turns[number], places[number]),
                    confidence=confidence,
                    split=splits[number],
                    time=float(seconds[number]),
                    known=is_known,
                )
            )
    return read_capture(Path(folder))


def camera_from_matrices(
    intrinsics: Float[Tensor, "3 3"],
    camera_from_world: Float[Tensor, "4 4"],
    width: int,
    height: int,
) -> Camera:
    """A camera of the usual matrices.

    Args:
        intrinsics: pixels, the first pixel's centre at (0.5, 0.5); without skew.
        camera_from_world: metres, OpenCV camera axes.
        width: of the picture, pixels.
        height: of the picture, pixels.

    Raises:
        ArgumentError: if the first is no pinhole's, or the second is not rigid.
    """
    require_tensor("intrinsics", intrinsics, (3, 3))
    values = intrinsics.detach().double().cpu()
    expected = torch.tensor([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]], dtype=torch.float64)
    if bool((values[expected == 0] != 0).any()) or float(values[2, 2]) != 1:
        raise ArgumentError(
            "intrinsics", str(values.tolist()), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels"
        )
    return Camera(
        (float(values[0, 0]), float(values[1, 1])),
        (float(values[0, 2]), float(values[1, 2])),
        width,
        height,
        camera_from_world,
    )


def image_from_array(name: str, value: Array) -> UInt8[Tensor, "height width 3"]:
    """A picture of 8 bits.

    Args:
        name: of the argument.
        value: height width 3, sRGB: levels of 8 bits, or floats in [0, 1].

    Raises:
        ArgumentError: if it is none.
    """
    found = _levels(name, _tensor(name, value))
    require_tensor(name, found, (-1, -1, 3), torch.uint8)
    return found


def coverage_from_array(name: str, value: Array) -> UInt8[Tensor, "height width"]:
    """How much of each pixel the hand covers, 255 for all of it.

    Args:
        name: of the argument.
        value: height width: booleans, floats in [0, 1], or levels of 8 bits.

    Raises:
        ArgumentError: if it is none, or holds levels up to 1 alone.
    """
    found = _tensor(name, value)
    if found.dtype == torch.bool:
        found = found.byte() * 255
    elif found.dtype == torch.uint8 and int(found.max() if found.numel() else 0) == 1:
        raise ArgumentError(
            name, "levels of 0 and 1", "levels to 255, or booleans", "hand in `mask > 0`"
        )
    found = _levels(name, found)
    require_tensor(name, found, (-1, -1), torch.uint8)
    return found


def _booleans(name: str, value: Array) -> Bool[Tensor, "height width"]:
    found = _tensor(name, value)
    require_tensor(name, found, (-1, -1), torch.bool)
    return found


def _levels(name: str, value: Tensor) -> Tensor:
    """Floats in [0, 1] as levels of 8 bits; other kinds as they are."""
    if not value.is_floating_point():
        return value
    low, high = (float(value.min()), float(value.max())) if value.numel() else (0.0, 0.0)
    if not (low >= 0 and high <= 1):
        raise ArgumentError(
            name, f"floats from {low:.4g} to {high:.4g}", "floats in [0, 1], or levels of 8 bits"
        )
    return (value * 255).round().to(torch.uint8)


def _floats(name: str, value: Array, shape: tuple[int, ...]) -> Tensor:
    found = _tensor(name, value)
    found = found.float() if found.dtype == torch.float64 else found
    require_tensor(name, found, shape, torch.float32)
    return found


def _one_each(name: str, value: Array, count: int, shape: tuple[int, int]) -> Tensor:
    found = _tensor(name, value)
    found = found.expand(count, *found.shape) if found.ndim == len(shape) else found
    return _floats(name, found, (count, *shape))


def _tensor(name: str, value: Array) -> Tensor:
    """On the CPU, without gradient, its memory its own."""
    if isinstance(value, np.ndarray):
        # A copy: turned pictures have negative strides, which torch does not know.
        return torch.from_numpy(np.ascontiguousarray(value).copy())
    if isinstance(value, Tensor):
        return value.detach().cpu()
    raise ArgumentError(name, type(value).__name__, "an array of NumPy or torch")
