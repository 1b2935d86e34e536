"""A sound capture made worse on purpose, as trackers, maskers and cameras make captures worse.

The truth of the source stays with the result; the true poses are added to it as a motion file,
``truth/poses.json``, frame by frame.
"""

import io
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageFilter
from scipy.ndimage import binary_erosion

from handavatar.capture.checks import CaptureError
from handavatar.capture.frames import Capture, CaptureWriter, Frame, read_capture
from handavatar.capture.motion import Motion, write_motion
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import HandPose

_TRACKED = 0.5
"""Confidence of poses that are no longer exact."""
_MILLIMETRES_PER_DEGREE = 0.5
"""A tracker that is off by some degrees is off by as many half millimetres."""


@dataclass(frozen=True)
class DegradeOptions:
    """What to make worse, and by how much.

    Attributes:
        source: folder of the capture.
        pose_noise: degrees (root mean square) by which every joint of every frame is turned about
            a random axis; the hand moves by half a millimetre per degree as well, each way.
        mask_erosion: pixels that the masks lose all around.
        blur: standard deviation of a Gaussian over the pictures, pixels.
        jpeg: quality of a JPEG in between, 1 to 95; 100 leaves it out.
        seed: of the noise.
    """

    source: Path
    pose_noise: float = 0.0
    mask_erosion: int = 0
    blur: float = 0.0
    jpeg: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses what would make a capture better, or nothing of it."""
        limits = {
            "pose_noise": (0, 45),
            "mask_erosion": (0, 64),
            "blur": (0, 32),
            "jpeg": (1, 100),
        }
        for name, (least, most) in limits.items():
            if not least <= getattr(self, name) <= most:
                raise CaptureError(
                    f"{name} is {getattr(self, name)}, expected {least} to {most}",
                    "choose a value between",
                )


def degrade_capture(folder: Path, options: DegradeOptions, overwrite: bool = False) -> Capture:
    """Writes a worse copy of a capture.

    Args:
        folder: where the copy is to be.
        options: the source, and what happens to it.
        overwrite: replace a capture that is there.

    Raises:
        CaptureError: if the source is damaged or the folder is in use.
    """
    source = read_capture(options.source)
    random = np.random.default_rng([options.seed, 4711])
    writer = CaptureWriter(
        folder,
        rig_name=source.rig_name,
        rig_sha256=source.rig_sha256,
        subject=source.subject,
        source=f"{source.source}; degraded, seed {options.seed}",
        licence=source.licence,
        side=source.side,
        shape_coefficients=source.shape_coefficients,
        overwrite=overwrite,
        inputs=(source.folder,),
    )
    with writer:
        frames = [source.frame(index) for index in range(len(source.records))]
        for frame in frames:
            writer.add(_degraded(frame, options, random))
        if (source.folder / "truth").is_dir():
            shutil.copytree(
                source.folder / "truth", writer.file("truth/poses.json").parent, dirs_exist_ok=True
            )
        motion = Motion(
            1.0,
            torch.stack([frame.pose.rotations for frame in frames]),
            torch.stack([frame.pose.translation for frame in frames]),
        )
        write_motion(writer.file("truth/poses.json"), motion)
        # Its name and not where it lies: the same bits wherever they are made.
        facts = {
            **asdict(options),
            "source": source.folder.resolve().name,
            "source_sha256": source.sha256,
        }
        writer.file("truth/degraded.json").write_text(json.dumps(facts, indent=1), "utf-8")
    return read_capture(folder)


def _degraded(frame: Frame, options: DegradeOptions, random: np.random.Generator) -> Frame:
    picture = Image.fromarray(frame.image.numpy())
    if options.blur:
        picture = picture.filter(ImageFilter.GaussianBlur(options.blur))
    if options.jpeg < 100:
        stream = io.BytesIO()
        picture.save(stream, "JPEG", quality=options.jpeg)
        picture = Image.open(stream)
    coverage = frame.coverage.numpy()
    if options.mask_erosion:
        reach = options.mask_erosion
        disc = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach
        coverage = np.where(binary_erosion(coverage > 127, disc), 255, 0).astype(np.uint8)
    return Frame(
        name=frame.name,
        image=torch.from_numpy(np.array(picture)),
        coverage=torch.from_numpy(coverage),
        camera=frame.camera,
        pose=_misread(frame.pose, options.pose_noise, random),
        confidence=min(frame.confidence, _TRACKED) if options.pose_noise else frame.confidence,
        split=frame.split,
        time=frame.time,
        known=frame.known,
        gain=frame.gain,
    )


def _misread(pose: HandPose, degrees: float, random: np.random.Generator) -> HandPose:
    """Turns every joint by a random rotation vector of that root mean square length."""
    if not degrees:
        return pose
    bones = len(pose.rotations)
    turns = np.deg2rad(degrees) / np.sqrt(3) * random.standard_normal((bones, 3))
    shift = _MILLIMETRES_PER_DEGREE * 1e-3 * degrees * random.standard_normal(3)
    turned = matrix_from_axis_angle(pose.rotations.double()) @ matrix_from_axis_angle(
        torch.from_numpy(turns)
    )
    return HandPose(
        axis_angle_from_matrix(turned).to(pose.rotations),
        pose.translation + torch.from_numpy(shift).to(pose.translation),
    )
