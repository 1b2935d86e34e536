"""Made videos: a subject's hand moves naturally before a background, as a phone would record it.

The hand and its forearm are one skin, lit by a lamp with soft shadows and by light from everywhere.
Exposure and white balance drift, motion blurs, the sensor makes noise, and H.264 compresses. The
truth lies beside the video, see :mod:`handavatar.synthetic.truth`.
"""

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from safetensors.torch import save
from scipy import ndimage
from torch import Tensor

from handavatar.capture.motion import MOTIONS, Motion, gesture, placed
from handavatar.capture.synthetic import SynthOptions, make_subject
from handavatar.errors import require_ranges
from handavatar.geometry.cameras import Camera, project
from handavatar.geometry.colors import srgb_from_linear
from handavatar.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    rotations_between,
)
from handavatar.hand.detail import subdivided
from handavatar.hand.pose import FINGER_BONES, HandPose
from handavatar.hand.pose_sampling import (
    interpolate_rotations,
    resolve_penetration,
    sample_poses,
)
from handavatar.hand.rig import Rig
from handavatar.hand.rigs import load_rig
from handavatar.jobs.files import write_atomically
from handavatar.jobs.progress import SILENT, Progress
from handavatar.jobs.video_writer import VideoWriter
from handavatar.render.rasterize import rasterize_projected
from handavatar.synthetic.actor import Actor, Lights, PosedActor, draw_lights
from handavatar.synthetic.backgrounds import Background, paint_background
from handavatar.synthetic.truth import SCHEMA, encoded_masks

# A pixel is looked at from several places, at as many moments of the exposure.
_PLACES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
_MASK_SCALE = 2
_SHADOW_STEP = 4
# Fingers up, palm to the camera, of a hand whose fingers lie along -x and whose back is +y.
_PALM_VIEW = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_NOT_YET_SMOOTH = 0.7
_TAKES_APART = 7919


@dataclass(frozen=True)
class FilmOptions:
    """A made video."""

    name: str
    """name of the files"""
    seed: int
    """subject, skin, light, motion, noise"""
    tone: float = 0.35
    """skin: 0 very light to 1 very dark"""
    gestures: tuple[str, ...] = MOTIONS["gestures"]
    """what the fingers pass through; free poses come between"""
    view: Literal["palm", "back", "turn"] = "palm"
    """which side is seen; turn begins with the palm and ends with the back"""
    background: Background = "plain"
    """what stands behind the hand"""
    sleeved: bool = False
    """whether a sleeve covers the forearm"""
    leaves: bool = False
    """whether the hand leaves the picture in part, for a part of the time"""
    width: int = 640
    """pixels"""
    height: int = 480
    """pixels"""
    seconds: float = 6.0
    """length"""
    fps: float = 15.0
    """pictures per second"""
    focal_share: float = 1.0
    """focal length over the longer side of the picture"""
    distance: float = 0.40
    """of the hand from the camera, metres"""
    shutter: float = 0.35
    """share of the time between two pictures in which light falls in"""
    drift: float = 0.12
    """by which exposure drifts, either way; white balance by a third of it"""
    noise: float = 2.2
    """deviation of the sensor's noise, of 255"""
    crf: int = 21
    """of H.264: how coarse it is"""
    personal: float = 0.5
    """strength of the displacement that shape coefficients cannot express"""
    rig: str = "open-hand"
    """the hand"""
    take: int = 0
    """another recording of the same subject: its own light, motion, background and noise"""

    def __post_init__(self) -> None:
        """Refuses what cannot be made."""
        require_ranges(
            self,
            width=(96, 1920),
            height=(96, 1920),
            seconds=(0.5, 60),
            fps=(1, 120),
            shutter=(0, 1),
        )

    @property
    def num_frames(self) -> int:
        """Pictures of the film."""
        return round(self.seconds * self.fps)

    def random(self, purpose: int) -> np.random.Generator:
        """Random numbers of this take for one purpose."""
        # The first take is as films were before there were others.
        return np.random.default_rng([self.seed, purpose, *([self.take] if self.take else [])])


