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

from handavatar.capture.frames import Capture, CaptureWriter, Frame, read_capture
from handavatar.capture.motion import Motion, write_motion
from handavatar.errors import SEEDS, require_ranges
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.pose import HandPose
from handavatar.jobs.progress import SILENT, Progress

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
        pose_noise_correlation: seconds after which that noise has forgotten itself to 1 / e, as
            trackers err for a while in the same way (an Ornstein-Uhlenbeck process along the times
            of the frames); 0 draws every frame anew. The root mean square is the same.
        mask_erosion: pixels that the masks lose all around.
        blur: standard deviation of a Gaussian over the pictures, pixels.
        jpeg: quality of a JPEG in between, 1 to 95; 100 leaves it out.
        seed: of the noise.
    """

    source: Path
    pose_noise: float = 0.0
    pose_noise_correlation: float = 0.0
    mask_erosion: int = 0
    blur: float = 0.0
    jpeg: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses what would make a capture better, or nothing of it."""
        require_ranges(
            self,
            pose_noise=(0, 45),
            pose_noise_correlation=(0, 3600),
            mask_erosion=(0, 64),
            blur=(0, 32),
            jpeg=(1, 100),
            seed=SEEDS,
        )


def degrade_capture(
    folder: Path,
    options: DegradeOptions,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Capture:
    """Writes a worse copy of a capture.

    Args:
        folder: where the copy is to be.
        options: the source, and what happens to it.
        overwrite: replace a capture that is there.
        progress: told the frames done.

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
        noise = _PoseNoise(options, random)
        for index in range(len(source.records)):
            writer.add(_degraded(source.frame(index), options, noise))
            progress(index + 1, len(source.records))
        if (source.folder / "truth").is_dir():
            shutil.copytree(
                source.folder / "truth", writer.file("truth/poses.json").parent, dirs_exist_ok=True
            )
        motion = Motion(
            1.0,
            torch.stack([record.pose.rotations for record in source.records]),
            torch.stack([record.pose.translation for record in source.records]),
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


def _degraded(frame: Frame, options: DegradeOptions, noise: "_PoseNoise") -> Frame:
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
        pose=noise.misread(frame),
        confidence=min(frame.confidence, _TRACKED) if options.pose_noise else frame.confidence,
        split=frame.split,
        time=frame.time,
        known=frame.known,
        gain=frame.gain,
    )


class _PoseNoise:
    """Errors of poses, frame after frame."""

    def __init__(self, options: DegradeOptions, random: np.random.Generator) -> None:
        self._degrees = options.pose_noise
        self._correlation = options.pose_noise_correlation
        self._random = random
        self._last: np.ndarray | None = None
        self._time = 0.0

    def misread(self, frame: Frame) -> HandPose:
        """Turns every joint by a random rotation vector of that root mean square length."""
        pose = frame.pose
        if not self._degrees:
            return pose
        bones = len(pose.rotations)
        drawn = self._drawn(bones, frame)
        turns = np.deg2rad(self._degrees) / np.sqrt(3) * drawn[:bones]
        shift = _MILLIMETRES_PER_DEGREE * 1e-3 * self._degrees * drawn[bones]
        turned = matrix_from_axis_angle(pose.rotations.double()) @ matrix_from_axis_angle(
            torch.from_numpy(turns)
        )
        return HandPose(
            axis_angle_from_matrix(turned).to(pose.rotations),
            pose.translation + torch.from_numpy(shift).to(pose.translation),
        )

    def _drawn(self, bones: int, frame: Frame) -> np.ndarray:
        """Standard normal numbers: three for every bone, and three for the translation."""
        fresh = np.concatenate(
            [self._random.standard_normal((bones, 3)), self._random.standard_normal((1, 3))]
        )
        if not self._correlation:
            return fresh
        if self._last is not None:
            kept = float(np.exp(-abs(frame.time - self._time) / self._correlation))
            fresh = kept * self._last + np.sqrt(1 - kept**2) * fresh
        self._last, self._time = fresh, frame.time
        return fresh