FILMS: tuple[FilmOptions, ...] = (
    FilmOptions("palm_plain", 21, 0.2, MOTIONS["gestures"], "palm", "plain"),
    FilmOptions(
        "back_wood",
        22,
        0.5,
        ("relaxed", "spread", "four", "three", "victory", "point", "loose_fist", "flat"),
        "back",
        "wood",
        sleeved=True,
        focal_share=0.85,
        distance=0.36,
    ),
    FilmOptions(
        "turn_room",
        23,
        0.35,
        ("spread", "relaxed", "flat", "claw", "loose_fist", "spread", "relaxed"),
        "turn",
        "room",
        width=480,
        height=640,
        focal_share=1.1,
        distance=0.46,
    ),
    FilmOptions(
        "skin_wall",
        24,
        0.3,
        ("relaxed", "pinch", "thumb_to_middle", "ok", "spread", "purse", "relaxed"),
        "palm",
        "skin",
        sleeved=True,
        distance=0.38,
    ),
    FilmOptions(
        "border_cloth",
        25,
        0.75,
        ("spread", "wave_low", "flat", "wave_high", "relaxed", "shaka", "spread"),
        "palm",
        "cloth",
        leaves=True,
        focal_share=0.95,
        distance=0.36,
    ),
    FilmOptions(
        "dark_room",
        26,
        0.95,
        ("relaxed", "thumbs_up", "fist", "gun", "spread", "hook", "flat"),
        "back",
        "room",
        width=640,
        height=640,
        focal_share=0.9,
        distance=0.36,
    ),
)
"""The films of ``handavatar bench --table registration``."""


def make_film(options: FilmOptions, folder: Path, progress: Progress = SILENT) -> Path:
    """Renders a film and its truth.

    Args:
        options: which.
        folder: where ``NAME.mp4``, ``NAME.json`` and ``NAME.safetensors`` are to be.
        progress: told the number of pictures that are done.

    Returns:
        The path of the video.

    Raises:
        CaptureError: a gesture that is not known.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{options.name}.mp4"
    base = load_rig(options.rig)
    stage = _Stage(options, base)
    masks = []
    with VideoWriter(path, options.fps, options.height, options.width, options.crf) as recorder:
        for frame in range(options.num_frames):
            picture, mask = stage.frame(frame)
            recorder.add(picture)
            masks.append(mask)
            progress(frame + 1, options.num_frames)
        # The video is there last: who finds it finds the truth as well.
        _write_truth(path, options, base, stage, masks)
    return path


def _write_truth(
    path: Path, options: FilmOptions, base: Rig, stage: "_Stage", masks: list[np.ndarray]
) -> None:
    data, ends = encoded_masks(masks)
    arrays = {
        "rotations": stage.motion.rotations,
        "translations": stage.motion.translations,
        "shape_coefficients": stage.actor.subject.shape_coefficients,
        "rest_vertices": stage.actor.subject.rest_vertices[: base.num_vertices],
        "gains": stage.gains,
        "inside": torch.tensor([stage.inside(frame) for frame in range(options.num_frames)]),
        "mask_bytes": data,
        "mask_ends": ends,
    }
    facts = {
        "schema": SCHEMA,
        "rig_name": base.name,
        "rig_sha256": base.sha256,
        "size": [options.width, options.height],
        "focal": stage.camera.focal[0],
        "center": list(stage.camera.center),
        "fps": options.fps,
        "options": asdict(options),
    }
    write_atomically(
        {
            path.with_suffix(".safetensors"): save({k: v.contiguous() for k, v in arrays.items()}),
            path.with_suffix(".json"): json.dumps(facts, indent=1).encode(),
        }
    )


def natural_motion(rig: Rig, options: FilmOptions) -> Motion:
    """Poses of every picture, in camera axes: fingers that do not all move at once, a moving wrist.

    Args:
        rig: whose joints move.
        options: gestures, view, length.
    """
    random = options.random(31)
    generator = torch.Generator().manual_seed(options.seed + _TAKES_APART * options.take)
    frames = options.num_frames
    keys = [gesture(rig, name) for name in options.gestures]
    for index, pose in enumerate(sample_poses(rig, 2, generator)):
        keys.insert(3 * index + 2, pose)
    last = len(keys) - 1
    share = torch.linspace(0, 1, frames)
    fingers = torch.zeros(frames, len(keys[0]), 3)
    for bones in FINGER_BONES.values():
        # Each finger is a little early or late.
        late = 0.09 * float(random.standard_normal())
        moved = interpolate_rotations(torch.stack(keys), share * last - late)
        fingers[:, list(bones)] = moved[:, list(bones)]
    fingers = resolve_penetration(rig, fingers)
    fingers = torch.from_numpy(
        ndimage.gaussian_filter1d(fingers.numpy(), _NOT_YET_SMOOTH, axis=0, mode="nearest")
    )

    def wave(reach: float, period: float) -> Tensor:
        """A slow movement with a faster one on it."""
        time = share * options.seconds
        first, second = random.uniform(0, 2 * math.pi, 2)
        slow = torch.sin(2 * math.pi * time / period + first)
        return reach * (0.8 * slow + 0.2 * torch.sin(2 * math.pi * time / (0.37 * period) + second))

    to_back = {
        "palm": torch.zeros(frames),
        "back": torch.full((frames,), 180.0),
        "turn": 180 * _eased((share - 0.38) / 0.24),
    }[options.view]
    yaw, pitch, roll = wave(28.0, 3.9), wave(20.0, 3.1), wave(16.0, 4.7) + random.uniform(-14, 14)
    axes = torch.eye(3)
    about = [
        matrix_from_axis_angle(angle.deg2rad()[:, None] * axis)
        for angle, axis in ((roll, axes[2]), (pitch, axes[0]), (to_back + yaw, axes[0]))
    ]
    wrist = about[0] @ about[1] @ torch.tensor(_PALM_VIEW) @ about[2]
    room = options.distance / options.focal_share / max(options.width, options.height)
    middle = torch.stack(
        [
            wave(0.035, 4.3),
            wave(0.022, 3.3) + 0.04 * room * options.height,
            options.distance + wave(0.035, 5.3),
        ],
        dim=-1,
    )
    if options.leaves:
        # To one side until about half the hand is out, and back.
        gone = _eased((share - 0.3) / 0.2) * _eased((0.8 - share) / 0.2)
        middle[:, 0] += gone * 0.46 * room * options.width
    return placed(rig, fingers, wrist, middle, options.fps)


def _eased(share: Tensor) -> Tensor:
    share = share.clamp(0, 1)
    return share * share * (3 - 2 * share)


def drifting_gains(options: FilmOptions) -> Float[Tensor, "frames 3"]:
    """Exposure times white balance of every picture: factors of linear light, 1 in the mean."""
    random = options.random(32)
    time = np.arange(options.num_frames) / options.fps
    phases = random.uniform(0, 2 * np.pi, 4)
    exposure = 0.7 * np.sin(2 * np.pi * time / 5.1 + phases[0])
    exposure += 0.3 * np.sin(2 * np.pi * time / 1.9 + phases[1])
    balance = np.sin(2 * np.pi * time / 6.3 + phases[2])[:, None] * np.array([0.33, 0.0, -0.33])
    logarithm = options.drift * (exposure[:, None] + balance)
    return torch.from_numpy(np.exp(logarithm - logarithm.mean(0))).float()


class _Stage:
    """Actor, light, background and camera of one film."""

    def __init__(self, options: FilmOptions, base: Rig) -> None:
        self.options = options
        random = options.random(33)
        made = SynthOptions(
            seed=options.seed, tone=options.tone, personal=options.personal, subdivisions=1
        )
        subject = make_subject(subdivided(base, 1), made)
        self.actor = Actor(subject, base, options.sleeved, options.seed)
        self.num_vertices = base.num_vertices
        self.motion = natural_motion(base, options)
        self.gains = drifting_gains(options)
        self.lights: Lights = draw_lights(random)
        self.background = paint_background(
            options.background, options.height, options.width, random
        )
        self.wall = options.distance + random.uniform(0.22, 0.4)
        focal = options.focal_share * max(options.width, options.height)
        self.camera = Camera(
            (focal, focal),
            (options.width / 2, options.height / 2),
            options.width,
            options.height,
            torch.eye(4),
        )
        self.elbow_shift = torch.from_numpy(
            np.array([random.uniform(-0.1, 0.1), 0.36, random.uniform(-0.02, 0.1)])
        ).float()
        self.random = random

    def posed(self, frame: int, late: float = 0.0) -> PosedActor:
        """The actor at a frame, or by a share of the time between two pictures later."""
        pose = _pose_between(self.motion, frame + late)
        return self.actor.posed(pose, pose.translation + self.elbow_shift)

    def inside(self, frame: int) -> float:
        """Share of the hand's vertices in the picture."""
        vertices = self.posed(frame).vertices[: self.num_vertices]
        pixels, _ = project(self.camera, vertices)
        size = torch.tensor([self.camera.width, self.camera.height])
        return float(((pixels >= 0) & (pixels <= size)).all(-1).float().mean())

    def mask(self, frame: int) -> UInt8[np.ndarray, "height width"]:
        """How much of each pixel shows the hand in the middle of the exposure."""
        fine = self.camera.resized(
            self.camera.width * _MASK_SCALE, self.camera.height * _MASK_SCALE
        )
        shown = self.actor.is_hand(self.actor.fragments(self.posed(frame), fine)).numpy()
        shape = (self.camera.height, _MASK_SCALE, self.camera.width, _MASK_SCALE)
        return (255 * shown.reshape(shape).mean((1, 3))).round().astype(np.uint8)

    def frame(
        self, frame: int
    ) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"]]:
        """The picture as the sensor gives it, sRGB, and the true mask."""
        options = self.options
        middle = self.posed(frame)
        light = self.actor.light(middle, self.lights)
        background = torch.from_numpy(self.background * self._cast_shadow(middle)[..., None])
        total = torch.zeros_like(background)
        for number, (right, down) in enumerate(_PLACES):
            late = options.shutter * ((number + 0.5) / len(_PLACES) - 0.5)
            actor = self.posed(frame, late)
            camera = replace(
                self.camera,
                center=(self.camera.center[0] - right, self.camera.center[1] - down),
            )
            fragments = self.actor.fragments(actor, camera)
            seen = background.clone()
            seen[fragments.mask] = self.actor.colors(fragments, actor, light, self.lights)
            total += seen
        linear = total / len(_PLACES) * self.gains[frame]
        stored = 255 * srgb_from_linear(linear).numpy()
        noise = self.random.standard_normal(stored.shape) * options.noise
        # Light comes in grains: darker places of a gamma picture are noisier.
        noise *= 1.25 - 0.5 * stored / 255
        return (stored + noise).round().clip(0, 255).astype(np.uint8), self.mask(frame)

    def _cast_shadow(self, actor: PosedActor) -> Float[np.ndarray, "height width"]:
        """What the lamp's shadow of the hand leaves of the light on the wall behind it."""
        height = -(-self.camera.height // _SHADOW_STEP)
        width = -(-self.camera.width // _SHADOW_STEP)
        towards = self.lights.directions[self.lights.key]
        gone = (self.wall - actor.vertices[:, 2:]) / -towards[2]
        on_wall = actor.vertices - towards * gone
        small = self.camera.resized(width, height)
        pixels, depths = project(small, on_wall)
        drawn = rasterize_projected(pixels, depths, self.actor.caster_faces, width, height)
        soft = ndimage.gaussian_filter(drawn.mask.numpy().astype(np.float32), 0.03 * width)
        fine = ndimage.zoom(soft, _SHADOW_STEP, order=1)
        return 1 - 0.4 * fine[: self.camera.height, : self.camera.width]


def _pose_between(motion: Motion, time: float) -> HandPose:
    """The pose at a time in steps of the motion, held at its ends."""
    time = min(max(time, 0.0), len(motion) - 1.0)
    start = min(int(time), max(len(motion) - 2, 0))
    end = min(start + 1, len(motion) - 1)
    share = time - start
    if share == 0:
        return motion.pose(start)
    first, second = (matrix_from_axis_angle(motion.rotations[step]) for step in (start, end))
    return HandPose(
        axis_angle_from_matrix(rotations_between(first, second, share)),
        torch.lerp(motion.translations[start], motion.translations[end], share),
    )
